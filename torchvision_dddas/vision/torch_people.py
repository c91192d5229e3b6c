"""Scores of windows by `ops.hog`: batched over pictures of one size, differentiable, on a CPU or GPU."""

from collections.abc import Sequence

import numpy as np
import torch

from torchvision_dddas.ops import hog
from torchvision_dddas.settings import PeopleKnobs
from torchvision_dddas.types import LinearSvm
from torchvision_dddas.vision.protocol import Part


class TorchRecognizer:
    """Implements `Recognizer`."""

    name = "torch"

    def __init__(self, knobs: PeopleKnobs, svm: LinearSvm, device: str | torch.device | None = None) -> None:
        """device: by default the GPU where there is one."""
        self.knobs, self.svm = knobs, svm
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        self.layout = hog.Layout((knobs.window_width_px, knobs.window_height_px))

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """The score map of each part of each picture."""
        raise NotImplementedError
