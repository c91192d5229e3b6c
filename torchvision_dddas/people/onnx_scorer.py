"""Scores of windows by OpenCV and ONNX Runtime, for a small CPU: no torch.

The graphs are made from `ops.hog` by `dddas export`. A part goes through them in tiles that stay in the
cache; parts are shared among threads, each of which runs the graphs on itself alone.
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
from torchvision_dddas.people.opencv_gradient import Gradient
from torchvision_dddas.people.scratch import spans
from torchvision_dddas.runtime import SHIPPED, manifest, verified
from torchvision_dddas.runtime import opened as open_graph
from torchvision_dddas.types import LinearSvm, Part

GRAPHS = "people_histograms.onnx", "people_scores.onnx"
# What the graphs have baked in; their manifest names it.
BAKED = ("cell_px", "block_px", "block_stride_px", "bins", "signed", "gamma")

# Side of a tile: its 16 maps take 1.8 MB, about what stays in a core's cache; smaller ones overlap their neighbours
# for a larger share (104 px: 1.2 times the time), and larger ones gain nothing.
_TILE_PX = 168
# Pixels whose gradient is taken at once, and blocks that are scored at once: what bounds the memory.
_GRADIENT_PX = 160_000
_BLOCKS = 2_500


class OnnxScorer:
    """Implements `WindowScorer`."""

    name = "onboard"

    def __init__(self, parameters: PeopleParameters, svm: LinearSvm) -> None:
        """Raises InputError where the SVM has another length than the descriptor, or the graphs another layout."""
        self.parameters, self.svm, self.graphs = parameters, svm, graphs(parameters)
        self.svm_feed = {
            "weights": arranged(svm, parameters),
            "bias": np.array(svm.bias, np.float32),
            "clip": np.array(parameters.clip, np.float32),
        }
        self.local = threading.local()

    @cached_property
    def sessions(self) -> tuple[Any, Any]:
        """The graphs of histograms and of scores, loaded when first needed: that takes longer than a frame."""
        return opened(self.graphs, GRAPHS[0]), opened(self.graphs, GRAPHS[1])

    @cached_property
    def pool(self) -> ThreadPoolExecutor:
        """As many threads as OpenCV takes; each holds some 15 MB at 640x480."""
        return ThreadPoolExecutor(max(1, cv2.getNumThreads()))

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """The score map of each part of each picture."""
        _ = self.sessions
        jobs: dict[tuple[int, tuple[int, int]], list[int]] = defaultdict(list)
        for picture, wanted in enumerate(parts):
            for index, part in enumerate(wanted):
                jobs[picture, part.level].append(index)
        # A fourth channel that nobody looks at: OpenCV resizes four of them quicker than three.
        sources = [cv2.cvtColor(image, cv2.COLOR_BGR2BGRA) if image.ndim == 3 else image for image in images]
        maps: list[list[np.ndarray]] = [[np.empty(0)] * len(wanted) for wanted in parts]

        def score(job: tuple[int, tuple[int, int]]) -> None:
            picture, size = job
            level = sources[picture]
            if size != level.shape[1::-1]:
                level = cv2.resize(level, size, interpolation=cv2.INTER_LINEAR_EXACT)
            for index in jobs[job]:
                maps[picture][index] = self._of_part(level, parts[picture][index])

        # The largest first, so that the threads end together.
        order = sorted(jobs, key=lambda job: -sum(parts[job[0]][i].width * parts[job[0]][i].height for i in jobs[job]))
        for _ in self.pool.map(score, order):
            pass
        return maps

    def _of_part(self, level: np.ndarray, part: Part) -> np.ndarray:
        """A part's scores, every window stride. level: uint8 (H, W) or (H, W, 4) BGRA."""
        parameters, stride = self.parameters, self.parameters.window_stride_px
        width = max(0, (part.width - parameters.window_width_px) // stride + 1)
        height = max(0, (part.height - parameters.window_height_px) // stride + 1)
        scores = np.empty((height, width), np.float32)
        if not scores.size:
            return scores
        # Windows whose offset is the same modulo the block stride share their blocks: these are scored together.
        common = math.gcd(stride, parameters.block_stride_px)
        phases, every = parameters.block_stride_px // common, stride // common
        for row in range(min(phases, height)):
            for column in range(min(phases, width)):
                x, y = column * stride, row * stride
                inner = replace(part, x=part.x + x, y=part.y + y, width=part.width - x, height=part.height - y)
                found = self._scored(level, inner)[::every, ::every]
                here = scores[row::phases, column::phases]
                here[:] = found[: here.shape[0], : here.shape[1]]
        return scores

    def _scored(self, level: np.ndarray, part: Part) -> np.ndarray:
        """Scores of the windows at every block stride."""
        histograms = self._histograms(level, part)
        _, ny, nx = histograms.shape
        down, across, _ = self.svm_feed["weights"].shape
        found = np.empty((ny - down + 1, nx - across + 1), np.float32)
        # Each block takes as many numbers as a window has blocks: some rows at a time bound the memory.
        for top, bottom in spans(len(found), max(down, _BLOCKS // nx)):
            rows = np.ascontiguousarray(histograms[:, top : bottom + down - 1])
            (found[top:bottom],) = self.sessions[1].run(None, {"histograms": rows, **self.svm_feed})
        return found

    def _histograms(self, level: np.ndarray, part: Part) -> np.ndarray:
        """(F, ny, nx), tile by tile."""
        gradient = self._gradient
        block, stride = self.parameters.block_px, self.parameters.block_stride_px
        down, across = ((length - block) // stride + 1 for length in (part.height, part.width))
        channels = 1 if level.ndim == 2 else 3
        side = max(1, (_TILE_PX - block) // stride + 1)
        size = self.parameters.bins * (block // self.parameters.cell_px) ** 2
        found = gradient.scratch("histograms", (size, down, across))
        for first, last in spans(down, max(side, _GRADIENT_PX // (part.width + 2) // stride)):
            # The channels of these rows alone: those of the whole would take 6 MB at 1280x720.
            rows_px = (last - 1 - first) * stride + block
            planes = gradient.scratch("planes", (channels, rows_px + 2, part.width + 2), np.uint8)
            fill(planes, level, replace(part, y=part.y + first * stride, height=rows_px))
            polar = gradient(planes)
            for top, bottom in spans(last - first, side):
                for left, right in spans(across, side):
                    rows = slice(top * stride, (bottom - 1) * stride + block)
                    here = polar[:, rows, left * stride : (right - 1) * stride + block]
                    tile = gradient.scratch("tile", here.shape)
                    np.copyto(tile, here)
                    (found[:, first + top : first + bottom, left:right],) = self.sessions[0].run(
                        None, {"polar": tile[None]}
                    )
        return found

    @property
    def _gradient(self) -> Gradient:
        """This thread's."""
        if not hasattr(self.local, "gradient"):
            self.local.gradient = Gradient(self.parameters.gamma, self.parameters.signed)
        held: Gradient = self.local.gradient
        return held


def graphs(parameters: PeopleParameters) -> Path:
    """The folder of the graphs. Raises InputError where they are not those of the manifest, or of another layout."""
    folder = SHIPPED if parameters.graphs == "shipped" else Path(parameters.graphs)
    wanted = {name: int(getattr(parameters, name)) for name in BAKED}
    settings = " ".join(f"--set people.{name}={value}" for name, value in wanted.items())
    make = f"make such graphs with `dddas export --graph people --out FOLDER {settings}`"
    make = f"{make}, and give people.graphs=FOLDER; or take --backend torch"
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


def opened(folder: Path, name: str) -> Any:
    """An ONNX Runtime session of a graph."""
    # A memory pattern is a plan for every size of a level, which is no quicker and takes 9 MB.
    return open_graph(folder, name, enable_mem_pattern=False)


def fill(planes: np.ndarray, level: np.ndarray, part: Part) -> None:
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


def arranged(svm: LinearSvm, parameters: PeopleParameters) -> np.ndarray:
    """(down, across, F) weights as `ops.hog.arranged` has them.

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
