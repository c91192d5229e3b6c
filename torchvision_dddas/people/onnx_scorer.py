"""Score windows by OpenCV and ONNX Runtime, for a small CPU without torch.

`dddas export` makes the graphs from `functional.hog`. The graphs process a part in tiles that fit into the cache. The
levels are distributed to a pool of threads; each thread runs the graphs single-threaded.
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
# Parameters that are constants in the graphs. The manifest states their values.
BAKED = ("cell_px", "block_px", "block_stride_px", "bins", "signed", "gamma")

# Side of a tile: its 16 maps take 1.8 MB, about the size of a core's cache. Smaller tiles overlap their neighbours by a
# larger share (104 px: 1.2 times the time), and larger tiles gain nothing.
_TILE_PX = 168
# Pixels of a band: with three channels its buffers take 1 MB, which should stay in a core's cache.
_BAND_PX = 20_000
# Pixels whose gradient is computed at once, and blocks that are scored at once. These numbers limit the memory.
_GRADIENT_PX = 160_000
_BLOCKS = 2_500
# Pixels of a level whose histograms are in memory at once, 2.3 bytes a pixel. Strips overlap by a window's height.
_STRIP_PX = 16_000_000
# Pictures with more values than this are not copied to four channels before resizing: slower, but with less memory.
_FEW_VALUES = 25_000_000


class OnnxScorer:
    """Implements `WindowScorer`."""

    name = "onboard"

    def __init__(self, parameters: PeopleParameters, svm: LinearSvm) -> None:
        """Load the scorer. Raises InputError if the SVM's length or the graphs' layout do not fit the parameters."""
        self.parameters, self.svm, self.graphs = parameters, svm, find_graphs(parameters)
        self.svm_feed = {
            "weights": arrange_weights(svm, parameters),
            "bias": np.array(svm.bias, np.float32),
            "clip": np.array(parameters.clip, np.float32),
        }
        self.local = threading.local()

    @cached_property
    def sessions(self) -> tuple[Any, Any]:
        """The graphs of histograms and of scores. They are loaded on first use, which takes longer than a frame."""
        # ONNX Runtime's memory patterns, one for each size of a level, save no time here and take 9 MB.
        histograms, scores = (open_graph(self.graphs, name, enable_mem_pattern=False) for name in GRAPHS)
        return histograms, scores

    @cached_property
    def pool(self) -> ThreadPoolExecutor:
        """A pool of as many threads as OpenCV uses. Each thread takes about 15 MB at 640x480."""
        return ThreadPoolExecutor(max(1, cv2.getNumThreads()))

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """Return the score map of each part of each picture, see `WindowScorer.scores`."""
        _ = self.sessions
        jobs: dict[tuple[int, tuple[int, int]], list[int]] = defaultdict(list)
        for picture, wanted in enumerate(parts):
            for index, part in enumerate(wanted):
                jobs[picture, part.level].append(index)
        # Add an unused fourth channel, because OpenCV resizes four channels faster than three.
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

        # Start the largest jobs first, so that all threads finish at about the same time.
        order = sorted(jobs, key=lambda job: -sum(parts[job[0]][i].width * parts[job[0]][i].height for i in jobs[job]))
        for _ in self.pool.map(score, order):
            pass
        return maps

    def _score_part(self, level: np.ndarray, part: Part) -> np.ndarray:
        """Return the scores of a part at every window stride. level: uint8 (H, W), (H, W, 3) BGR or (H, W, 4) BGRA."""
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
        # Windows whose offsets are equal modulo the block stride share their blocks, and are scored together.
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
        """Return the scores of the windows at every block stride."""
        _, ny, nx = histograms.shape
        down, across, _ = self.svm_feed["weights"].shape
        found = np.empty((ny - down + 1, nx - across + 1), np.float32)
        # The graph stores, for each block, as many numbers as a window has blocks. Score some rows at a time to save
        # memory.
        for top, bottom in split_evenly(len(found), max(down, _BLOCKS // nx)):
            rows = np.ascontiguousarray(histograms[:, top : bottom + down - 1])
            (found[top:bottom],) = self.sessions[1].run(None, {"histograms": rows, **self.svm_feed})
        return found

    def _compute_histograms(self, level: np.ndarray, part: Part) -> np.ndarray:
        """Compute the block histograms (F, ny, nx) of a part, tile by tile."""
        if not hasattr(self.local, "gradient"):  # each thread has its own object
            self.local.gradient = Gradient(self.parameters.gamma, self.parameters.signed)
        gradient: Gradient = self.local.gradient
        block, stride = self.parameters.block_px, self.parameters.block_stride_px
        down, across = ((length - block) // stride + 1 for length in (part.height, part.width))
        channels = 1 if level.ndim == 2 else 3
        side = max(1, (_TILE_PX - block) // stride + 1)
        size = self.parameters.bins * (block // self.parameters.cell_px) ** 2
        found = gradient.scratch("histograms", (size, down, across))
        for first, last in split_evenly(down, max(side, _GRADIENT_PX // (part.width + 2) // stride)):
            # Copy the channels of these rows only: those of the whole picture would take 6 MB at 1280x720.
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
    """Return the folder of the graphs. Raise InputError if they differ from the manifest or have another layout."""
    folder = SHIPPED if parameters.graphs == "shipped" else Path(parameters.graphs)
    wanted = {name: int(getattr(parameters, name)) for name in BAKED}
    settings = " ".join(f"--set people.{name}={value}" for name, value in wanted.items())
    make = f"make matching graphs with `dddas export --graph people --out FOLDER {settings}`, and set "
    make += "people.graphs=FOLDER; or use --backend torch"
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
    """Write the channels of a part, with a border of one pixel, into planes (C, H + 2, W + 2).

    The border pixels come from the level, which is reflected at its own edge.
    """
    width, height = part.level
    left, top = max(0, 1 - part.x), max(0, 1 - part.y)
    right = max(0, part.x + part.width + 1 - width)
    bottom = max(0, part.y + part.height + 1 - height)
    _, rows, columns = planes.shape
    x, y = part.x - 1 + left, part.y - 1 + top
    if max(left, right) >= columns - left - right or max(top, bottom) >= rows - top - bottom:
        # The border is wider than the visible part, so reflect the whole level instead.
        level = cv2.copyMakeBorder(level, top, bottom, left, right, cv2.BORDER_REFLECT_101)
        left = top = right = bottom = 0
    inside = level[y : y + rows - top - bottom, x : x + columns - left - right]
    for channel, plane in enumerate(planes):
        held = inside if level.ndim == 2 else cv2.extractChannel(inside, channel)
        cv2.copyMakeBorder(held, top, bottom, left, right, cv2.BORDER_REFLECT_101, dst=plane)


def arrange_weights(svm: LinearSvm, parameters: PeopleParameters) -> np.ndarray:
    """Return the weights as (down, across, F), in the order of `functional.arrange_weights`.

    Raises InputError if the length of the SVM differs from that of the descriptor.
    """
    (across, down), cells = parameters.blocks, parameters.block_px // parameters.cell_px
    if svm.weights.size != parameters.features:
        raise InputError(
            f"the classifier {svm.origin} has {svm.weights.size} weights; a window of these settings has "
            f"{parameters.features}; set people.* to its training layout"
        )
    weights = svm.weights.astype(np.float32).reshape(across, down, cells, cells, parameters.bins)
    return np.ascontiguousarray(weights.transpose(1, 0, 4, 3, 2)).reshape(down, across, -1)


class Gradient:
    """Computes the gradient and the angle of HOG with OpenCV, in bands of rows that fit into the processor's cache.

    This takes a quarter of the time of the same computation in ONNX Runtime. Each thread needs an object of its own.
    """

    def __init__(self, gamma: bool, signed: bool) -> None:
        """Set the options. gamma: compute the gradient on the square roots of the grey levels.

        signed: directions cover 360 degrees; otherwise opposite directions are equal, and directions cover 180 degrees.
        """
        self.gamma, self.signed = gamma, signed
        self.held: dict[str, np.ndarray] = {}

    def scratch(self, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        """Return a contiguous array that is reused by each call with the same name. It is not initialized."""
        size = math.prod(shape)
        held = self.held.get(name)
        if held is None or held.size < size or held.dtype != dtype:
            held = self.held[name] = np.empty(size, dtype)
        return held[:size].reshape(shape)

    def __call__(self, planes: np.ndarray) -> np.ndarray:
        """Return (2, H, W) float32: the gradient's magnitude, and magnitude x direction in radians.

        planes: (C, H + 2, W + 2) uint8. Each pixel takes the first channel of largest magnitude. The
        result is valid until the next call.
        """
        height, width = planes.shape[1] - 2, planes.shape[2] - 2
        polar = self.scratch("polar", (2, height, width))
        for begin, end in split_evenly(height, max(8, _BAND_PX // width)):
            self._band(planes[:, begin : end + 2], polar[0, begin:end], polar[1, begin:end])
        return polar

    def _band(self, planes: np.ndarray, magnitude: np.ndarray, moment: np.ndarray) -> None:
        channels, height, width = planes.shape[0], planes.shape[1] - 2, planes.shape[2] - 2
        # The planes are stacked vertically with their borders. Difference rows between two planes have no meaning.
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
            # Do not use `accumulateSquare`: it rounds only once, so that another of nearly equal channels could win.
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
