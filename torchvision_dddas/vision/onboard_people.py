"""Scores of windows by an ONNX graph on ONNX Runtime, for a small CPU: no torch."""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.settings import PeopleKnobs
from torchvision_dddas.types import LinearSvm
from torchvision_dddas.vision.protocol import Part


class OnboardRecognizer:
    """Implements `Recognizer`."""

    name = "onboard"

    def __init__(self, knobs: PeopleKnobs, svm: LinearSvm) -> None:
        self.knobs, self.svm = knobs, svm

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """The score map of each part of each picture."""
        raise NotImplementedError
