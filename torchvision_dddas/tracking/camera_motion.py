"""Estimate the camera's motion between sampled frames, at any distance in time.

Tracking boxes needs less accuracy than segmentation. Most steps of a fixed camera are therefore recognized on a tiny
picture, and the other steps are registered on a reduced picture.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np

from torchvision_dddas.types import Registration

# Smallest shorter side of the registered picture. The corners differ by 0.1 to 0.4 px (median) from a registration at
# full size, which takes two to three times as long.
_REGISTERED_PX = 240
# Smallest longer side of the picture on which a fixed camera is recognized, and its largest reduction.
_TINY_PX, _LARGEST_REDUCTION = 160, 6
_POINTS, _WINDOW_PX = 80, 15
# A quadrant of the picture stands still if its median motion is below this. Between successive frames moving cameras
# have 0.6 px or more, fixed cameras 0.01 to 0.05 px.
_STILL_PX = 0.25
_LEAST_POINTS, _LEAST_QUARTERS = 5, 3
# The anchor is replaced after this many frames, because targets cover its points and the light changes.
_ANCHOR_FRAMES = 16


class Registrar(Protocol):
    """The methods of a detection engine that register pictures. A view has a `size`, (width, height) in pixels."""

    def prepare(self, image: np.ndarray) -> Any:
        """Return the view of a picture for `register`."""
        ...

    def register(self, pairs: Sequence[tuple[Any, Any]]) -> list[Registration]:
        """Return the background's motion from the first to the second view of each pair."""
        ...


class CameraMotion:
    """Estimates the motion from each picture to the next. Pass the pictures in order to `update`.

    While the camera stands still, pictures are compared with one earlier picture, the anchor, and so is the first
    picture after a motion. A slow pan is thus detected although each of its steps is too small to be seen, unless it
    takes longer than the life of the anchor.
    """

    def __init__(self, engine: Registrar) -> None:
        self.engine = engine
        self._anchor: _TrackedPicture | None = None
        self._last: _TrackedPicture | None = None  # the latest picture with a known motion
        self._lost: _TrackedPicture | None = None  # the latest picture after `_last`, with an unknown motion
        self._age = 0  # number of pictures since the anchor

    def update(self, image: np.ndarray) -> tuple[np.ndarray | None, str]:
        """Return the (3, 3) pixel homography from the previous picture to this picture, and a cause if it is unknown.

        The homography is None if the camera stood still (with an empty cause) or if the motion is unknown.
        """
        picture = _TrackedPicture(image, self.engine)
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
        # The previous picture may be lost, for example by a flash. The tracker has applied no motion since `_last`, so
        # the motion from `_last` is tried before that from the lost picture.
        earlier = [self._anchor, *(e for e in (self._last, self._lost) if e is not None and e is not self._anchor)]
        for other in earlier:
            (found,) = self.engine.register([(other.view, picture.view)])
            if found.reliable:
                self._begin(picture)
                # Convert from pixels of the view to pixels of the picture; both count from the centre of the first one.
                x, y = np.array(picture.grey.shape[::-1]) / picture.view.size
                full_from_small = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])
                motion = full_from_small @ found.later_from_earlier @ np.linalg.inv(full_from_small)
                return motion / motion[2, 2], ""
        self._lost = picture
        if is_old:
            self._begin(picture)
        return None, found.cause

    def _begin(self, picture: "_TrackedPicture") -> None:
        """Make this picture the anchor of the next pictures."""
        self._anchor, self._last, self._lost, self._age = picture, picture, None, 0


class _TrackedPicture:
    """A picture with its view, its tiny copy and the corners in that copy, computed on first use."""

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
        """The (N, 2) float32 corners of the tiny picture, spread over it."""
        found = cv2.goodFeaturesToTrack(self.tiny, _POINTS, 0.01, max(4, min(self.tiny.shape) // 12))
        return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)

    def is_still(self, anchor: "_TrackedPicture") -> bool:
        """Return whether three quadrants of the picture have not moved. A moving target may cover the fourth."""
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
