"""The source's tracker with histograms and affinities of many frames at once, by `nn.HistogramAffinity`.

Weights, clusters, gate and assignment are those of `source_tracker`. Counts of pixels and the float64 sums in the
affinities are exact, so the identities are the same.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from math import prod
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.config import PaperParameters, Settings
from torchvision_dddas.nn import HistogramAffinity
from torchvision_dddas.runtime import torch_device
from torchvision_dddas.tracking.source_tracker import (
    Feature,
    Features,
    PicturedBoxes,
    SourceTracker,
    check_window,
    crops,
    frames_considered,
    needs_appearance,
    weigh,
)
from torchvision_dddas.types import Detections, Tracks

Window = Sequence[Features]

# Number of frames that are settled together. They are fewer if their windows have more than _AFFINITIES affinities.
FRAMES, _AFFINITIES = 16, 1 << 22
# Largest number of box pixels on the device at once, about 100 bytes each.
_PIXELS = 1 << 20


class TorchSourceTracker(SourceTracker):
    """A `SourceTracker` whose `feed` settles FRAMES frames together, and whose `end` settles the rest.

    histograms_s: computing time of histograms, seconds.
    """

    def __init__(self, settings: Settings, interval: int, size: tuple[float, float] | None = None) -> None:
        """Start without frames. The arguments are those of `SourceTracker`."""
        super().__init__(settings, interval, size)
        self.histograms_s = 0.0
        self._device = torch.device(torch_device())
        self._model = HistogramAffinity(normalize=False)
        self._waiting: list[tuple[int, Detections, Window]] = []

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
    ) -> list[Tracks]:
        """Add the detections of a frame. appearance: `PicturedBoxes`, or a function returning (N, 768) histograms."""
        self.window.appendleft(Features(detections.box_px, appearance))
        check_window(self.window)
        self._waiting.append((frame, detections, list(self.window)))
        affinities = sum(prod(len(targets) + 1 for targets in window) for _, _, window in self._waiting)
        return self.end() if len(self._waiting) == FRAMES or affinities > _AFFINITIES else []

    def end(self) -> list[Tracks]:
        """Settle the waiting frames."""
        waiting, self._waiting = self._waiting, []
        known = self._affinities([window for _, _, window in waiting])
        return [self.identify(*each, by_feature) for each, by_feature in zip(waiting, known, strict=True)]

    @torch.inference_mode()
    def _affinities(self, windows: Sequence[Window]) -> list[dict[Feature, np.ndarray]]:
        """Return for each window the affinities that its association needs, by feature.

        Histograms and similarities within a frame are stored in its `Features`.
        """
        known: list[dict[Feature, np.ndarray]] = [{} for _ in windows]
        linked = [k for k, window in enumerate(windows) if len(window) > 1]
        self._compare(_considered([windows[k] for k in linked], self.parameters), "location")
        looked = [windows[k] for k in linked if needs_appearance(windows[k], self.parameters)]
        self._count_colours(frame for window in looked for frame in window)
        if self.parameters.rule == "dispersion":
            self._compare(_considered(looked, self.parameters), "appearance")
        weights = {k: weigh(windows[k], self.parameters)[0] for k in linked}
        counts: dict[Feature, list[int]] = {
            "location": [k for k, weight in weights.items() if weight > 0],
            "appearance": [k for k, weight in weights.items() if weight < 1],
        }
        for feature, places in counts.items():
            for size in (2, 3):
                chosen = [k for k in places if len(windows[k]) == size]
                for k, found in zip(chosen, self._affinity([windows[k] for k in chosen], feature), strict=True):
                    known[k][feature] = found
        return known

    def _count_colours(self, frames: Iterable[Features]) -> None:
        """Compute the histograms of frames, and store them in their `Features`."""
        start = perf_counter()
        some = [frame for frame in dict.fromkeys(frames) if not frame.has_histograms]
        pictured = [(frame, frame.source) for frame in some if isinstance(frame.source, PicturedBoxes)]
        inside = [crop for _, boxes in pictured for crop in crops(boxes.image, boxes.box_px)]
        found = np.zeros((len(inside), 768), np.float32)
        # Sort the crops by size, so that little padding is needed.
        for rows in _parts(sorted(range(len(inside)), key=lambda k: inside[k].size), [crop.shape for crop in inside]):
            found[rows] = self._histograms([inside[k] for k in rows])
        ends = np.cumsum([len(frame) for frame, _ in pictured]).tolist()
        for (frame, _), end in zip(pictured, ends, strict=True):
            frame.take_histograms(found[end - len(frame) : end])
        self.histograms_s += perf_counter() - start

    def _histograms(self, inside: Sequence[np.ndarray]) -> np.ndarray:
        """Return (N, 768) counts of crops, each of which is a picture with one box."""
        sides = np.array([crop.shape[1::-1] for crop in inside])
        width, height = sides.max(axis=0)
        padded = np.zeros((len(inside), height, width, 3), np.uint8)
        for picture, crop in zip(padded, inside, strict=True):
            picture[: crop.shape[0], : crop.shape[1]] = crop
        clip = torch.from_numpy(padded).to(self._device).permute(0, 3, 1, 2).flip(1).float().div_(255)
        box_px = torch.from_numpy(np.pad(sides, ((0, 0), (2, 0))).astype(np.float32)).to(self._device)
        valid = torch.ones(len(inside), 1, dtype=torch.bool, device=self._device)
        counts: np.ndarray = self._model.histograms(clip, box_px[:, None], valid)[0].cpu().numpy()
        return counts[:, 0]

    def _compare(self, frames: Iterable[Features], feature: Feature) -> None:
        """Compute the similarities of the targets within frames, and store them in their `Features`."""
        some = [frame for frame in dict.fromkeys(frames) if len(frame) > 1 and feature not in frame.similarity]
        if some:
            values, valid = self._padded([frame.values(feature, self.parameters.histogram) for frame in some])
            itself = torch.arange(len(some), device=self._device)[:, None].expand(-1, 2)
            found = self._model.affinity(values, valid, itself).cpu().numpy()
            for frame, similarity in zip(some, found, strict=True):
                frame.similarity[feature] = similarity[: len(frame), : len(frame)]

    def _affinity(self, windows: Sequence[Window], feature: Feature) -> list[np.ndarray]:
        """Return the results of `source_tracker.affinity` for windows of equal length."""
        if not windows:
            return []
        frames = list(dict.fromkeys(frame for window in windows for frame in window))
        rows = [frame.values(feature, self.parameters.histogram) for frame in frames]
        # A dummy is a zero vector. If it is marked as not valid, its affinities are 0.
        values, valid = self._padded([np.pad(row, ((1, 0), (0, 0))) for row in rows])
        valid[:, 0] = self.parameters.dummy != "zero"
        place = {frame: k for k, frame in enumerate(frames)}
        places = torch.tensor([[place[frame] for frame in window] for window in windows], device=self._device)
        found = self._model.affinity(values, valid, places).cpu().numpy()
        return [
            table[tuple(slice(len(frame) + 1) for frame in window)]
            for table, window in zip(found, windows, strict=True)
        ]

    def _padded(self, rows: Sequence[np.ndarray]) -> tuple[Tensor, Tensor]:
        """Return the rows of frames padded with zeros, (T, N, D) float64, and (T, N) whether a row is real."""
        most = max(map(len, rows))
        values = np.stack([np.pad(np.asarray(row, float), ((0, most - len(row)), (0, 0))) for row in rows])
        valid = np.arange(most) < np.array([len(row) for row in rows])[:, None]
        return torch.from_numpy(values).to(self._device), torch.from_numpy(valid).to(self._device)


def _parts(order: Sequence[int], shapes: Sequence[tuple[int, ...]]) -> Iterator[list[int]]:
    """Yield indices of non-empty crops, in order, in parts of one crop or of at most _PIXELS pixels after padding."""
    part, height, width = list[int](), 0, 0
    for k in order:
        tall, wide = shapes[k][:2]
        if not tall or not wide:
            continue
        height, width = max(height, tall), max(width, wide)
        if part and (len(part) + 1) * height * width > _PIXELS:
            yield part
            part, height, width = [], tall, wide
        part.append(k)
    if part:
        yield part


def _considered(windows: Iterable[Window], parameters: PaperParameters) -> Iterable[Features]:
    """Yield the frames of windows whose dispersions are used."""
    for window in windows:
        yield from window[: frames_considered([len(frame) for frame in window], parameters)]
