"""Scores of windows by OpenCV and ONNX Runtime, for a small CPU without torch.

The graphs are made from `functional.hog` by `dddas export`. A part goes through them in tiles that stay in the cache;
parts are shared among threads, each of which runs the graphs on one thread.
"""

import math
import threading
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.people.pyramid import count_windows, split_evenly
from torchvision_dddas.runtime import SHIPPED, manifest, verified
from torchvision_dddas.runtime import opened as open_graph
from torchvision_dddas.types import LinearSvm, Part

GRAPHS = "people_histograms.onnx", "people_scores.onnx"
# What the graphs have baked in; their manifest names it.
BAKED = ("cell_px", "block_px", "block_stride_px", "bins", "signed", "gamma")

# Side of a tile: its 16 maps take 1.8 MB, about what stays in a core's cache; smaller ones overlap their neighbours
# for a larger share (104 px: 1.2 times the time), and larger ones gain nothing.
_TILE_PX = 168
# Pixels of a band: with three channels its buffers take 1 MB, which should stay in a core's cache.
_BAND_PX = 20_000
# Pixels whose gradient is taken at once, and blocks that are scored at once: what bounds the memory.
_GRADIENT_PX = 160_000
_BLOCKS = 2_500
# Pixels of a level whose histograms are held at once, 2.3 bytes a pixel; strips overlap by a window's height.
_STRIP_PX = 16_000_000
# Pictures with more values are resized as they are, which takes longer and less memory.
_FEW_VALUES = 25_000_000


class OnnxScorer:
    """Implements `WindowScorer`."""

    name = "onboard"

    def __init__(self, parameters: PeopleParameters, svm: LinearSvm) -> None:
        """Raises InputError where the SVM has another length than the descriptor, or the graphs another layout."""
        self.parameters, self.svm, self.graphs = parameters, svm, find_graphs(parameters)
        self.svm_feed = {
            "weights": arrange_weights(svm, parameters),
            "bias": np.array(svm.bias, np.float32),
            "clip": np.array(parameters.clip, np.float32),
        }
        self.local = threading.local()

    @cached_property
    def sessions(self) -> tuple[Any, Any]:
        """The graphs of histograms and of scores, loaded when first needed: that takes longer than a frame."""
        # A memory pattern is a plan for every size of a level, which is no quicker and takes 9 MB.
        histograms, scores = (open_graph(self.graphs, name, enable_mem_pattern=False) for name in GRAPHS)
        return histograms, scores

    @cached_property
    def pool(self) -> ThreadPoolExecutor:
        """As many threads as OpenCV uses; each holds some 15 MB at 640x480."""
        return ThreadPoolExecutor(max(1, cv2.getNumThreads()))

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """The score map of each part of each picture."""
        _ = self.sessions
        jobs: dict[tuple[int, tuple[int, int]], list[int]] = defaultdict(list)
        for picture, wanted in enumerate(parts):
            for index, part in enumerate(wanted):
                jobs[picture, part.level].append(index)
        # With an unused fourth channel: OpenCV resizes four channels quicker than three.
        sources = [
            cv2.cvtColor(image, cv2.COLOR_BGR2BGRA) if image.ndim == 3 and image.size <= _FEW_VALUES else image
            for image in images
        ]
        maps: list[list[np.ndarray]] = [[np.empty(0)] * len(wanted) for wanted in parts]

        def score(job: tuple[int, tuple[int, int]]) -> None:
            picture, size = job
            level = sources[picture]
            if size != level.shape[1::-1]:
                level = cv2.resize(level, size, interpolation=cv2.INTER_LINEAR_EXACT)
            for index in jobs[job]:
                maps[picture][index] = self._score_part(level, parts[picture][index])

        # The largest first, so that the threads end together.
        order = sorted(jobs, key=lambda job: -sum(parts[job[0]][i].width * parts[job[0]][i].height for i in jobs[job]))
        for _ in self.pool.map(score, order):
            pass
        return maps

    def _score_part(self, level: np.ndarray, part: Part) -> np.ndarray:
        """A part's scores, every window stride. level: uint8 (H, W), or (H, W, 3) or (H, W, 4) in the order BGRA."""
        stride, block_stride = self.parameters.window_stride_px, self.parameters.block_stride_px
        width, height = count_windows(part, self.parameters)
        scores = np.empty((height, width), np.float32)
        if not scores.size:
            return scores
        rows = max(1, (_STRIP_PX // part.width - self.parameters.window_height_px) // stride)
        if height > rows:
            for top, bottom in split_evenly(height, rows):
                high = (bottom - top - 1) * stride + self.parameters.window_height_px
                scores[top:bottom] = self._score_part(level, replace(part, y=part.y + top * stride, height=high))
            return scores
        # Windows whose offset is the same modulo the block stride share their blocks: these are scored together.
        common = math.gcd(stride, block_stride)
        phases, every = block_stride // common, stride // common
        for row in range(min(phases, height)):
            for column in range(min(phases, width)):
                x, y = column * stride, row * stride
                inner = replace(part, x=part.x + x, y=part.y + y, width=part.width - x, height=part.height - y)
                found = self._score_blocks(self._compute_histograms(level, inner))[::every, ::every]
                here = scores[row::phases, column::phases]
                here[:] = found[: here.shape[0], : here.shape[1]]
        return scores

    def _score_blocks(self, histograms: np.ndarray) -> np.ndarray:
        """Scores of the windows at every block stride."""
        _, ny, nx = histograms.shape
        down, across, _ = self.svm_feed["weights"].shape
        found = np.empty((ny - down + 1, nx - across + 1), np.float32)
        # Each block takes as many numbers as a window has blocks: some rows at a time bound the memory.
        for top, bottom in split_evenly(len(found), max(down, _BLOCKS // nx)):
            rows = np.ascontiguousarray(histograms[:, top : bottom + down - 1])
            (found[top:bottom],) = self.sessions[1].run(None, {"histograms": rows, **self.svm_feed})
        return found

    def _compute_histograms(self, level: np.ndarray, part: Part) -> np.ndarray:
        """(F, ny, nx), tile by tile."""
        if not hasattr(self.local, "gradient"):  # one a thread
            self.local.gradient = Gradient(self.parameters.gamma, self.parameters.signed)
        gradient: Gradient = self.local.gradient
        block, stride = self.parameters.block_px, self.parameters.block_stride_px
        down, across = ((length - block) // stride + 1 for length in (part.height, part.width))
        channels = 1 if level.ndim == 2 else 3
        side = max(1, (_TILE_PX - block) // stride + 1)
        size = self.parameters.bins * (block // self.parameters.cell_px) ** 2
        found = gradient.scratch("histograms", (size, down, across))
        for first, last in split_evenly(down, max(side, _GRADIENT_PX // (part.width + 2) // stride)):
            # The channels of these rows alone: those of the whole would take 6 MB at 1280x720.
            rows_px = (last - 1 - first) * stride + block
            planes = gradient.scratch("planes", (channels, rows_px + 2, part.width + 2), np.uint8)
            fill_planes(planes, level, replace(part, y=part.y + first * stride, height=rows_px))
            polar = gradient(planes)
            for top, bottom in split_evenly(last - first, side):
                for left, right in split_evenly(across, side):
                    rows = slice(top * stride, (bottom - 1) * stride + block)
                    here = polar[:, rows, left * stride : (right - 1) * stride + block]
                    tile = gradient.scratch("tile", here.shape)
                    np.copyto(tile, here)
                    (found[:, first + top : first + bottom, left:right],) = self.sessions[0].run(
                        None, {"polar": tile[None]}
                    )
        return found


def find_graphs(parameters: PeopleParameters) -> Path:
    """The folder of the graphs. Raises InputError where they are not those of the manifest, or of another layout."""
    folder = SHIPPED if parameters.graphs == "shipped" else Path(parameters.graphs)
    wanted = {name: int(getattr(parameters, name)) for name in BAKED}
    settings = " ".join(f"--set people.{name}={value}" for name, value in wanted.items())
    make = f"make such graphs with `dddas export --graph people --out FOLDER {settings}`, and give "
    make += "people.graphs=FOLDER; or take --backend torch"
    try:
        held = manifest(folder)["graphs"]
    except InputError as error:
        raise InputError(f"people.graphs: {error}") from None
    if missing := [name for name in GRAPHS if name not in held]:
        raise InputError(f"people.graphs: {folder} lacks {' and '.join(missing)}; {make}")
    made_for = held[GRAPHS[0]]["knobs"]
    if wrong := [name for name in BAKED if made_for.get(name) != wanted[name]]:
        differences = ", ".join(f"people.{name} = {made_for.get(name)}, not {wanted[name]}" for name in wrong)
        raise InputError(f"the graphs in {folder} are made for {differences}; {make}")
    for name in GRAPHS:
        verified(folder, name)
    return folder


def fill_planes(planes: np.ndarray, level: np.ndarray, part: Part) -> None:
    """Channels (C, H + 2, W + 2) of a part with one pixel more on each side.

    That is its neighbour in the level, which is reflected beyond its own edge.
    """
    width, height = part.level
    left, top = max(0, 1 - part.x), max(0, 1 - part.y)
    right = max(0, part.x + part.width + 1 - width)
    bottom = max(0, part.y + part.height + 1 - height)
    _, rows, columns = planes.shape
    x, y = part.x - 1 + left, part.y - 1 + top
    if max(left, right) >= columns - left - right or max(top, bottom) >= rows - top - bottom:
        # More border than there is of the part to reflect.
        level = cv2.copyMakeBorder(level, top, bottom, left, right, cv2.BORDER_REFLECT_101)
        left = top = right = bottom = 0
    inside = level[y : y + rows - top - bottom, x : x + columns - left - right]
    for channel, plane in enumerate(planes):
        held = inside if level.ndim == 2 else cv2.extractChannel(inside, channel)
        cv2.copyMakeBorder(held, top, bottom, left, right, cv2.BORDER_REFLECT_101, dst=plane)


def arrange_weights(svm: LinearSvm, parameters: PeopleParameters) -> np.ndarray:
    """(down, across, F) weights as `functional.arrange_weights` has them.

    Raises InputError where the SVM is of another length than the descriptor.
    """
    (across, down), cells = parameters.blocks, parameters.block_px // parameters.cell_px
    if svm.weights.size != parameters.features:
        raise InputError(
            f"the classifier {svm.origin} has {svm.weights.size} weights; a window of these settings has "
            f"{parameters.features}"
        )
    weights = svm.weights.astype(np.float32).reshape(across, down, cells, cells, parameters.bins)
    return np.ascontiguousarray(weights.transpose(1, 0, 4, 3, 2)).reshape(down, across, -1)


class Gradient:
    """`functional.hog.gradient` and `angle` by a few passes of OpenCV, in bands that stay in the cache.

    It takes a quarter of the time that ONNX Runtime does for the same. One object a thread.
    """

    def __init__(self, gamma: bool, signed: bool) -> None:
        """gamma: of square roots of the levels. signed: directions of a whole turn; false: folded into half of it."""
        self.gamma, self.signed = gamma, signed
        self.held: dict[str, np.ndarray] = {}

    def scratch(self, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        """A contiguous array by its name: what it was given last, until it is asked for again."""
        size = math.prod(shape)
        held = self.held.get(name)
        if held is None or held.size < size or held.dtype != dtype:
            held = self.held[name] = np.empty(size, dtype)
        return held[:size].reshape(shape)

    def __call__(self, planes: np.ndarray) -> np.ndarray:
        """(2, H, W) float32 of planes uint8 (C, H + 2, W + 2): magnitude, and magnitude x direction in radians.

        Valid until the next call. Of channels whose magnitudes are equal the first wins.
        """
        height, width = planes.shape[1] - 2, planes.shape[2] - 2
        polar = self.scratch("polar", (2, height, width))
        for begin, end in split_evenly(height, max(8, _BAND_PX // width)):
            self._band(planes[:, begin : end + 2], polar[0, begin:end], polar[1, begin:end])
        return polar

    def _band(self, planes: np.ndarray, magnitude: np.ndarray, moment: np.ndarray) -> None:
        channels, height, width = planes.shape[0], planes.shape[1] - 2, planes.shape[2] - 2
        # Planes stand above one another, each with its border: rows of the differences between two planes mean nothing.
        tall = channels * (height + 2)
        levels = self.scratch("levels", (tall, width + 2))
        dx, dy, square = (self.scratch(name, (tall - 2, width)) for name in ("dx", "dy", "square"))
        np.copyto(levels.reshape(planes.shape), planes)
        if self.gamma:
            cv2.sqrt(levels, dst=levels)
        cv2.subtract(levels[1:-1, 2:], levels[1:-1, :-2], dst=dx)
        cv2.subtract(levels[2:, 1:-1], levels[:-2, 1:-1], dst=dy)
        best_dx, best_dy = dx[:height], dy[:height]
        if channels > 1:
            other = self.scratch("levels", square.shape)  # the levels are no longer needed
            # Not `accumulateSquare`, which rounds but once: of channels nearly equal another would win.
            cv2.add(cv2.multiply(dx, dx, dst=square), cv2.multiply(dy, dy, dst=other), dst=square)
            largest = square[:height]
            for begin in range(height + 2, tall, height + 2):
                end = begin + height
                wins = cv2.compare(square[begin:end], largest, cv2.CMP_GT)
                cv2.copyTo(dx[begin:end], wins, best_dx)
                cv2.copyTo(dy[begin:end], wins, best_dy)
                if end < len(square):
                    cv2.max(square[begin:end], largest, dst=largest)
        cv2.cartToPolar(best_dx, best_dy, magnitude=magnitude, angle=moment)
        if not self.signed:
            half_turn = cv2.threshold(moment, math.pi, math.pi, cv2.THRESH_BINARY, dst=best_dx)[1]
            cv2.subtract(moment, half_turn, dst=moment)
        cv2.multiply(moment, magnitude, dst=moment)
