"""Erosion and dilation against OpenCV, bit for bit."""

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.functional import morphology

SIZES = [1, 2, 3, 4, 5, 7, 8, 15, 25, (5, 9), (10, 3), (1, 7), (7, 1), (3, 2), (41, 41)]
OPERATIONS = {
    cv2.MORPH_DILATE: morphology.dilate,
    cv2.MORPH_ERODE: morphology.erode,
    cv2.MORPH_OPEN: morphology.opening,
    cv2.MORPH_CLOSE: morphology.closing,
}
SHAPES = {"rectangle": cv2.MORPH_RECT, "ellipse": cv2.MORPH_ELLIPSE}


def pair(size: int | tuple[int, int]) -> tuple[int, int]:
    return size if isinstance(size, tuple) else (size, size)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", SIZES)
def test_the_element_is_opencvs(shape, size):
    wanted = cv2.getStructuringElement(SHAPES[shape], pair(size))
    rows = morphology.element_rows(*pair(size), shape)
    found = [[int(first <= column < last) for column in range(pair(size)[0])] for first, last in rows]
    assert np.array_equal(found, wanted)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_bit_exact_with_opencv_on_masks_and_grey(texture, shape, size, operation):
    element = cv2.getStructuringElement(SHAPES[shape], pair(size))
    for picture in (texture(1, 37, 53), (texture(2, 90, 121) > 128).astype(np.uint8) * 255):
        wanted = cv2.morphologyEx(picture, operation, element)
        found = OPERATIONS[operation](torch.from_numpy(picture)[None, None], size, shape)
        assert found.dtype == torch.uint8
        assert np.array_equal(found[0, 0].numpy(), wanted)


@pytest.mark.parametrize("shape", ["rectangle", "ellipse"])
def test_floats_and_booleans_give_what_bytes_give(texture, shape):
    mask = torch.from_numpy(texture(3, 37, 53))[None, None] > 140
    wanted = morphology.closing(mask.to(torch.uint8), 7, shape)
    assert torch.equal(morphology.closing(mask, 7, shape), wanted.bool())
    assert torch.equal(morphology.closing(mask.float(), 7, shape), wanted.float())


def test_one_pixel_grows_into_a_square_and_shrinks_back():
    mask = torch.zeros(1, 1, 5, 5, dtype=torch.bool)
    mask[..., 2, 2] = True
    grown = morphology.dilate(mask, 3)
    assert grown.sum() == 9 and grown[..., 1:4, 1:4].all()
    assert torch.equal(morphology.erode(grown, 3), mask)


@pytest.mark.parametrize("shape", ["rectangle", "ellipse"])
def test_the_outside_never_decides(shape):
    full, empty = torch.ones(1, 1, 9, 11, dtype=torch.bool), torch.zeros(1, 1, 9, 11, dtype=torch.bool)
    assert morphology.erode(full, 5, shape).all()
    assert not morphology.dilate(empty, 5, shape).any()


@pytest.mark.parametrize("shape", ["rectangle", "ellipse"])
def test_a_batch_is_the_same_as_each_mask_alone(shape):
    masks = torch.rand(3, 2, 19, 23, generator=torch.Generator().manual_seed(0)) > 0.8
    together = morphology.opening(morphology.dilate(masks, 5, shape), 3, shape)
    for clip in range(3):
        for plane in range(2):
            alone = masks[clip : clip + 1, plane : plane + 1]
            alone = morphology.opening(morphology.dilate(alone, 5, shape), 3, shape)
            assert torch.equal(together[clip, plane], alone[0, 0])


@pytest.mark.parametrize("shape", ["rectangle", "ellipse"])
def test_gradients_are_those_of_finite_differences(shape):
    picture = (
        torch.randperm(42, generator=torch.Generator().manual_seed(0)).reshape(1, 1, 6, 7).double().requires_grad_()
    )
    assert torch.autograd.gradcheck(lambda x: morphology.closing(x, 3, shape), (picture,))
