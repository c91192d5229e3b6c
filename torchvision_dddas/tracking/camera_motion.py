"""How the camera moved between the frames that are looked at, however far apart they are.

Boxes are carried along with the camera to a fraction of a pixel, and that needs less than masks do: most steps of a
camera that stands still are seen to be nothing on a small picture, and the others are registered on a reduced one.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from torchvision_dddas.detection import Engine, View

# The shorter side of the picture that is registered, at least: corners then differ by 0.1 to 0.4 px (median) from a
# registration at full size, for 30 to 45 % of its time.
_REGISTERED_PX = 240
# The longer side of the picture on which a standing camera is recognized, at least.
_TINY_PX, _TINIEST = 160, 6
_POINTS, _WINDOW_PX = 80, 15
# The camera stands still if the points of a quarter of the picture have moved by less, in the median. Moving cameras
# of ours show 0.6 px and more between successive frames, standing ones 0.01 to 0.05 px.
_STILL_PX = 0.25
_LEAST_POINTS, _LEAST_QUARTERS = 5, 3
# A look is compared with one that lies no more looks back: targets cover the points, the light changes.
_OLDEST = 16


class Camera:
    """Gives the motion from each picture to the next. Show it the pictures in order.

    Looks at a standing camera are compared with the same earlier one, the anchor, and so is the first that has moved:
    a slow pan is not lost in steps that are each too small to see, unless it takes longer than _OLDEST looks to be.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.anchor: _Look | None = None
        self.last: _Look | None = None
        self.lost: _Look | None = None  # the latest look whose motion is not known, shown since `last`
        self.age = 0  # looks since the anchor

    def step(self, image: np.ndarray) -> tuple[np.ndarray | None, str]:
        """The (3, 3) pixel homography to this picture from the one before.

        None where the camera stood still, and where the motion is unknown, then with a cause in words.
        """
        look = _Look(image, self.engine)
        self.age += 1
        if self.anchor is None or self.last is None:
            self.anchor = self.last = look
            self.age = 0
            return None, ""
        if _still(self.anchor, look):
            if self.age >= _OLDEST:
                self.anchor, self.age = look, 0
            self.last, self.lost = look, None
            return None, ""
        # After a look that goes with nothing, a flash say, the motion since the one before it counts: the tracker has
        # been told of none in between.
        earlier = [self.anchor, *(e for e in (self.last, self.lost) if e is not None and e is not self.anchor)]
        for other in earlier:
            (found,) = self.engine.register([(other.view, look.view)])
            if found.reliable:
                self.anchor = self.last = look
                self.lost, self.age = None, 0
                now_from_before = look.full_from_small @ found.later_from_earlier @ np.linalg.inv(look.full_from_small)
                return now_from_before / now_from_before[2, 2], ""
        if self.age >= _OLDEST:
            self.anchor = self.last = look
            self.lost, self.age = None, 0
        else:
            self.lost = look
        return None, found.cause


@dataclass
class _Look:
    """One picture, and what is made of it where it is needed."""

    image: np.ndarray
    engine: Engine

    @cached_property
    def grey(self) -> np.ndarray:
        return cv2.cvtColor(self.image, cv2.COLOR_BGR2GRAY) if self.image.ndim == 3 else self.image

    @cached_property
    def view(self) -> View:
        """The reduced picture, for the back end."""
        times = max(1, min(self.grey.shape) // _REGISTERED_PX)
        return self.engine.prepare(_reduced(self.grey, times))

    @cached_property
    def full_from_small(self) -> np.ndarray:
        """From the view's pixels to the picture's. Both count from the middle of their first pixel."""
        scale = np.array([self.grey.shape[1], self.grey.shape[0]]) / self.view.size
        return np.array([[scale[0], 0, (scale[0] - 1) / 2], [0, scale[1], (scale[1] - 1) / 2], [0, 0, 1]])

    @cached_property
    def times(self) -> int:
        """How many times smaller the tiny picture is."""
        return int(np.clip(max(self.grey.shape) // _TINY_PX, 1, _TINIEST))

    @cached_property
    def tiny(self) -> np.ndarray:
        return _reduced(self.grey, self.times)

    @cached_property
    def points(self) -> np.ndarray:
        """(N, 2) float32: corners of the tiny picture, spread over it."""
        apart = max(4, min(self.tiny.shape) // 12)
        found = cv2.goodFeaturesToTrack(self.tiny, _POINTS, 0.01, apart)
        return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)


def _reduced(grey: np.ndarray, times: int) -> np.ndarray:
    size = max(1, grey.shape[1] // times), max(1, grey.shape[0] // times)
    return grey if times == 1 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _still(anchor: _Look, look: _Look) -> bool:
    """Whether three quarters of the picture have not moved; the fourth may be covered by something that has."""
    start = anchor.points
    if len(start) < _LEAST_POINTS * _LEAST_QUARTERS:
        return False
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.01)
    search = {"winSize": (_WINDOW_PX, _WINDOW_PX), "maxLevel": 1, "criteria": criteria}
    end, found, _ = cv2.calcOpticalFlowPyrLK(anchor.tiny, look.tiny, start, None, **search)  # type: ignore[call-overload]
    followed = found.ravel() == 1
    moved = (end - start)[followed] * look.times
    height, width = look.tiny.shape
    right, low = (start[followed] > (width / 2, height / 2)).T
    moves = [moved[(right == r) & (low == d)] for r in (False, True) for d in (False, True)]
    medians = [np.median(move, axis=0) for move in moves if len(move) >= _LEAST_POINTS]
    return sum(float(np.linalg.norm(median)) < _STILL_PX for median in medians) >= _LEAST_QUARTERS
