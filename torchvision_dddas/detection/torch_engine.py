"""The engine for batches and GPUs: functions of `functional` on whole grey levels, so that it sees what OpenCV sees.

Functions there take pictures in [0, 1]; here they are float levels 0 .. 255, whose sums are exact.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

import torchvision_dddas.functional as F
from torchvision_dddas.config import RegistrationParameters, Settings
from torchvision_dddas.detection.engine import (
    EVIDENCE_CAP,
    EVIDENCE_SCALE,
    WHITE,
    Engine,
    Foreground,
    View,
    Window,
    cell_side,
    evidence_scale,
    exposure_between,
    exposure_step,
    judge_points,
    match_exposure,
)
from torchvision_dddas.types import Registration

Item = TypeVar("Item")

LEVEL = 255.0
# Pixels of warped neighbours in work at once: larger temporaries leave a CPU's cache, a GPU wants many.
_PIXELS_AT_ONCE = {"cpu": 1_500_000, "cuda": 400_000_000}
# Pixels of more gradient, 4 x grey levels each, have texture: they show how well the registration fits.
_TEXTURED = 16

_POINTS_AT_ONCE = {"cpu": 1000, "cuda": 100_000}
# So many points search for the motion first; the others start where it takes them.
_SCOUTS = 32
# Gates of the refits, in RANSAC's tolerance; they matter most for accuracy.
_REFITS = (1.5, 1.0, 0.5, 0.5)


class TorchEngine(Engine):
    """Implements `Engine` on all pairs and windows of equal structure at once."""

    name = "torch"

    def __init__(self, settings: Settings, device: str | torch.device | None = None) -> None:
        """device: by default the GPU where there is one."""
        self.parameters = settings
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))

    @torch.inference_mode()
    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """See `Engine.register`. Pyramids, and the keypoints of the earlier frames, are left in `View.kept`."""
        registration = _PairRegistration(self.parameters.registration, self.device)
        return _apply_in_groups(pairs, lambda pair: (pair[0].size, pair[1].size), registration)

    @torch.inference_mode()
    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """See `Engine.foreground`."""

        def structure(window: Window) -> tuple[Any, ...]:
            sizes = tuple(view.size for view in window.neighbours)
            return window.reference.size, sizes, window.near, window.wide, window.small, window.close_px

        def work(group: list[Window]) -> list[Foreground]:
            width, height = group[0].reference.size
            pixels = width * height * max(len(group[0].neighbours), 1)
            step = max(1, _PIXELS_AT_ONCE.get(self.device.type, 1_500_000) // pixels)
            return [made for i in range(0, len(group), step) for made in self._foreground(group[i : i + step])]

        return _apply_in_groups(windows, structure, work)

    def warp_neighbours(self, windows: list[Window]) -> "WarpedWindows":
        """Windows of equal structure with their neighbours warped to the references, in the references' light."""
        parameters, one = self.parameters.difference, windows[0]
        width, height = one.reference.size
        grey = torch.cat([torch.from_numpy(window.reference.grey)[None, None] for window in windows]).to(self.device)
        levels = _join([_levels_of(window.reference, self.device) for window in windows])
        matrices = torch.from_numpy(np.stack([window.neighbour_from_reference for window in windows])).to(self.device)
        warped: list[Tensor] = []
        seen: list[tuple[Tensor, Tensor]] = []
        for k in range(len(one.neighbours)):
            neighbours = _join([_levels_of(window.neighbours[k], self.device) for window in windows])
            frame_size = neighbours.shape[-2], neighbours.shape[-1]
            sampled = F.warp_perspective(
                neighbours, matrices[:, k], (height, width), padding_mode="border", inverse_map=True, subpixels=32
            )
            sampled = sampled.add_(0.5).floor_()
            run = F.seen_columns(matrices[:, k], (height, width), frame_size, parameters.border_px)
            if parameters.kind == "normalized":
                sampled = _match_light(levels, sampled, run)
            elif parameters.kind == "to_reference":
                light = np.array([exposure_between(window.reference, window.neighbours[k]) for window in windows])
                if (light != (1.0, 0.0)).any():
                    sampled = _apply_light(levels, sampled, *torch.from_numpy(light.T).to(levels))
            warped.append(sampled.to(torch.uint8))
            seen.append(run)
        # Needed for neither otherwise.
        wanted = parameters.kind == "normalized" or self.parameters.refine.on
        texture = F.mean_gradient(levels) if wanted else torch.zeros_like(levels)
        return WarpedWindows(grey, warped, seen, texture, parameters.kind == "between_later")

    def _foreground(self, windows: list[Window]) -> list[Foreground]:
        settings, parameters, one = self.parameters, self.parameters.difference, windows[0]
        views = self.warp_neighbours(windows)
        normalized = parameters.kind == "normalized"
        if normalized:
            weight = F.noise_weight(views.texture, parameters.noise_levels, parameters.gradient_share)
            weight = weight.mul_(EVIDENCE_SCALE)

        def evidence(pair: tuple[int, int]) -> Tensor:
            both, least = views.both(pair), views.least(pair)
            if not normalized:
                return F.gaussian_blur2d(least, parameters.blur_px) * both
            z = least.mul_(both).float().mul_(weight).round_().clamp_(max=EVIDENCE_CAP).to(torch.uint8)
            z = F.gaussian_blur2d(z, parameters.blur_px)
            # Divided by its median over textured pixels, where that is above one noise unit.
            units = F.noise_units(z, views.textured & both, EVIDENCE_SCALE)
            if bool((units == 1.0).all()):
                return z
            return z.float().mul_(units.reciprocal().to(torch.float32).reshape(-1, 1, 1, 1)).round_().to(torch.uint8)

        near = evidence(one.near[0])
        for pair in one.near[1:]:
            near = torch.maximum(near, evidence(pair))
        wide = near if one.wide is None else evidence(one.wide)
        core = (near > int(parameters.threshold * evidence_scale(settings))).to(torch.uint8) * 255
        core = F.erosion(core, F.structuring_element("ellipse", settings.morphology.erode_px))
        core = _close_masks(core, one.close_px or settings.morphology.close_px)
        smalls: list[Any] = [None] * len(windows)
        if one.small is not None:
            least = F.gaussian_blur2d(views.smaller(one.small), 5) * views.both(one.small)
            mean = least.to(torch.float64).mean(dim=(1, 2, 3), keepdim=True)
            level = (settings.small.noise_ratio * mean).clamp(min=settings.small.threshold).floor()
            small = _close_masks((least > level).to(torch.uint8) * 255, settings.small.close_px)
            smalls = list(small[:, 0].cpu().numpy())
        a, b = one.near[-1]
        maps = core, near, wide, views.texture.to(torch.uint8), views.warped[a], views.warped[b]
        rows = zip(*(made[:, 0].cpu().numpy() for made in maps), strict=True)
        return [
            Foreground(core, near, wide, texture, small, (first, other), (window.offsets[a], window.offsets[b]))
            for window, (core, near, wide, texture, first, other), small in zip(windows, rows, smalls, strict=True)
        ]


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


# -- foreground --------------------------------------------------------------------------------------------------------


@dataclass
class WarpedWindows:
    """A batch of references and what their neighbours show of them.

    grey: (B, 1, H, W) uint8; warped: the same for each neighbour; seen: for each the first and last column of every row
    that it shows (see `F.seen_columns`); texture: (B, 1, H, W) float, 4 x grey levels a pixel. between_later:
    compare the neighbours of a pair with each other, not with the reference.
    """

    grey: Tensor
    warped: list[Tensor]
    seen: list[tuple[Tensor, Tensor]]
    texture: Tensor
    between_later: bool
    _distance: dict[int, Tensor] = field(default_factory=dict)

    @property
    def textured(self) -> Tensor:
        """Where there is texture enough to show how well the registration fits."""
        return self.texture > _TEXTURED

    def both(self, pair: tuple[int, int]) -> Tensor:
        """Where both neighbours of a pair are seen."""
        return F.seen_by_both(self.seen[pair[0]], self.seen[pair[1]], self.grey.shape[-1])

    def least(self, pair: tuple[int, int]) -> Tensor:
        """What the settings compare of a pair, a new tensor."""
        if self.between_later:
            return _absolute_difference(self.warped[pair[0]], self.warped[pair[1]])
        return self.smaller(pair)

    def smaller(self, pair: tuple[int, int]) -> Tensor:
        """The difference from the reference that both neighbours of a pair show, a new tensor."""
        for k in pair:
            if k not in self._distance:
                self._distance[k] = _absolute_difference(self.grey, self.warped[k])
        return torch.minimum(self._distance[pair[0]], self._distance[pair[1]])


def _absolute_difference(a: Tensor, b: Tensor) -> Tensor:
    """|a - b| of unsigned bytes."""
    return torch.maximum(a, b).sub_(torch.minimum(a, b))


def _close_masks(mask: Tensor, side: int) -> Tensor:
    """The mask closed with an ellipse; on a CPU only around where it is set at all in any of the pictures."""
    if mask.device.type != "cpu":
        return F.closing(mask, F.structuring_element("ellipse", side))
    spans = []
    for dim in (-1, -2):
        places = mask.amax((0, 1, dim)).nonzero()
        if not len(places):
            return mask
        # A pixel's closing depends on what lies less than 2 x side away.
        spans.append(slice(max(int(places[0]) - 2 * side, 0), int(places[-1]) + 2 * side + 1))
    out = torch.zeros_like(mask)
    out[..., spans[0], spans[1]] = F.closing(mask[..., spans[0], spans[1]], F.structuring_element("ellipse", side))
    return out


def _match_light(reference: Tensor, warped: Tensor, seen: tuple[Tensor, Tensor]) -> Tensor:
    """The warped pictures in their references' exposure, in whole levels."""
    step = exposure_step(reference.shape[-2:])
    first, last = (edge[:, ::step, None] for edge in seen)
    columns = torch.arange(0, reference.shape[-1], step, device=reference.device)
    inside = (columns >= first) & (columns <= last)
    wanted, given = (picture[..., ::step, ::step] / LEVEL for picture in (reference, warped))
    gain, offset = F.fit_exposure(wanted, given, inside[:, None])
    enough = inside.sum((1, 2)) >= 100
    return _apply_light(reference, warped, torch.where(enough, gain, 1.0), torch.where(enough, offset * LEVEL, 0.0))


def _apply_light(reference: Tensor, warped: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """The warped pictures through their gains and offsets, (B,) each, in whole levels.

    Where they are clipped at white they agree with anything brighter.
    """
    gain, offset = gain.reshape(-1, 1, 1, 1), offset.reshape(-1, 1, 1, 1)
    darkened = (gain * LEVEL + offset).round() < WHITE
    # A clipped pixel only says that the place was at least so bright.
    cut = (warped >= WHITE) & darkened if bool(darkened.any()) else None
    through = warped.mul_(gain).add_(offset).round_().clamp_(0.0, LEVEL)
    return through if cut is None else torch.where(cut, torch.maximum(through, reference), through)


# -- registration ------------------------------------------------------------------------------------------------------


class _Batch(NamedTuple):
    """points: (B, N, 2) keypoints, valid (B, N) which are there. earlier, later: pyramids."""

    points: Tensor
    valid: Tensor
    earlier: list[Tensor]
    later: list[Tensor]

    def select(self, chosen: Tensor) -> "_Batch":
        earlier, later = ([level[chosen] for level in pyramid] for pyramid in (self.earlier, self.later))
        return _Batch(self.points[chosen], self.valid[chosen], earlier, later)


Tracked = tuple[Tensor, Tensor, Tensor]
"""Where the points are in the later frames, which were found, and the motion (B, 3, 3) that they agree on."""


class _PairRegistration:
    """The registration of frame pairs of one size, all at once: keypoints, point tracking, RANSAC, refits."""

    def __init__(self, parameters: RegistrationParameters, device: torch.device) -> None:
        self.parameters, self.device = parameters, device
        self.model = F.MODELS[parameters.model]

    def __call__(self, pairs: list[tuple[View, View]]) -> list[Registration]:
        """The background's motion from the first to the second frame of each pair."""
        for earlier, _ in pairs:
            self._detect(earlier)
        matched = []
        for pair in pairs:  # where exposures differ, one of the two is a view of its own
            greys = zip(pair, match_exposure(*pair), strict=True)
            matched.append([view if grey is view.grey else View(view.image, grey) for view, grey in greys])
        self._build_pyramids([view for pair in matched for view in pair])
        count = max(pairs[0][0].kept["points"].shape[1], 1)
        step = max(1, _POINTS_AT_ONCE.get(self.device.type, 1000) // count)
        found: list[Registration] = []
        for first in range(0, len(pairs), step):
            part = np.s_[first : first + step]
            points, valid = (_join([view.kept[name] for view, _ in pairs[part]]) for name in ("points", "valid"))
            pyramids = [
                [_join(level) for level in zip(*(view.kept["pyramid"] for view in views), strict=True)]
                for views in zip(*matched[part], strict=True)
            ]
            end, tracked, matrices = self._track_points(_Batch(points, valid, *pyramids))
            arrays = (array.cpu().numpy() for array in (points, end, valid & tracked, matrices.double()))
            found += [
                judge_points(matrix, start[kept], end[kept], pairs[0][0].size, self.parameters)[0]
                for start, end, kept, matrix in zip(*arrays, strict=True)
            ]
        return found

    def _detect(self, view: View) -> None:
        """Detect keypoints, at half the resolution if that is set, at a quarter of the cost."""
        if "points" in view.kept:
            return
        parameters = self.parameters
        levels, cell, step = _levels_of(view, self.device), cell_side(*view.size, parameters), 1
        if parameters.halved_corners and min(view.size) > 1:
            # Half a pixel to the left and top of where the corner stands: a search window does not mind.
            levels, cell, step = functional.avg_pool2d(levels, 2), max(cell // 2, 1), 2
        least = 1e-7 * LEVEL**2
        points, _, valid = F.grid_features(levels, cell, parameters.quality, parameters.block_px, least=least)
        view.kept["points"], view.kept["valid"] = step * points, valid

    def _build_pyramids(self, views: list[View]) -> None:
        """Build the missing pyramids in one batch."""
        missing = list({id(view): view for view in views if "pyramid" not in view.kept}.values())
        if not missing:
            return
        levels, smaller_side = 1, min(missing[0].size)
        # OpenCV's rule: a level that Lucas-Kanade's window does not fit into is left out.
        while levels <= self.parameters.levels and smaller_side / 2**levels > self.parameters.window_px:
            levels += 1
        pictures = F.build_pyramid(_join([_levels_of(view, self.device) for view in missing]), levels)
        for number, view in enumerate(missing):
            view.kept["pyramid"] = [level[number : number + 1] for level in pictures]

    def _track_points(self, batch: _Batch) -> Tracked:
        """Lucas-Kanade and RANSAC.

        A few scouts search the whole pyramid; the others start where the scouts' motion takes them, which is much
        faster. Where the scouts do not agree, all points search the whole pyramid.
        """
        points, valid, parameters = batch.points, batch.valid, self.parameters
        if not points.shape[1]:
            return points, valid, torch.eye(3).expand(len(points), 3, 3)
        if points.shape[1] < 2 * _SCOUTS:
            return self._search_everywhere(batch)
        scouts = F.spread_ranks(valid, _SCOUTS)
        start = points.gather(1, scouts[..., None].expand(-1, -1, 2))
        # A scout that has not arrived after a few steps does not count.
        ahead, found = F.lucas_kanade(start, batch.earlier, batch.later, rounds=2, **self._search(most_steps=8))
        found = found & valid.gather(1, scouts)
        motion = self._ransac(start.double(), ahead.double(), found, parameters.hypotheses // 2, (1.5, 1.0)).float()
        near = found & (F.oneway_transfer_error(start, ahead, motion, squared=False) < parameters.ransac_px)
        agreed = near.sum(1) >= (0.6 * valid.gather(1, scouts).sum(1)).clamp(min=12)
        end, kept, motion = torch.zeros_like(points), torch.zeros_like(valid), motion.double()
        for choice, search in ((agreed, self._search_near), (~agreed, self._search_everywhere)):
            chosen = choice.nonzero()[:, 0]
            if len(chosen) == len(points):
                return search(batch, motion)
            if len(chosen):
                end[chosen], kept[chosen], motion[chosen] = search(batch.select(chosen), motion[chosen])
        return end, kept, motion

    def _search_everywhere(self, batch: _Batch, _: Tensor | None = None) -> Tracked:
        """Lucas-Kanade through the whole pyramid, then RANSAC."""
        end, found = self._track(batch, None, self._search() | {"rounds": 3})
        start, valid = batch.points.double(), batch.valid & found
        return end, found, self._ransac(start, end.double(), valid, self.parameters.hypotheses, _REFITS)

    def _search_near(self, batch: _Batch, motion: Tensor) -> Tracked:
        """Lucas-Kanade in the finest level alone, near where the motion takes the points; refits of that motion."""
        finest = batch._replace(earlier=batch.earlier[:1], later=batch.later[:1])
        guess = F.transform_points(motion.float(), batch.points)
        end, found = self._track(finest, guess, self._search(most_steps=10) | {"reach_px": 3})
        gates_px = tuple(share * self.parameters.ransac_px for share in _REFITS)
        start, valid, model = batch.points.double(), batch.valid & found, self.model
        return end, found, F.refit_map(start, end.double(), valid, motion, gates_px, model)

    def _track(self, batch: _Batch, guess: Tensor | None, settings: dict[str, Any]) -> tuple[Tensor, Tensor]:
        pictures, limit_px = (batch.points, batch.earlier, batch.later), self.parameters.forward_backward_px
        if limit_px > 0:
            return F.forward_backward(*pictures, guess, limit_px=limit_px, **settings)
        return F.lucas_kanade(*pictures, guess, **settings)

    def _search(self, most_steps: int = 1000) -> dict[str, Any]:
        """Settings of the search for points."""
        return {
            "window_px": self.parameters.window_px,
            "iterations": min(self.parameters.iterations, most_steps),
            "epsilon_px": self.parameters.epsilon_px,
            "min_eigen": 1e-4 * LEVEL**2,
        }

    def _ransac(
        self, start: Tensor, end: Tensor, tracked: Tensor, hypotheses: int, shares: tuple[float, ...]
    ) -> Tensor:
        """RANSAC, then least squares on the inliers of a tightening tolerance, `shares` of RANSAC's own."""
        model, (batch, count) = self.model, tracked.shape
        if count < model.size:
            return torch.eye(3, dtype=start.dtype, device=start.device).expand(batch, 3, 3)
        # The same numbers for every pair and call: what one pair gives does not depend on its company.
        generator = torch.Generator().manual_seed(0)
        samples = F.draw_samples(generator, 1, hypotheses, count, model.size)
        samples = samples.to(start.device).expand(batch, -1, -1)
        tolerance_px = self.parameters.ransac_px
        refits = tuple(share * tolerance_px for share in shares)
        return F.ransac(start, end, tracked, samples, model, tolerance_px, refits)[0]
