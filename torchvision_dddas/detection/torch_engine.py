"""The engine for batches and GPUs: `nn.Registration` and `nn.MotionSegmenter` on many frames and windows."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

import torchvision_dddas.functional as F
from torchvision_dddas.config import Settings
from torchvision_dddas.detection.blobs import halve_side
from torchvision_dddas.detection.engine import (
    Engine,
    Foreground,
    View,
    Window,
    exposure_between,
    judge_points,
    match_exposure,
)
from torchvision_dddas.detection.torch_blobs import foregrounds_with_blobs
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.filters import to_bytes
from torchvision_dddas.nn import MotionSegmenter, WarpedWindows, close_masks
from torchvision_dddas.runtime import torch_device
from torchvision_dddas.types import Registration

Item = TypeVar("Item")

# Pixels of pictures in work at once: larger temporaries leave a CPU's cache, a GPU wants many.
_PIXELS_AT_ONCE = {"cpu": 1_500_000, "cuda": 400_000_000}
_POINTS_AT_ONCE = 100_000


class TorchEngine(Engine):
    """Implements `Engine` on all pairs and windows of equal structure at once."""

    name = "torch"

    def __init__(
        self,
        settings: Settings,
        device: str | torch.device | None = None,
        components: Literal["opencv", "torch"] | None = None,
    ) -> None:
        """device: by default the GPU where there is one.

        components: who labels regions. torch does so on the device, and whole maps stay there; by default OpenCV for
        the CPU and torch for others. Raises InputError for Apple's MPS and for settings at half resolution.
        """
        for group in ("registration", "difference"):
            if getattr(settings, group).halved:
                raise InputError(f"the torch engine has no {group}.halved: take the backend onboard or set it false")
        self.parameters = settings
        self.device = torch.device(device or torch_device())
        if self.device.type == "mps":
            raise InputError("the torch engine needs float64, which mps does not have; give device cpu or cuda")
        self.components = components or ("opencv" if self.device.type == "cpu" else "torch")

    @property
    def segmenter(self) -> MotionSegmenter:
        """The hard chain of the settings in force, whose numbers are no tensors."""
        return MotionSegmenter(self.parameters, tuned=()).to(self.device)

    @torch.inference_mode()
    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """See `Engine.register`. Pyramids, and the keypoints of the earlier frames, are left in `View.kept`."""
        return _apply_in_groups(pairs, lambda pair: (pair[0].size, pair[1].size), self._register)

    def _register(self, pairs: list[tuple[View, View]]) -> list[Registration]:
        registration, parameters = self.segmenter.registration, self.parameters.registration
        for earlier, _ in pairs:
            if "points" not in earlier.kept:
                found = registration.keypoints(_levels_of(earlier, self.device))
                earlier.kept["points"], earlier.kept["valid"] = found
        matched = []
        for pair in pairs:  # where exposures differ, one of the two is a view of its own
            greys = zip(pair, match_exposure(*pair), strict=True)
            matched.append([view if grey is view.grey else View(view.image, grey) for view, grey in greys])
        missing = list({id(view): view for pair in matched for view in pair if "pyramid" not in view.kept}.values())
        width, height = pairs[0][0].size
        step = self._at_once(width * height)
        for views in (missing[first : first + step] for first in range(0, len(missing), step)):
            pyramid = registration.pyramid(_join([_levels_of(view, self.device) for view in views]))
            for number, view in enumerate(views):
                view.kept["pyramid"] = [level[number : number + 1] for level in pyramid]
        count = max(pairs[0][0].kept["points"].shape[1], 1)
        step = max(1, _POINTS_AT_ONCE // count)
        made: list[Registration] = []
        for first in range(0, len(pairs), step):
            part = np.s_[first : first + step]
            points, valid = (_join([view.kept[name] for view, _ in pairs[part]]) for name in ("points", "valid"))
            before, after = (
                [_join(level) for level in zip(*(view.kept["pyramid"] for view in views), strict=True)]
                for views in zip(*matched[part], strict=True)
            )
            motion = registration.match(points, valid, before, after)
            arrays = (array.cpu().numpy() for array in motion[:4])
            made += [
                judge_points(matrix, start[kept], end[kept], pairs[0][0].size, parameters)[0]
                for matrix, start, end, kept in zip(*arrays, strict=True)
            ]
        return made

    @torch.inference_mode()
    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """See `Engine.foreground`."""

        def structure(window: Window) -> tuple[Any, ...]:
            sizes = tuple(view.size for view in window.neighbours)
            return window.reference.size, sizes, window.near, window.wide, window.small, window.close_px

        def work(group: list[Window]) -> list[Foreground]:
            width, height = group[0].reference.size
            step = self._at_once(width * height * max(len(group[0].neighbours), 1))
            return [made for i in range(0, len(group), step) for made in self._foreground(group[i : i + step])]

        return _apply_in_groups(windows, structure, work)

    def _at_once(self, pixels: int) -> int:
        """How many items of so many pixels are worked on at once."""
        return max(1, _PIXELS_AT_ONCE.get(self.device.type, _PIXELS_AT_ONCE["cpu"]) // pixels)

    def warp_neighbours(self, windows: list[Window]) -> WarpedWindows:
        """Windows of equal structure with their neighbours warped to the references, in the references' light."""
        levels = _join([_levels_of(window.reference, self.device) for window in windows])
        matrices = torch.from_numpy(np.stack([window.neighbour_from_reference for window in windows])).to(self.device)
        neighbours = (
            _join([_levels_of(view, self.device) for view in views])
            for views in zip(*(window.neighbours for window in windows), strict=True)
        )
        light = None
        if self.parameters.difference.kind == "to_reference":
            fits = [[exposure_between(w.reference, view) for view in w.neighbours] for w in windows]
            gain, offset = torch.tensor(fits, dtype=torch.float64, device=self.device).unbind(-1)
            light = gain, offset
        return self.segmenter.warp(levels, neighbours, matrices, light)

    def _foreground(self, windows: list[Window]) -> list[Foreground]:
        settings, one, segmenter = self.parameters, windows[0], self.segmenter
        views = self.warp_neighbours(windows)
        weight = segmenter.noise_weight(views.texture)

        def evidence(pair: tuple[int, int]) -> Tensor:
            return segmenter.pair_evidence(views.least(pair), views.both(pair), views.texture, weight)

        near = evidence(one.near[0])
        for pair in one.near[1:]:
            near = torch.maximum(near, evidence(pair))
        wide = near if one.wide is None else evidence(one.wide)
        core = segmenter.core(near, close_px=one.close_px)
        small: Tensor | None = None
        if one.small is not None:
            least = F.gaussian_blur2d(views.smaller(one.small), 5) * views.both(one.small)
            mean = least.to(torch.float64).mean(dim=(1, 2, 3), keepdim=True)
            level = (settings.small.noise_ratio * mean).clamp(min=settings.small.threshold).floor()
            small = close_masks((least > level).to(torch.uint8) * 255, settings.small.close_px)
        a, b = one.near[-1]
        texture = to_bytes(views.texture)
        if self.components == "torch":
            is_weak_wanted = settings.persistence.on and any(window.looks_both_ways for window in windows)
            weak = weak_maps(segmenter, wide, one.close_px) if is_weak_wanted else None
            warped = views.warped[a], views.warped[b]
            return foregrounds_with_blobs(windows, settings, (core, near, wide, texture), weak, small, warped)
        smalls = [None] * len(windows) if small is None else list(small[:, 0].cpu().numpy())
        maps = core, near, wide, texture, views.warped[a], views.warped[b]
        rows = zip(*(made[:, 0].cpu().numpy() for made in maps), strict=True)
        return [
            Foreground(core, near, wide, texture, small, (first, other), (window.offsets[a], window.offsets[b]))
            for window, (core, near, wide, texture, first, other), small in zip(windows, rows, smalls, strict=True)
        ]


def weak_maps(segmenter: MotionSegmenter, wide: Tensor, close_px: int = 0) -> tuple[Tensor, Tensor] | None:
    """Where the wide evidence is certain at half the resolution, and that evidence: as `find_weak_blobs` has them.

    wide: (B, 1, H, W) uint8. None for pictures of a single row or column.
    """
    if min(wide.shape[-2:]) < 2:
        return None
    half = functional.avg_pool2d(wide.float(), 2).add_(0.5).to(torch.uint8)
    morphology = segmenter.settings.morphology
    sides = {"erode": morphology.erode_px, "dilate": morphology.dilate_px, "close": close_px or morphology.close_px}
    return segmenter.core(half, {f"morphology.{name}_px": halve_side(side) for name, side in sides.items()}), half


def _apply_in_groups(
    items: Sequence[Item], key: Callable[[Item], Any], work: Callable[[list[Item]], list[Any]]
) -> list[Any]:
    """Do the work on all items of a key at once; results in the order of the items."""
    places: dict[Any, list[int]] = defaultdict(list)
    for place, item in enumerate(items):
        places[key(item)].append(place)
    results: dict[int, Any] = {}
    for group in places.values():
        results |= zip(group, work([items[place] for place in group]), strict=True)
    return [results[place] for place in range(len(items))]


def _levels_of(view: View, device: torch.device) -> Tensor:
    """(1, 1, H, W) float32 grey levels, computed once."""
    if "levels" not in view.kept:
        view.kept["levels"] = torch.from_numpy(view.grey)[None, None].to(device).float()
    levels: Tensor = view.kept["levels"]
    return levels


def _join(pictures: Sequence[Tensor]) -> Tensor:
    """One batch; a single picture is not copied."""
    return pictures[0] if len(pictures) == 1 else torch.cat(list(pictures))
