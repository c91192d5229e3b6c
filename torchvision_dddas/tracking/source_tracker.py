"""The source's tracker: association of absolute positions and RGB histograms (appendix C).

With every sampled frame, the last K frames are assigned anew; a target takes the identity of the older target that the
newest link of that window names. What fails in it is kept: see the tests, and `score_tracker` for the improved one.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import PaperParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking.dual_ascent import assign_triplets
from torchvision_dddas.tracking.source_affinity import (
    centres,
    dispersion,
    frames_considered,
    gate,
    location_weight,
    normalize_channels,
    pair_affinity,
    pair_gain_over_alone,
    triplet_affinity,
)
from torchvision_dddas.types import Detections, Float, Int, Tracks


class Features:
    """The features of a frame's targets; histograms are computed when first needed."""

    def __init__(self, box_px: Float[np.ndarray, "N 4"], histograms: Callable[[], np.ndarray] | None) -> None:
        """histograms: gives (N, 768) counts of pixels or shares; None where there is no picture."""
        self.centre_px = centres(box_px)
        self._compute = histograms
        self._histograms = np.zeros((len(box_px), 768)) if histograms is None or not len(box_px) else None

    def __len__(self) -> int:
        return len(self.centre_px)

    @property
    def has_picture(self) -> bool:
        """Whether there are histograms."""
        return self._compute is not None

    def histogram(self, normalization: str) -> Float[np.ndarray, "N 768"]:
        """The boxes' histograms by the reading that `paper.histogram` names."""
        if self._histograms is None and self._compute is not None:
            self._histograms = np.asarray(self._compute(), float)
            if self._histograms.shape != (len(self), 768):
                raise InputError(
                    f"the source's association needs histograms ({len(self)}, 768), 3 x 256 bins a box; "
                    f"got {self._histograms.shape}. Compute them with tracking.appearance.rgb_histograms."
                )
        assert self._histograms is not None
        return normalize_channels(self._histograms) if normalization == "channel" else self._histograms


@dataclass(frozen=True)
class Association:
    """How a window was assigned.

    rows: (Z, K) indices from 1, newest frame first, 0 for the dummy. weight: of the location. appearance_dispersion:
    None where it was not needed.
    """

    rows: Int[np.ndarray, "Z K"]
    weight: float
    location_dispersion: float
    appearance_dispersion: float | None


def associate(window: Sequence[Features], parameters: PaperParameters) -> Association:
    """Assign the targets of two or three frames, newest first: weigh, gate, solve."""
    counts = [len(frame) for frame in window]
    considered = window[: frames_considered(counts, parameters)]
    location = min(dispersion(frame.centre_px, parameters.location_cut) for frame in considered)

    def appearance() -> float:
        histograms = [frame.histogram(parameters.histogram) for frame in considered]
        return min(dispersion(histogram, parameters.appearance_cut) for histogram in histograms)

    appearance_dispersion: float | None = None
    if not all(frame.has_picture or not len(frame) for frame in window):
        weight = 1.0
    elif parameters.rule == "fixed":
        weight = parameters.weight
    else:
        weight, appearance_dispersion = location_weight(location, appearance, parameters.lowest_dispersion)
    by_location = affinity([frame.centre_px for frame in window], parameters) if weight > 0 else None
    by_appearance = (
        affinity([frame.histogram(parameters.histogram) for frame in window], parameters) if weight < 1 else None
    )
    return Association(assign(by_location, by_appearance, weight, parameters), weight, location, appearance_dispersion)


def assign(
    location: Float[np.ndarray, "N1 M1 *L1"] | None,
    appearance: Float[np.ndarray, "N1 M1 *L1"] | None,
    weight: float,
    parameters: PaperParameters,
) -> Int[np.ndarray, "Z K"]:
    """The best assignment of affinities with a dummy first on each axis; a feature of no weight may be None.

    Every real target is in exactly one row; rows are sorted. Source: eq. 2, 6 and 7 with the gate of III-E.
    """
    parts = [(share, score) for share, score in ((weight, location), (1 - weight, appearance)) if score is not None]
    by_feature = parameters.gated == "features"
    score = sum(
        share * (gate(part, parameters.threshold, parameters.gate) if by_feature else part) for share, part in parts
    )
    assert isinstance(score, np.ndarray)
    if not by_feature:
        score = gate(score, parameters.threshold, parameters.gate)
    if score.ndim == 2:
        return _best_pairs(score)
    if max(score.shape) - 1 <= parameters.exact_targets:
        return assign_triplets(score, gap=0.0, most_exact=None).triplets
    return assign_triplets(score, parameters.gap).triplets


def affinity(features: Sequence[np.ndarray], parameters: PaperParameters) -> np.ndarray:
    """Affinity of the targets of two or three frames by one feature, newest first, with a dummy first on each axis."""
    if len(features) == 2:
        return pair_affinity(features[0], features[1])
    return triplet_affinity(features[0], features[1], features[2], parameters.dummy)


def _best_pairs(score: Float[np.ndarray, "N1 M1"]) -> Int[np.ndarray, "Z 2"]:
    """The best assignment of two frames, every real target in exactly one row."""
    matched = best_pairs(pair_gain_over_alone(score)) + 1
    rows = [matched]
    for axis, size in enumerate(score.shape):
        alone = np.zeros((size - 1 - len(matched), 2), np.int64)
        alone[:, axis] = np.setdiff1d(np.arange(1, size), matched[:, axis])
        rows.append(alone)
    pairs = np.concatenate(rows)
    return pairs[np.lexsort(pairs.T[::-1])]


class SourceTracker:
    """The state of a run by the source's association; the interface of `ScoreTracker`, without delay."""

    def __init__(self, settings: Settings, interval: int, size: tuple[float, float] | None = None) -> None:
        """interval, size: not used; positions are compared in pixels of the picture."""
        self.parameters = settings.paper
        self.window: deque[Features] = deque(maxlen=self.parameters.window)  # newest first
        self.identities: deque[np.ndarray] = deque(maxlen=self.parameters.window)
        self.next_identity = 1
        self.association: Association | None = None  # of the newest window

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
        interval: int | None = None,
    ) -> list[Tracks]:
        """Add the detections of a frame, and give them identities at once.

        now_from_before, interval: not used. appearance: gives (N, 768) histograms of the boxes. It is called at most
        once, where the dispersion of the locations requires it, maybe while one of the next frames is fed.
        """
        self.window.appendleft(Features(detections.box_px, appearance))
        identity = np.zeros(len(detections), np.int64)
        if len(self.window) > 1:
            self.association = associate(list(self.window), self.parameters)
            identity = inherit_identities(
                self.association.rows, len(detections), list(self.identities)[: len(self.window) - 1]
            )
        new = np.flatnonzero(identity == 0)
        identity[new] = self.next_identity + np.arange(len(new))
        self.next_identity += len(new)
        self.identities.appendleft(identity)
        return [Tracks(frame, identity, detections.box_px, detections.score, np.arange(len(detections)))]

    def end(self) -> list[Tracks]:
        """Nothing: no frame waits."""
        return []


def inherit_identities(
    rows: Int[np.ndarray, "Z K"], count: int, identities: Sequence[Int[np.ndarray, "N"]]
) -> Int[np.ndarray, "N"]:
    """The identities of the newest frame's targets by the window's links, 0 for a new target.

    identities: of the older frames, newest first. The newest link counts: i to j, or i to k where j is the dummy,
    unless another target has that identity by its own link to j.
    """
    identity = np.zeros(count, np.int64)
    for older, known in enumerate(identities, 1):
        direct = (rows[:, 0] > 0) & (rows[:, older] > 0) & (rows[:, 1:older] == 0).all(axis=1)
        taken = known[rows[direct, older] - 1]
        free = ~np.isin(taken, identity)
        identity[rows[direct, 0][free] - 1] = taken[free]
    return identity
