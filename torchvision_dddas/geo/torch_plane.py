"""Plane homographies by `ops.homography`: batched, on a CPU or GPU."""

import numpy as np
import torch

from torchvision_dddas.functional import homography


class TorchPlaneSolver:
    """Implements `PlaneSolver`."""

    name = "torch"

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By `ops.homography.fit`."""
        matrix, valid = homography.fit(_tensor(ground), _tensor(image), _tensor(weight))
        return matrix.numpy(), valid.numpy()

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By `ops.homography.fit_raw`."""
        matrix, valid = homography.fit_raw(_tensor(ground), _tensor(image))
        return matrix.numpy(), valid.numpy()


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float64))
