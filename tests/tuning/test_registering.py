"""The parameters of registration: points of labelled frames, and a loss that is the hard registration's own error."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.synthetic_clip import film_into
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.kinds import read
from torchvision_dddas.evaluation.datasets.record import Clip, Source
from torchvision_dddas.evaluation.metrics.truth import labels_of
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.geometry import transfer
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters
from torchvision_dddas.tuning.registration import CHECK, RANSAC, RegistrationFamily

SETTINGS = Settings()


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    place = tmp_path_factory.mktemp("films")
    film_into(place / "film", 3, 5, (240, 180))
    (found,) = read(Source("folder", place), place).clips
    return found


@pytest.fixture(scope="module")
def examples(clip: Clip) -> list[Example]:
    return RegistrationFamily().examples([clip], SETTINGS)


def lost(examples: list[Example], tolerance_px: float, check_px: float, softness: float = 0.0) -> torch.Tensor:
    parameters = {RANSAC: torch.tensor(tolerance_px).double(), CHECK: torch.tensor(check_px).double()}
    return RegistrationFamily().loss(parameters, examples, softness)


def test_every_labelled_frame_that_has_a_next_one_is_an_example(clip: Clip, examples: list[Example]) -> None:
    assert [example.frame for example in examples] == [1, 2, 3, 4]
    assert clip.truth is not None
    for example in examples:
        points = example.content.points
        column, row = points.earlier_px[points.still].long().T.numpy()
        assert len(row) > 20 and not labels_of(clip.truth, example.frame)[row, column].any()


@pytest.mark.parametrize("tolerance_px", [0.7, 2.0, 6.0])
def test_the_hard_loss_is_the_error_of_the_pipelines_registration(clip, examples, tolerance_px: float) -> None:
    settings = with_parameters(SETTINGS, {RANSAC: tolerance_px})
    engine = load_engine("onboard", settings)
    views = [engine.prepare(frame.image) for frame in open_clip(clip)]
    wanted = []
    for pair, example in zip(pairwise(views), examples, strict=True):
        points = example.content.points
        start, end = (side[points.still].numpy() for side in (points.earlier_px, points.later_px))
        found = engine.register([pair])[0].later_from_earlier
        wanted.append(np.linalg.norm(transfer(found, start) - end, axis=1).mean())
    np.testing.assert_allclose(lost(examples, tolerance_px, 1.0).numpy(), wanted, atol=0.01)


def test_the_loss_tends_to_the_hard_one(examples: list[Example]) -> None:
    hard = lost(examples, 2.0, 1.0)
    misses = [float((lost(examples, 2.0, 1.0, softness) - hard).abs().max()) for softness in (0.3, 0.1, 0.01)]
    assert misses[0] > misses[1] > misses[2] and misses[2] < 0.01


def test_knobs_of_the_family_have_finite_gradients(examples: list[Example]) -> None:
    parameters = Parameters(
        SETTINGS, [name for name, parameter in TUNABLE.items() if parameter.family == "registration"]
    )
    RegistrationFamily().loss(parameters.values(), examples, 0.2).sum().backward()
    for name, free in zip(parameters.names, parameters.free, strict=True):
        assert free.grad is not None and bool(free.grad.isfinite()) and float(free.grad) != 0, name


def test_a_tolerance_that_is_too_wide_slopes_down_to_narrower_ones(examples: list[Example]) -> None:
    parameters = Parameters(with_parameters(SETTINGS, {RANSAC: 6.0}), [RANSAC])
    RegistrationFamily().loss(parameters.values(), examples, 0.3).sum().backward()
    assert float(parameters.free[0].grad) > 0
    assert float(lost(examples, 6.0, 1.0).mean()) > float(lost(examples, 2.0, 1.0).mean())


def test_what_is_no_registration_to_be_believed_costs(examples: list[Example]) -> None:
    """Half of the points are somewhere else: too few agree."""
    points = examples[0].content.points
    later = points.later_px.clone()
    later[::3] += 50
    later[1::3] -= 60
    wild = replace(examples[0], content=replace(examples[0].content, points=replace(points, later_px=later)))
    assert float(lost([wild], 2.0, 1.0)) > 2


def test_what_cannot_be_tuned_is_told_in_a_line(clip: Clip, examples: list[Example]) -> None:
    assert clip.truth is not None
    bare, told = replace(clip, name="bare", truth=replace(clip.truth, masks={})), list[int]()
    with pytest.raises(InputError, match="bare has no masks of what moves"):
        RegistrationFamily().examples([clip, bare], SETTINGS, lambda: told.append(1))
    assert not told, "a clip was computed before"
    with pytest.raises(InputError, match=r"registration\.halved"):
        RegistrationFamily().check([RANSAC], with_parameters(SETTINGS, {"registration.halved": True}))
    unchecked = with_parameters(SETTINGS, {CHECK: 0.0})
    free = RegistrationFamily().examples([clip], unchecked)
    assert bool(torch.isfinite(RegistrationFamily().loss({RANSAC: torch.tensor(2.0).double()}, free, 0.1)).all())
    with pytest.raises(InputError, match="forward_backward_px = 0 leaves the check out"):
        RegistrationFamily().check([RANSAC, CHECK], unchecked)
    assert clip.truth.masks
    alone = replace(clip, truth=replace(clip.truth, masks={5: clip.truth.masks[5]}))
    with pytest.raises(InputError, match="no two consecutive frames"):
        RegistrationFamily().examples([alone], SETTINGS)
