"""Motion history (appendix B, step S5): record when each pixel last moved, and derive the motion of blobs.

A blob leaves a trail in the history. The trail gives the blob's heading and speed. If the trail has two regions with
clearly different headings, the blob is two targets that touch.
"""

from collections import deque
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from torchvision_dddas.config import HistoryParameters
from torchvision_dddas.detection.blobs import Blob, Box, box_slices
from torchvision_dddas.geometry import transfer

NEWEST = 255
# Corners are drawn with a resolution of 1/16 px, and clipped to a distance that lies outside any picture.
_SHIFT, _FAR_PX = 4, 1e5
# Distance around a blob within which its trail is searched, px.
_REACH_PX = 48
# A trail shows only the motion component across its edge. One motion can therefore leave two trails whose headings
# differ by up to a right angle, or a little more with noise. A larger angle means two motions.
_APART_RAD = np.radians(120)
# Flicker has gradients with less agreement than _MIN_AGREEMENT, or is slower than _MIN_SPEED_PX (px a frame).
_MIN_AGREEMENT, _MIN_SPEED_PX = 0.5, 0.5
# Trails with a smaller share of all trail pixels, and parts with a smaller share of the blob, are noise.
_MIN_SHARE = 0.2


@dataclass
class _Silhouette:
    """One past silhouette. outlines: (N, 2) corners of all outlines and holes. ends: (K,) end index of each outline."""

    number: int
    outlines: np.ndarray
    ends: np.ndarray
    now_from_then: np.ndarray


class MotionHistory:
    """The silhouettes of the last `duration_frames` frames of a clip. Call `move` and `add` for every frame in order.

    Stamps are uint8: 255 is the current frame, 254 the frame before, 0 is older than the duration. Outlines are kept
    with their composed registrations and drawn at most once a frame. Warping the stamps at every step would round to
    whole pixels each time, so that a camera motion of 0.4 px a frame would never move the history.
    """

    def __init__(self, duration_frames: float) -> None:
        self.duration_frames = duration_frames
        self.number = 0
        self._past: deque[_Silhouette] = deque()
        self._shape = (0, 0)
        self._painted: np.ndarray | None = None

    def move(self, number: int, this_from_last: np.ndarray | None) -> None:
        """Align the history to a frame. this_from_last: (3, 3) registration; None, at a cut, clears the history."""
        self.number = number
        self._painted = None
        if this_from_last is None:
            self._past.clear()
        while self._past and number - self._past[0].number > self.duration_frames:
            self._past.popleft()
        for past in self._past:
            past.now_from_then = this_from_last @ past.now_from_then

    def add(self, silhouette: np.ndarray) -> None:
        """Add the silhouette of the current frame, (H, W) uint8, nonzero where something moves."""
        outlines, _ = cv2.findContours(silhouette, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        corners = np.concatenate([np.zeros((0, 2)), *(outline[:, 0] for outline in outlines)])
        ends = np.cumsum([len(outline) for outline in outlines], dtype=int)
        self._past.append(_Silhouette(self.number, corners, ends, np.eye(3)))
        self._shape = silhouette.shape[:2]
        self._painted = None

    def stamps(self, box: Box) -> np.ndarray:
        """Return the (height, width) uint8 stamps inside a box (x, y, width, height) of the current frame."""
        if not self._past:
            return np.zeros(box[:1:-1], np.uint8)
        if self._painted is None:
            self._painted = np.zeros(self._shape, np.uint8)
            for past in self._past:  # the newest silhouette is drawn last, over the older ones
                if len(past.ends):
                    places = np.clip(transfer(past.now_from_then, past.outlines), -_FAR_PX, _FAR_PX)
                    outlines = np.split(np.round(places * 2**_SHIFT).astype(np.int32), past.ends[:-1])
                    cv2.fillPoly(self._painted, outlines, NEWEST - (self.number - past.number), shift=_SHIFT)
        return self._painted[box_slices(box)].copy()


def motion_gradient(
    stamps: np.ndarray, delta_min_frames: float, delta_max_frames: float, aperture: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction of motion (radians, 0 = right, pi/2 = down) and where it is valid, (H, W) each.

    The direction follows the Sobel gradient over aperture x aperture px (odd). It is valid where the stamps in the
    aperture span at least delta_min_frames and at most delta_max_frames. OpenCV's calcMotionGradient, which the source
    used, has the same rule.
    """
    along_u, along_v = (
        cv2.Sobel(stamps, cv2.CV_32F, *order, ksize=aperture, borderType=cv2.BORDER_REPLICATE)
        for order in ((1, 0), (0, 1))
    )
    under = np.ones((aperture, aperture), np.uint8)
    span = cv2.dilate(stamps, under) - cv2.erode(stamps, under)
    steep = np.maximum(np.abs(along_u), np.abs(along_v)) > 1e-4 * aperture**2
    valid = steep & (span >= delta_min_frames) & (span <= delta_max_frames)
    return np.where(valid, np.arctan2(along_v, along_u), np.float32(0)), valid


def region_orientation(
    orientation_rad: np.ndarray, valid: np.ndarray, stamps: np.ndarray, region: np.ndarray, duration_frames: float
) -> tuple[float, float]:
    """Return the mean direction of a (H, W) bool region in radians, and the agreement of its gradients, 0 to 1.

    The mean is the circular mean of the valid gradients, NaN if they cancel out or there are none. The weight of a
    gradient falls from 1 for a new stamp to 0 at the duration.
    """
    inside = region & valid
    weight = np.clip(1 - (NEWEST - stamps[inside].astype(np.float32)) / duration_frames, 0, 1)
    angle = orientation_rad[inside]
    cos, sin = float((weight * np.cos(angle)).sum()), float((weight * np.sin(angle)).sum())
    agreement = float(np.hypot(cos, sin)) / max(float(weight.sum()), 1e-6)
    return (float(np.arctan2(sin, cos)), agreement) if agreement > 1e-3 else (float("nan"), 0.0)


def flood_regions(stamps: np.ndarray, seeds: np.ndarray, threshold_frames: float) -> list[np.ndarray]:
    """Return (H, W) bool masks of the flood-fill regions that contain a seed.

    Neighbours (8) whose stamps differ by at most the threshold belong to one region. Stamp 0 belongs to no region.
    stamps: (H, W) uint8. seeds: (H, W) bool.
    """
    # OpenCV's mask is one pixel larger on every side; the fill stops where it is nonzero.
    wall = np.pad((stamps == 0).astype(np.uint8), 1, constant_values=1)
    threshold = int(min(threshold_frames, 254))  # stamps are whole frames
    flags = 8 | (2 << 8) | cv2.FLOODFILL_MASK_ONLY
    left, found = seeds & (stamps > 0), []
    while left.any():
        row, column = np.unravel_index(int(left.argmax()), left.shape)
        cv2.floodFill(stamps, wall, (int(column), int(row)), 0, threshold, threshold, flags)
        region = wall[1:-1, 1:-1] == 2
        wall[1:-1, 1:-1][region] = 1
        left &= ~region
        found.append(region)
    return found


def split_by_trail(
    blob: Blob, history: MotionHistory, size: tuple[int, int], parameters: HistoryParameters
) -> list[tuple[Blob, np.ndarray]]:
    """Return the blob with its velocity, or its two parts with their velocities if the trail shows two motions.

    history: must contain the current frame's silhouette. size: (width, height) of the picture. A velocity is (2,)
    pixels a frame over the background. It is NaN for a blob without a usable trail, which moves very slowly, or by
    more than its own length a frame.
    """
    x, y, width, height = blob.box
    left, top = max(x - _REACH_PX, 0), max(y - _REACH_PX, 0)
    right, bottom = min(x + width + _REACH_PX, size[0]), min(y + height + _REACH_PX, size[1])
    stamps = history.stamps((left, top, right - left, bottom - top))
    inside = box_slices(blob.box, left, top)
    body = np.zeros(stamps.shape, bool)
    body[inside] = blob.mask
    body &= stamps == NEWEST
    orientations, valid = motion_gradient(stamps, parameters.delta_min_frames, parameters.delta_max_frames)

    def grow(region: np.ndarray) -> np.ndarray:
        return cv2.dilate(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0

    def orientation(trail: np.ndarray) -> tuple[float, float]:
        return region_orientation(orientations, valid, stamps, grow(trail), parameters.duration_frames)

    old = np.where(stamps == NEWEST, np.uint8(0), stamps)
    trails = flood_regions(old, grow(body), parameters.segmentation_threshold_frames)
    total = sum(int(trail.sum()) for trail in trails)
    trails = [trail for trail in trails if trail.sum() >= _MIN_SHARE * total]
    if not trails:
        return [(blob, np.full(2, np.nan))]
    headings = [heading if agreement >= _MIN_AGREEMENT else np.nan for heading, agreement in map(orientation, trails)]
    # Find the two trails with the largest angle between them above _APART_RAD.
    best, pair = _APART_RAD, None
    for j, i in combinations(range(len(trails)), 2):
        angle = abs(np.angle(np.exp(1j * (headings[i] - headings[j]))))
        if angle > best:
            best, pair = angle, (j, i)
    if pair is not None:
        ways = [(trails[i], headings[i]) for i in pair]
        shares = _share_out(body, ways)
        if all(share.sum() >= _MIN_SHARE * body.sum() for share in shares):
            velocities = [_velocity(stamps, share, *way) for share, way in zip(shares, ways, strict=True)]
            if all(np.hypot(*velocity) >= _MIN_SPEED_PX for velocity in velocities):
                return [(blob.cut(s[inside]), velocity) for s, velocity in zip(shares, velocities, strict=True)]
    trail = np.logical_or.reduce(trails)
    return [(blob, _velocity(stamps, body, trail, orientation(trail)[0]))]


def _share_out(body: np.ndarray, ways: list[tuple[np.ndarray, float]]) -> np.ndarray:
    """Assign each pixel of the body to the trail that it lies ahead of; if it lies ahead of both, to the nearer.

    ways: trails and their headings. Returns (2, H, W) bool.
    """
    row, column = np.nonzero(body)
    costs = []
    for trail, heading in ways:
        along, across = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        place, behind = np.c_[column, row], np.c_[np.nonzero(trail)[::-1]]
        side, lane = behind @ across, place @ across
        beside = np.maximum(np.maximum(side.min() - lane, lane - side.max()), 0)
        costs.append(1e3 * np.round(beside) + np.abs(place @ along - (behind @ along).max()))
    shares = np.zeros((len(ways), *body.shape), bool)
    shares[np.argmin(costs, axis=0), row, column] = True
    return shares


def _velocity(stamps: np.ndarray, body: np.ndarray, trail: np.ndarray, heading: float) -> np.ndarray:
    """Return a body's velocity: trail area a frame over breadth across the heading; NaN for an unknown heading."""
    if not np.isfinite(heading) or not body.any():
        return np.full(2, np.nan)
    age = NEWEST - stamps[trail].astype(int)
    row, column = np.nonzero(body)
    breadth = len(np.unique(np.round(column * np.sin(heading) - row * np.cos(heading))))
    return len(age) / (int(age.max()) * breadth) * np.array([np.cos(heading), np.sin(heading)])
