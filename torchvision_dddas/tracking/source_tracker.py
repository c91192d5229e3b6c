"""The source's tracker: association of absolute positions and RGB histograms, without torch (appendix C).

With every sampled frame, the last K frames are assigned again. A target takes the identity of the older target to which
its newest link in that window leads. The failures of this method are kept on purpose; the tests show them, and
`score_tracker` is the improved tracker.

Features are non-negative vectors, one row for each target. Affinities have a dummy target at index 0 of each axis. Axes
and windows are ordered from the newest frame to the oldest. `functional.affinity` computes affinities for batches of
tensors, and `torch_source_tracker` computes those of many windows at once.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Any, Literal

import cv2
import numpy as np

from torchvision_dddas.config import PaperParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.memory import check_memory
from torchvision_dddas.tracking.dual_ascent import add_lone_targets, assign_triplets
from torchvision_dddas.types import AppearanceUse, Detections, Float, Int, Tracks

Feature = Literal["location", "appearance"]

_COMBINATION = 45  # bytes of memory for each combination of targets in a window
_STEPS = 2.0**40  # the shares in a normalized histogram are rounded to multiples of 1 / _STEPS

# -- features ----------------------------------------------------------------------------------------------------------


def rgb_histograms(image: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """Return (N, 768) float32 counts of pixels: 256 levels of red, then of green, then of blue.

    image: (H, W, 3) uint8 BGR, or (H, W) grey, which is counted three times. box_px: (N, 4) x, y, width, height; edges
    are rounded to whole pixels and clipped to the image. A box without a pixel in the image has zeros.
    Source: appendix C, eq. 3.
    """
    counts = np.zeros((len(box_px), 3, 256), np.float32)
    for row, crop in zip(counts, crops(image, box_px), strict=True):
        if crop.size:
            for place, channel in enumerate((2, 1, 0)):
                row[place] = cv2.calcHist([crop], [channel], None, [256], [0, 256]).ravel()
    return counts.reshape(len(box_px), 768)


def crops(image: np.ndarray, box_px: np.ndarray) -> list[np.ndarray]:
    """Return the part (h, w, 3) of the picture in each box, with the rounding of `rgb_histograms`."""
    bgr = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    boxes = np.array(box_px, float).reshape(-1, 4)
    boxes[~np.isfinite(boxes).all(axis=1)] = 0.0
    limit = np.array(bgr.shape[1::-1])
    low = np.clip(np.rint(boxes[:, :2]), 0, limit).astype(int).tolist()
    high = np.clip(np.rint(boxes[:, :2] + boxes[:, 2:]), 0, limit).astype(int).tolist()
    return [bgr[top:bottom, left:right] for (left, top), (right, bottom) in zip(low, high, strict=True)]


def normalize_channels(histogram: Float[np.ndarray, "N 768"]) -> Float[np.ndarray, "N 768"]:
    """Divide the 256 bins of each channel by their sum, rounded to multiples of 2^-40; zeros stay zeros.

    Sums of such multiples are exact, so that affinities do not depend on the order of summation. That order differs
    between libraries and processors, and would decide ties, which the gate makes frequent.
    """
    channels = np.asarray(histogram, float).reshape(len(histogram), 3, 256)
    total = channels.sum(axis=-1, keepdims=True)
    return (np.rint(channels / np.where(total > 0, total, 1.0) * _STEPS) / _STEPS).reshape(len(histogram), 768)


def centres(box_px: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 2"]:
    """Return the boxes' centres (u, v) in pixels from the picture's corner, at least 0."""
    return np.maximum(box_px[:, :2] + box_px[:, 2:] / 2, 0.0)


@dataclass(frozen=True)
class PicturedBoxes:
    """The boxes of a frame and its picture. A call returns the boxes' histograms, as `Features` requires."""

    image: np.ndarray
    box_px: Float[np.ndarray, "N 4"]

    def __call__(self) -> Float[np.ndarray, "N 768"]:
        """Return the boxes' histograms from `rgb_histograms`."""
        return rgb_histograms(self.image, self.box_px)


class Features:
    """The features of a frame's targets. Histograms and dispersions are computed on first use, and cached.

    similarity: by feature, the (N, N) similarities of the frame's targets to each other, if computed in a batch.
    """

    def __init__(self, box_px: Float[np.ndarray, "N 4"], histograms: Callable[[], np.ndarray] | None) -> None:
        """Take the boxes. histograms: returns (N, 768) counts of pixels or shares; None without a picture."""
        self.centre_px = centres(box_px)
        self.source = histograms
        self.similarity: dict[Feature, np.ndarray] = {}
        self._histograms = np.zeros((len(box_px), 768)) if histograms is None or not len(box_px) else None
        self._dispersions: dict[tuple[Feature, float, str], float] = {}

    def __len__(self) -> int:
        return len(self.centre_px)

    @property
    def has_picture(self) -> bool:
        """Whether there is a picture for the histograms."""
        return self.source is not None

    @property
    def has_histograms(self) -> bool:
        """Whether the histograms are computed, or known to be zeros."""
        return self._histograms is not None

    def take_histograms(self, histograms: Float[np.ndarray, "N 768"]) -> None:
        """Store computed histograms. Raises InputError if they are not (N, 768)."""
        if histograms.shape != (len(self), 768):
            raise InputError(
                f"the source's association needs histograms ({len(self)}, 768), 3 x 256 bins for each box; "
                f"got {histograms.shape}. Compute them with tracking.rgb_histograms."
            )
        self._histograms = np.asarray(histograms, float)

    def histogram(self, normalization: str) -> Float[np.ndarray, "N 768"]:
        """Return the boxes' histograms, normalized as `paper.histogram` says."""
        if self._histograms is None and self.source is not None:
            self.take_histograms(self.source())
        assert self._histograms is not None
        return normalize_channels(self._histograms) if normalization == "channel" else self._histograms

    def values(self, feature: Feature, normalization: str) -> Float[np.ndarray, "N D"]:
        """Return the vectors of a feature: centres in pixels, or histograms."""
        return self.centre_px if feature == "location" else self.histogram(normalization)

    def dispersion(self, feature: Feature, parameters: PaperParameters) -> float:
        """Return the `dispersion` of the targets in a feature, and cache it."""
        cut = parameters.location_cut if feature == "location" else histogram_cut(parameters)
        key = (feature, cut, parameters.histogram)
        if key not in self._dispersions:
            if len(self) < 2:
                self._dispersions[key] = 1.0
            elif feature in self.similarity:
                self._dispersions[key] = _cluster_entropy(self.similarity[feature], cut)
            else:
                self._dispersions[key] = dispersion(self.values(feature, parameters.histogram), cut)
        return self._dispersions[key]


# -- affinities --------------------------------------------------------------------------------------------------------


def affinity(features: Sequence[np.ndarray], parameters: PaperParameters) -> np.ndarray:
    """Return the affinities of the targets of two or three frames by one feature, with a dummy first on each axis.

    Two frames (eq. 1): similarities (N + 1, M + 1). Three frames (eq. 4 and 5): (N + 1, M + 1, L + 1), the sum of the
    numerators of (a, b) and (b, c) over the sum of their denominators. With `paper.dummy` = zero, entries with a dummy
    are 0, as in the source's text. Otherwise the dummy is a zero vector in eq. 4 and 5, which gives up to one half for
    (i, j, 0) and (0, j, k).
    """
    if len(features) == 2:
        return np.pad(similarity(*features), ((1, 0), (1, 0)))
    by_formula = parameters.dummy != "zero"
    a, b, c = (np.pad(rows, ((1, 0), (0, 0))) if by_formula else rows for rows in features)
    (ab_smaller, ab_larger), (bc_smaller, bc_larger) = _overlap(a, b), _overlap(b, c)
    share = _share(ab_smaller[:, :, None] + bc_smaller[None], ab_larger[:, :, None] + bc_larger[None])
    return share if by_formula else np.pad(share, ((1, 0), (1, 0), (1, 0)))


def similarity(a: Float[np.ndarray, "N D"], b: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "N M"]:
    """Return the generalized Jaccard similarities Σ min / Σ max in [0, 1]; 0 for two zero vectors."""
    return _share(*_overlap(a, b))


def real_pairs(features: Sequence[np.ndarray], parameters: PaperParameters, feature: Feature) -> list[np.ndarray]:
    """Return the similarities (N, M) and (M, L) for `gate` if `paper.dummy` is real_pair; none for two frames."""
    if parameters.dummy != "real_pair" or len(features) < 3:
        return []
    scale = parameters.histogram_scale if feature == "appearance" else 1.0
    return [1 - scale * (1 - similarity(a, b)) for a, b in pairwise(features)]


def _overlap(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Σ min and Σ max of each pair, from min + max = a + b and max - min = |a - b|."""
    if not len(a) or not len(b):
        return np.zeros((len(a), len(b))), np.zeros((len(a), len(b)))
    from scipy.spatial.distance import cdist  # imported here because only the source's association needs it

    total = a.sum(axis=1)[:, None] + b.sum(axis=1)[None]
    apart = cdist(a, b, "cityblock")
    return np.maximum(total - apart, 0.0) / 2, (total + apart) / 2


def _share(smaller: np.ndarray, larger: np.ndarray) -> np.ndarray:
    return np.divide(smaller, larger, out=np.zeros_like(larger), where=larger > 0)


def scale_histograms(affinity: Float[np.ndarray, "..."], scale: float) -> Float[np.ndarray, "..."]:
    """Return a copy with the dissimilarity of real targets multiplied by `scale`. Entries with a dummy do not change.

    In Fig. 6 of the source the accuracy is constant for thresholds above 0.4, so the gate cuts no true link there. With
    the formula as printed, histograms of 3 x 256 bins differ by more than 0.4 in 42 % of the true links of PETS09-S2L1
    and in 7 % of those of TUD-Stadtmitte, five frames apart. The source must therefore have used another scale.
    """
    scaled = np.array(affinity, float)
    real = np.index_exp[1:] * scaled.ndim
    scaled[real] = 1 - scale * (1 - scaled[real])
    return scaled


def histogram_cut(parameters: PaperParameters) -> float:
    """Return the dissimilarity of histograms, before scaling, at which the cluster tree is cut."""
    return parameters.appearance_cut / parameters.histogram_scale


def gate(
    score: Float[np.ndarray, "..."],
    threshold: float,
    reading: Literal["one_dummy", "every_dummy", "off"],
    pairs: Sequence[np.ndarray] = (),
) -> Float[np.ndarray, "..."]:
    """Raise entries with a dummy to 1 - threshold if all real alternatives are below (III-E), and return a copy.

    score: two or three axes; index 0 of each is the dummy. reading: "one_dummy" raises entries with exactly one dummy;
    "every_dummy" follows the text literally, so that entries with two dummies are raised too, and the best assignment
    leaves every target alone; "off" raises no entry. The entry of only dummies is never raised. For an entry with two
    dummies, the smaller of the best alternatives of its axes counts. pairs: raise only entries of two successive
    targets whose own similarity is at least 1 - threshold [our reading for three frames].
    """
    score = np.array(score, float)
    if reading == "off":
        return score
    best = np.full(score.shape, np.inf)
    firsts = [np.index_exp[:] * axis + (0,) for axis in range(score.ndim)]
    dummies = np.zeros(score.shape, np.int64)
    for first in firsts:
        dummies[first] += 1
    allowed = dummies == 1 if reading == "one_dummy" else dummies < score.ndim
    if pairs:
        allowed[:] = False
        allowed[1:, 1:, 0], allowed[0, 1:, 1:] = (alike >= 1 - threshold for alike in pairs)
    for axis, first in enumerate(firsts):
        real = score.take(np.arange(1, score.shape[axis]), axis).max(axis=axis, initial=-np.inf)
        best[first] = np.where(allowed[first], np.minimum(best[first], real), best[first])
    return np.where(best < 1 - threshold, 1 - threshold, score)


# -- which feature counts ----------------------------------------------------------------------------------------------


def dispersion(feature: Float[np.ndarray, "N D"], cut: float) -> float:
    """Return the dispersion of a frame's targets in a feature (III-D): the normalized entropy of their clusters.

    The clusters come from average linkage; the tree is cut at the dissimilarity `cut` (eq. 10 and G).
    """
    return 1.0 if len(feature) < 2 else _cluster_entropy(similarity(feature, feature), cut)


def _cluster_entropy(alike: Float[np.ndarray, "N N"], cut: float) -> float:
    """Return the dispersion of two or more targets from their similarities."""
    from scipy.cluster.hierarchy import fcluster  # imported here because only the source's association needs it

    return normalized_entropy(fcluster(_tree(alike), cut, "distance"))


def normalized_entropy(cluster: Int[np.ndarray, "N"]) -> float:
    """Return Ndm of eq. 9: 1 if each target is its own cluster, 0 if all are one cluster, 1 for less than 2 targets."""
    if len(cluster) < 2:
        return 1.0
    share = np.unique(cluster, return_counts=True)[1] / len(cluster)
    return float(np.abs((share * np.log2(share)).sum()) / np.log2(len(cluster)))


def _tree(alike: Float[np.ndarray, "N N"]) -> np.ndarray:
    from scipy.cluster.hierarchy import linkage
    from scipy.spatial.distance import squareform

    dissimilarity = 1 - alike
    np.fill_diagonal(dissimilarity, 0.0)
    return np.asarray(linkage(squareform(dissimilarity, checks=False), "average"))


def frames_considered(counts: Sequence[int], parameters: PaperParameters) -> int:
    """Return the number of frames of a window, from the newest, whose smallest dispersion counts (`dispersion_of`)."""
    of_all = {"smallest": True, "newest": False, "smallest_if_counts_differ": len(set(counts)) > 1}
    return len(counts) if of_all[parameters.dispersion_of] else 1


def location_weight(location: float, appearance: Callable[[], float], lowest: float) -> tuple[float, float | None]:
    """Return the weight of location, and the dispersion of appearance or None if it was not needed.

    The weight is 1 if locations distinguish the targets; otherwise 0 if appearance does, and one half if neither does.
    This is the source's second feedback rule.
    """
    if location > lowest:
        return 1.0, None
    found = appearance()
    return (0.0 if found > lowest else 0.5), found


def needs_appearance(window: Sequence[Features], parameters: PaperParameters) -> bool:
    """Return whether the association of a window needs its histograms."""
    if not all(frame.has_picture or not len(frame) for frame in window):
        return False
    if parameters.rule == "fixed":
        return parameters.weight < 1
    return smallest_dispersion(window, "location", parameters) <= parameters.lowest_dispersion


def smallest_dispersion(window: Sequence[Features], feature: Feature, parameters: PaperParameters) -> float:
    """Return the smallest dispersion of a window's frames, among those that `dispersion_of` selects."""
    considered = window[: frames_considered([len(frame) for frame in window], parameters)]
    return min(frame.dispersion(feature, parameters) for frame in considered)


def weigh(window: Sequence[Features], parameters: PaperParameters) -> tuple[float, float, float | None]:
    """Return the weight of location in a window, and the dispersions of locations and of appearances (or None)."""
    location = smallest_dispersion(window, "location", parameters)
    if not needs_appearance(window, parameters):
        return 1.0, location, None
    if parameters.rule == "fixed":
        return parameters.weight, location, None

    def appearance() -> float:
        return smallest_dispersion(window, "appearance", parameters)

    weight, found = location_weight(location, appearance, parameters.lowest_dispersion)
    return weight, location, found


def explain_weight(
    window: Sequence[Features], weight: float, location: float, appearance: float | None, parameters: PaperParameters
) -> AppearanceUse:
    """Return the results of `weigh`, with the cause in words."""
    lowest, found = parameters.lowest_dispersion, f"dispersion of locations {location:.3f}"
    has_pictures = all(frame.has_picture or not len(frame) for frame in window)
    if parameters.rule == "fixed":
        cause = "paper.rule is fixed"
    elif location > lowest:
        cause = f"{found}, above {lowest:g}"
    elif appearance is not None:
        cause = f"{found}, of appearances {appearance:.3f}: {'only the latter' if weight == 0 else 'neither'}"
        cause += f" above {lowest:g}"
    else:
        cause = f"{found}, not above {lowest:g}"
    if not has_pictures and weight == 1:
        is_wanted = parameters.rule != "fixed" and location <= lowest
        cause += f", {'but' if is_wanted else 'and'} a frame has no picture"
    shown = float("nan") if appearance is None else appearance
    return AppearanceUse(weight < 1, cause, weight, location, shown)


# -- association -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Association:
    """The assignment of a window.

    rows: (Z, K) indices from 1, 0 for the dummy. weight: weight of location. appearance_dispersion: None if it was not
    needed.
    """

    rows: Int[np.ndarray, "Z K"]
    weight: float
    location_dispersion: float
    appearance_dispersion: float | None


def check_window(window: Sequence[Features]) -> None:
    """Raise InputError if a window has too many combinations of targets for the memory budget."""
    count, most = math.prod(len(frame) + 1 for frame in window), max(map(len, window))
    what = f"paper.window = {len(window)} with {most} targets in a frame has {count:,} combinations"
    check_memory(_COMBINATION * count, what, 0, "use paper.window=2, or another --config")


def associate(
    window: Sequence[Features], parameters: PaperParameters, affinities: Mapping[Feature, np.ndarray] | None = None
) -> Association:
    """Assign the targets of two or three frames: weigh, gate, solve.

    affinities: by feature, if a batch computed them already.
    """
    weight, location, appearance = weigh(window, parameters)

    shares: dict[Feature, float] = {"location": weight, "appearance": 1 - weight}
    scores, pairs = dict(affinities or {}), dict[Feature, list[np.ndarray]]()
    for feature in [name for name, share in shares.items() if share > 0]:
        values = [frame.values(feature, parameters.histogram) for frame in window]
        pairs[feature] = real_pairs(values, parameters, feature)
        if feature not in scores:
            scores[feature] = affinity(values, parameters)
    rows = assign(scores.get("location"), scores.get("appearance"), weight, parameters, pairs)
    return Association(rows, weight, location, appearance)


def assign(
    location: Float[np.ndarray, "N1 M1 *L1"] | None,
    appearance: Float[np.ndarray, "N1 M1 *L1"] | None,
    weight: float,
    parameters: PaperParameters,
    pairs: Mapping[Feature, Sequence[np.ndarray]] = MappingProxyType({}),
) -> Int[np.ndarray, "Z K"]:
    """Return the best assignment for affinities with a dummy first on each axis, as (Z, K) indices, 0 for the dummy.

    A feature without weight may be None. appearance: affinities of histograms before scaling. pairs: `real_pairs` by
    feature. Every real target is in exactly one row; rows are sorted. Source: eq. 2, 6 and 7 with the gate of III-E.
    """
    if appearance is not None:
        appearance = scale_histograms(appearance, parameters.histogram_scale)
    given: Any = ("location", weight, location), ("appearance", 1 - weight, appearance)
    parts: Any = [(share, (score, *pairs.get(name, ()))) for name, share, score in given if score is not None]
    if parameters.gated == "affinity":
        parts = [(1.0, [sum(share * of[k] for share, of in parts) for k in range(len(parts[0][1]))])]
    score: Any = sum(
        share * gate(part, parameters.threshold, parameters.gate, alike) for share, (part, *alike) in parts
    )
    if score.ndim == 2:
        over_alone = score[1:, 1:] - score[1:, :1] - score[:1, 1:]
        rows = add_lone_targets(best_pairs(over_alone) + 1, score.shape)
        return rows[np.lexsort(rows.T[::-1])]
    if max(score.shape) - 1 <= parameters.exact_targets:
        return assign_triplets(score, gap=0.0, most_exact=None).triplets
    return assign_triplets(score, parameters.gap).triplets


class SourceTracker:
    """The tracker of a run by the source's association. It has the interface of `ScoreTracker`, but no delay."""

    def __init__(self, settings: Settings, interval: int, size: tuple[float, float] | None = None) -> None:
        """Start without frames. interval, size: not used; positions are compared in pixels of the picture."""
        self.parameters = settings.paper
        self.window: deque[Features] = deque(maxlen=self.parameters.window)  # newest first
        self.identities: deque[np.ndarray] = deque(maxlen=self.parameters.window - 1)  # of all frames but the newest
        self.next_identity = 1

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
    ) -> list[Tracks]:
        """Add the detections of a frame, and return it with identities at once.

        now_from_before: not used. appearance: returns (N, 768) histograms of the boxes. It is called at most once, and
        only if the dispersion of the locations requires it, perhaps while a later frame is fed.
        """
        self.window.appendleft(Features(detections.box_px, appearance))
        check_window(self.window)
        return [self.identify(frame, detections, list(self.window))]

    def identify(
        self,
        frame: int,
        detections: Detections,
        window: Sequence[Features],
        affinities: Mapping[Feature, np.ndarray] | None = None,
    ) -> Tracks:
        """Return the newest frame of a window with identities. affinities: see `associate`."""
        identity, use = np.zeros(len(detections), np.int64), None
        if len(window) > 1:
            found = associate(window, self.parameters, affinities)
            rows = found.rows
            if len(window[0]) and any(map(len, window[1:])):  # otherwise there was nothing to link
                dispersions = found.location_dispersion, found.appearance_dispersion
                use = explain_weight(window, found.weight, *dispersions, self.parameters)
            # A target takes the identity from its newest link: from frame i to j, or to k if j is the dummy. If another
            # target has already taken that identity through a link to j, this target gets a new identity.
            for older, known in enumerate(self.identities, 1):
                direct = (rows[:, 0] > 0) & (rows[:, older] > 0) & (rows[:, 1:older] == 0).all(axis=1)
                taken = known[rows[direct, older] - 1]
                free = ~np.isin(taken, identity)
                identity[rows[direct, 0][free] - 1] = taken[free]
        new = np.flatnonzero(identity == 0)
        identity[new] = self.next_identity + np.arange(len(new))
        self.next_identity += len(new)
        self.identities.appendleft(identity)
        row = np.arange(len(detections))
        return Tracks(frame, identity, detections.box_px, detections.score, row, appearance=use)

    def end(self) -> list[Tracks]:
        """Return nothing, because no frame waits."""
        return []
