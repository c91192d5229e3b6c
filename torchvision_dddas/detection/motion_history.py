"""Motion history of one clip: when each place last moved, seen from the current frame (appendix B, step S5).

The counterpart of `ops.history` for one 8-bit stream. Stamps are uint8: 255 is now, 254 one frame ago, 0 longer ago
than the duration. The outlines of past silhouettes are kept with their composed registrations, and the stamps are
painted once a frame if anyone asks: warping stamps on at every step would round to whole pixels each time, so that a
camera moving by 0.4 px a frame would never move its history at all.
"""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.geometry import transfer

NEWEST = 255
# Corners are painted to 1/16 px; further off than this they are beyond any picture.
_SHIFT, _FAR_PX = 4, 1e5
Box = tuple[int, int, int, int]


@dataclass
class _Past:
    """outlines: (N, 2) corners of a silhouette's outlines, holes too, one after another. ends: where each ends."""

    number: int
    outlines: np.ndarray
    ends: np.ndarray
    now_from_then: np.ndarray


class MotionHistory:
    """A clip's silhouettes of the last `duration_frames`. Move it on to every frame in order, then add its own."""

    def __init__(self, duration_frames: float) -> None:
        self.duration_frames = duration_frames
        self.number = 0
        self._past: deque[_Past] = deque()
        self._shape = (0, 0)
        self._painted: np.ndarray | None = None

    def move(self, number: int, this_from_last: np.ndarray | None) -> None:
        """Go on to a frame. this_from_last: (3, 3) registration from the frame before; None at a cut forgets all."""
        self.number = number
        self._painted = None
        if this_from_last is None:
            self._past.clear()
        while self._past and number - self._past[0].number > self.duration_frames:
            self._past.popleft()
        for past in self._past:
            past.now_from_then = this_from_last @ past.now_from_then

    def add(self, silhouette: np.ndarray) -> None:
        """Stamp the (H, W) uint8 silhouette of the current frame, nonzero where something moves."""
        outlines, _ = cv2.findContours(silhouette, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        corners = np.concatenate([np.zeros((0, 2)), *(outline[:, 0] for outline in outlines)])
        self._past.append(_Past(self.number, corners, np.cumsum([len(o) for o in outlines], dtype=int), np.eye(3)))
        self._shape = silhouette.shape[:2]
        self._painted = None

    def stamps(self, box: Box) -> np.ndarray:
        """(height, width) uint8 stamps inside a box of the current frame: x, y, width, height."""
        x, y, width, height = box
        if not self._past:
            return np.zeros((height, width), np.uint8)
        if self._painted is None:
            self._painted = self._all()
        return self._painted[y : y + height, x : x + width].copy()

    def _all(self) -> np.ndarray:
        """The stamps of the whole picture."""
        stamps = np.zeros(self._shape, np.uint8)
        for past in self._past:  # the newest last: it overwrites
            if len(past.ends):
                places = np.clip(transfer(past.now_from_then, past.outlines), -_FAR_PX, _FAR_PX)
                corners = np.round(places * 2**_SHIFT).astype(np.int32)
                outlines = np.split(corners, past.ends[:-1])
                cv2.fillPoly(stamps, outlines, NEWEST - (self.number - past.number), shift=_SHIFT)
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
