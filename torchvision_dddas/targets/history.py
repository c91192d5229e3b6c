"""Motion history of one clip: when each place last moved, seen from the current frame (appendix B, step S5).

The counterpart of `ops.history` for one 8-bit stream. Stamps are uint8: 255 is now, 254 one frame ago, 0 longer ago
than the duration. The past silhouettes are kept with their composed registrations and the stamps are made where they
are asked for: warping stamps on at every step would round to whole pixels each time, so that a camera moving by 0.4 px
a frame would never move its history at all.
"""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

NEWEST = 255
Box = tuple[int, int, int, int]


@dataclass
class _Past:
    number: int
    silhouette: np.ndarray
    now_from_then: np.ndarray


class MotionHistory:
    """A clip's silhouettes of the last `duration_frames`. Move it on to every frame in order, then add its own."""

    def __init__(self, duration_frames: float) -> None:
        self.duration_frames = duration_frames
        self.number = 0
        self._past: deque[_Past] = deque()

    def move(self, number: int, this_from_last: np.ndarray | None) -> None:
        """Go on to a frame. this_from_last: (3, 3) registration from the frame before; None at a cut forgets all."""
        self.number = number
        if this_from_last is None:
            self._past.clear()
        while self._past and number - self._past[0].number > self.duration_frames:
            self._past.popleft()
        for past in self._past:
            past.now_from_then = this_from_last @ past.now_from_then

    def add(self, silhouette: np.ndarray) -> None:
        """Stamp the (H, W) uint8 silhouette of the current frame, nonzero where something moves."""
        self._past.append(_Past(self.number, silhouette.copy(), np.eye(3)))

    def stamps(self, box: Box) -> np.ndarray:
        """(height, width) uint8 stamps inside a box of the current frame: x, y, width, height."""
        x, y, width, height = box
        from_picture = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1]], float)
        stamps = np.zeros((height, width), np.uint8)
        for past in self._past:  # the newest last: it overwrites
            matrix = from_picture @ past.now_from_then
            seen = cv2.warpPerspective(past.silhouette, matrix, (width, height), flags=cv2.INTER_NEAREST)
            stamps[seen > 0] = NEWEST - (self.number - past.number)
        return stamps


def gradient(
    stamps: np.ndarray, delta_min_frames: float, delta_max_frames: float, aperture: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Direction of motion (radians, 0 = right, pi/2 = down) and where it may be believed, (H, W) each.

    As `ops.history.gradient`: Sobel over aperture x aperture px (odd), valid where the stamps under it span at least
    delta_min_frames and at most delta_max_frames.
    """
    along_u = cv2.Sobel(stamps, cv2.CV_32F, 1, 0, ksize=aperture, borderType=cv2.BORDER_REPLICATE)
    along_v = cv2.Sobel(stamps, cv2.CV_32F, 0, 1, ksize=aperture, borderType=cv2.BORDER_REPLICATE)
    under = np.ones((aperture, aperture), np.uint8)
    span = cv2.dilate(stamps, under) - cv2.erode(stamps, under)
    steep = np.maximum(np.abs(along_u), np.abs(along_v)) > 1e-4 * aperture**2
    valid = steep & (span >= delta_min_frames) & (span <= delta_max_frames)
    return np.where(valid, np.arctan2(along_v, along_u), np.float32(0)), valid


def region_orientation(
    orientation_rad: np.ndarray, valid: np.ndarray, stamps: np.ndarray, region: np.ndarray, duration_frames: float
) -> tuple[float, float]:
    """Mean direction of a (H, W) bool region in radians, NaN where it has none, and their agreement, 0 to 1.

    The weighted circular mean of the valid gradients, the newest weighing most: as `ops.history.region_orientation`.
    """
    inside = region & valid
    age = NEWEST - stamps[inside].astype(np.float32)
    weight = np.clip(1 - age / duration_frames, 0, 1)
    angle = orientation_rad[inside]
    cos, sin = float((weight * np.cos(angle)).sum()), float((weight * np.sin(angle)).sum())
    agreement = float(np.hypot(cos, sin)) / max(float(weight.sum()), 1e-6)
    return (float(np.arctan2(sin, cos)), agreement) if agreement > 1e-3 else (float("nan"), 0.0)
