"""Landmarks in the picture: found by their colours, separated from targets, and tracked.

Source: appendix A, IV-A. Beyond it: patches of a landmark's colour that are something else, blobs that hold a landmark
and a person, and landmarks that the picture's border cuts.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.geo.colours import Patches, find_patches
from torchvision_dddas.geo.ranging import touches_border
from torchvision_dddas.geometry import beside, centres_of, cheapest, covering, inside, transfer
from torchvision_dddas.types import Detections

# A blob this many times larger than usual for its colour holds something beside the landmark.
_SHARED = 1.8
# A vehicle's blob is no longer than it, but for its shadow; and its middle no further from the colour than this share.
_LONGER, _WITHIN = 1.25, 0.6
# Frames whose blobs define the usual size, and the fewest that do.
_MEMORY, _ENOUGH = 25, 3


def separate(
    colour_px: np.ndarray, blob_px: np.ndarray, parameters: LandmarkParameters, allowed: np.ndarray | None = None
) -> np.ndarray:
    """(n,) int64, which of the m blobs is each landmark's, -1 for none; no blob is of two.

    colour_px: (n, 2), NaN for a colour that was not found. blob_px: (m, 2) centres of what moves. allowed: (n, m) bool,
    pairs that may be; None: all.
    exact: as many matches as there can be within reach_px, then the least distance in all. The source asks for one blob
    for each landmark, which is infeasible where one has none in reach; its text says "if any". greedy: its heuristic,
    row by row, each landmark the nearest blob that is left.
    """
    distance = np.linalg.norm(colour_px[:, None] - blob_px[None], axis=2)
    within = distance <= parameters.reach_px  # False for NaN
    if allowed is not None:
        within &= allowed
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
    # One more pair outweighs any saving of distance.
    missing = 1.0 + parameters.reach_px * (min(distance.shape) + 1)
    rows, columns = cheapest(np.where(within, distance, missing))
    good = within[rows, columns]
    match[rows[good]] = columns[good]
    return match


@dataclass(frozen=True)
class TrackedLandmarks:
    """The landmarks in one frame's picture, one row a landmark of the names given.

    image_px: (K, 2) where each is, NaN where it was not found or the border cuts it. by: (K,) motion, colour, or "".
    colour_px: (K, 2) centres of their colours. blob: (K,) int64, which detection is its own, -1 for none.
    rows: (N,) bool, the detections that are landmarks or parts of them, and so no targets. shared: (N,) bool, those
    that hold a landmark and something beside it: they stay among the targets.
    """

    image_px: np.ndarray
    by: tuple[str, ...]
    colour_px: np.ndarray
    blob: np.ndarray
    rows: np.ndarray
    shared: np.ndarray


def _of_vehicles(at_px: np.ndarray, length_px: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(N,) bool, the blobs that lie where a vehicle is, at (K, 2) and so long (K,), and are no longer than it."""
    middle, longest = boxes[:, :2] + (boxes[:, 2:] - 1) / 2, boxes[:, 2:].max(axis=1, initial=0)
    away = np.linalg.norm(at_px[:, None] - middle, axis=2)  # NaN where unknown: of no vehicle
    return ((away <= _WITHIN * length_px[:, None]) & (longest <= _LONGER * length_px[:, None])).any(axis=0)


@dataclass
class _Coupling:
    """State of a landmark's blob; blob_px: in the last frame, NaN if there was none."""

    blob_px: np.ndarray = field(default_factory=lambda: np.full(2, np.nan))
    coupled: bool = False
    ratios: deque[float] = field(default_factory=lambda: deque(maxlen=_MEMORY))


class LandmarkTracker:
    """Finds landmarks in successive pictures.

    Of each colour the patch counts that is large, is where the landmark was, and has something moving at it. Every
    interval_frames landmarks are told from targets anew; between, a landmark's blob is the one where it is predicted.
    """

    def __init__(self, names: tuple[str, ...], parameters: LandmarkParameters) -> None:
        self.names, self._parameters = names, parameters
        self._colours = [ColourTracker(parameters) for _ in names]
        self._blobs = [_Coupling() for _ in names]
        self._next = 0

    def update(
        self,
        frame: int,
        masks: np.ndarray,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        foreground: np.ndarray | None = None,
        expected_px: np.ndarray | None = None,
        length_px: np.ndarray | None = None,
    ) -> TrackedLandmarks:
        """The landmarks of the next frame.

        masks: (K, H, W) uint8 of the landmarks' colours. now_from_before: (3, 3) how the background moved since the
        frame before; None: it did not, or nobody knows. foreground: (H, W), i + 1 where detection i is, as in Scene;
        without it a blob's centre is its box's, which a limb or a shadow shifts more.
        expected_px: (K, 2) where each should be by what else is known, length_px (K,) how long it shows there; NaN or
        None: unknown.
        """
        size = masks.shape[2], masks.shape[1]
        anew = frame >= self._next
        if anew:
            self._next = frame + self._parameters.interval_frames
        boxes = detections.box_px
        blobs = centres_of(boxes, foreground)
        blob_area = detections.area_px if len(detections.area_px) else boxes[:, 2:].prod(axis=1)
        chosen, colour, area = self._find(masks, boxes, now_from_before, expected_px, anew)
        shape = len(masks), len(boxes)
        near = np.array([beside(box, boxes) for box in chosen], bool).reshape(shape)
        match = self._couple(colour, blobs, near, now_from_before, anew)
        touching = np.array([covering(box, boxes, blob_area, foreground) for box in chosen], bool).reshape(shape)
        # A blob that is not at the colour is a part of the vehicle; its centre is not the vehicle's.
        whole = touching.sum(axis=0) == 1
        touching[match >= 0, match[match >= 0]] = True
        shared = self._shared(match, touching, area, blob_area)
        clean = whole & ~shared & (touching.sum(axis=0) == 1) & ~touches_border(boxes, size)
        image, by = np.full((len(masks), 2), np.nan), [""] * len(masks)
        for k, (coupling, box) in enumerate(zip(self._blobs, chosen, strict=True)):
            blob = blobs[match[k]] if match[k] >= 0 and clean[match[k]] else None
            if blob is not None and self._parameters.centre == "motion":
                image[k], by[k] = blob, "motion"
            elif box is not None and not touches_border(box[None], size)[0]:
                image[k], by[k] = colour[k], "colour"
            if blob is not None:
                coupling.blob_px = blob
        # Too large for its colour need not be too large for a vehicle: of most, a part alone is seen to move at first.
        own = np.zeros(len(boxes), bool)
        if length_px is not None:
            at = colour if expected_px is None else np.where(np.isnan(colour), expected_px, colour)
            own = _of_vehicles(at, length_px, boxes)
        return TrackedLandmarks(image, tuple(by), colour, match, touching.any(axis=0) & ~shared | own, shared & ~own)

    def _find(
        self,
        masks: np.ndarray,
        boxes: np.ndarray,
        now_from_before: np.ndarray | None,
        expected_px: np.ndarray | None,
        anew: bool,
    ) -> tuple[list[np.ndarray | None], np.ndarray, np.ndarray]:
        """Boxes, centres (K, 2) and areas (K,) of the landmarks' colours; None and NaN where not seen."""
        expected = np.full((len(masks), 2), np.nan) if expected_px is None else expected_px
        for mask, colour in zip(masks, self._colours, strict=True):
            found = find_patches(mask, self._parameters.least_area_px)
            colour.advance(now_from_before)
            colour.see(found, np.atleast_1d(inside(found.centre_px, boxes).any(axis=1)))
        # Plates of one team are alike in size: those of others tell the usual size.
        usual = np.inf
        for _ in range(2):
            for colour, where in zip(self._colours, expected, strict=True):
                colour.decide(where, usual, anew)
            areas = [colour.lock.area_px for colour in self._colours if colour.lock is not None]
            usual = float(np.median(areas)) if len(areas) >= _ENOUGH else np.inf
        locks = [c.lock if c.lock is not None and c.sure and c.lock.row >= 0 else None for c in self._colours]
        centre = np.array([(np.nan, np.nan) if one is None else one.centre_px for one in locks]).reshape(-1, 2)
        area = np.array([np.nan if one is None else one.area_px for one in locks])
        return [None if one is None else one.box_px for one in locks], centre, area

    def _couple(
        self, colour: np.ndarray, blobs: np.ndarray, near: np.ndarray, now_from_before: np.ndarray | None, anew: bool
    ) -> np.ndarray:
        """Which blob is each landmark's: matched anew, or the one at its prediction.

        near: (K, N) bool, the blobs at or beside its colour: others are people who walk near a vehicle that is not
        seen to move. Where the colour is hidden any will do.
        """
        if anew:
            match = separate(colour, blobs, self._parameters, near)
            for coupling, blob in zip(self._blobs, match, strict=True):
                coupling.coupled = bool(blob >= 0)
            return match
        predicted = np.full((len(colour), 2), np.nan)
        for k, (coupling, candidates) in enumerate(zip(self._blobs, self._colours, strict=True)):
            if not coupling.coupled:
                continue
            # A lost blob, as of a vehicle that stood still, returns at the colour.
            predicted[k] = colour[k]
            if np.isfinite(coupling.blob_px).all():
                moved = coupling.blob_px
                if now_from_before is not None:
                    moved = transfer(now_from_before, moved)[0]
                velocity = 0.0 if candidates.lock is None else candidates.lock.velocity_px
                predicted[k] = coupling.blob_px = moved + velocity
        return separate(predicted, blobs, self._parameters, near | np.isnan(colour[:, :1]))

    def _shared(self, match: np.ndarray, touching: np.ndarray, area: np.ndarray, blob_area: np.ndarray) -> np.ndarray:
        """(N,) bool: the blobs that are much larger than the landmarks at them explain; takes note of what is usual.

        touching: (K, N) bool. area: (K,) of the landmarks' colours, NaN where not seen.
        """
        ratio = np.full(len(match), np.nan)
        ratio[match >= 0] = blob_area[match[match >= 0]] / area[match >= 0]
        alone = touching.sum(axis=1) == 1
        peers = ratio[np.isfinite(ratio) & alone]
        others = float(np.median(peers)) if len(peers) >= _ENOUGH else np.inf
        explained = np.zeros(len(match))
        for k, (coupling, candidates) in enumerate(zip(self._blobs, self._colours, strict=True)):
            usual = float(np.median(coupling.ratios)) if len(coupling.ratios) >= _ENOUGH else others
            # Where the colour is hidden, the area that it had stands for it.
            explained[k] = usual * (candidates.lock.area_px if candidates.lock is not None else np.inf)
        limit = np.where(touching, explained[:, None], 0).sum(axis=0)
        shared = touching.any(axis=0) & (blob_area > _SHARED * limit)
        for k, coupling in enumerate(self._blobs):
            if match[k] >= 0 and not shared[match[k]] and touching[:, match[k]].sum() == 1 and np.isfinite(ratio[k]):
                coupling.ratios.append(float(ratio[k]))
        return shared


# Score of a patch, in logarithms of its area: for motion at it; for its travel over the ground; for being the
# landmark already. Greatest penalty for its distance from the expected place.
_BLOB, _TRAVEL, _LOCK, _FAR = 2.0, 3.0, 1.0, 4.0
# A patch of this many times the usual area is no better than one of half as many, and one that fills its box by less
# than this is a shadow or a roof's edge rather than a vehicle's plate.
_LARGE, _FILL = 2.0, 0.5
# Gain of a new frame in velocity, area and share of frames with motion.
_GAIN = 0.3
# Most patches of a colour that are tracked.
_MOST = 16
# Margin by which the best patch must beat the next one to be taken for the landmark.
_MARGIN = 1.0
# Patches smaller than the best by more than this logarithm are no rivals.
_ALIKE = 2.0


@dataclass
class TrackedPatch:
    """A patch over time. Places are in the picture of the frame at hand; where it was not seen, as predicted.

    origin_px: where the ground lies now on which it was seen first. moving: share of the late frames in which
    something moved at it. seen, missed: frames in which it was, and since. row: among the frame's patches; -1: missed.
    """

    centre_px: np.ndarray
    box_px: np.ndarray
    area_px: float
    origin_px: np.ndarray
    velocity_px: np.ndarray = field(default_factory=lambda: np.zeros(2))
    moving: float = 0.0
    seen: int = 1
    missed: int = 0
    row: int = -1

    @property
    def fill(self) -> float:
        """Share of its box that it fills; half for a square on its corner."""
        return float(self.area_px / self.box_px[2:].prod())

    @property
    def travelled(self) -> float:
        """Distance that it went over the ground, in its own sizes, up to 1."""
        return float(min(np.linalg.norm(self.centre_px - self.origin_px) / np.sqrt(self.area_px), 1.0))


class ColourTracker:
    """The patches of one colour, and which of them is the landmark."""

    def __init__(self, parameters: LandmarkParameters) -> None:
        self._parameters = parameters
        self._all: list[TrackedPatch] = []
        self.lock: TrackedPatch | None = None
        self.sure = False
        self._blind = False

    def advance(self, now_from_before: np.ndarray | None) -> None:
        """Go on to the next picture. Without the background's motion, patches are searched further around."""
        self._blind = now_from_before is None
        if now_from_before is not None and self._all:
            places = np.array([(one.centre_px, one.origin_px) for one in self._all])
            places = transfer(now_from_before, places.reshape(-1, 2)).reshape(places.shape)
            for one, (centre, origin) in zip(self._all, places, strict=True):
                one.centre_px, one.origin_px = centre, origin
        for one in self._all:
            one.centre_px = one.centre_px + one.velocity_px

    def see(self, found: Patches, moving: np.ndarray) -> None:
        """Take in the patches of a frame; moving: (P,) bool, whether something moves at each."""
        largest = self._foremost(found)
        taken = self._continue(found, largest)
        for one in self._all:
            one.row = taken.get(id(one), -1)
            if one.row < 0:
                one.missed += 1
                continue
            centre = found.centre_px[one.row]
            one.velocity_px = one.velocity_px + _GAIN * (centre - one.centre_px)
            one.centre_px, one.box_px, one.seen, one.missed = centre, found.box_px[one.row], one.seen + 1, 0
            one.area_px += _GAIN * (found.area_px[one.row] - one.area_px)
            one.moving += _GAIN * (moving[one.row] - one.moving)
        new = [
            TrackedPatch(
                *(found.centre_px[row], found.box_px[row], float(found.area_px[row]), found.centre_px[row]),
                moving=float(moving[row]),
                row=int(row),
            )
            for row in largest
            if row not in taken.values()
        ]
        self._all = [one for one in self._all if one.missed <= min(self._parameters.interval_frames, one.seen)] + new
        if self.lock is not None and not any(one is self.lock for one in self._all):
            self.lock, self.sure = None, False

    def _foremost(self, found: Patches) -> np.ndarray:
        """The rows of the most likely patches."""
        area, near = found.area_px, np.zeros(len(found), bool)
        if self.lock is not None:
            area = np.minimum(area, _LARGE * self.lock.area_px)
            near = np.linalg.norm(found.centre_px - self.lock.centre_px, axis=1) <= self._parameters.reach_px
        fill = found.area_px / found.box_px[:, 2:].prod(axis=1)
        return np.lexsort((-area * np.minimum(fill / _FILL, 1.0) ** 4, ~near))[:_MOST]

    def _continue(self, found: Patches, rows: np.ndarray) -> dict[int, int]:
        """The patch that continues each candidate, by the candidate's id."""
        if not self._all or not len(rows):
            return {}
        before = np.array([one.centre_px for one in self._all])
        gate = np.array([np.sqrt(one.area_px) * (1 + 0.2 * one.missed) + 4 for one in self._all])
        reach = max(self._parameters.reach_px, 4.0)
        gate = np.full(len(gate), reach) if self._blind else np.minimum(gate, reach)
        apart = np.linalg.norm(before[:, None] - found.centre_px[rows][None], axis=2) / gate[:, None]
        change = np.log(found.area_px[rows][None] / np.array([one.area_px for one in self._all])[:, None])
        cost = np.where(apart <= 1, apart + 0.3 * np.abs(change), 100.0)
        pairs = zip(*cheapest(cost), strict=True)
        return {id(self._all[i]): int(rows[j]) for i, j in pairs if cost[i, j] < 100}

    def decide(self, expected_px: np.ndarray, usual_px: float, anew: bool) -> None:
        """Which patch is the landmark: as before, unless it is lost or in doubt, or the question is put anew.

        `sure` tells whether clearly more speaks for it than for the next best.
        expected_px: (2,) where it should be, NaN for unknown. usual_px: area of the landmarks' patches, inf: unknown.
        """
        if not self._all or not (anew or self.lock is None or not self.sure):
            return
        sizes = np.array([self._size(one, usual_px) for one in self._all])
        signs = np.array([self._signs(one, expected_px, usual_px) for one in self._all])
        held = np.array([_LOCK * (one is self.lock) for one in self._all])
        best = int((sizes + signs + held).argmax())
        same, self.lock = self._all[best] is self.lock, self._all[best]
        # Size alone does not tell a vehicle from a roof.
        rivals = sizes > sizes[best] - _ALIKE
        rivals[best] = False
        clear = not rivals.any() or signs[best] - signs[rivals].max() >= _MARGIN
        self.sure = bool(clear or (same and self.sure))

    @staticmethod
    def _size(one: TrackedPatch, usual_px: float) -> float:
        return float(np.log(min(one.area_px, _LARGE * usual_px)))

    def _signs(self, one: TrackedPatch, expected_px: np.ndarray, usual_px: float) -> float:
        """Score of a candidate without its size."""
        score = 4 * np.log(min(one.fill / _FILL, 1.0)) + _BLOB * one.moving + _TRAVEL * one.travelled
        if np.isfinite(usual_px):
            score -= max(np.log(one.area_px / (_LARGE * usual_px)), 0.0)
        if np.isfinite(expected_px).all():
            away = np.linalg.norm(one.centre_px - expected_px) / (2 * max(self._parameters.reach_px, 1.0))
            score -= min(away**2 / 2, _FAR)
        return float(score)
