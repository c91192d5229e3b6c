"""Find landmarks in the picture by their colours, separate them from targets, and track them.

Source: appendix A, IV-A. Beyond the source: patches of a landmark's colour that are something else, blobs that hold a
landmark and a person, and landmarks that the picture's border cuts.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.geo.colours import Patches, find_patches
from torchvision_dddas.geo.ranging import touches_border
from torchvision_dddas.geometry import cheapest, inside, middles_of, shared_px, transfer, window_of
from torchvision_dddas.types import Detections

# A blob this many times larger than usual for its colour holds something beside the landmark.
_SHARED = 1.8
# A vehicle's blob is at most _LONGER vehicle lengths long, and its middle at most _WITHIN lengths from the colour.
_LONGER, _WITHIN = 1.25, 0.6
# Blobs whose boxes are at most this far from a patch's box are beside the patch.
_BESIDE_PX = 2.0
# Number of frames that define the usual blob size, and the fewest that suffice.
_MEMORY, _ENOUGH = 25, 3
# Scores of a patch, added to the logarithm of its area: for motion at the patch, for its travel over the ground, and
# for being the landmark already. Then the greatest penalty for its distance from the expected place.
_BLOB, _TRAVEL, _LOCK, _FAR = 2.0, 3.0, 1.0, 4.0
# Area beyond this many times the usual area does not improve the score. A patch that fills a smaller share of its box
# than _FILL is a shadow or the edge of a roof rather than a vehicle's plate.
_LARGE, _FILL = 2.0, 0.5
# Gain of a new frame in the averages of velocity, area and motion.
_GAIN = 0.3
# Largest number of patches of one colour that are tracked.
_MOST = 16
# Margin by which the best patch must beat the next patch to become the landmark.
_MARGIN = 1.0
# Patches whose log area is smaller than the best patch's by more than this are not rivals.
_ALIKE = 2.0


def separate(
    colour_px: np.ndarray, blob_px: np.ndarray, parameters: LandmarkParameters, allowed: np.ndarray | bool = True
) -> np.ndarray:
    """Return (n,) int64, the blob of each landmark, -1 for none; no two landmarks share a blob.

    colour_px: (n, 2), NaN for a colour that was not found. blob_px: (m, 2) centres of moving blobs. allowed: (n, m)
    bool, permitted pairs. exact: the largest number of matches within reach_px, then the least total distance. The
    source requires one blob for each landmark, which is infeasible if a landmark has none in reach; its text says "if
    any". greedy: the source's heuristic; each landmark in turn takes the nearest blob that is left.
    """
    distance = np.linalg.norm(colour_px[:, None] - blob_px[None], axis=2)
    within = (distance <= parameters.reach_px) & allowed  # False for NaN
    match = np.full(len(colour_px), -1, np.int64)
    if not within.any():
        return match
    if parameters.differentiation == "greedy":
        free = np.ones(len(blob_px), bool)
        for row, near in enumerate(within):
            if (near & free).any():
                match[row] = np.where(near & free, distance[row], np.inf).argmin()
                free[match[row]] = False
        return match
    # The cost of a missing pair exceeds any saving of distance.
    missing = 1.0 + parameters.reach_px * (min(distance.shape) + 1)
    rows, columns = cheapest(np.where(within, distance, missing))
    good = within[rows, columns]
    match[rows[good]] = columns[good]
    return match


@dataclass(frozen=True)
class TrackedLandmarks:
    """The landmarks in one frame's picture, one row a landmark.

    image_px: (K, 2) pixels, NaN if not found or cut by the border. by: (K,) motion, colour, or "".
    colour_px: (K, 2) centres of the colour patches. blob: (K,) int64, the landmark's own detection, -1 for none.
    rows: (N,) bool, detections that are landmarks or parts of them, and so are not targets. shared: (N,) bool,
    detections that hold a landmark and something beside it: they remain targets.
    """

    image_px: np.ndarray
    by: tuple[str, ...]
    colour_px: np.ndarray
    blob: np.ndarray
    rows: np.ndarray
    shared: np.ndarray


@dataclass
class _Patch:
    """A patch over time. Places are in the current picture, and predicted if the patch was not seen in it.

    origin_px: current pixel of the ground where the patch was first seen. moving: share of recent frames with motion at
    the patch. seen: number of frames with the patch. missed: number of frames since it was last seen.
    """

    centre_px: np.ndarray
    box_px: np.ndarray
    area_px: float
    origin_px: np.ndarray
    moving: float
    velocity_px: np.ndarray = field(default_factory=lambda: np.zeros(2))
    seen: int = 1
    missed: int = 0


class _ColourTracker:
    """The patches of one colour, the patch that is the landmark (lock), and the landmark's blob.

    sure: whether the lock's score clearly exceeds the next best. blob_px: centre of the landmark's blob in the last
    frame, NaN without one. ratios: area of the blob over the area of the colour in recent frames.
    """

    def __init__(self, parameters: LandmarkParameters) -> None:
        self._parameters = parameters
        self._patches: list[_Patch] = []
        self.lock: _Patch | None = None
        self.sure = False
        self.coupled = False
        self.blob_px = np.full(2, np.nan)
        self.ratios: deque[float] = deque(maxlen=_MEMORY)

    @property
    def shown(self) -> _Patch | None:
        """The landmark's patch if this frame shows it with certainty."""
        return self.lock if self.lock is not None and self.sure and not self.lock.missed else None

    def update(self, found: Patches, moving: np.ndarray, now_from_before: np.ndarray | None) -> None:
        """Process the patches of the next picture. moving: (P,) bool, whether something moves at each."""
        if now_from_before is not None and self._patches:
            places = np.array([(one.centre_px, one.origin_px) for one in self._patches])
            places = transfer(now_from_before, places.reshape(-1, 2)).reshape(places.shape)
            for one, (centre, origin) in zip(self._patches, places, strict=True):
                one.centre_px, one.origin_px = centre, origin
        for one in self._patches:
            one.centre_px = one.centre_px + one.velocity_px
        # Choose the most likely patches, those near the landmark first.
        area, near = found.area_px, np.zeros(len(found), bool)
        if self.lock is not None:
            area = np.minimum(area, _LARGE * self.lock.area_px)
            near = np.linalg.norm(found.centre_px - self.lock.centre_px, axis=1) <= self._parameters.reach_px
        fill = found.area_px / found.box_px[:, 2:].prod(axis=1)
        foremost = np.lexsort((-area * np.minimum(fill / _FILL, 1.0) ** 4, ~near))[:_MOST]
        taken = self._continue(found, foremost, blind=now_from_before is None)
        for k, one in enumerate(self._patches):
            if k not in taken:
                one.missed += 1
                continue
            row = taken[k]
            centre = found.centre_px[row]
            one.velocity_px = one.velocity_px + _GAIN * (centre - one.centre_px)
            one.centre_px, one.box_px, one.seen, one.missed = centre, found.box_px[row], one.seen + 1, 0
            one.area_px += _GAIN * (found.area_px[row] - one.area_px)
            one.moving += _GAIN * (moving[row] - one.moving)
        longest = self._parameters.interval_frames
        self._patches = [one for one in self._patches if one.missed <= min(longest, one.seen)]
        for row in foremost.tolist():
            if row not in taken.values():
                centre, area_px = found.centre_px[row], float(found.area_px[row])
                self._patches.append(_Patch(centre, found.box_px[row], area_px, centre, float(moving[row])))
        if not any(one is self.lock for one in self._patches):
            self.lock, self.sure = None, False

    def _continue(self, found: Patches, rows: np.ndarray, blind: bool) -> dict[int, int]:
        """Return the row of the patch that continues each tracked patch. blind: the background's motion is unknown."""
        if not self._patches or not len(rows):
            return {}
        before = np.array([one.centre_px for one in self._patches])
        areas = np.array([one.area_px for one in self._patches])
        reach = max(self._parameters.reach_px, 4.0)
        gate = np.sqrt(areas) * (1 + 0.2 * np.array([one.missed for one in self._patches])) + 4
        gate = np.full(len(gate), reach) if blind else np.minimum(gate, reach)
        apart = np.linalg.norm(before[:, None] - found.centre_px[rows][None], axis=2) / gate[:, None]
        change = np.log(found.area_px[rows][None] / areas[:, None])
        cost = np.where(apart <= 1, apart + 0.3 * np.abs(change), 100.0)
        return {int(i): int(rows[j]) for i, j in zip(*cheapest(cost), strict=True) if cost[i, j] < 100}

    def decide(self, expected_px: np.ndarray, usual_px: float, anew: bool) -> None:
        """Decide which patch is the landmark. Keep the previous patch unless it is lost or uncertain, or if `anew`.

        expected_px: (2,) expected pixel, NaN if unknown. usual_px: usual area of the landmarks' patches, inf if
        unknown.
        """
        if not self._patches or not (anew or self.lock is None or not self.sure):
            return
        sizes = np.array([np.log(min(one.area_px, _LARGE * usual_px)) for one in self._patches])
        signs = np.array([self._score(one, expected_px, usual_px) for one in self._patches])
        held = np.array([_LOCK * (one is self.lock) for one in self._patches])
        best = int((sizes + signs + held).argmax())
        same, self.lock = self._patches[best] is self.lock, self._patches[best]
        # Size alone does not distinguish a vehicle from a roof.
        rivals = sizes > sizes[best] - _ALIKE
        rivals[best] = False
        clear = not rivals.any() or signs[best] - signs[rivals].max() >= _MARGIN
        self.sure = bool(clear or (same and self.sure))

    def _score(self, one: _Patch, expected_px: np.ndarray, usual_px: float) -> float:
        """Return the score of a patch without its size."""
        fill = float(one.area_px / one.box_px[2:].prod())  # 0.5 for a square on its corner
        travelled = min(np.linalg.norm(one.centre_px - one.origin_px) / np.sqrt(one.area_px), 1.0)
        score = 4 * np.log(min(fill / _FILL, 1.0)) + _BLOB * one.moving + _TRAVEL * travelled
        if np.isfinite(usual_px):
            score -= max(np.log(one.area_px / (_LARGE * usual_px)), 0.0)
        if np.isfinite(expected_px).all():
            away = np.linalg.norm(one.centre_px - expected_px) / (2 * max(self._parameters.reach_px, 1.0))
            score -= min(away**2 / 2, _FAR)
        return float(score)


class LandmarkTracker:
    """Find landmarks in successive pictures.

    Of the patches of a landmark's colour, the tracker takes a large one that is near the former position and moves.
    Every interval_frames, it decides which blobs are landmarks and which are targets. In between, it takes the blob at
    the predicted position.
    """

    def __init__(self, count: int, parameters: LandmarkParameters) -> None:
        self._parameters = parameters
        self._colours = [_ColourTracker(parameters) for _ in range(count)]
        self._next = 0

    def update(
        self,
        frame: int,
        masks: np.ndarray,
        detections: Detections,
        foreground: np.ndarray,
        now_from_before: np.ndarray | None,
        expected_px: np.ndarray,
        length_px: np.ndarray,
    ) -> TrackedLandmarks:
        """Return the landmarks of the next frame.

        masks: (K, H, W) uint8 of the landmarks' colours. foreground: (H, W), i + 1 at the pixels of detection i, as in
        Scene. now_from_before: (3, 3) motion of the background since the frame before; None: none, or unknown.
        expected_px: (K, 2) expected pixels from other sources, length_px: (K,) expected lengths there; NaN: unknown.
        """
        size = masks.shape[2], masks.shape[1]
        anew = frame >= self._next
        if anew:
            self._next = frame + self._parameters.interval_frames
        boxes = detections.box_px
        middle = boxes[:, :2] + (boxes[:, 2:] - 1) / 2
        blobs = middles_of(boxes, foreground)
        blobs = np.where(np.isfinite(blobs), blobs, middle)
        blob_area = detections.area_px if len(detections.area_px) else boxes[:, 2:].prod(axis=1)
        self._find(masks, boxes, now_from_before, expected_px, anew)
        shown = [colour.shown for colour in self._colours]
        own_px = np.array([np.full(4, np.nan) if one is None else one.box_px for one in shown]).reshape(-1, 4)
        centre = np.array([(np.nan, np.nan) if one is None else one.centre_px for one in shown]).reshape(-1, 2)
        area = np.array([np.nan if one is None else one.area_px for one in shown])
        near = shared_px(own_px[:, None] + _BESIDE_PX * np.array([-1, -1, 2, 2]), boxes) > 0  # False for NaN
        match = self._couple(centre, blobs, near, now_from_before, anew)
        has = match >= 0
        touching = _covering(own_px, blob_area, foreground)
        # A blob that is not at the colour is only a part of the vehicle, so its centre is not the vehicle's centre.
        whole = touching.sum(axis=0) == 1
        touching[has, match[has]] = True
        shared = self._shared(match, touching, area, blob_area)
        clean = whole & ~shared & (touching.sum(axis=0) == 1) & ~touches_border(boxes, size)
        image, by = np.full((len(masks), 2), np.nan), [""] * len(masks)
        cut = touches_border(own_px, size)
        for k, colour in enumerate(self._colours):
            is_clean = bool(has[k] and clean[match[k]])
            if is_clean:
                colour.blob_px = blobs[match[k]]
            if is_clean and self._parameters.centre == "motion":
                image[k], by[k] = blobs[match[k]], "motion"
            elif shown[k] is not None and not cut[k]:
                image[k], by[k] = centre[k], "colour"
        # A blob too large for its colour may still fit the vehicle: at first only a part of most vehicles seems to
        # move.
        at, long = np.where(np.isnan(centre), expected_px, centre), length_px[:, None]
        away = np.linalg.norm(at[:, None] - middle, axis=2)  # NaN where unknown
        own = ((away <= _WITHIN * long) & (boxes[:, 2:].max(axis=1, initial=0) <= _LONGER * long)).any(axis=0)
        return TrackedLandmarks(image, tuple(by), centre, match, touching.any(axis=0) & ~shared | own, shared & ~own)

    def _find(
        self,
        masks: np.ndarray,
        boxes: np.ndarray,
        now_from_before: np.ndarray | None,
        expected_px: np.ndarray,
        anew: bool,
    ) -> None:
        """Choose the patches of this frame that are the landmarks."""
        for mask, colour in zip(masks, self._colours, strict=True):
            found = find_patches(mask, self._parameters.least_area_px)
            colour.update(found, np.atleast_1d(inside(found.centre_px, boxes).any(axis=1)), now_from_before)
        # The plates of one team have similar sizes, so the other landmarks give the usual size.
        usual = np.inf
        for _ in range(2):
            for colour, where in zip(self._colours, expected_px, strict=True):
                colour.decide(where, usual, anew)
            areas = [colour.lock.area_px for colour in self._colours if colour.lock is not None]
            usual = _median_of(areas, np.inf)

    def _couple(
        self, centre: np.ndarray, blobs: np.ndarray, near: np.ndarray, now_from_before: np.ndarray | None, anew: bool
    ) -> np.ndarray:
        """Return the blob of each landmark: matched again, or the blob at its predicted place.

        near: (K, N) bool, blobs at or beside the landmark's colour. Other blobs are people who walk near a vehicle that
        does not seem to move. If the colour is hidden, every blob is allowed.
        """
        if anew:
            match = separate(centre, blobs, self._parameters, near)
            for colour, blob in zip(self._colours, match, strict=True):
                colour.coupled = bool(blob >= 0)
            return match
        predicted = np.full((len(centre), 2), np.nan)
        for k, colour in enumerate(self._colours):
            if not colour.coupled:
                continue
            # A blob that was lost, for example while the vehicle stood still, reappears at the colour.
            predicted[k] = centre[k]
            if np.isfinite(colour.blob_px).all():
                moved = colour.blob_px if now_from_before is None else transfer(now_from_before, colour.blob_px)[0]
                velocity = 0.0 if colour.lock is None else colour.lock.velocity_px
                predicted[k] = colour.blob_px = moved + velocity
        return separate(predicted, blobs, self._parameters, near | np.isnan(centre[:, :1]))

    def _shared(self, match: np.ndarray, touching: np.ndarray, area: np.ndarray, blob_area: np.ndarray) -> np.ndarray:
        """Return (N,) bool: whether a blob is much larger than its landmarks explain. Also update the usual ratios.

        touching: (K, N) bool. area: (K,) areas of the landmarks' colours, NaN if not seen.
        """
        ratio = np.full(len(match), np.nan)
        ratio[match >= 0] = blob_area[match[match >= 0]] / area[match >= 0]
        others = _median_of(ratio[np.isfinite(ratio) & (touching.sum(axis=1) == 1)], np.inf)
        # If the colour is hidden, use its former area.
        areas = [np.inf if colour.lock is None else colour.lock.area_px for colour in self._colours]
        explained = np.array([_median_of(c.ratios, others) * own for c, own in zip(self._colours, areas, strict=True)])
        limit = np.where(touching, explained.reshape(-1, 1), 0).sum(axis=0)
        shared = touching.any(axis=0) & (blob_area > _SHARED * limit)
        for k, colour in enumerate(self._colours):
            if match[k] >= 0 and not shared[match[k]] and touching[:, match[k]].sum() == 1 and np.isfinite(ratio[k]):
                colour.ratios.append(float(ratio[k]))
        return shared


def _covering(box_px: np.ndarray, area_px: np.ndarray, foreground: np.ndarray) -> np.ndarray:
    """Return (K, N) bool: blobs with areas (N,) that cover a good part of boxes (K, 4), or are covered by them."""
    covers = np.zeros((len(box_px), len(area_px)), bool)
    for k in np.flatnonzero(np.isfinite(box_px).all(axis=1)) if len(area_px) else ():
        part = foreground[window_of(box_px[k], foreground.shape)]
        count = np.bincount(part.ravel(), minlength=len(area_px) + 1)[1 : len(area_px) + 1]
        covers[k] = count > np.minimum(0.3 * part.size, 0.5 * area_px)
    return covers


def _median_of(values: Sequence[float] | np.ndarray, otherwise: float) -> float:
    """Return the median of values, or `otherwise` if there are too few of them."""
    return float(np.median(values)) if len(values) >= _ENOUGH else otherwise
