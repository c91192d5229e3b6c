"""Differences between registered frames, and the light that is taken out of them first."""

import pytest
import torch

from torchvision_dddas.functional import difference


def row(*values: float) -> torch.Tensor:
    return torch.tensor(values).reshape(1, 1, 1, -1)


def test_equation_9_marks_where_the_two_later_frames_differ():
    assert torch.equal(difference.three_frame(row(0.5, 0.25, 0), row(0.5, 1, 0.5)), row(0, 0.75, 0.5))


def test_the_pair_marks_a_mover_once_where_it_stands_in_the_reference():
    reference, later, last = row(1, 0, 0, 0), row(0, 1, 0, 0), row(0, 0, 1, 0)
    assert torch.equal(difference.pair(reference, later, last), row(1, 0, 0, 0))
    assert torch.equal(difference.three_frame(later, last), row(0, 1, 1, 0))


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


def test_exposure_of_a_batch_is_that_of_each_clip_alone(texture, tensor):
    reference = torch.cat([tensor(texture(seed, 37, 53)) for seed in range(3)])
    warped = reference * torch.tensor([0.9, 1.0, 1.1])[:, None, None, None] + 0.01
    inside = torch.rand(3, 1, 37, 53, generator=torch.Generator().manual_seed(0)) > 0.3
    together = difference.exposure(reference, warped, inside)
    for clip in range(3):
        one = slice(clip, clip + 1)
        for whole, alone in zip(together, difference.exposure(reference[one], warped[one], inside[one]), strict=True):
            torch.testing.assert_close(whole[one], alone)


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(0)
    pictures = [torch.rand(1, 1, 4, 5, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(3)]
    assert torch.autograd.gradcheck(difference.three_frame, tuple(pictures[:2]))
    assert torch.autograd.gradcheck(difference.pair, tuple(pictures))
    inside = torch.ones(1, 1, 4, 5, dtype=torch.bool)
    # A floor above all errors: trimming, which has no gradient, does not take part.
    assert torch.autograd.gradcheck(lambda a, b: difference.exposure(a, b, inside, floor=9.0), tuple(pictures[:2]))
