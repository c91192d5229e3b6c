"""A clip run once by the hard pipeline, and the windows of its labelled frames as the soft steps take them."""

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass

import numpy as np
import torch

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.detector import Loop
from torchvision_dddas.detection.engine import (
    EVIDENCE_CAP,
    EVIDENCE_SCALE,
    Engine,
    Foreground,
    View,
    Window,
    load_engine,
)
from torchvision_dddas.detection.torch_engine import TorchEngine
from torchvision_dddas.detection.torch_foreground import TEXTURED, distances, least_of, seen_by_both
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.stages import opened
from torchvision_dddas.nn.motion_segmenter import Differences
from torchvision_dddas.types import Registration, Scene

_NUMBER = "number of the frame"


@dataclass(frozen=True)
class Recorded:
    """A frame and what the hard pipeline made of it. window: None where it had none. mask: (H, W) bool, its targets."""

    frame: int
    window: Window | None
    mask: np.ndarray


def recorded(clip: Clip, settings: Settings, wanted: Set[int]) -> Iterator[Recorded]:
    """The wanted frames of a clip, in order. Raises InputError as `dddas detect` does."""
    source = opened(clip)
    engine = _Recorder(load_engine("onboard", settings), wanted)
    loop = Loop(engine, settings, source.rate_hz)

    def scenes() -> Iterator[Scene]:
        for frame in source:
            engine.number = frame.number
            yield from loop.feed(frame)
        yield from loop.end(source.last)

    for scene in scenes():
        number = scene.frame.number
        if number in wanted:
            yield Recorded(number, engine.windows.pop(number, None), scene.mask > 0)


class _Recorder:
    """A back end that remembers the windows of wanted frames."""

    def __init__(self, engine: Engine, wanted: Set[int]) -> None:
        self.name, self.number = engine.name, 0
        self.windows: dict[int, Window] = {}
        self._vision, self._wanted = engine, wanted

    @property
    def parameters(self) -> Settings:
        return self._vision.parameters

    @parameters.setter
    def parameters(self, settings: Settings) -> None:
        self._vision.parameters = settings

    def prepare(self, image: np.ndarray) -> View:
        view = self._vision.prepare(image)
        view.kept[_NUMBER] = self.number
        return view

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        return self._vision.register(pairs)

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        for window in windows:
            if (number := window.reference.kept[_NUMBER]) in self._wanted:
                self.windows[number] = window
        return self._vision.foreground(windows)


@torch.inference_mode()
def differences_of(window: Window, settings: Settings) -> Differences:
    """A window as far as no tunable parameter has a say, on the CPU; a batch of one."""
    grey, warped, seen, texture = TorchEngine(settings, "cpu").registered([window])
    parameters = settings.difference
    distance = distances(window, grey, warped, parameters)
    least = [least_of(pair, distance, warped) for pair in window.near]
    both = [seen_by_both(seen[a], seen[b], grey.shape[-1]) for a, b in window.near]
    return Differences(
        torch.cat(least, 1).clone(),
        torch.cat(both, 1),
        texture.to(torch.uint8),
        texture > TEXTURED,
        EVIDENCE_SCALE,
        EVIDENCE_CAP,
    )
