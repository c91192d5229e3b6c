"""The family of registration: a loss that is the hard registration's own error, and gradients of its tolerances."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.tuning.worlds import filmed_clip
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import labels_of
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.functional import find_homography as fit
from torchvision_dddas.geometry import transfer
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.registration import CHECK, RANSAC, RegistrationFamily, TrackedPoints, refit_motion

# Every pair for itself, as the loss sees them.
SETTINGS = with_parameters(Settings(), {"registration.redetect_frames": 1})


def number(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    return filmed_clip(tmp_path_factory.mktemp("films"), 5)


@pytest.fixture(scope="module")
def examples(clip: Clip) -> list[Example]:
    return RegistrationFamily().examples([clip], SETTINGS)


def lost(examples: list[Example], tolerance_px: float, check_px: float, softness: float = 0.0) -> torch.Tensor:
    return RegistrationFamily().loss({RANSAC: number(tolerance_px), CHECK: number(check_px)}, examples, softness)


def test_points_that_are_still_are_those_outside_the_labels(clip: Clip, examples: list[Example]) -> None:
    assert clip.truth is not None
    for example in examples:
        points = example.content
        column, row = points.earlier_px[points.still].long().T.numpy()
        assert len(row) > 20 and not labels_of(clip.truth, example.frame)[row, column].any()


@pytest.mark.parametrize("tolerance_px", [0.7, 2.0, 6.0])
def test_the_hard_loss_is_the_error_of_the_pipelines_registration(clip, examples, tolerance_px: float) -> None:
    settings = with_parameters(SETTINGS, {RANSAC: tolerance_px})
    engine = load_engine("onboard", settings)
    views = [engine.prepare(frame.image) for frame in open_clip(clip)]
    wanted = []
    for pair, example in zip(pairwise(views), examples, strict=True):
        points = example.content
        start, end = (side[points.still].numpy() for side in (points.earlier_px, points.later_px))
        found = engine.register([pair])[0].later_from_earlier
        wanted.append(np.linalg.norm(transfer(found, start) - end, axis=1).mean())
    np.testing.assert_allclose(lost(examples, tolerance_px, 1.0).detach().numpy(), wanted, atol=0.01)


def test_a_registration_on_which_too_few_points_agree_costs(examples: list[Example]) -> None:
    points = examples[0].content
    later = points.later_px.clone()
    later[::3] += 50
    later[1::3] -= 60
    wild = replace(examples[0], content=replace(points, later_px=later))
    assert float(lost([wild], 2.0, 1.0).detach()) > 2


def test_what_cannot_be_tuned_is_refused_in_one_line(clip: Clip) -> None:
    assert clip.truth is not None and clip.truth.masks
    for masks, line in (({}, "film has no masks of what moves"), ({5: clip.truth.masks[5]}, "no two consecutive")):
        with pytest.raises(InputError, match=line):
            RegistrationFamily().examples([replace(clip, truth=replace(clip.truth, masks=masks))], SETTINGS)
    for name, value, line in (
        ("registration.halved", True, r"registration\.halved"),
        (CHECK, 0.0, "forward_backward_px = 0 leaves the check out"),
    ):
        with pytest.raises(InputError, match=line):
            RegistrationFamily().check([RANSAC, CHECK], with_parameters(SETTINGS, {name: value}))
    free = RegistrationFamily().examples([clip], with_parameters(SETTINGS, {CHECK: 0.0}))
    assert bool(torch.isfinite(RegistrationFamily().loss({RANSAC: number(2.0)}, free, 0.1)).all())


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


def test_what_is_too_wide_takes_in_what_moves_slowly_and_its_slope_says_so() -> None:
    points, tolerance = scene(), number(8.0)
    wide = refit_motion(points, TRUE, tolerance, None, fit, 0.2)
    fine = refit_motion(points, TRUE, torch.tensor(2.0).double(), None, fit, 0.02)
    assert float(wide.off_px.detach()) > 0.3 > 0.1 > float(fine.off_px)
    wide.off_px.backward()
    assert tolerance.grad is not None and float(tolerance.grad) > 0


def test_what_does_not_find_back_is_left_out_by_the_check() -> None:
    points, check = scene(slow_px=0.0), number(2.1)
    off = [float(refit_motion(points, TRUE, number(4.0), one, fit).off_px) for one in (None, number(1.0))]
    assert off[1] < off[0]
    refit_motion(points, TRUE, number(4.0), check, fit, 0.2).off_px.backward()
    assert check.grad is not None and float(check.grad) > 0


def test_soft_refits_tend_to_the_hard_one() -> None:
    points = scene()
    hard, *soft = (refit_motion(points, TRUE, number(2.0), number(1.0), fit, s) for s in (0.0, 0.3, 0.1, 0.01))
    off = points.later_px - torch.from_numpy(transfer(TRUE.numpy(), points.earlier_px.numpy()))
    kept = (points.missed_px <= 1) & (off.norm(dim=1) < 1)
    wanted, _ = fit(points.earlier_px[None], points.later_px[None], kept[None].double())
    torch.testing.assert_close(hard.later_from_earlier, wanted[0])
    assert float(hard.share.detach()) == pytest.approx(60 / 72)
    away = [float((one.later_from_earlier - hard.later_from_earlier).detach().abs().max()) for one in soft]
    assert away[0] > away[1] > away[2] and away[2] < 1e-6


def test_both_tolerances_have_the_right_gradient() -> None:
    def refit(tolerance_px: torch.Tensor, check_px: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = refit_motion(scene(1), TRUE, tolerance_px, check_px, fit, 0.3)
        return found.off_px, found.share

    assert torch.autograd.gradcheck(refit, (number(3.0), number(1.5)))
