"""The detection chain, written once: what moves in a reference frame, seen from frames around it.

    neighbours   warp each neighbour to the reference by the camera's motion         appendix B, step S3
                 correct its exposure                                                not in the source
    compare      the difference that both neighbours of a pair show                  eq. 9 (`between_later`), step S4
                 in units of the local noise, smoothed                               step S5, noise units not in it
    combine      the largest over the near pairs
    find_core    threshold, erode, dilate, close                                     step S5
    find_weak    the same at half the resolution, of a pair further apart            not in the source
    find_small   what is small and slow                                              not in the source

Engines give the operations: OpenCV on arrays, Kornia and torch on tensors. Registration comes before the chain, blobs,
their motion, persistence and outlines after it (`detection`).
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any, Generic

from torchvision_dddas.chain.operations import Number, Operations, Picture, Seen, View
from torchvision_dddas.config import EVIDENCE_CAP, EVIDENCE_SCALE, HALF, DifferenceParameters, Settings

Pair = tuple[int, int]

_TEXTURED = 16  # 4 x grey levels a pixel: pixels of more gradient show how well the registration fits
_SMALL_BLUR_PX = 5


@dataclass(frozen=True)
class Window(Generic[View]):
    """A reference frame and its neighbours in time.

    neighbour_from_reference: (K, 3, 3), or (B, K, 3, 3) of tensors. offsets: (K,) frames from the reference, negative
    = past. near: pairs of indices of neighbours whose evidence is combined; the last one is the widest and shows the
    motion. wide: a pair further apart, which fills the inside of large targets. small: one that shows small slow
    targets. close_px: side of the ellipse that closes gaps between fragments of a target; 0: that of the settings.
    settings: those of the frame, for engines that find blobs themselves; None: those of the engine. ignored: set where
    the reference is left out.
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

    @property
    def looks_both_ways(self) -> bool:
        """Whether there is a wide pair, and it shows what is in the reference frame alone."""
        return self.wide is not None and self.offsets[self.wide[0]] * self.offsets[self.wide[1]] < 0


@dataclass(frozen=True)
class Reference(Generic[Picture]):
    """What a reference frame shows by itself: its grey levels, and its mean gradient, 4 x grey levels a pixel."""

    grey: Picture
    texture: Picture


@dataclass(frozen=True)
class Maps(Generic[Picture]):
    """What the chain finds of a window, in the reference's pixels.

    core: set where a target is certain, cleaned by morphology. evidence: the difference, the largest over the near
    pairs, in steps of 1/16 noise unit or in grey levels; `wide` the same for the wide pair. texture: mean gradient, 4 x
    grey levels a pixel. small: set where something small may move; None where it is not wanted. warped: the two
    neighbours of the widest near pair, in the reference's frame and exposure. pairs: the evidence of each near pair.
    """

    core: Picture
    evidence: Picture
    wide: Picture
    texture: Picture
    small: Picture | None
    warped: tuple[Picture, Picture]
    pairs: tuple[Picture, ...] = ()


def evidence_scale(settings: Settings) -> float:
    """The step of evidence maps for one unit of the thresholds: grey levels unless the difference is normalized."""
    return EVIDENCE_SCALE if settings.difference.kind == "normalized" else 1.0


def halve_side(side: int) -> int:
    """The odd side nearest to half of an odd one: 25 -> 13, 7 -> 3, 3 -> 1."""
    return 2 * (side // 4) + 1


class DetectionChain(Generic[View, Picture, Seen]):
    """The chain of some settings on some operations."""

    def __init__(
        self,
        settings: Settings,
        operations: Operations[View, Picture, Seen],
        values: Mapping[str, Number] | None = None,
    ) -> None:
        """values: numbers, or tensors that take gradients, by name of parameter; they replace those of the settings."""
        self.settings, self.operations, self.values = settings, operations, values or {}
        self.is_normalized = settings.difference.kind == "normalized"

    def value(self, name: str) -> Number:
        """The value of a parameter, as "difference.threshold"."""
        if name in self.values:
            return self.values[name]
        group, key = name.split(".")
        return getattr(getattr(self.settings, group), key)

    def find_foreground(self, window: Window[View]) -> Maps[Picture]:
        """The maps of a window, by all steps of the chain."""
        neighbours = self.neighbours(window)
        reference = neighbours.reference()
        pairs = tuple(self.find_evidences(map(neighbours.compared_and_seen, window.near), reference))
        near = reduce(self.operations.larger, pairs)
        one, other = window.near[-1]
        warped = neighbours.warped(one), neighbours.warped(other)
        neighbours.keep_for(window.wide, window.small)
        wide = near
        if window.wide is not None:
            (wide,) = self.find_evidences([neighbours.compared_and_seen(window.wide)], reference)
        neighbours.keep_for(window.small)
        core = self.find_core(near, window.close_px)
        small = None if window.small is None else self.find_small(neighbours, window.small)
        return Maps(core, near, wide, reference.texture, small, warped, pairs)

    def neighbours(self, window: Window[View]) -> "Neighbours[View, Picture, Seen]":
        """The neighbours of a window as its reference sees them."""
        return Neighbours(window, self.settings, self.operations)

    def find_evidence(self, pairs: Iterable[tuple[Picture, Picture]], reference: Reference[Picture]) -> Picture:
        """The largest evidence of one or more pairs, as `find_evidences`."""
        return reduce(self.operations.larger, self.find_evidences(pairs, reference))

    def find_evidences(
        self, pairs: Iterable[tuple[Picture, Picture]], reference: Reference[Picture]
    ) -> Iterator[Picture]:
        """The evidence of each pair: its difference where both neighbours are seen, smoothed, in units of noise.

        pairs: of each the difference and the mask of what both neighbours show, as `Neighbours.compared_and_seen`.
        """
        weight = self._noise_weight(reference.texture)
        for difference, seen in pairs:
            yield self._find_pair_evidence(difference, seen, reference.texture, weight)

    def _noise_weight(self, texture: Picture) -> Any:
        """Steps of evidence a grey level; None unless differences are in units of local noise."""
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
        """Evidence above the threshold, cleaned. close_px: in place of the parameter."""
        operations = self.operations
        mask = operations.above(evidence, self.value("difference.threshold") * evidence_scale(self.settings))
        if self.settings.difference.blur_of == "silhouette":
            mask = operations.above(operations.blur(mask, self.value("difference.blur_px")), HALF)
        mask = operations.erode(mask, self.value("morphology.erode_px"))
        mask = operations.dilate(mask, self.value("morphology.dilate_px"))
        return operations.close(mask, close_px or self.value("morphology.close_px"))

    def find_weak(self, wide: Picture, close_px: int = 0) -> tuple[Picture, Picture]:
        """Where the wide pair is certain at half the resolution, and its evidence there: slow, even targets."""
        morphology, half = self.settings.morphology, self.operations.halve(wide)
        sides = {"erode": morphology.erode_px, "dilate": morphology.dilate_px, "close": close_px or morphology.close_px}
        small = {f"morphology.{name}_px": halve_side(side) for name, side in sides.items()}
        blur = {"difference.blur_px": 1}
        return DetectionChain(self.settings, self.operations, {**self.values, **small, **blur}).find_core(half), half

    def find_small(self, neighbours: "Neighbours[View, Picture, Seen]", pair: Pair) -> Picture:
        """Where something small may move: differences in grey levels that stand out from their mean."""
        parameters, operations = self.settings.small, self.operations
        least = operations.blur(neighbours.least(pair), _SMALL_BLUR_PX)
        least = operations.inside(least, neighbours.both(pair))
        mask = operations.stands_out(least, parameters.threshold, parameters.noise_ratio)
        return operations.close(mask, parameters.close_px)


class Neighbours(Generic[View, Picture, Seen]):
    """The neighbours as the reference sees them, each warped when it is first needed.

    All neighbours of a window at once, with where each is seen, would take 15 MB at 1280x720.
    """

    def __init__(self, window: Window[View], settings: Settings, operations: Operations[View, Picture, Seen]) -> None:
        self.window, self.settings, self.operations = window, settings, operations
        self._made: dict[int, tuple[Picture, Seen]] = {}
        self._least: dict[Pair, Picture] = {}

    @property
    def _parameters(self) -> DifferenceParameters:
        return self.settings.difference

    def reference(self) -> Reference[Picture]:
        """The reference's grey levels and texture; its texture is 0 where no step needs it."""
        view, operations = self.window.reference, self.operations
        is_needed = self._parameters.kind == "normalized" or self.settings.refine.on
        return Reference(operations.grey(view), operations.texture(view) if is_needed else operations.no_texture(view))

    def warped(self, index: int) -> Picture:
        """A neighbour in the reference's frame and exposure."""
        return self._make(index)[0]

    def both(self, pair: Pair) -> Picture:
        """The mask of what both of a pair show, and what is not left out."""
        one, other = (self._make(index)[1] for index in pair)
        both = self.operations.seen_by_both(one, other, self.window.reference)
        return both if self.window.ignored is None else self.operations.outside(both, self.window.ignored)

    def compared(self, pair: Pair) -> Picture:
        """The difference of a pair by `difference.kind`."""
        if self._parameters.kind == "between_later":  # eq. 9: a mover shows where it is in the two later frames
            return self.operations.difference(self.warped(pair[0]), self.warped(pair[1]))
        return self.least(pair)

    def compared_and_seen(self, pair: Pair) -> tuple[Picture, Picture]:
        """The difference of a pair, and the mask of what both of it show."""
        return self.compared(pair), self.both(pair)

    def least(self, pair: Pair) -> Picture:
        """The smaller difference of the reference to the two of a pair: it marks a mover where the reference has it."""
        if pair not in self._least:
            grey = self.operations.grey(self.window.reference)
            one, other = (self.operations.difference(grey, self.warped(index)) for index in pair)
            self._least[pair] = self.operations.smaller(one, other)
        return self._least[pair]

    def keep_for(self, *pairs: Pair | None) -> None:
        """Drop what none of these pairs uses."""
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
