"""Silhouettes and blobs to try the targets' functions on."""

from collections.abc import Callable

import numpy as np
import pytest

from torchvision_dddas.detection.blobs import Blob

Box = tuple[int, int, int, int]


@pytest.fixture
def box_blob() -> Callable[[Box], Blob]:
    """A rectangle, certain all over."""

    def make(box: Box, peak: float = 200.0) -> Blob:
        full = np.ones((box[3], box[2]), bool)
        return Blob(box, full, full, peak)

    return make


@pytest.fixture
def painted() -> Callable[..., np.ndarray]:
    """A (height, width) uint8 mask, 255 in the boxes."""

    def make(size: tuple[int, int], *boxes: Box) -> np.ndarray:
        mask = np.zeros((size[1], size[0]), np.uint8)
        for x, y, width, height in boxes:
            mask[max(y, 0) : y + height, max(x, 0) : x + width] = 255
        return mask

    return make
