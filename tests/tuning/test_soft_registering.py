"""A refit on soft inliers: background that does not move as the movers do, and the slope of its tolerances."""

import pytest
import torch

from torchvision_dddas.functional.homography import fit
from torchvision_dddas.geometry import transfer
from torchvision_dddas.tuning.registration import TrackedPoints, refit_motion

TRUE = torch.tensor([[1.01, 0.02, 3.0], [-0.01, 0.99, -2.0], [1e-5, -2e-5, 1.0]], dtype=torch.float64)


def scene(seed: int = 0, slow_px: float = 3.0) -> TrackedPoints:
    """60 points on background, 12 on something slow, 8 that were lost and did not find back."""
    random = torch.Generator().manual_seed(seed)
    earlier = torch.rand(80, 2, generator=random, dtype=torch.float64) * 300
    later = torch.from_numpy(transfer(TRUE.numpy(), earlier.numpy()))
    later = later + 0.05 * torch.randn(80, 2, generator=random, dtype=torch.float64)
    later[60:72, 0] += slow_px
    later[72:] += 0.7
    missed = 0.05 * torch.rand(80, generator=random, dtype=torch.float64)
    missed[72:] = 2.0
    return TrackedPoints(earlier, later, missed, torch.arange(80) < 60)


def number(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


def test_what_is_too_wide_takes_in_what_moves_slowly_and_its_slope_says_so() -> None:
    points, tolerance = scene(), number(8.0)
    wide = refit_motion(points, TRUE, tolerance, None, 0.5, fit, 0.2)
    fine = refit_motion(points, TRUE, torch.tensor(2.0).double(), None, 0.5, fit, 0.02)
    assert float(wide.off_px.detach()) > 0.3 > 0.1 > float(fine.off_px)
    wide.off_px.backward()
    assert tolerance.grad is not None and float(tolerance.grad) > 0


def test_what_does_not_find_back_is_left_out_by_the_check() -> None:
    points = scene(slow_px=0.0)
    off = [float(refit_motion(points, TRUE, number(4.0), check, 0.5, fit).off_px) for check in (None, number(1.0))]
    assert off[1] < off[0]
    check = number(2.1)
    refit_motion(points, TRUE, number(4.0), check, 0.5, fit, 0.2).off_px.backward()
    assert check.grad is not None and float(check.grad) > 0


def test_soft_refits_tend_to_the_hard_one() -> None:
    points = scene()
    hard = refit_motion(points, TRUE, number(2.0), number(1.0), 0.5, fit)
    near = points.missed_px <= 1
    kept = near & (points.later_px - torch.from_numpy(transfer(TRUE.numpy(), points.earlier_px.numpy()))).norm(
        dim=1
    ).lt(1)
    wanted, _ = fit(points.earlier_px[None], points.later_px[None], kept[None].double())
    torch.testing.assert_close(hard.later_from_earlier, wanted[0])
    assert float(hard.share.detach()) == pytest.approx(60 / 72)
    soft = [refit_motion(points, TRUE, number(2.0), number(1.0), 0.5, fit, s) for s in (0.3, 0.1, 0.01)]
    away = [float((one.later_from_earlier - hard.later_from_earlier).detach().abs().max()) for one in soft]
    assert away[0] > away[1] > away[2] and away[2] < 1e-6


def test_both_tolerances_have_the_right_gradient() -> None:
    points = scene(1)

    def lost(tolerance_px: torch.Tensor, check_px: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = refit_motion(points, TRUE, tolerance_px, check_px, 0.5, fit, 0.3)
        return found.off_px, found.share

    assert torch.autograd.gradcheck(lost, (number(3.0), number(1.5)))
