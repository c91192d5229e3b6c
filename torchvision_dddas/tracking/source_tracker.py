"""The source's association and the identities that follow from it (appendix C): absolute positions, RGB histograms.

Every `interval` the last K frames are assigned anew; a target takes the identity of the older target that the newest
link of that window names. What fails in it is kept: see the tests, and `tracks` for what is done better.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import PaperParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking import assignment, jaccard
from torchvision_dddas.tracking import lagrangian as relaxation
from torchvision_dddas.tracking.dispersion import dispersion, location_weight, of_window
from torchvision_dddas.tracking.gating import gate
from torchvision_dddas.tracking.triplet_scores import pair_gain_over_alone
from torchvision_dddas.types import Detections, Float, Int, Tracks


class Look:
    """What the association knows of a frame; histograms are made when they are first asked for."""

    def __init__(self, box_px: Float[np.ndarray, "N 4"], histograms: Callable[[], np.ndarray] | None) -> None:
        """histograms: gives (N, 768) numbers of pixels or shares; None where there is no picture."""
        self.centre_px = jaccard.centres(box_px)
        self._make = histograms
        self._made = np.zeros((len(box_px), 768)) if histograms is None or not len(box_px) else None

    def __len__(self) -> int:
        return len(self.centre_px)

    @property
    def has_picture(self) -> bool:
        """Whether there are histograms to ask for."""
        return self._make is not None

    def histogram(self, normalization: str) -> Float[np.ndarray, "N 768"]:
        """The boxes' histograms by the reading that `paper.histogram` names."""
        if self._made is None and self._make is not None:
            self._made = np.asarray(self._make(), float)
            if self._made.shape != (len(self), 768):
                raise InputError(
                    f"the source's association needs histograms ({len(self)}, 768), 3 x 256 bins a box; "
                    f"got {self._made.shape}. Make them with engine.histograms.rgb_histograms."
                )
        assert self._made is not None
        return jaccard.per_channel(self._made) if normalization == "channel" else self._made


@dataclass(frozen=True)
class Association:
    """How a window was assigned: rows (i, j) or (i, j, k), newest first, from 1, and 0 for the dummy; and by what."""

    rows: Int[np.ndarray, "Z K"]
    weight: float
    location_dispersion: float
    appearance_dispersion: float | None


def associate(window: Sequence[Look], parameters: PaperParameters) -> Association:
    """Assign the targets of two or three frames, newest first: weigh, gate, solve."""
    counts = [len(look) for look in window]
    location = of_window([dispersion(look.centre_px, parameters.location_cut) for look in window], counts, parameters)

    def appearance() -> float:
        found = [dispersion(look.histogram(parameters.histogram), parameters.appearance_cut) for look in window]
        return of_window(found, counts, parameters)

    asked: float | None = None
    if not all(look.has_picture or not len(look) for look in window):
        weight = 1.0
    elif parameters.rule == "fixed":
        weight = parameters.weight
    else:
        weight, asked = location_weight(location, appearance, parameters.lowest_dispersion)
    by_location = affinity([look.centre_px for look in window], parameters) if weight > 0 else None
    by_appearance = (
        affinity([look.histogram(parameters.histogram) for look in window], parameters) if weight < 1 else None
    )
    return Association(assign(by_location, by_appearance, weight, parameters), weight, location, asked)


def assign(
    location: Float[np.ndarray, "N1 M1 *L1"] | None,
    appearance: Float[np.ndarray, "N1 M1 *L1"] | None,
    weight: float,
    parameters: PaperParameters,
) -> Int[np.ndarray, "Z K"]:
    """The best assignment of affinities with a dummy first on each axis; a feature of no weight may be None.

    Every real target stands in exactly one row; rows are sorted. Source: eq. 2, 6 and 7 with the gate of III-E.
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
        return assignment.triplets_exact(score)
    return relaxation.triplets(score, parameters.gap).triplets


def affinity(features: Sequence[np.ndarray], parameters: PaperParameters) -> np.ndarray:
    """Of the targets of two or three frames by one feature, newest first, with a dummy first on each axis."""
    if len(features) == 2:
        return jaccard.pairs(features[0], features[1])
    return jaccard.triplets(features[0], features[1], features[2], parameters.dummy)


def _best_pairs(score: Float[np.ndarray, "N1 M1"]) -> Int[np.ndarray, "Z 2"]:
    """As `triplets_exact`, for two frames: what a pair gains over leaving both with the dummy is SciPy's matter."""
    matched = best_pairs(pair_gain_over_alone(score)) + 1
    rows = [matched]
    for axis, size in enumerate(score.shape):
        alone = np.zeros((size - 1 - len(matched), 2), np.int64)
        alone[:, axis] = np.setdiff1d(np.arange(1, size), matched[:, axis])
        rows.append(alone)
    pairs = np.concatenate(rows)
    return pairs[np.lexsort(pairs.T[::-1])]


class PaperTracker:
    """The state of a run by the source's association; the same interface as `tracks.Tracker`, and never any delay."""

    def __init__(self, settings: Settings, interval_frames: int, size: tuple[float, float] | None = None) -> None:
        """interval_frames, size: not needed here; what is fed is what is associated, in pixels of the picture."""
        self.parameters = settings.paper
        self.window: deque[Look] = deque(maxlen=self.parameters.window)  # newest first
        self.identities: deque[np.ndarray] = deque(maxlen=self.parameters.window)
        self.next_identity = 1
        self.association: Association | None = None  # the newest window's, to be looked at

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
        interval_frames: int | None = None,
    ) -> list[Tracks]:
        """Take the detections of a frame and give them identities at once.

        now_from_before, interval_frames: not used; the source compares positions in the picture, whatever the camera
        did, and however long it took.
        appearance: gives (N, 768) histograms of the boxes. It is called only where the dispersion of the locations asks
        for it, which may be while one of the next frames is fed, and at most once.
        """
        self.window.appendleft(Look(detections.box_px, appearance))
        identity = np.zeros(len(detections), np.int64)
        if len(self.window) > 1:
            self.association = associate(list(self.window), self.parameters)
            identity = inherited(self.association.rows, len(detections), list(self.identities)[: len(self.window) - 1])
        new = np.flatnonzero(identity == 0)
        identity[new] = self.next_identity + np.arange(len(new))
        self.next_identity += len(new)
        self.identities.appendleft(identity)
        return [Tracks(frame, identity, detections.box_px, detections.score, np.arange(len(detections)))]

    def end(self) -> list[Tracks]:
        """Nothing: no frame ever waits."""
        return []


def inherited(
    rows: Int[np.ndarray, "Z K"], count: int, identities: Sequence[Int[np.ndarray, "N"]]
) -> Int[np.ndarray, "N"]:
    """The identities of the newest frame's targets by the window's links, 0 for who is new.

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
