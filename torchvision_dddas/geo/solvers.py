"""Solvers of plane homographies and finders of colours: the protocols, and the engines that do it."""

from typing import Protocol

import numpy as np

from torchvision_dddas.runtime import wants_torch


class PlaneSolver(Protocol):
    """A back end's solver of plane homographies, batched, float64."""

    name: str

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """image_from_ground (B, 3, 3), h33 = 1, and whether each is valid (B,), from ground and image (B, n, 2).

        Weighted least squares, Hartley-normalised; weight (B, n), 0 for a row that is none.
        """
        ...

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same as the source solves it: normal equations of the given coordinates, such as degrees."""
        ...


class ColourFinder(Protocol):
    """A back end's search for colours."""

    name: str

    def masks(self, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """(K, H, W) uint8, 255 where the BGR image lies within a range of hue, saturation and value; others 0.

        low, high: (K, 3), OpenCV's units (hue 0 to 180); a range whose lowest hue is above its highest goes over 0.
        """
        ...


def load_solver(backend: str) -> PlaneSolver:
    """What solves plane homographies, on the engine that `wants_torch` names. Raises InputError as it does."""
    if not wants_torch(backend):
        from torchvision_dddas.geo.onnx_plane import OnnxPlaneSolver

        return OnnxPlaneSolver()
    from torchvision_dddas.geo.torch_plane import TorchPlaneSolver

    return TorchPlaneSolver()


def load_colours(backend: str) -> ColourFinder:
    """What finds colours, on the engine that `wants_torch` names. Raises InputError as it does."""
    if not wants_torch(backend):
        from torchvision_dddas.geo.opencv_colours import OpenCVColourFinder

        return OpenCVColourFinder()
    from torchvision_dddas.geo.torch_colours import TorchColourFinder

    return TorchColourFinder()
