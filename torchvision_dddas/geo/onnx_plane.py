"""Plane homographies by ONNX Runtime, for a small CPU: no torch. The graphs are made by `dddas export`."""

from functools import cache
from typing import Any

import numpy as np

from torchvision_dddas.runtime import SHIPPED
from torchvision_dddas.runtime import opened as open_graph

LEAST = 4


class OnnxPlaneSolver:
    """Implements `PlaneSolver`."""

    name = "onboard"

    def __init__(self) -> None:
        """Opens the graphs, once in a process: that takes longer than thousands of landmarks' solution."""
        self.fit, self.fit_raw = opened("homography"), opened("homography_raw")

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `ops.homography.fit`, to 1e-6 px."""
        ground, image, weight = _wide(ground), _wide(image), _wide(weight)
        if weight.shape[1] < LEAST or not len(weight):
            return _nothing(len(weight))
        if np.count_nonzero(weight) < weight.size:
            # What is not there may hold anything, and zero times NaN is not zero.
            ground, image = (np.where(weight[..., None] > 0, points, 0.0) for points in (ground, image))
        matrix, valid = self.fit.run(None, {"ground": ground, "image": image, "weight": weight})
        return matrix, valid

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `ops.homography.fit_raw`; where the system is ill-conditioned both are wrong, and not by the same."""
        ground, image = _wide(ground), _wide(image)
        if ground.shape[1] < LEAST or not len(ground):
            return _nothing(len(ground))
        matrix, valid = self.fit_raw.run(None, {"ground": ground, "image": image})
        return matrix, valid


@cache
def opened(name: str) -> Any:
    """An ONNX Runtime session of a shipped graph."""
    return open_graph(SHIPPED, f"{name}.onnx")


def _wide(array: np.ndarray) -> np.ndarray:
    return np.asarray(array, np.float64)


def _nothing(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)
