"""Landmarks in the picture: found by their colours, told from targets, followed.

Source: appendix A, IV-A. Beyond it: patches of a landmark's colour that are something else, blobs that hold a landmark
and a person, and landmarks that the picture's border cuts.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.settings import LandmarkKnobs
from torchvision_dddas.targets.colours import Patches, patches_of
from torchvision_dddas.targets.projective import transfer
from torchvision_dddas.targets.ranging import touches_border
from torchvision_dddas.targets.touching import centres_of, covering, inside
from torchvision_dddas.types import Detections

# What speaks for a patch of a colour, in the logarithm of its area: a blob at it; being where the landmark is
# predicted, by whether the landmark was ever seen to move; and, at most, against it: being far from where it should be.
_BLOB, _LOCK_MOVED, _LOCK, _FAR = 3.0, 3.0, 1.0, 4.0
# A blob that is this many times larger for its colour than usual holds something beside the landmark.
_SHARED = 1.8
# Blobs and areas of the last so many frames say what is usual; fewer than the second number say nothing.
_MEMORY, _ENOUGH = 25, 3
# How much a new frame changes the velocity.
_GAIN = 0.3


def separate(colour_px: np.ndarray, blob_px: np.ndarray, knobs: LandmarkKnobs) -> np.ndarray:
    """(n,) int64, which of the m blobs is each landmark's, -1 for none; no blob is of two.

    colour_px: (n, 2), NaN for a colour that was not found. blob_px: (m, 2) centres of what moves.
    exact: as many matches as there can be within reach_px, then the least distance in all. The source asks for one blob
    for each landmark, which is infeasible where one has none in reach; its text says "if any". greedy: its heuristic,
    row by row, each landmark the nearest blob that is left.
    """
    distance = np.linalg.norm(colour_px[:, None] - blob_px[None], axis=2)
    within = distance <= knobs.reach_px  # False for NaN
    match = np.full(len(colour_px), -1, np.int64)
    if not within.any():
        return match
    if knobs.differentiation == "greedy":
        free = np.ones(len(blob_px), bool)
        for row, near in enumerate(within):
            if (near & free).any():
                match[row] = np.where(near & free, distance[row], np.inf).argmin()
                free[match[row]] = False
        return match
    # One pair more is worth more than any saving of distance.
    missing = 1.0 + knobs.reach_px * (min(distance.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(within, distance, missing))
    good = within[rows, columns]
    match[rows[good]] = columns[good]
    return match


@dataclass(frozen=True)
class Sighted:
    """The landmarks in one frame's picture, one row a landmark of the names given.

    image_px: (K, 2) where each is, NaN where it was not found or the border cuts it. by: (K,) motion, colour, or "".
    colour_px: (K, 2) centres of their colours. blob: (K,) int64, which detection is its own, -1 for none.
    rows: (N,) bool, the detections that are landmarks, and so no targets. shared: (N,) bool, those that hold a landmark
    and something beside it: they stay among the targets.
    """

    image_px: np.ndarray
    by: tuple[str, ...]
    colour_px: np.ndarray
    blob: np.ndarray
    rows: np.ndarray
    shared: np.ndarray


@dataclass
class _State:
    """What is known of one landmark: places in the picture of the frame before, NaN where unknown."""

    colour_px: np.ndarray = field(default_factory=lambda: np.full(2, np.nan))
    blob_px: np.ndarray = field(default_factory=lambda: np.full(2, np.nan))
    velocity_px: np.ndarray = field(default_factory=lambda: np.zeros(2))
    missed: int = 0
    coupled: bool = False
    moved: bool = False
    areas: deque[float] = field(default_factory=lambda: deque(maxlen=_MEMORY))
    ratios: deque[float] = field(default_factory=lambda: deque(maxlen=_MEMORY))


class LandmarkFollower:
    """Finds landmarks in picture after picture.

    Of each colour the patch counts that is large, is where the landmark was, and has something moving at it. Every
    interval_frames landmarks are told from targets anew; between, a landmark's blob is the one where it is predicted.
    """

    def __init__(self, names: tuple[str, ...], knobs: LandmarkKnobs) -> None:
        self.names, self._knobs = names, knobs
        self._states = [_State() for _ in names]
        self._next = 0

    def step(
        self,
        frame: int,
        masks: np.ndarray,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        foreground: np.ndarray | None = None,
        expected_px: np.ndarray | None = None,
    ) -> Sighted:
        """The landmarks of the next frame.

        masks: (K, H, W) uint8 of the landmarks' colours. now_from_before: (3, 3) how the background moved since the
        frame before; None: it did not, or nobody knows. foreground: (H, W), i + 1 where detection i is, as in Scene;
        without it a blob's centre is its box's, which a limb or a shadow shifts more.
        expected_px: (K, 2) where each should be by what else is known; NaN or None: unknown.
        """
        size = masks.shape[2], masks.shape[1]
        anew = frame >= self._next
        if anew:
            self._next = frame + self._knobs.interval_frames
        for state in self._states:
            _advance(state, now_from_before)
        boxes = detections.box_px
        blobs = centres_of(boxes, foreground)
        expected = np.full((len(masks), 2), np.nan) if expected_px is None else expected_px
        patches = [patches_of(mask, self._knobs.least_area_px) for mask in masks]
        picked = [
            self._pick(state, found, boxes, where, anew)
            for state, found, where in zip(self._states, patches, expected, strict=True)
        ]
        chosen = [found.box_px[i] if i >= 0 else None for found, i in zip(patches, picked, strict=True)]
        colour = np.array(
            [found.centre_px[i] if i >= 0 else (np.nan, np.nan) for found, i in zip(patches, picked, strict=True)]
        ).reshape(-1, 2)
        match = self._couple(colour, blobs, anew)
        area = np.array([found.area_px[i] if i >= 0 else np.nan for found, i in zip(patches, picked, strict=True)])
        touching = np.array([covering(box, boxes, foreground) for box in chosen], bool).reshape(len(masks), len(boxes))
        touching[match >= 0, match[match >= 0]] = True
        blob_area = detections.area_px if len(detections.area_px) else boxes[:, 2:].prod(axis=1)
        shared = self._shared(match, touching, area, blob_area)
        # The centre of a blob is a landmark's if it holds this one whole, and nothing else.
        clean = ~shared & (touching.sum(axis=0) == 1) & ~touches_border(boxes, size)
        image, by = np.full((len(masks), 2), np.nan), [""] * len(masks)
        for k, (state, box) in enumerate(zip(self._states, chosen, strict=True)):
            own = blobs[match[k]] if match[k] >= 0 and clean[match[k]] else None
            if own is not None and self._knobs.centre == "motion":
                image[k], by[k] = own, "motion"
            elif box is not None and not touches_border(box[None], size)[0]:
                image[k], by[k] = colour[k], "colour"
            _remember(state, colour[k], own, area[k], self._knobs)
        return Sighted(image, tuple(by), colour, match, touching.any(axis=0) & ~shared, shared)

    def _pick(self, state: _State, found: Patches, boxes: np.ndarray, expected: np.ndarray, anew: bool) -> int:
        """Which of its colour's patches is the landmark; -1 for none."""
        if not len(found):
            return -1
        reach = self._knobs.reach_px
        followed = np.isfinite(state.colour_px[0]) and state.missed <= self._knobs.interval_frames
        score = np.log(found.area_px)
        if state.areas:
            # Beyond its usual size more area says nothing for it.
            score = np.minimum(score, np.log(2 * float(np.median(state.areas))))
        if followed:
            near = np.linalg.norm(found.centre_px - state.colour_px, axis=1) / (reach * (1 + 0.2 * state.missed))
            score += np.where(near <= 1, (_LOCK_MOVED if state.moved else _LOCK) * (1 - near**2), 0)
            if not anew:
                score = np.where(near <= 1, score, -np.inf)
        elif np.isfinite(expected).all():
            away = np.linalg.norm(found.centre_px - expected, axis=1) / (2 * reach)
            score -= np.minimum(away**2 / 2, _FAR)
        if anew or not followed:
            score += _BLOB * inside(found.centre_px, boxes).any(axis=1)
        best = int(score.argmax())
        return best if np.isfinite(score[best]) else -1

    def _couple(self, colour: np.ndarray, blobs: np.ndarray, anew: bool) -> np.ndarray:
        """Which blob is each landmark's."""
        if anew:
            match = separate(colour, blobs, self._knobs)
            for state, blob in zip(self._states, match, strict=True):
                state.coupled = blob >= 0
            return match
        predicted = np.array([s.blob_px if s.coupled else (np.nan, np.nan) for s in self._states]).reshape(-1, 2)
        # A blob that was lost out of sight, as when the vehicle stopped, comes back at its colour.
        predicted = np.where(np.isnan(predicted) & [[s.coupled] for s in self._states], colour, predicted)
        match = separate(predicted, blobs, self._knobs)
        for k in np.flatnonzero(match >= 0):
            if np.linalg.norm(blobs[match[k]] - colour[k]) > self._knobs.reach_px:
                match[k] = -1
        return match

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
        for k, state in enumerate(self._states):
            usual = float(np.median(state.ratios)) if len(state.ratios) >= _ENOUGH else others
            # Where the colour is hidden, its usual area stands for it.
            seen = area[k] if np.isfinite(area[k]) else float(np.median(state.areas or [np.inf]))
            explained[k] = usual * seen
        limit = np.where(touching, explained[:, None], 0).sum(axis=0)
        shared = touching.any(axis=0) & (blob_area > _SHARED * limit)
        for k, state in enumerate(self._states):
            if match[k] >= 0 and not shared[match[k]] and touching[:, match[k]].sum() == 1 and np.isfinite(ratio[k]):
                state.ratios.append(float(ratio[k]))
        return shared


def _advance(state: _State, now_from_before: np.ndarray | None) -> None:
    """Where everything is predicted to be in the next picture."""
    for name in ("colour_px", "blob_px"):
        place = getattr(state, name)
        if np.isfinite(place).all():
            moved = place if now_from_before is None else transfer(now_from_before, place)[0]
            setattr(state, name, moved + state.velocity_px)


def _remember(
    state: _State, colour_px: np.ndarray, blob_px: np.ndarray | None, area_px: float, knobs: LandmarkKnobs
) -> None:
    """Take note of a frame. The state's places are those that were predicted for it."""
    seen = np.isfinite(colour_px[0])
    now, predicted = (colour_px, state.colour_px) if seen or blob_px is None else (blob_px, state.blob_px)
    missed_by = now - predicted
    if np.linalg.norm(missed_by) <= knobs.reach_px:
        state.velocity_px = state.velocity_px + _GAIN * missed_by
    elif seen:
        state.velocity_px = np.zeros(2)
    if blob_px is not None:
        state.blob_px = blob_px
        state.moved = state.moved or len(state.ratios) >= _ENOUGH
    if seen:
        state.colour_px, state.missed = colour_px, 0
        state.areas.append(area_px)
        return
    state.missed += 1
    if blob_px is not None:
        # What hides the colour from the follower, such as a shadow, does not hide the vehicle.
        state.colour_px = state.colour_px + missed_by
    elif state.missed > knobs.interval_frames:
        state.colour_px, state.blob_px = np.full(2, np.nan), np.full(2, np.nan)
        state.velocity_px, state.coupled = np.zeros(2), False
