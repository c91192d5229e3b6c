"""The back end for batches and GPUs: the pixel floor `ops` on whole grey levels, so that it sees what OpenCV sees.

`ops` speak of [0, 1]; here pictures are kept as float levels 0 .. 255, whose sums are exact.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.engine import EVIDENCE_SCALE, Foreground, View, Window
from torchvision_dddas.detection.exposure import to_light_of
from torchvision_dddas.detection.torch_foreground import closed, evidence, exposed, joined, levels_of, lit, small_movers
from torchvision_dddas.detection.torch_registration import register
from torchvision_dddas.functional import difference, morphology, warp
from torchvision_dddas.types import Registration

Item = TypeVar("Item")

# Pixels of warped neighbours in work at once: larger temporaries leave a CPU's cache, a GPU wants many.
PIXELS_AT_ONCE = {"cpu": 1_500_000, "cuda": 400_000_000}


class Registered(NamedTuple):
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
        """The frame and its grey picture; tensors follow when they are asked for."""
        return View(image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)

    @torch.inference_mode()
    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """Keypoints, pyramidal Lucas-Kanade, RANSAC, refits on the inliers: all pairs at once."""
        return _in_groups(
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

        return _in_groups(windows, structure, self._foreground)

    def _foreground(self, windows: list[Window]) -> list[Foreground]:
        width, height = windows[0].reference.size
        pixels = width * height * max(len(windows[0].neighbours), 1)
        step = max(1, PIXELS_AT_ONCE.get(self.device.type, 1_500_000) // pixels)
        return [
            result
            for first in range(0, len(windows), step)
            for result in self._foreground_at_once(windows[first : first + step])
        ]

    def registered(self, windows: list[Window]) -> Registered:
        """Windows of equal structure with their neighbours warped to the references, in the references' light."""
        parameters, one = self.parameters.difference, windows[0]
        (width, height), count = one.reference.size, len(one.neighbours)
        grey = torch.cat([torch.from_numpy(window.reference.grey)[None, None] for window in windows]).to(self.device)
        levels = joined([levels_of(window.reference, self.device) for window in windows])
        matrices = torch.from_numpy(np.stack([window.neighbour_from_reference for window in windows])).to(self.device)
        warped: list[Tensor] = []
        seen: list[tuple[Tensor, Tensor]] = []
        for k in range(count):
            neighbours = joined([levels_of(window.neighbours[k], self.device) for window in windows])
            frame_size = neighbours.shape[-2], neighbours.shape[-1]
            sampled = warp.sample(neighbours, matrices[:, k], (height, width)).add_(0.5).floor_()
            run = warp.seen_columns(matrices[:, k], (height, width), frame_size, parameters.border_px)
            if parameters.kind == "normalized":
                sampled = exposed(levels, sampled, run)
            elif parameters.kind == "to_reference":
                light = np.array([to_light_of(window.reference, window.neighbours[k]) for window in windows])
                if (light != (1.0, 0.0)).any():
                    sampled = lit(levels, sampled, *torch.from_numpy(light.T).to(levels))
            warped.append(sampled.to(torch.uint8))
            seen.append(run)
        # Without either nobody asks for the texture.
        wanted = parameters.kind == "normalized" or self.parameters.refine.on
        texture = difference.gradient(levels) if wanted else torch.zeros_like(levels)
        return Registered(grey, warped, seen, texture)

    def _foreground_at_once(self, windows: list[Window]) -> list[Foreground]:
        parameters, morph, one = self.parameters.difference, self.parameters.morphology, windows[0]
        grey, warped, seen, texture = self.registered(windows)
        near, wide = evidence(one, grey, warped, seen, texture, parameters)
        scale = EVIDENCE_SCALE if parameters.kind == "normalized" else 1.0
        core = (near > int(parameters.threshold * scale)).to(torch.uint8) * 255
        core = closed(morphology.erode(core, morph.erode_px, "ellipse"), one.close_px or morph.close_px)
        small = small_movers(one, grey, warped, seen, self.parameters.small)
        a, b = one.near[-1]
        maps = core, near, wide, texture.to(torch.uint8), warped[a], warped[b]
        rows = zip(*(made[:, 0].cpu().numpy() for made in maps), strict=True)
        smalls = [None] * len(windows) if small is None else list(small[:, 0].cpu().numpy())
        return [
            Foreground(core, near, wide, texture, small, (one, other), (window.offsets[a], window.offsets[b]))
            for window, (core, near, wide, texture, one, other), small in zip(windows, rows, smalls, strict=True)
        ]


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
