"""Scores of windows by an ONNX graph on ONNX Runtime, for a small CPU: no torch.

The graph is made from `ops.hog` by export/people_graph.py. It takes levels of the pyramid, or parts of them, that have
their border of one pixel already, and the SVM's weights: any classifier of the same cells and blocks runs on it.
"""

import math
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.settings import PeopleKnobs
from torchvision_dddas.types import LinearSvm
from torchvision_dddas.vision.protocol import Part

SHIPPED = Path(__file__).parents[1] / "graphs" / "people.onnx"
# What a graph has baked in; it names them in its metadata.
BAKED = ("cell_px", "block_px", "block_stride_px", "bins", "signed", "gamma")


class OnboardRecognizer:
    """Implements `Recognizer`."""

    name = "onboard"

    def __init__(self, knobs: PeopleKnobs, svm: LinearSvm) -> None:
        """Raises InputError where the graph has another layout than the knobs, or the SVM another length."""
        self.knobs, self.svm = knobs, svm
        self.graph = SHIPPED if knobs.graph == "shipped" else Path(knobs.graph)
        self.weights = arranged(svm, knobs)

    @cached_property
    def session(self) -> Any:
        """ONNX Runtime with the graph, made when first needed: it takes longer than a frame."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        session = onnxruntime.InferenceSession(str(self.graph), options, providers=["CPUExecutionProvider"])
        return session

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """The score map of each part of each picture."""
        return [self._of_picture(image, wanted) for image, wanted in zip(images, parts, strict=True)]

    def _of_picture(self, image: np.ndarray, parts: Sequence[Part]) -> list[np.ndarray]:
        maps = []
        for part in parts:
            level = image if part.level == image.shape[1::-1] else resized(image, part.level)
            maps.append(self._of_part(bordered(level, part)))
        return maps

    def _of_part(self, inside: np.ndarray) -> np.ndarray:
        """The map of a part with its border, every window stride."""
        knobs = self.knobs
        stride, hop = knobs.window_stride_px, math.gcd(knobs.window_stride_px, knobs.block_stride_px)
        width, height = (
            max(0, (length - 2 - window) // stride + 1)
            for length, window in zip(inside.shape[1::-1], (knobs.window_width_px, knobs.window_height_px), strict=True)
        )
        scores = np.empty((height, width), np.float32)
        if not scores.size:
            return scores
        # Windows whose offset is the same modulo the block stride share their blocks: one run of the graph for each.
        phases, every = knobs.block_stride_px // hop, stride // hop
        for row in range(min(phases, height)):
            for column in range(min(phases, width)):
                found = self._run(inside[row * stride :, column * stride :])[::every, ::every]
                here = scores[row::phases, column::phases]
                here[:] = found[: here.shape[0], : here.shape[1]]
        return scores

    def _run(self, inside: np.ndarray) -> np.ndarray:
        if inside.ndim == 2:
            inside = cv2.cvtColor(inside, cv2.COLOR_GRAY2BGR)
        feed = {
            "image": np.ascontiguousarray(inside),
            "weights": self.weights,
            "bias": np.array(self.svm.bias, np.float32),
            "clip": np.array(self.knobs.clip, np.float32),
        }
        (found,) = self.session.run(None, feed)
        return found


def resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A level of the pyramid, as OpenCV's detector makes it."""
    return cv2.resize(image, size, interpolation=cv2.INTER_LINEAR_EXACT)


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
