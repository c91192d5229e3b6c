"""Motion history: its stamps, its gradient, and how it travels with the camera."""

import math

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.functional import history


def row(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32).reshape(1, 1, 1, -1)


def sweep(direction_rad: float, height: int = 37, width: int = 53) -> torch.Tensor:
    """Stamps of an edge that swept over the picture at 10 px a second in the given direction."""
    v, u = torch.meshgrid(torch.arange(height) - height / 2, torch.arange(width) - width / 2, indexing="ij")
    return (5.0 + (u * math.cos(direction_rad) + v * math.sin(direction_rad)) * 0.1)[None, None]


def test_update_stamps_keeps_and_forgets():
    found = history.update(row(0, 1.0, 2.0, 2.0), row(0, 0, 0, 1), now_s=3.5, duration_s=2.0)
    assert torch.equal(found, row(0, 0, 2.0, 3.5))


def test_each_clip_of_a_batch_has_its_own_clock():
    stamps, silhouette = torch.full((2, 1, 3, 3), 1.0), torch.zeros(2, 1, 3, 3)
    found = history.update(stamps, silhouette, torch.tensor([2.0, 9.0]), torch.tensor([3.0, 3.0]))
    assert (found[0] == 1).all() and (found[1] == 0).all()


def test_carried_history_has_only_stamps_that_were_there():
    stamps = torch.randint(0, 5, (1, 1, 37, 53), generator=torch.Generator().manual_seed(0)).float()
    turned = torch.tensor([[[0.98, -0.1, 4.3], [0.1, 0.98, -2.7], [0, 0, 1]]])
    found = history.carry(stamps, turned)
    assert set(found.unique().tolist()) == {0.0, 1.0, 2.0, 3.0, 4.0}
    wanted = cv2.warpPerspective(stamps[0, 0].numpy(), turned[0].numpy(), (53, 37), flags=cv2.INTER_NEAREST)
    # Positions half-way between two pixels may go either way.
    assert (found[0, 0].numpy() != wanted).mean() < 0.02


def test_history_carried_by_a_shift_moves_by_it():
    assert torch.equal(
        history.carry(row(1, 2, 3, 4), torch.tensor([[[1.0, 0, 1], [0, 1, 0], [0, 0, 1]]])), row(0, 1, 2, 3)
    )


@pytest.mark.parametrize("aperture", [3, 5, 7])
@pytest.mark.parametrize("direction", [0.0, math.pi / 2, 2.5, -1.0])
def test_the_gradient_points_where_the_motion_went(aperture, direction):
    angle, valid = history.gradient(sweep(direction), 0.05, 2.0, aperture)
    inner = valid[..., 4:-4, 4:-4]
    assert inner.all()
    turn = (angle - direction)[..., 4:-4, 4:-4]
    assert torch.atan2(turn.sin(), turn.cos()).abs().max() < 1e-3


@pytest.mark.parametrize("aperture", [3, 5, 7])
def test_the_gradient_is_the_one_of_opencvs_motion_templates(aperture):
    stamps = torch.rand(1, 1, 37, 53, generator=torch.Generator().manual_seed(0))
    picture = stamps[0, 0].numpy()
    # calcMotionGradient, step by step; the function itself is only in OpenCV's contributed modules.
    u, v = (
        cv2.Sobel(picture, cv2.CV_32F, *axis, ksize=aperture, borderType=cv2.BORDER_REPLICATE)
        for axis in ((1, 0), (0, 1))
    )
    element = np.ones((aperture, aperture), np.uint8)
    span = cv2.dilate(picture, element) - cv2.erode(picture, element)
    steep = np.maximum(abs(u), abs(v)) > 1e-4 * aperture**2
    angle, valid = history.gradient(stamps, 0.85, 0.97, aperture)
    assert np.array_equal(valid[0, 0].numpy(), steep & (span >= 0.85) & (span <= 0.97))
    turn = (angle[0, 0] - torch.from_numpy(np.arctan2(v, u)))[valid[0, 0]]
    assert valid.any() and torch.atan2(turn.sin(), turn.cos()).abs().max() < 1e-3


def test_where_nothing_moved_there_is_no_direction():
    angle, valid = history.gradient(torch.zeros(2, 1, 37, 53), 0.05, 0.5)
    assert not valid.any() and (angle == 0).all()


def test_region_orientation_goes_around_the_circle_and_weighs_the_newest_most():
    angle = row(math.pi - 0.1, -math.pi + 0.1, 0.0, math.pi / 2)
    stamps = row(10, 10, 9.5, 10)
    regions = torch.tensor([[[[1, 1, 0, 0]], [[0, 0, 1, 1]], [[0, 0, 0, 0]]]], dtype=torch.bool)
    found, known = history.region_orientation(angle, torch.ones_like(angle).bool(), stamps, regions, 10.0, 1.0)
    assert known.tolist() == [[True, True, False]]
    assert abs(abs(found[0, 0].item()) - math.pi) < 1e-5
    # Half the weight on direction 0, all of it on pi/2.
    assert found[0, 1].item() == pytest.approx(math.atan2(1.0, 0.5), abs=1e-5)


def test_opposite_directions_have_no_mean():
    angle, stamps = row(0.0, math.pi), row(5.0, 5.0)
    everywhere = torch.ones(1, 1, 1, 2, dtype=torch.bool)
    assert not history.region_orientation(angle, everywhere, stamps, everywhere, 5.0, 1.0)[1].any()


def test_a_region_is_oriented_as_the_sweep_over_it():
    stamps = sweep(2.0)
    angle, valid = history.gradient(stamps, 0.05, 1.0)
    regions = torch.zeros(1, 1, 37, 53, dtype=torch.bool)
    regions[..., 10:25, 15:40] = True
    found, known = history.region_orientation(angle, valid, stamps, regions, 8.0, 10.0)
    assert known.all() and found.item() == pytest.approx(2.0, abs=1e-3)


def test_a_batch_is_the_same_as_each_clip_alone():
    stamps = torch.rand(3, 1, 19, 23, generator=torch.Generator().manual_seed(0))
    angle, valid = history.gradient(stamps, 0.1, 0.9)
    for clip in range(3):
        alone = history.gradient(stamps[clip : clip + 1], 0.1, 0.9)
        assert torch.equal(valid[clip], alone[1][0])
        torch.testing.assert_close(angle[clip], alone[0][0])


def test_gradients_are_those_of_finite_differences():
    stamps = torch.rand(1, 1, 5, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: history.gradient(x, 0.0, 9.0)[0], (stamps,))
