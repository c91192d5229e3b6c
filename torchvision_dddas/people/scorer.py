"""What scores windows of a picture for people: the protocol, and the engine that does it."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.runtime import wants_torch
from torchvision_dddas.types import LinearSvm, Part


class WindowScorer(Protocol):
    """A back end's scorer of windows, for one classifier and one layout of its descriptor (`PeopleParameters`)."""

    name: str

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """For every image its parts' score maps: (ny, nx) float32, [j, i] the window at (x + i stride, y + j stride).

        images: uint8 (H, W) or (H, W, 3) BGR; resized as by OpenCV's INTER_LINEAR_EXACT, reflected (101) at the border.
        A part does not see its own edge: its scores are those of the same windows in a search everywhere.
        A part that is smaller than the window has an empty map.
        """
        ...


def load_scorer(backend: str, parameters: PeopleParameters, svm: LinearSvm) -> WindowScorer:
    """What scores windows for people, on the engine that `wants_torch` names. Raises InputError as it does."""
    if not wants_torch(backend):
        from torchvision_dddas.people.onnx_scorer import OnnxScorer

        return OnnxScorer(parameters, svm)
    from torchvision_dddas.people.torch_scorer import TorchScorer

    return TorchScorer(parameters, svm)
