"""Landmarks in the picture: found by their colours, told from targets, followed.

Source: appendix A, IV-A. Beyond it: patches of a landmark's colour that are something else, blobs that hold a landmark
and a person, and landmarks that the picture's border cuts.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.geo.colour_patches import patches_of
from torchvision_dddas.geo.landmark_candidates import Candidates
from torchvision_dddas.geo.ranging import touches_border
from torchvision_dddas.geometry import beside, centres_of, cheapest, covering, inside, transfer
from torchvision_dddas.types import Detections

# A blob that is this many times larger for its colour than usual holds something beside the landmark.
_SHARED = 1.8
# A vehicle's blob is no longer than it, but for its shadow; and its middle no further from the colour than this share.
_LONGER, _WITHIN = 1.25, 0.6
# Blobs of the last so many frames say what is usual; fewer than the second number say nothing.
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
    # One pair more is worth more than any saving of distance.
    missing = 1.0 + parameters.reach_px * (min(distance.shape) + 1)
    rows, columns = cheapest(np.where(within, distance, missing))
    good = within[rows, columns]
    match[rows[good]] = columns[good]
    return match


@dataclass(frozen=True)
class Sighted:
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
    """What is known of a landmark's blob: its place in the picture of the frame before, NaN where there was none."""

    blob_px: np.ndarray = field(default_factory=lambda: np.full(2, np.nan))
    coupled: bool = False
    ratios: deque[float] = field(default_factory=lambda: deque(maxlen=_MEMORY))


class LandmarkFollower:
    """Finds landmarks in picture after picture.

    Of each colour the patch counts that is large, is where the landmark was, and has something moving at it. Every
    interval_frames landmarks are told from targets anew; between, a landmark's blob is the one where it is predicted.
    """

    def __init__(self, names: tuple[str, ...], parameters: LandmarkParameters) -> None:
        self.names, self._parameters = names, parameters
        self._colours = [Candidates(parameters) for _ in names]
        self._blobs = [_Coupling() for _ in names]
        self._next = 0

    def step(
        self,
        frame: int,
        masks: np.ndarray,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        foreground: np.ndarray | None = None,
        expected_px: np.ndarray | None = None,
        length_px: np.ndarray | None = None,
    ) -> Sighted:
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
        return Sighted(image, tuple(by), colour, match, touching.any(axis=0) & ~shared | own, shared & ~own)

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
            found = patches_of(mask, self._parameters.least_area_px)
            colour.advance(now_from_before)
            colour.see(found, np.atleast_1d(inside(found.centre_px, boxes).any(axis=1)))
        # Vehicles of one team wear plates of like size: what others wear says what to look for.
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
        """Which blob is each landmark's: told anew, or the one where it is predicted.

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
            # A blob that was lost, as when the vehicle stood still, comes back at the colour.
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
