"""Solvers of plane homographies: ONNX Runtime, which needs no torch, or torch on a CPU or GPU."""

from functools import cache
from typing import Any, Protocol

import numpy as np

from torchvision_dddas.runtime import SHIPPED, opened, wants_torch

LEAST_POINTS = 4


class PlaneSolver(Protocol):
    """Batched solver of plane homographies in float64."""

    name: str

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """image_from_ground (B, 3, 3), h33 = 1, and whether each is valid (B,), from ground and image (B, n, 2).

        Weighted least squares, Hartley-normalised. weight: (B, n), 0 for a row that is padding.
        """
        ...

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same as the source solves it: normal equations of the given coordinates, such as degrees."""
        ...


def load_solver(backend: str) -> PlaneSolver:
    """The solver of a back end: auto, onboard or torch. Raises InputError for another name or missing packages."""
    return TorchPlaneSolver() if wants_torch(backend) else OnnxPlaneSolver()


class OnnxPlaneSolver:
    """PlaneSolver that runs the shipped ONNX graphs. They agree with the torch solver to 1e-6 px."""

    name = "onboard"

    def __init__(self) -> None:
        self.fit, self.fit_raw = open_graph("homography"), open_graph("homography_raw")

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See PlaneSolver. The graph is that of `functional.homography.fit`."""
        ground, image, weight = (np.asarray(array, np.float64) for array in (ground, image, weight))
        if weight.shape[1] < LEAST_POINTS or not len(weight):
            return _invalid(len(weight))
        if np.count_nonzero(weight) < weight.size:
            # Padding may hold NaN, and zero times NaN is not zero.
            ground, image = (np.where(weight[..., None] > 0, points, 0.0) for points in (ground, image))
        matrix, valid = self.fit.run(None, {"ground": ground, "image": image, "weight": weight})
        return matrix, valid

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See PlaneSolver. On an ill-conditioned system it and the torch solver err differently."""
        ground, image = np.asarray(ground, np.float64), np.asarray(image, np.float64)
        if ground.shape[1] < LEAST_POINTS or not len(ground):
            return _invalid(len(ground))
        matrix, valid = self.fit_raw.run(None, {"ground": ground, "image": image})
        return matrix, valid


@cache
def open_graph(name: str) -> Any:
    """An ONNX Runtime session of a shipped graph. Opening one takes longer than thousands of solutions."""
    return opened(SHIPPED, f"{name}.onnx")


def _invalid(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)


class TorchPlaneSolver:
    """PlaneSolver by `functional.homography`."""

    name = "torch"

    def __init__(self) -> None:
        import torch

        from torchvision_dddas.functional import homography

        self._tensor, self._homography = torch.from_numpy, homography

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See PlaneSolver."""
        matrix, valid = self._homography.fit(*map(self._double, (ground, image, weight)))
        return matrix.numpy(), valid.numpy()

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See PlaneSolver."""
        matrix, valid = self._homography.fit_raw(*map(self._double, (ground, image)))
        return matrix.numpy(), valid.numpy()

    def _double(self, array: np.ndarray) -> Any:
        return self._tensor(np.ascontiguousarray(array, np.float64))
