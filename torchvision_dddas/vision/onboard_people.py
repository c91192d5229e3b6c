"""Scores of windows by OpenCV and ONNX Runtime, for a small CPU: no torch.

The graphs are made from `ops.hog` by export/people_graph.py. A part goes through them in tiles that stay in the
cache; parts are shared among threads, each of which runs the graphs on itself alone.
"""

import math
import threading
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.settings import PeopleKnobs
from torchvision_dddas.types import LinearSvm
from torchvision_dddas.vision.onboard_gradient import Gradient
from torchvision_dddas.vision.protocol import Part

SHIPPED = Path(__file__).parents[1] / "graphs"
# What a graph has baked in; it names them in its metadata.
BAKED = ("cell_px", "block_px", "block_stride_px", "bins", "signed", "gamma")

# Side of a tile: its 16 maps take 1.2 MB, which should stay in a core's cache, and its neighbours' blocks overlap it.
_TILE_PX = 136


class OnboardRecognizer:
    """Implements `Recognizer`."""

    name = "onboard"

    def __init__(self, knobs: PeopleKnobs, svm: LinearSvm) -> None:
        """Raises InputError where the SVM has another length than the descriptor."""
        self.knobs, self.svm = knobs, svm
        self.svm_feed = {
            "weights": arranged(svm, knobs),
            "bias": np.array(svm.bias, np.float32),
            "clip": np.array(knobs.clip, np.float32),
        }
        self.local = threading.local()

    @cached_property
    def sessions(self) -> tuple[Any, Any]:
        """The graphs of histograms and of scores, loaded when first needed: that takes longer than a frame."""
        folder = SHIPPED if self.knobs.graphs == "shipped" else Path(self.knobs.graphs)
        return opened(folder / "people_histograms.onnx", self.knobs), opened(folder / "people_scores.onnx", self.knobs)

    @cached_property
    def pool(self) -> ThreadPoolExecutor:
        """As many threads as OpenCV takes."""
        return ThreadPoolExecutor(max(1, cv2.getNumThreads()))

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """The score map of each part of each picture."""
        _ = self.sessions
        jobs: dict[tuple[int, tuple[int, int]], list[int]] = defaultdict(list)
        for picture, wanted in enumerate(parts):
            for index, part in enumerate(wanted):
                jobs[picture, part.level].append(index)
        planes = [cv2.split(image) if image.ndim == 3 else (image,) for image in images]
        maps: list[list[np.ndarray]] = [[np.empty(0)] * len(wanted) for wanted in parts]

        def score(job: tuple[int, tuple[int, int]]) -> None:
            picture, level = job
            size = planes[picture][0].shape[::-1]
            resized = [
                plane if level == size else cv2.resize(plane, level, interpolation=cv2.INTER_LINEAR_EXACT)
                for plane in planes[picture]
            ]
            for index in jobs[job]:
                maps[picture][index] = self._of_part(resized, parts[picture][index])

        # The largest first, so that the threads end together.
        order = sorted(jobs, key=lambda job: -sum(parts[job[0]][i].width * parts[job[0]][i].height for i in jobs[job]))
        for _ in self.pool.map(score, order):
            pass
        return maps

    def _of_part(self, level: Sequence[np.ndarray], part: Part) -> np.ndarray:
        """A part's scores, every window stride. level: planes uint8."""
        knobs, stride = self.knobs, self.knobs.window_stride_px
        width = max(0, (part.width - knobs.window_width_px) // stride + 1)
        height = max(0, (part.height - knobs.window_height_px) // stride + 1)
        scores = np.empty((height, width), np.float32)
        if not scores.size:
            return scores
        planes = self._gradient.scratch("planes", (len(level), part.height + 2, part.width + 2), np.uint8)
        for plane, held in zip(level, planes, strict=True):
            np.copyto(held, bordered(plane, part))
        # Windows whose offset is the same modulo the block stride share their blocks: these are scored together.
        common = math.gcd(stride, knobs.block_stride_px)
        phases, every = knobs.block_stride_px // common, stride // common
        for row in range(min(phases, height)):
            for column in range(min(phases, width)):
                found = self._scored(planes[:, row * stride :, column * stride :])[::every, ::every]
                here = scores[row::phases, column::phases]
                here[:] = found[: here.shape[0], : here.shape[1]]
        return scores

    def _scored(self, planes: np.ndarray) -> np.ndarray:
        """Scores of the windows at every block stride. planes: uint8 (C, H + 2, W + 2)."""
        feed = {"histograms": self._histograms(planes), **self.svm_feed}
        (found,) = self.sessions[1].run(None, feed)
        return found

    def _histograms(self, planes: np.ndarray) -> np.ndarray:
        """(F, ny, nx), tile by tile."""
        gradient = self._gradient
        polar = gradient(planes)
        block, stride = self.knobs.block_px, self.knobs.block_stride_px
        down, across = ((length - block) // stride + 1 for length in polar.shape[1:])
        some = max(1, (_TILE_PX - block) // stride + 1)
        size = self.knobs.bins * (block // self.knobs.cell_px) ** 2
        found = gradient.scratch("histograms", (size, down, across))
        for top, bottom in spans(down, some):
            begin, end = top * stride, (bottom - 1) * stride + block
            for left, right in spans(across, some):
                here = polar[:, begin:end, left * stride : (right - 1) * stride + block]
                tile = gradient.scratch("tile", here.shape)
                np.copyto(tile, here)
                (found[:, top:bottom, left:right],) = self.sessions[0].run(None, {"polar": tile[None]})
        return found

    @property
    def _gradient(self) -> Gradient:
        """This thread's."""
        if not hasattr(self.local, "gradient"):
            self.local.gradient = Gradient(self.knobs.gamma, self.knobs.signed)
        held: Gradient = self.local.gradient
        return held


def spans(length: int, most: int) -> list[tuple[int, int]]:
    """(begin, end) of stretches of about equal length that make up the whole."""
    count = -(-length // most)
    return [(length * i // count, length * (i + 1) // count) for i in range(count)]


def opened(path: Path, knobs: PeopleKnobs) -> Any:
    """An ONNX Runtime session of a graph, on one thread.

    Raises InputError where the graph is not there, or has another layout baked in than the knobs.
    """
    import onnxruntime

    make = "python export/people_graph.py --set people.cell_px=... --out FOLDER, then people.graphs=FOLDER"
    if not path.exists():
        raise InputError(f"no graph {path}; make it with {make}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    made_for = session.get_modelmeta().custom_metadata_map
    wrong = [name for name in BAKED if made_for.get(name) != str(int(getattr(knobs, name)))]
    if wrong:
        raise InputError(
            f"the graph {path.name} is made for "
            + ", ".join(f"people.{name} = {made_for.get(name)}" for name in wrong)
            + ", not "
            + ", ".join(f"{int(getattr(knobs, name))}" for name in wrong)
            + f"; take --backend torch, or make one: {make}"
        )
    return session


def bordered(level: np.ndarray, part: Part) -> np.ndarray:
    """A part with one pixel more on each side: its neighbours in the level, which is reflected beyond its own edge."""
    width, height = part.level
    left, top = max(0, 1 - part.x), max(0, 1 - part.y)
    right = max(0, part.x + part.width + 1 - width)
    bottom = max(0, part.y + part.height + 1 - height)
    if left or top or right or bottom:
        level = cv2.copyMakeBorder(level, top, bottom, left, right, cv2.BORDER_REFLECT_101)
    x, y = part.x - 1 + left, part.y - 1 + top
    return level[y : y + part.height + 2, x : x + part.width + 2]


def arranged(svm: LinearSvm, knobs: PeopleKnobs) -> np.ndarray:
    """(down, across, F) weights as `ops.hog.arranged` has them.

    Raises InputError where the SVM is of another length than the descriptor.
    """
    across, down = (
        (window - knobs.block_px) // knobs.block_stride_px + 1
        for window in (knobs.window_width_px, knobs.window_height_px)
    )
    cells = knobs.block_px // knobs.cell_px
    wanted = across * down * cells**2 * knobs.bins
    if svm.weights.size != wanted:
        raise InputError(
            f"the classifier {svm.origin} has {svm.weights.size} weights; a window of these settings has {wanted}"
        )
    weights = svm.weights.astype(np.float32).reshape(across, down, cells, cells, knobs.bins)
    return np.ascontiguousarray(weights.transpose(1, 0, 4, 3, 2)).reshape(down, across, -1)
