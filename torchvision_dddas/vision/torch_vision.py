"""The back end for batches and GPUs: the pixel floor `ops` on whole grey levels, so that it sees what OpenCV sees.

`ops` speak of [0, 1]; here pictures are kept as float levels 0 .. 255, whose sums are exact.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.ops import affine, blur, consensus, difference, flow, homography, keypoints, morphology, warp
from torchvision_dddas.settings import DifferenceKnobs, RegistrationKnobs, Settings
from torchvision_dddas.targets.projective import transfer
from torchvision_dddas.types import Registration
from torchvision_dddas.vision.judgement import judged
from torchvision_dddas.vision.protocol import EVIDENCE_CAP, EVIDENCE_SCALE, Foreground, View, Window

Item = TypeVar("Item")

# Pixels of warped neighbours in work at once: larger temporaries leave a CPU's cache, a GPU wants many.
PIXELS_AT_ONCE = {"cpu": 1_500_000, "cuda": 400_000_000}
POINTS_AT_ONCE = {"cpu": 1000, "cuda": 100_000}
SCOUTS = 32
LEVEL = 255.0


class TorchVision:
    """Implements `Vision` on all pairs and windows of equal structure at once."""

    name = "torch"

    def __init__(self, settings: Settings, device: str | torch.device | None = None) -> None:
        """device: by default the GPU where there is one."""
        self.knobs = settings
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))

    def prepare(self, image: np.ndarray) -> View:
        """The frame and its grey picture; tensors follow when they are asked for."""
        return View(image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)

    @torch.inference_mode()
    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """Keypoints, pyramidal Lucas-Kanade, RANSAC, refits on the inliers: all pairs at once."""
        return _in_groups(pairs, lambda pair: (pair[0].size, pair[1].size), self._register)

    @torch.inference_mode()
    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """Differences to the warped neighbours, threshold, morphology: all windows of equal structure at once."""

        def structure(window: Window) -> tuple[Any, ...]:
            sizes = tuple(view.size for view in window.neighbours)
            return window.reference.size, sizes, window.near, window.wide, window.small

        return _in_groups(windows, structure, self._foreground)

    # ----------------------------------------------------------------------------------------------------------------

    def _register(self, pairs: list[tuple[View, View]]) -> list[Registration]:
        self._prepare_views([view for pair in pairs for view in pair])
        count = max(pairs[0][0].kept["points"].shape[1], 1)
        step = max(1, POINTS_AT_ONCE.get(self.device.type, 1000) // count)
        parts = (pairs[first : first + step] for first in range(0, len(pairs), step))
        return [result for part in parts for result in self._register_at_once(part)]

    def _register_at_once(self, pairs: list[tuple[View, View]]) -> list[Registration]:
        knobs, size = self.knobs.registration, pairs[0][0].size
        points, valid = (_joined([earlier.kept[name] for earlier, _ in pairs]) for name in ("points", "valid"))
        earlier, later = (
            [_joined(level) for level in zip(*(pair[i].kept["pyramid"] for pair in pairs), strict=True)] for i in (0, 1)
        )
        if points.shape[1]:
            end, found = _follow(points, valid, earlier, later, knobs)
            tracked = valid & found
            matrices = _fit(points.double(), end.double(), tracked, knobs)
        else:
            end, tracked, matrices = points, valid, torch.eye(3).expand(len(pairs), 3, 3)
        arrays = (array.cpu().numpy() for array in (points, end, valid, tracked, matrices))
        return [_judged(one, size, knobs) for one in zip(*arrays, strict=True)]

    def _prepare_views(self, views: list[View]) -> None:
        """Pyramid and keypoints of those views that have none yet, in batches."""
        for name, make in (("pyramid", self._pyramids), ("points", self._keypoints)):
            missing = {id(view): view for view in views if name not in view.kept}
            _in_groups(list(missing.values()), lambda view: view.size, make)

    def _pyramids(self, views: list[View]) -> list[None]:
        knobs, (width, height) = self.knobs.registration, views[0].size
        levels = 1
        # OpenCV's rule: a level that Lucas-Kanade's window does not fit into is left out.
        while levels <= knobs.levels and min(width, height) / 2**levels > knobs.window_px:
            levels += 1
        pictures = flow.pyramid(_joined([self._levels(view) for view in views]), levels)
        for number, view in enumerate(views):
            view.kept["pyramid"] = [level[number : number + 1] for level in pictures]
        return [None] * len(views)

    def _keypoints(self, views: list[View]) -> list[None]:
        knobs = self.knobs.registration
        cell = cell_side(*views[0].size, knobs)
        for view in views:
            grey = view.kept["pyramid"][0]
            points, _, valid = keypoints.grid_features(grey, cell, knobs.quality, knobs.block_px, least=1e-7 * LEVEL**2)
            view.kept["points"], view.kept["valid"] = points, valid
        return [None] * len(views)

    def _levels(self, view: View) -> Tensor:
        """(1, 1, H, W) float32 grey levels, made once."""
        if "levels" not in view.kept:
            view.kept["levels"] = torch.from_numpy(view.grey)[None, None].to(self.device).float()
        return view.kept["levels"]

    # ----------------------------------------------------------------------------------------------------------------

    def _foreground(self, windows: list[Window]) -> list[Foreground]:
        width, height = windows[0].reference.size
        pixels = width * height * max(len(windows[0].neighbours), 1)
        step = max(1, PIXELS_AT_ONCE.get(self.device.type, 1_500_000) // pixels)
        return [
            result
            for first in range(0, len(windows), step)
            for result in self._foreground_at_once(windows[first : first + step])
        ]

    def _foreground_at_once(self, windows: list[Window]) -> list[Foreground]:
        knobs, morph, one = self.knobs.difference, self.knobs.morphology, windows[0]
        (width, height), count = one.reference.size, len(one.neighbours)
        grey = torch.cat([torch.from_numpy(window.reference.grey)[None, None] for window in windows]).to(self.device)
        levels = _joined([self._levels(window.reference) for window in windows])
        matrices = torch.from_numpy(np.stack([window.neighbour_from_reference for window in windows])).to(self.device)
        warped: list[Tensor] = []
        seen: list[tuple[Tensor, Tensor]] = []
        for k in range(count):
            neighbours = _joined([self._levels(window.neighbours[k]) for window in windows])
            frame_size = neighbours.shape[-2], neighbours.shape[-1]
            sampled = warp.sample(neighbours, matrices[:, k], (height, width)).add_(0.5).floor_()
            run = warp.seen_columns(matrices[:, k], (height, width), frame_size, knobs.border_px)
            if knobs.kind == "normalized":
                sampled = _exposed(levels, sampled, run)
            warped.append(sampled.to(torch.uint8))
            seen.append(run)
        # Without either nobody asks for the texture.
        wanted = knobs.kind == "normalized" or self.knobs.refine.on
        texture = difference.gradient(levels) if wanted else torch.zeros_like(levels)
        near, wide = _evidence(one, grey, warped, seen, texture, knobs)
        scale = EVIDENCE_SCALE if knobs.kind == "normalized" else 1.0
        core = (near > int(knobs.threshold * scale)).to(torch.uint8) * 255
        core = morphology.closing(morphology.erode(core, morph.erode_px, "ellipse"), morph.close_px, "ellipse")
        small = self._small(one, grey, warped, seen)
        a, b = one.near[-1]
        maps = core, near, wide, texture.to(torch.uint8), warped[a], warped[b]
        rows = zip(*(made[:, 0].cpu().numpy() for made in maps), strict=True)
        smalls = [None] * len(windows) if small is None else list(small[:, 0].cpu().numpy())
        return [
            Foreground(core, near, wide, texture, small, (one, other), (window.offsets[a], window.offsets[b]))
            for window, (core, near, wide, texture, one, other), small in zip(windows, rows, smalls, strict=True)
        ]

    def _small(
        self, window: Window, grey: Tensor, warped: list[Tensor], seen: list[tuple[Tensor, Tensor]]
    ) -> Tensor | None:
        if window.small is None:
            return None
        a, b = window.small
        least = torch.minimum(_apart(grey, warped[a]), _apart(grey, warped[b]))
        least = blur.gaussian_levels(least, 5) * _both(seen[a], seen[b], grey.shape[-1])
        knobs = self.knobs.small
        mean = least.to(torch.float64).mean(dim=(1, 2, 3), keepdim=True)
        level = (knobs.noise_ratio * mean).clamp(min=knobs.threshold).floor()
        return morphology.closing((least > level).to(torch.uint8) * 255, knobs.close_px, "ellipse")


def cell_side(width: int, height: int, knobs: RegistrationKnobs) -> int:
    """Side of the grid cells, in pixels, that keeps the number of keypoints within the budget."""
    return max(knobs.cell_px, int(np.ceil(np.sqrt(width * height / knobs.keypoints))))


def _in_groups(items: Sequence[Item], key: Callable[[Item], Any], work: Callable[[list[Item]], list[Any]]) -> list[Any]:
    """Do the work on all items of a key at once; results in the order of the items."""
    places: dict[Any, list[int]] = defaultdict(list)
    for place, item in enumerate(items):
        places[key(item)].append(place)
    results: list[Any] = [None] * len(items)
    for group in places.values():
        for place, result in zip(group, work([items[place] for place in group]), strict=True):
            results[place] = result
    return results


def _joined(pictures: Sequence[Tensor]) -> Tensor:
    """One batch; a single picture is not copied."""
    return pictures[0] if len(pictures) == 1 else torch.cat(list(pictures))


# --------------------------------------------------------------------------------------------------------------------


def _follow(
    points: Tensor, valid: Tensor, earlier: list[Tensor], later: list[Tensor], knobs: RegistrationKnobs
) -> tuple[Tensor, Tensor]:
    """Where the points are in the later frames, and which were found.

    A few scouts search the whole pyramid; the others start where the scouts' motion takes them, which is quicker by
    far. Where the scouts do not agree, all points search the whole pyramid.
    """
    if points.shape[1] < 2 * SCOUTS:
        return _search(points, earlier, later, knobs)
    scouts = consensus.spread(valid, SCOUTS)
    start = points.gather(1, scouts[..., None].expand(-1, -1, 2))
    ahead, found = flow.track(start, earlier, later, rounds=3, **_tracking(knobs))
    found = found & valid.gather(1, scouts)
    motion = _fit(start, ahead, found, knobs)
    near = found & (consensus.transfer_error(motion, start, ahead) < knobs.ransac_px)
    agreed = near.sum(1) >= (0.6 * valid.gather(1, scouts).sum(1)).clamp(min=12)
    end, kept = torch.zeros_like(points), torch.zeros_like(valid)
    for choice, guessed in ((agreed, True), (~agreed, False)):
        chosen = choice.nonzero()[:, 0]
        if len(chosen):
            pyramids = earlier, later
            if len(chosen) < len(points):
                pyramids = [level[chosen] for level in earlier], [level[chosen] for level in later]
            guess = consensus.transfer(motion[chosen], points[chosen]) if guessed else None
            end[chosen], kept[chosen] = _search(points[chosen], *pyramids, knobs, guess)
    return end, kept


def _search(
    points: Tensor, earlier: list[Tensor], later: list[Tensor], knobs: RegistrationKnobs, guess: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Lucas-Kanade through the whole pyramid, or, near a guess, in its finest level."""
    settings = _tracking(knobs) | {"rounds": 3}
    if guess is not None:
        earlier, later, settings = earlier[:1], later[:1], settings | {"reach_px": 2, "rounds": 2}
    if knobs.forward_backward_px > 0:
        return flow.forward_backward(points, earlier, later, guess, limit_px=knobs.forward_backward_px, **settings)
    return flow.track(points, earlier, later, guess, **settings)


def _tracking(knobs: RegistrationKnobs) -> dict[str, Any]:
    return {
        "window_px": knobs.window_px,
        "iterations": knobs.iterations,
        "epsilon_px": knobs.epsilon_px,
        "min_eigen": 1e-4 * LEVEL**2,
    }


def _fit(start: Tensor, end: Tensor, tracked: Tensor, knobs: RegistrationKnobs) -> Tensor:
    """RANSAC, then least squares on the inliers of a tightening tolerance: the refits matter most for accuracy."""
    model = affine if knobs.model == "affine" else homography
    batch, count = tracked.shape
    if count < model.SAMPLE_SIZE:
        return torch.eye(3, dtype=start.dtype, device=start.device).expand(batch, 3, 3)
    # The same numbers for every pair and call: what one pair gives does not depend on its company.
    generator = torch.Generator().manual_seed(0)
    samples = consensus.draw_samples(generator, 1, knobs.hypotheses, count, model.SAMPLE_SIZE)
    samples = samples.to(start.device).expand(batch, -1, -1)
    refits = tuple(share * knobs.ransac_px for share in (1.5, 1.0, 0.5, 0.5))
    return model.ransac(start, end, tracked, samples, knobs.ransac_px, refits)[0]


def _judged(found: tuple[np.ndarray, ...], size: tuple[int, int], knobs: RegistrationKnobs) -> Registration:
    start, end, valid, tracked, later_from_earlier = found
    start, end = start[tracked], end[tracked]
    if valid.sum() < 4 or len(start) < 4:
        return judged(np.eye(3), len(start) if valid.sum() >= 4 else 0, 0, np.inf, size, knobs)
    miss = np.linalg.norm(transfer(later_from_earlier, start) - end, axis=1)
    inliers = miss < knobs.ransac_px
    error = float(np.median(miss[inliers])) if inliers.any() else np.inf
    return judged(later_from_earlier.astype(np.float64), len(start), int(inliers.sum()), error, size, knobs)


# --------------------------------------------------------------------------------------------------------------------


def _evidence(
    window: Window,
    grey: Tensor,
    warped: list[Tensor],
    seen: list[tuple[Tensor, Tensor]],
    texture: Tensor,
    knobs: DifferenceKnobs,
) -> tuple[Tensor, Tensor]:
    """The largest evidence over the near pairs, and that of the wide pair, uint8."""
    width = grey.shape[-1]
    if knobs.kind == "normalized":
        noise = texture.square().mul_((knobs.gradient_share / 4) ** 2).add_(knobs.noise_levels**2)
        weight, textured = noise.rsqrt_().mul_(EVIDENCE_SCALE), texture > 16
    apart = {k: _apart(grey, warped[k]) for k in _used(window)} if knobs.kind != "between_later" else {}

    def evidence(pair: tuple[int, int]) -> Tensor:
        a, b = pair
        both = _both(seen[a], seen[b], width)
        least = _apart(warped[a], warped[b]) if not apart else torch.minimum(apart[a], apart[b])
        if knobs.kind != "normalized":
            return blur.gaussian_levels(least, knobs.blur_px) * both
        z = least.mul_(both).float().mul_(weight).round_().clamp_(max=EVIDENCE_CAP).to(torch.uint8)
        z = blur.gaussian_levels(z, knobs.blur_px)
        return _in_units(z, textured & both)

    near = evidence(window.near[0])
    for pair in window.near[1:]:
        near = torch.maximum(near, evidence(pair))
    return near, near if window.wide is None else evidence(window.wide)


def _used(window: Window) -> set[int]:
    return {k for pair in (*window.near, *([window.wide] if window.wide else [])) for k in pair}


def _in_units(z: Tensor, textured: Tensor) -> Tensor:
    """Evidence divided by its median over textured pixels, where that is above one noise unit."""
    units = []
    for one, here in zip(z, textured, strict=True):
        counts = torch.bincount(one[here], minlength=256).cumsum(0)
        total = int(counts[-1])
        # The mean of the two in the middle, as NumPy takes it.
        ranks = torch.tensor([(total - 1) // 2, total // 2], device=z.device)
        median = float(torch.searchsorted(counts, ranks, right=True).double().mean()) if total > 500 else 0.0
        units.append(max(1.0, median / EVIDENCE_SCALE))
    if max(units) == 1.0:
        return z
    per_unit = torch.tensor([1 / unit for unit in units], device=z.device).reshape(-1, 1, 1, 1)
    return z.float().mul_(per_unit).round_().to(torch.uint8)


def _exposed(reference: Tensor, warped: Tensor, seen: tuple[Tensor, Tensor]) -> Tensor:
    """The warped pictures in their references' exposure, in whole levels."""
    first, last = (edge[:, ::4] for edge in seen)
    columns = torch.arange(0, reference.shape[-1], 4, device=reference.device)
    inside = (columns >= first[..., None]) & (columns <= last[..., None])
    wanted, given = (picture[..., ::4, ::4] / LEVEL for picture in (reference, warped))
    gain, offset = difference.exposure(wanted, given, inside[:, None], stride=1)
    enough = inside.sum((1, 2)) >= 100
    gain, offset = torch.where(enough, gain, 1.0), torch.where(enough, offset * LEVEL, 0.0)
    gain, offset = gain.reshape(-1, 1, 1, 1), offset.reshape(-1, 1, 1, 1)
    return warped.mul_(gain).add_(offset).round_().clamp_(0.0, LEVEL)


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """|a - b| of unsigned bytes."""
    return torch.maximum(a, b).sub_(torch.minimum(a, b))


def _both(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], width: int) -> Tensor:
    """Where both neighbours are seen, as a Boolean mask."""
    return warp.between(torch.maximum(one[0], other[0]), torch.minimum(one[1], other[1]), width)
