"""How the camera moved between the frames that are looked at, however far apart they are."""

import numpy as np

from torchvision_dddas.vision.protocol import View, Vision


class Camera:
    """Registers each picture to the one before it. Show it the pictures in order."""

    def __init__(self, vision: Vision) -> None:
        self.vision = vision
        self.last: View | None = None

    def step(self, image: np.ndarray) -> tuple[np.ndarray | None, str]:
        """The (3, 3) homography to this picture from the one before; None where unknown, then with a cause in words."""
        view, before = self.vision.prepare(image), self.last
        self.last = view
        if before is None:
            return None, ""
        (found,) = self.vision.register([(before, view)])
        return (found.later_from_earlier, "") if found.reliable else (None, found.cause)
