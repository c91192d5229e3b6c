"""The engine for batches and GPUs: it runs `nn.FrameRegistration` and `nn.MotionSegmenter` on many frames."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.chain import View, Window, match_exposure
from torchvision_dddas.config import Settings, uses_tracklets
from torchvision_dddas.detection.detector import MotionDetector
from torchvision_dddas.detection.engine import Engine, Foreground, grey_of, judge_points
from torchvision_dddas.detection.torch_blobs import foregrounds_with_blobs
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.filters import to_bytes
from torchvision_dddas.nn import MotionSegmenter
from torchvision_dddas.runtime import torch_device
from torchvision_dddas.types import Registration

Item = TypeVar("Item")

# Megabytes of float pictures that are processed at once. 72 MB are eight windows of 640x480. With 6 MB (one window) the
# default configuration takes 1.15 times as long and `fast` 1.11 times (`python eval/speed.py batches`).
BATCH_MB = {"cpu": 72.0, "cuda": 1600.0}
_MB_OF_PIXEL = 4e-6
_POINTS_AT_ONCE = 100_000


@dataclass
class TensorView(View):
    """A frame with data that the engine has computed. levels: (1, 1, H, W) float32 grey levels.

    keypoints: (1, N, 2) positions, and (1, N) whether each is valid. pyramid: the image pyramid of the grey levels.
    """

    levels: Tensor | None = None
    keypoints: tuple[Tensor, Tensor] | None = None
    pyramid: list[Tensor] = field(default_factory=list)


class TorchEngine(Engine[TensorView]):
    """Implements `Engine`, and computes all pairs and windows of equal structure at once."""

    name = "torch"

    def __init__(
        self,
        settings: Settings,
        device: str | torch.device | None = None,
        components: Literal["opencv", "torch"] | None = None,
        batch_mb: float | None = None,
    ) -> None:
        """Set up the engine.

        device: by default the GPU if there is one. components: the library that labels regions, by default opencv on
        the CPU and torch on other devices; with torch whole maps stay on the device. batch_mb: megabytes of pictures
        that are processed at once, by default BATCH_MB of the device.
        Raises InputError for Apple's MPS and for settings at half resolution.
        """
        for group in ("registration", "difference"):
            if getattr(settings, group).halved:
                raise InputError(f"the torch engine does not support {group}.halved; set it false or use onboard")
        self.parameters = settings
        self.device = torch.device(device or torch_device())
        if self.device.type == "mps":
            raise InputError("the torch engine needs float64, which mps does not support; use the device cpu or cuda")
        self.batch_mb = batch_mb or BATCH_MB.get(self.device.type, BATCH_MB["cpu"])
        self.components = components or ("opencv" if self.device.type == "cpu" else "torch")

    @property
    def segmenter(self) -> MotionSegmenter:
        """The hard detection chain of the current settings, without trainable parameters."""
        return MotionSegmenter(self.parameters, tuned=()).to(self.device)

    def prepare(self, image: np.ndarray) -> TensorView:
        """See `Engine.prepare`."""
        return TensorView(image, grey_of(image))

    @torch.inference_mode()
    def register(self, pairs: Sequence[tuple[TensorView, TensorView]]) -> list[Registration]:
        """See `Engine.register`. Pyramids and the keypoints of the earlier frames are cached in the views."""
        return _apply_in_groups(pairs, lambda pair: (pair[0].size, pair[1].size), self._register)

    def _register(self, pairs: list[tuple[TensorView, TensorView]]) -> list[Registration]:
        registration, parameters = self.segmenter.registration, self.parameters.registration
        keypoints = [self._keypoints(earlier) for earlier, _ in pairs]
        matched = []
        for pair in pairs:  # if exposures differ, one of the two becomes a new view
            greys = zip(pair, match_exposure(*pair), strict=True)
            matched.append([view if grey is view.grey else TensorView(view.image, grey) for view, grey in greys])
        missing = list({id(view): view for pair in matched for view in pair if not view.pyramid}.values())
        width, height = pairs[0][0].size
        step = self._at_once(width * height)
        for views in (missing[first : first + step] for first in range(0, len(missing), step)):
            pyramid = registration.pyramid(_join([self._levels(view) for view in views]))
            for number, view in enumerate(views):
                view.pyramid = [level[number : number + 1] for level in pyramid]
        count = max(keypoints[0][0].shape[1], 1)
        step = max(1, _POINTS_AT_ONCE // count)
        made: list[Registration] = []
        for first in range(0, len(pairs), step):
            part = np.s_[first : first + step]
            points, valid = (_join(kept) for kept in zip(*keypoints[part], strict=True))
            before, after = (
                [_join(level) for level in zip(*(view.pyramid for view in views), strict=True)]
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
    def foreground(self, windows: Sequence[Window[TensorView]]) -> list[Foreground]:
        """See `Engine.foreground`."""

        def structure(window: Window[TensorView]) -> tuple[Any, ...]:
            sizes = tuple(view.size for view in window.neighbours)
            ignored = id(window.reference.ignored)  # one mask for all frames of a setting
            given = window.settings or self.parameters
            return window.reference.size, sizes, window.near, window.wide, window.small, window.close_px, ignored, given

        def work(group: list[Window[TensorView]]) -> list[Foreground]:
            width, height = group[0].reference.size
            step = self._at_once(width * height * max(len(group[0].neighbours), 1))
            return [made for i in range(0, len(group), step) for made in self._foreground(group[i : i + step])]

        return _apply_in_groups(windows, structure, work)

    def _at_once(self, pixels: int) -> int:
        """Return how many items with this number of pixels are processed at once."""
        return max(1, int(self.batch_mb / (_MB_OF_PIXEL * pixels)))

    def batch_of(self, windows: Sequence[Window[TensorView]]) -> Window[Tensor]:
        """Join windows of equal structure into one window whose frames are batches."""
        one = windows[0]
        matrices = torch.from_numpy(np.stack([window.neighbour_from_reference for window in windows])).to(self.device)
        reference = _join([self._levels(window.reference) for window in windows])
        by_place = zip(*(window.neighbours for window in windows), strict=True)
        neighbours = tuple(_join([self._levels(view) for view in views]) for views in by_place)
        given = one.offsets, one.near, one.wide, one.small, one.close_px
        return Window(reference, neighbours, matrices, *given, ignored=self._ignored(one.reference))

    def _foreground(self, windows: list[Window[TensorView]]) -> list[Foreground]:
        one = windows[0]
        settings = one.settings or self.parameters
        chain = MotionSegmenter(settings, tuned=()).to(self.device).chain()
        maps = chain.find_foreground(self.batch_of(windows))
        texture = to_bytes(maps.texture)
        if self.components == "torch" and not uses_tracklets(settings):  # tracklets need whole maps
            whole = maps.core, maps.evidence, maps.wide, texture
            return foregrounds_with_blobs(windows, settings, whole, maps.small, maps.warped)
        pictures = (maps.core, maps.evidence, maps.wide, texture, *maps.warped, *maps.pairs)
        rows = zip(*(made[:, 0].cpu().numpy() for made in pictures), strict=True)
        smalls, levels = (
            [None] * len(windows) if made is None else made[:, 0].cpu().numpy() for made in (maps.small, maps.levels)
        )
        a, b = one.near[-1]
        offsets = [(window.offsets[a], window.offsets[b]) for window in windows]
        return [
            Foreground(core, near, wide, texture, small, (w1, w2), tuple(pairs), level, apart)
            for (core, near, wide, texture, w1, w2, *pairs), small, level, apart in zip(
                rows, smalls, levels, offsets, strict=True
            )
        ]

    def _keypoints(self, view: TensorView) -> tuple[Tensor, Tensor]:
        """Return the view's keypoints and whether each is valid, and cache both in the view."""
        if view.keypoints is None:
            points, valid = self.segmenter.registration.keypoints(self._levels(view))
            if (ignored := self._ignored(view)) is not None:
                u, v = points[0].long().unbind(-1)
                valid = valid & ~ignored[0, 0, v, u]
            view.keypoints = points, valid
        return view.keypoints

    def _ignored(self, view: TensorView) -> Tensor | None:
        """Return (1, 1, H, W) bool, true at the pixels that the view ignores, or None."""
        return None if view.ignored is None else torch.from_numpy(view.ignored > 0)[None, None].to(self.device)

    def _levels(self, view: TensorView) -> Tensor:
        """Return the (1, 1, H, W) float32 grey levels of a view, and cache them in the view."""
        if view.levels is None:
            view.levels = torch.from_numpy(view.grey)[None, None].to(self.device).float()
        return view.levels


def detect_masks(model: MotionSegmenter, clip: Float[Tensor, "B T C H W"]) -> Bool[Tensor, "B T 1 H W"]:
    """Return the masks of `MotionDetector` on the torch engine with the learned parameters of a model.

    clip: RGB or grey pictures in [0, 1]. Raises InputError for the same input as `MotionDetector`.
    """
    settings, masks = model.tuned_settings(), []
    for pictures in (clip.detach() * 255).round().to(torch.uint8).cpu().numpy():
        detector = MotionDetector(settings, backend=TorchEngine(settings, clip.device))
        frames = pictures[:, 0] if clip.shape[2] == 1 else pictures[:, ::-1].transpose(0, 2, 3, 1)
        scenes = [scene for frame in frames for scene in detector.update(np.ascontiguousarray(frame))]
        masks.append(np.stack([scene.mask > 0 for scene in [*scenes, *detector.flush()]]))
    return torch.from_numpy(np.stack(masks))[:, :, None].to(clip.device)


def _apply_in_groups(
    items: Sequence[Item], key: Callable[[Item], Any], work: Callable[[list[Item]], list[Any]]
) -> list[Any]:
    """Apply `work` to all items of equal key at once, and return the results in the order of the items."""
    places: dict[Any, list[int]] = defaultdict(list)
    for place, item in enumerate(items):
        places[key(item)].append(place)
    results: dict[int, Any] = {}
    for group in places.values():
        results |= zip(group, work([items[place] for place in group]), strict=True)
    return [results[place] for place in range(len(items))]


def _join(pictures: Sequence[Tensor]) -> Tensor:
    """Join pictures into one batch. A single picture is not copied."""
    return pictures[0] if len(pictures) == 1 else torch.cat(list(pictures))
