"""The detection chain, written once: find the moving pixels of a reference frame by comparison with neighbour frames.

    neighbours   warp each neighbour to the reference by the camera's motion         appendix B, step S3
                 correct its exposure                                                not in the source
    compare      take the difference that both neighbours of a pair show             eq. 9 (`between_later`), step S4
                 divide it by the local noise, and smooth it                         step S5, noise units are ours
    combine      take the largest over the near pairs
    find_core    threshold, erode, dilate, close                                     step S5
    find_small   find small slow targets                                             not in the source

Engines provide the operations: OpenCV on arrays, Kornia and torch on tensors. Registration runs before the chain;
blobs, their motion, tracklets and outlines are computed after it (`detection`).
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from itertools import islice
from typing import Any, Generic

from torchvision_dddas.chain.operations import Number, Operations, Picture, Seen, View
from torchvision_dddas.config import EVIDENCE_CAP, EVIDENCE_SCALE, HALF, DifferenceParameters, Settings, uses_tracklets

Pair = tuple[int, int]

_TEXTURED = 16  # 4 x grey levels a pixel; differences at pixels with a larger gradient measure the registration error
_SMALL_BLUR_PX, _LEVELS_BLUR_PX = 5, 7


@dataclass(frozen=True)
class Window(Generic[View]):
    """A reference frame and its neighbours in time. neighbour_from_reference: (K, 3, 3), or (B, K, 3, 3) for tensors.

    offsets: (K,) frames from the reference, negative = past. near: pairs of indices of neighbours whose evidence is
    combined; the last pair is the widest and is used for outlines. wide: a pair further apart, which fills the
    interior of large targets. small: a pair that shows small slow targets. close_px: side of the ellipse that closes
    gaps between fragments of a target; 0: the value in the settings. settings: settings for this frame; None: the
    engine's settings. ignored: mask of the reference's excluded pixels.
    """

    reference: View
    neighbours: tuple[View, ...]
    neighbour_from_reference: Any
    offsets: tuple[int, ...]
    near: tuple[Pair, ...]
    wide: Pair | None = None
    small: Pair | None = None
    close_px: int = 0
    settings: Settings | None = None
    ignored: Any = None


@dataclass(frozen=True)
class Reference(Generic[Picture]):
    """The reference frame's grey levels, and its mean gradient in 4 x grey levels a pixel."""

    grey: Picture
    texture: Picture


@dataclass(frozen=True)
class Maps(Generic[Picture]):
    """The results of the chain for a window, in the reference's pixels.

    core: mask of target pixels, after the threshold and morphology. evidence: the largest difference over the near
    pairs, in steps of 1/16 noise unit or in grey levels. wide: the same for the wide pair. texture: mean gradient, 4 x
    grey levels a pixel. small: mask of candidates for small slow targets; None if they are not searched for. warped:
    the two neighbours of the widest near pair, in the reference's coordinates and exposure. pairs: the evidence of each
    near pair. levels: the larger difference of the nearest and the wide pair, in grey levels, smoothed; None without
    tracklets.
    """

    core: Picture
    evidence: Picture
    wide: Picture
    texture: Picture
    small: Picture | None
    warped: tuple[Picture, Picture]
    pairs: tuple[Picture, ...] = ()
    levels: Picture | None = None


def evidence_scale(settings: Settings) -> float:
    """Return the steps of an evidence map in one unit of the thresholds: 1 unless the difference is normalized."""
    return EVIDENCE_SCALE if settings.difference.kind == "normalized" else 1.0


def halve_side(side: int) -> int:
    """Return an odd side of about half the length of an odd side: 25 -> 13, 7 -> 3, 3 -> 1."""
    return 2 * (side // 4) + 1


class DetectionChain(Generic[View, Picture, Seen]):
    """The detection chain for given settings and operations."""

    def __init__(
        self,
        settings: Settings,
        operations: Operations[View, Picture, Seen],
        values: Mapping[str, Number] | None = None,
    ) -> None:
        """Set up the chain. values: numbers or tensors by parameter name, which replace the settings' values."""
        self.settings, self.operations, self.values = settings, operations, values or {}
        self.is_normalized = settings.difference.kind == "normalized"

    def value(self, name: str) -> Number:
        """Return the value of a parameter, such as "difference.threshold"."""
        if name in self.values:
            return self.values[name]
        group, key = name.split(".")
        return getattr(getattr(self.settings, group), key)

    def find_foreground(self, window: Window[View]) -> Maps[Picture]:
        """Run all steps of the chain on a window, and return its maps."""
        neighbours = self.neighbours(window)
        reference = neighbours.reference()
        compared = window.near if window.wide is None else (*window.near, window.wide)
        evidences = self.find_evidences(map(neighbours.compared_and_seen, compared), reference)
        pairs = tuple(islice(evidences, len(window.near)))
        near = reduce(self.operations.larger, pairs)
        one, other = window.near[-1]
        warped = neighbours.warped(one), neighbours.warped(other)
        levels = self.find_levels(neighbours, window.near[0]) if uses_tracklets(self.settings) else None
        neighbours.keep_for(window.wide, window.small)
        wide = near
        if window.wide is not None:
            (wide,) = evidences
            if levels is not None:
                levels = self.operations.larger(levels, self.find_levels(neighbours, window.wide))
        neighbours.keep_for(window.small)
        core = self.find_core(near, window.close_px)
        small = None if window.small is None else self.find_small(neighbours, window.small)
        return Maps(core, near, wide, reference.texture, small, warped, pairs, levels)

    def neighbours(self, window: Window[View]) -> "Neighbours[View, Picture, Seen]":
        """Return the neighbours of a window, warped to its reference."""
        return Neighbours(window, self.settings, self.operations)

    def find_evidence(self, pairs: Iterable[tuple[Picture, Picture]], reference: Reference[Picture]) -> Picture:
        """Return the largest evidence over one or more pairs; see `find_evidences`."""
        return reduce(self.operations.larger, self.find_evidences(pairs, reference))

    def find_evidences(
        self, pairs: Iterable[tuple[Picture, Picture]], reference: Reference[Picture]
    ) -> Iterator[Picture]:
        """Yield the evidence of each pair: its smoothed difference, in noise units, at pixels that both frames show.

        pairs: for each pair the difference and the mask of these pixels, as from `Neighbours.compared_and_seen`.
        """
        weight = self._noise_weight(reference.texture)
        for difference, seen in pairs:
            yield self._find_pair_evidence(difference, seen, reference.texture, weight)

    def _noise_weight(self, texture: Picture) -> Any:
        """Return the steps of evidence for one grey level; None unless differences are in units of local noise."""
        if not self.is_normalized:
            return None
        levels, share = self.value("difference.noise_levels"), self.value("difference.gradient_share")
        return self.operations.noise_weight(texture, levels, share, EVIDENCE_SCALE)

    def _find_pair_evidence(self, difference: Picture, seen: Picture, texture: Picture, weight: Any) -> Picture:
        operations = self.operations
        if weight is None:
            return operations.inside(self._blur(difference), seen)
        z = self._blur(operations.weigh(operations.inside(difference, seen), weight, EVIDENCE_CAP))
        textured = operations.inside(operations.exceeds(texture, _TEXTURED), seen)
        return operations.in_units_of_median(z, textured, EVIDENCE_SCALE)

    def _blur(self, difference: Picture) -> Picture:
        if self.settings.difference.blur_of == "silhouette":
            return difference
        return self.operations.blur(difference, self.value("difference.blur_px"))

    def find_core(self, evidence: Picture, close_px: int = 0) -> Picture:
        """Return the mask of evidence above the threshold, cleaned. close_px: replaces morphology.close_px unless 0."""
        operations = self.operations
        mask = operations.above(evidence, self.value("difference.threshold") * evidence_scale(self.settings))
        if self.settings.difference.blur_of == "silhouette":
            mask = operations.above(operations.blur(mask, self.value("difference.blur_px")), HALF)
        mask = operations.erode(mask, self.value("morphology.erode_px"))
        mask = operations.dilate(mask, self.value("morphology.dilate_px"))
        return operations.close(mask, close_px or self.value("morphology.close_px"))

    def find_levels(self, neighbours: "Neighbours[View, Picture, Seen]", pair: Pair) -> Picture:
        """Return the smoothed difference of a pair in grey levels, 0 where a neighbour does not show the pixel."""
        return self.operations.inside(
            self.operations.blur(neighbours.least(pair), _LEVELS_BLUR_PX), neighbours.both(pair)
        )

    def find_small(self, neighbours: "Neighbours[View, Picture, Seen]", pair: Pair) -> Picture:
        """Return the mask of candidates for small targets: differences in grey levels well above their mean."""
        parameters, operations = self.settings.small, self.operations
        least = operations.inside(operations.blur(neighbours.least(pair), _SMALL_BLUR_PX), neighbours.both(pair))
        mask = operations.stands_out(least, parameters.threshold, parameters.noise_ratio)
        return operations.close(mask, parameters.close_px)


class Neighbours(Generic[View, Picture, Seen]):
    """The neighbours of a window, warped to the reference when they are first needed.

    All warped neighbours of a window with their masks would take 15 MB at 1280x720.
    """

    def __init__(self, window: Window[View], settings: Settings, operations: Operations[View, Picture, Seen]) -> None:
        self.window, self.settings, self.operations = window, settings, operations
        self._made: dict[int, tuple[Picture, Seen]] = {}
        self._least: dict[Pair, Picture] = {}

    @property
    def _parameters(self) -> DifferenceParameters:
        return self.settings.difference

    def reference(self) -> Reference[Picture]:
        """Return the reference's grey levels and texture. The texture is 0 if no step needs it."""
        view, operations = self.window.reference, self.operations
        is_needed = self._parameters.kind == "normalized" or self.settings.refine.on
        return Reference(operations.grey(view), operations.texture(view) if is_needed else operations.no_texture(view))

    def warped(self, index: int) -> Picture:
        """Return a neighbour in the reference's coordinates and exposure."""
        return self._make(index)[0]

    def both(self, pair: Pair) -> Picture:
        """Return the mask of the reference's pixels that both frames of a pair show and that are not ignored."""
        one, other = (self._make(index)[1] for index in pair)
        both = self.operations.seen_by_both(one, other, self.window.reference)
        return both if self.window.ignored is None else self.operations.outside(both, self.window.ignored)

    def compared(self, pair: Pair) -> Picture:
        """Return the difference of a pair by `difference.kind`."""
        if self._parameters.kind == "between_later":  # eq. 9 marks a target where it is in the two later frames
            return self.operations.difference(self.warped(pair[0]), self.warped(pair[1]))
        return self.least(pair)

    def compared_and_seen(self, pair: Pair) -> tuple[Picture, Picture]:
        """Return the difference of a pair, and the mask of the pixels that both of its frames show."""
        return self.compared(pair), self.both(pair)

    def least(self, pair: Pair) -> Picture:
        """Return the smaller of the reference's differences to a pair; it marks targets at their reference position."""
        if pair not in self._least:
            grey = self.operations.grey(self.window.reference)
            one, other = (self.operations.difference(grey, self.warped(index)) for index in pair)
            self._least[pair] = self.operations.smaller(one, other)
        return self._least[pair]

    def keep_for(self, *pairs: Pair | None) -> None:
        """Drop the cached pictures that none of these pairs uses."""
        wanted = {index for pair in pairs if pair for index in pair}
        self._made = {index: kept for index, kept in self._made.items() if index in wanted}
        self._least = {pair: kept for pair, kept in self._least.items() if pair in pairs}

    def _make(self, index: int) -> tuple[Picture, Seen]:
        if index not in self._made:
            operations, window, kind = self.operations, self.window, self._parameters.kind
            reference, neighbour = window.reference, window.neighbours[index]
            motion = window.neighbour_from_reference[..., index, :, :]
            warped = operations.warp(neighbour, reference, motion)
            seen = operations.seen(neighbour, reference, motion, self._parameters.border_px)
            if kind == "normalized":
                warped = operations.apply_light(reference, warped, operations.fit_light(reference, warped, seen))
            elif kind == "to_reference":
                warped = operations.apply_light(reference, warped, operations.fit_level_shares(reference, neighbour))
            self._made[index] = warped, seen
        return self._made[index]
