"""Differences between registered frames, and the light that is taken out of them first."""

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.functional import difference


@pytest.mark.parametrize(("gain", "offset"), [(1.15, 0.0), (0.85, 0.03), (1.0, -0.05)])
def test_exposure_recovers_a_change_of_light_despite_movers(texture, tensor, gain, offset):
    reference = tensor(texture(0, 240, 320)) * 0.8 + 0.05
    warped = (reference - offset) / gain
    warped[..., 50:110, 80:160] = tensor(texture(1, 60, 80))
    inside = torch.ones(1, 1, 240, 320, dtype=torch.bool)
    found_gain, found_offset = difference.exposure(reference, warped, inside)
    assert abs(found_gain.item() - gain) < 0.01
    assert abs(found_offset.item() - offset) < 0.005


def test_exposure_ignores_what_is_outside(texture, tensor):
    reference = tensor(texture(0, 60, 80))
    warped, inside = reference / 1.1, torch.ones(1, 1, 60, 80, dtype=torch.bool)
    inside[..., 40:] = False
    garbage = torch.where(inside, warped, torch.full_like(warped, 9.0))
    gain, offset = difference.exposure(reference, garbage, inside)
    assert abs(gain.item() - 1.1) < 1e-3 and abs(offset.item()) < 1e-3


@pytest.mark.parametrize("seen", [True, False])
def test_exposure_of_a_blank_frame_or_of_nothing_seen_keeps_the_gain(seen):
    blank = torch.full((1, 1, 37, 53), 0.5)
    gain, offset = difference.exposure(blank, blank * 0.8, torch.full((1, 1, 37, 53), seen))
    assert gain.item() == 1.0
    assert offset.item() == pytest.approx(0.1 if seen else 0.0, abs=1e-6)


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(0)
    pictures = [torch.rand(1, 1, 4, 5, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(2)]
    inside = torch.ones(1, 1, 4, 5, dtype=torch.bool)
    # A floor above all errors: trimming, which has no gradient, does not take part.
    assert torch.autograd.gradcheck(lambda a, b: difference.exposure(a, b, inside, floor=9.0), tuple(pictures))


@pytest.mark.parametrize("shape", [(120, 160), (61, 87)])
def test_the_gradient_is_opencvs(texture, shape):
    picture = texture(2, *shape)
    across = cv2.Sobel(picture, cv2.CV_32F, 1, 0, scale=0.5)
    down = cv2.Sobel(picture, cv2.CV_32F, 0, 1, scale=0.5)
    wanted = cv2.blur(cv2.convertScaleAbs(cv2.magnitude(across, down)), (5, 5))
    np.testing.assert_array_equal(
        difference.gradient(torch.from_numpy(picture.astype(np.float32))[None, None])[0, 0].numpy().astype(np.uint8),
        wanted,
    )


def test_the_masked_median_is_of_the_masked_values_alone():
    values = torch.tensor([[5.0, 1.0, 9.0, 3.0, 7.0], [1.0, 2.0, 3.0, 4.0, 5.0]])
    mask = torch.tensor([[True, True, False, True, True], [False] * 5])
    assert difference.masked_median(values, mask).tolist() == [[3.0], [0.0]]
