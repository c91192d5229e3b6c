"""The engine for batches and GPUs: functions of `functional` on whole grey levels, so that it sees what OpenCV sees.

Functions there take pictures in [0, 1]; here they are float levels 0 .. 255, whose sums are exact.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.config import DifferenceParameters, Settings, SmallParameters
from torchvision_dddas.detection.engine import EVIDENCE_CAP, EVIDENCE_SCALE, WHITE, Foreground, View, Window
from torchvision_dddas.detection.registration import exposure_between
from torchvision_dddas.detection.torch_registration import LEVEL, join_batch, levels_of, register
from torchvision_dddas.functional import difference, filters, morphology, warp
from torchvision_dddas.types import Registration

Item = TypeVar("Item")

# Pixels of warped neighbours in work at once: larger temporaries leave a CPU's cache, a GPU wants many.
PIXELS_AT_ONCE = {"cpu": 1_500_000, "cuda": 400_000_000}
# Pixels of more gradient, 4 x grey levels each, have texture: they show how well the registration fits.
TEXTURED = 16


class WarpedWindows(NamedTuple):
    """A batch of references and what their neighbours show of them.

    grey: (B, 1, H, W) uint8; warped: the same for each neighbour; seen: for each the first and last column of every row
    that it shows (see `warp.seen_columns`); texture: (B, 1, H, W) float, 4 x grey levels a pixel.
    """

    grey: Tensor
    warped: list[Tensor]
    seen: list[tuple[Tensor, Tensor]]
    texture: Tensor


class TorchEngine:
    """Implements `Engine` on all pairs and windows of equal structure at once."""

    name = "torch"

    def __init__(self, settings: Settings, device: str | torch.device | None = None) -> None:
        """device: by default the GPU where there is one."""
        self.parameters = settings
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))

    def prepare(self, image: np.ndarray) -> View:
        """The frame and its grey picture; tensors are made when they are needed."""
        return View(image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)

    @torch.inference_mode()
    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """Keypoints, pyramidal Lucas-Kanade, RANSAC, refits on the inliers: all pairs at once."""
        return _apply_in_groups(
            pairs,
            lambda pair: (pair[0].size, pair[1].size),
            lambda group: register(group, self.parameters.registration, self.device),
        )

    @torch.inference_mode()
    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """Differences to the warped neighbours, threshold, morphology: all windows of equal structure at once."""

        def structure(window: Window) -> tuple[Any, ...]:
            sizes = tuple(view.size for view in window.neighbours)
            return window.reference.size, sizes, window.near, window.wide, window.small, window.close_px

        return _apply_in_groups(windows, structure, self._foreground)

    def _foreground(self, windows: list[Window]) -> list[Foreground]:
        width, height = windows[0].reference.size
        pixels = width * height * max(len(windows[0].neighbours), 1)
        step = max(1, PIXELS_AT_ONCE.get(self.device.type, 1_500_000) // pixels)
        return [
            result
            for first in range(0, len(windows), step)
            for result in self._foreground_at_once(windows[first : first + step])
        ]

    def warp_neighbours(self, windows: list[Window]) -> WarpedWindows:
        """Windows of equal structure with their neighbours warped to the references, in the references' light."""
        parameters, one = self.parameters.difference, windows[0]
        (width, height), count = one.reference.size, len(one.neighbours)
        grey = torch.cat([torch.from_numpy(window.reference.grey)[None, None] for window in windows]).to(self.device)
        levels = join_batch([levels_of(window.reference, self.device) for window in windows])
        matrices = torch.from_numpy(np.stack([window.neighbour_from_reference for window in windows])).to(self.device)
        warped: list[Tensor] = []
        seen: list[tuple[Tensor, Tensor]] = []
        for k in range(count):
            neighbours = join_batch([levels_of(window.neighbours[k], self.device) for window in windows])
            frame_size = neighbours.shape[-2], neighbours.shape[-1]
            sampled = warp.sample(neighbours, matrices[:, k], (height, width)).add_(0.5).floor_()
            run = warp.seen_columns(matrices[:, k], (height, width), frame_size, parameters.border_px)
            if parameters.kind == "normalized":
                sampled = match_light(levels, sampled, run)
            elif parameters.kind == "to_reference":
                light = np.array([exposure_between(window.reference, window.neighbours[k]) for window in windows])
                if (light != (1.0, 0.0)).any():
                    sampled = apply_light(levels, sampled, *torch.from_numpy(light.T).to(levels))
            warped.append(sampled.to(torch.uint8))
            seen.append(run)
        # Needed for neither otherwise.
        wanted = parameters.kind == "normalized" or self.parameters.refine.on
        texture = difference.gradient(levels) if wanted else torch.zeros_like(levels)
        return WarpedWindows(grey, warped, seen, texture)

    def _foreground_at_once(self, windows: list[Window]) -> list[Foreground]:
        parameters, morph, one = self.parameters.difference, self.parameters.morphology, windows[0]
        views = self.warp_neighbours(windows)
        near, wide = _combine_evidence(one, views, parameters)
        scale = EVIDENCE_SCALE if parameters.kind == "normalized" else 1.0
        core = (near > int(parameters.threshold * scale)).to(torch.uint8) * 255
        core = _close_masks(morphology.erode(core, morph.erode_px, "ellipse"), one.close_px or morph.close_px)
        small = None if one.small is None else _find_small(one.small, views, self.parameters.small)
        a, b = one.near[-1]
        maps = core, near, wide, views.texture.to(torch.uint8), views.warped[a], views.warped[b]
        rows = zip(*(made[:, 0].cpu().numpy() for made in maps), strict=True)
        smalls = [None] * len(windows) if small is None else list(small[:, 0].cpu().numpy())
        return [
            Foreground(core, near, wide, texture, small, (one, other), (window.offsets[a], window.offsets[b]))
            for window, (core, near, wide, texture, one, other), small in zip(windows, rows, smalls, strict=True)
        ]


def _apply_in_groups(
    items: Sequence[Item], key: Callable[[Item], Any], work: Callable[[list[Item]], list[Any]]
) -> list[Any]:
    """Do the work on all items of a key at once; results in the order of the items."""
    places: dict[Any, list[int]] = defaultdict(list)
    for place, item in enumerate(items):
        places[key(item)].append(place)
    results: list[Any] = [None] * len(items)
    for group in places.values():
        for place, result in zip(group, work([items[place] for place in group]), strict=True):
            results[place] = result
    return results


def _combine_evidence(window: Window, views: WarpedWindows, parameters: DifferenceParameters) -> tuple[Tensor, Tensor]:
    """The largest evidence over the near pairs, and that of the wide pair, uint8."""
    width, normalized = views.grey.shape[-1], parameters.kind == "normalized"
    if normalized:
        weight = difference.noise_weight(views.texture, parameters.noise_levels, parameters.gradient_share)
        weight = weight.mul_(EVIDENCE_SCALE)
        textured = views.texture > TEXTURED
    distance = compare_to_reference(window, views.grey, views.warped, parameters)

    def evidence(pair: tuple[int, int]) -> Tensor:
        both = find_seen_by_both(views.seen[pair[0]], views.seen[pair[1]], width)
        least = smaller_difference(pair, distance, views.warped)
        if not normalized:
            return filters.gaussian_levels(least, parameters.blur_px) * both
        z = least.mul_(both).float().mul_(weight).round_().clamp_(max=EVIDENCE_CAP).to(torch.uint8)
        return _normalize(filters.gaussian_levels(z, parameters.blur_px), textured & both)

    near = evidence(window.near[0])
    for pair in window.near[1:]:
        near = torch.maximum(near, evidence(pair))
    return near, near if window.wide is None else evidence(window.wide)


def _find_small(pair: tuple[int, int], views: WarpedWindows, parameters: SmallParameters) -> Tensor:
    """255 where something small may move, uint8."""
    (a, b), (one, other) = pair, (absolute_difference(views.grey, views.warped[k]) for k in pair)
    least = filters.gaussian_levels(torch.minimum(one, other), 5)
    least = least * find_seen_by_both(views.seen[a], views.seen[b], views.grey.shape[-1])
    mean = least.to(torch.float64).mean(dim=(1, 2, 3), keepdim=True)
    level = (parameters.noise_ratio * mean).clamp(min=parameters.threshold).floor()
    return _close_masks((least > level).to(torch.uint8) * 255, parameters.close_px)


def _close_masks(mask: Tensor, side: int) -> Tensor:
    """The mask closed with an ellipse; on a CPU only around where it is set at all in any of the pictures."""
    if mask.device.type != "cpu":
        return morphology.closing(mask, side, "ellipse")
    spans = []
    for dim in (-1, -2):
        places = mask.amax((0, 1, dim)).nonzero()
        if not len(places):
            return mask
        # A pixel's closing depends on what lies less than 2 x side away.
        spans.append(slice(max(int(places[0]) - 2 * side, 0), int(places[-1]) + 2 * side + 1))
    out = torch.zeros_like(mask)
    out[..., spans[0], spans[1]] = morphology.closing(mask[..., spans[0], spans[1]], side, "ellipse")
    return out


def compare_to_reference(
    window: Window, grey: Tensor, warped: list[Tensor], parameters: DifferenceParameters
) -> dict[int, Tensor]:
    """The difference of each used neighbour to the reference; empty where neighbours are compared to each other."""
    if parameters.kind == "between_later":
        return {}
    pairs = (*window.near, *([window.wide] if window.wide else []))
    return {k: absolute_difference(grey, warped[k]) for k in {k for pair in pairs for k in pair}}


def smaller_difference(pair: tuple[int, int], distance: dict[int, Tensor], warped: list[Tensor]) -> Tensor:
    """The difference that both neighbours of a pair show."""
    a, b = pair
    return absolute_difference(warped[a], warped[b]) if not distance else torch.minimum(distance[a], distance[b])


def _normalize(z: Tensor, textured: Tensor) -> Tensor:
    """Evidence divided by its median over textured pixels, where that is above one noise unit."""
    units = difference.noise_units(z, textured, EVIDENCE_SCALE)
    if bool((units == 1.0).all()):
        return z
    return z.float().mul_(units.reciprocal().to(torch.float32).reshape(-1, 1, 1, 1)).round_().to(torch.uint8)


def match_light(reference: Tensor, warped: Tensor, seen: tuple[Tensor, Tensor]) -> Tensor:
    """The warped pictures in their references' exposure, in whole levels."""
    first, last = (edge[:, ::4] for edge in seen)
    columns = torch.arange(0, reference.shape[-1], 4, device=reference.device)
    inside = (columns >= first[..., None]) & (columns <= last[..., None])
    wanted, given = (picture[..., ::4, ::4] / LEVEL for picture in (reference, warped))
    gain, offset = difference.exposure(wanted, given, inside[:, None], stride=1)
    enough = inside.sum((1, 2)) >= 100
    return apply_light(reference, warped, torch.where(enough, gain, 1.0), torch.where(enough, offset * LEVEL, 0.0))


def apply_light(reference: Tensor, warped: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """The warped pictures through their gains and offsets, (B,) each, in whole levels.

    Where they are clipped at white they agree with anything brighter.
    """
    gain, offset = gain.reshape(-1, 1, 1, 1), offset.reshape(-1, 1, 1, 1)
    darkened = (gain * LEVEL + offset).round() < WHITE
    # A clipped pixel only says that the place was at least so bright.
    cut = (warped >= WHITE) & darkened if bool(darkened.any()) else None
    through = warped.mul_(gain).add_(offset).round_().clamp_(0.0, LEVEL)
    return through if cut is None else torch.where(cut, torch.maximum(through, reference), through)


def absolute_difference(a: Tensor, b: Tensor) -> Tensor:
    """|a - b| of unsigned bytes."""
    return torch.maximum(a, b).sub_(torch.minimum(a, b))


def find_seen_by_both(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], width: int) -> Tensor:
    """Where both neighbours are seen, as a Boolean mask."""
    return warp.between(torch.maximum(one[0], other[0]), torch.minimum(one[1], other[1]), width)
