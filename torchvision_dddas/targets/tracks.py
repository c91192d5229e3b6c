"""From detections to identities, one frame at a time."""

from collections.abc import Callable

import numpy as np

from torchvision_dddas.settings import Settings
from torchvision_dddas.types import Detections, Tracks


class Tracker:
    """The state of a run. Feed it frames in order; each call returns the frames that are settled by it, in order.

    A batch run is the same calls one after another, so it gives the same result as a run online.
    """

    def __init__(self, settings: Settings, interval_frames: int, size: tuple[int, int] | None = None) -> None:
        """interval_frames: usual distance of the frames fed. size: (width, height) of the picture, None if unknown."""
        self.settings, self.interval, self.size = settings, interval_frames, size
        self.next_identity = 1

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
    ) -> list[Tracks]:
        """Take the detections of a frame, whose number is above the last one's.

        now_from_before: (3, 3) pixel homography from the frame fed before; None: the camera stood still, or unknown.
        appearance: gives the (N, D) histograms of the boxes; called only where they are needed.
        """
        identity = np.arange(len(detections)) + self.next_identity
        self.next_identity += len(detections)
        return [Tracks(frame, identity, detections.box_px, detections.score, np.arange(len(detections)))]

    def end(self) -> list[Tracks]:
        """The frames that were still waiting."""
        return []
