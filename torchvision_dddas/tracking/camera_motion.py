"""How the camera moved between sampled frames, however far apart they are.

Boxes need the motion to a fraction of a pixel only, which costs less than segmentation needs: most steps of a standing
camera are recognized on a tiny picture, and the others are registered on a reduced one.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np

from torchvision_dddas.types import Registration

# Least shorter side of the registered picture: its corners differ by 0.1 to 0.4 px (median) from a registration at full
# size, which takes two to three times as long.
_REGISTERED_PX = 240
# Least longer side of the picture on which a standing camera is recognized, and its largest reduction.
_TINY_PX, _LARGEST_REDUCTION = 160, 6
_POINTS, _WINDOW_PX = 80, 15
# The camera stands still if the median motion of a quarter of the picture is less. Moving cameras show 0.6 px and more
# between successive frames, standing ones 0.01 to 0.05 px.
_STILL_PX = 0.25
_LEAST_POINTS, _LEAST_QUARTERS = 5, 3
# The anchor is replaced after so many frames: targets cover its points, and the light changes.
_ANCHOR_FRAMES = 16


class Registrar(Protocol):
    """The part of a detection engine that registers pictures. A view has a `size`, (width, height) in pixels."""

    def prepare(self, image: np.ndarray) -> Any:
        """The view of a picture, as `register` takes it."""
        ...

    def register(self, pairs: Sequence[tuple[Any, Any]]) -> list[Registration]:
        """The motion of the background from the first to the second view of each pair."""
        ...


class CameraMotion:
    """Estimates the motion from each picture to the next. Give it the pictures in order.

    All pictures of a standing camera are compared with one earlier picture, the anchor, and so is the first that has
    moved. So a slow pan is not lost in steps that are each too small to see, unless it takes longer than the anchor
    lasts.
    """

    def __init__(self, engine: Registrar) -> None:
        self.engine = engine
        self._anchor: _Picture | None = None
        self._last: _Picture | None = None  # the latest with a known motion
        self._lost: _Picture | None = None  # the latest with an unknown motion, after `_last`
        self._age = 0  # pictures since the anchor

    def update(self, image: np.ndarray) -> tuple[np.ndarray | None, str]:
        """The (3, 3) pixel homography from the previous picture to this one, and a cause where it is unknown.

        The homography is None where the camera stood still (the cause is empty) or the motion is unknown.
        """
        picture = _Picture(image, self.engine)
        self._age += 1
        is_old = self._age >= _ANCHOR_FRAMES
        if self._anchor is None or self._last is None:
            self._begin(picture)
            return None, ""
        if picture.is_still(self._anchor):
            if is_old:
                self._begin(picture)
            self._last, self._lost = picture, None
            return None, ""
        # The picture before may be the lost one, such as a flash. The tracker knows of no motion since `_last`, so that
        # the motion from there counts first.
        earlier = [self._anchor, *(e for e in (self._last, self._lost) if e is not None and e is not self._anchor)]
        for other in earlier:
            (found,) = self.engine.register([(other.view, picture.view)])
            if found.reliable:
                self._begin(picture)
                # From the view's pixels to the picture's. Both count from the middle of their first pixel.
                x, y = np.array(picture.grey.shape[::-1]) / picture.view.size
                full_from_small = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])
                motion = full_from_small @ found.later_from_earlier @ np.linalg.inv(full_from_small)
                return motion / motion[2, 2], ""
        self._lost = picture
        if is_old:
            self._begin(picture)
        return None, found.cause

    def _begin(self, picture: "_Picture") -> None:
        """Compare the next pictures with this one."""
        self._anchor, self._last, self._lost, self._age = picture, picture, None, 0


class _Picture:
    """A picture and what is computed from it when first needed."""

    def __init__(self, image: np.ndarray, engine: Registrar) -> None:
        self.grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        self.engine = engine
        self.reduction = int(np.clip(max(self.grey.shape) // _TINY_PX, 1, _LARGEST_REDUCTION))

    def _reduce(self, times: int) -> np.ndarray:
        size = max(1, self.grey.shape[1] // times), max(1, self.grey.shape[0] // times)
        return self.grey if times == 1 else cv2.resize(self.grey, size, interpolation=cv2.INTER_AREA)

    @cached_property
    def view(self) -> Any:
        return self.engine.prepare(self._reduce(max(1, min(self.grey.shape) // _REGISTERED_PX)))

    @cached_property
    def tiny(self) -> np.ndarray:
        return self._reduce(self.reduction)

    @cached_property
    def points(self) -> np.ndarray:
        """(N, 2) float32 corners of the tiny picture, spread over it."""
        found = cv2.goodFeaturesToTrack(self.tiny, _POINTS, 0.01, max(4, min(self.tiny.shape) // 12))
        return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)

    def is_still(self, anchor: "_Picture") -> bool:
        """Whether three quarters of the picture have not moved; a moving target may cover the fourth."""
        start = anchor.points
        if len(start) < _LEAST_POINTS * _LEAST_QUARTERS:
            return False
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.01)
        search = {"winSize": (_WINDOW_PX, _WINDOW_PX), "maxLevel": 1, "criteria": criteria}
        end, found, _ = cv2.calcOpticalFlowPyrLK(anchor.tiny, self.tiny, start, None, **search)  # type: ignore[call-overload]
        tracked = found.ravel() == 1
        moved = (end - start)[tracked] * self.reduction
        height, width = self.tiny.shape
        right, low = (start[tracked] > (width / 2, height / 2)).T
        quarters = [moved[(right == r) & (low == d)] for r in (False, True) for d in (False, True)]
        medians = [np.median(motion, axis=0) for motion in quarters if len(motion) >= _LEAST_POINTS]
        return sum(float(np.linalg.norm(median)) < _STILL_PX for median in medians) >= _LEAST_QUARTERS
