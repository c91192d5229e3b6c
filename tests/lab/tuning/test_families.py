"""What every family of parameters keeps to: examples in order, one loss an example, gradients, errors in one line."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from tests.lab.tuning.worlds import filmed_clip, seen, walk
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.tuning.family import Example, Family, load_family
from torchvision_dddas.lab.tuning.parameters import TUNABLE, Parameters

SETTINGS = Settings()
MOTION = with_parameters(
    SETTINGS, {"gates.min_area_px": 30, "morphology.close_px": 7, "registration.keypoints": 200, "small.on": False}
)


@dataclass(frozen=True)
class Case:
    """frames: of the examples. lacks: said of a clip without truth. idle: parameters without a gradient here."""

    name: str
    clip: Callable[[Path, pytest.MonkeyPatch], Clip]
    frames: list[int]
    lacks: str
    settings: Settings = SETTINGS
    softness: float = 0.2
    idle: frozenset[str] = frozenset()
    change: Callable[[Family], Family] = lambda family: family


# Without pictures, and whoever hides, these tracking parameters have no effect.
IDLE_SCORES = "appearance_weight appearance_offset rest_drift rest_price hiding"
IDLE = frozenset(f"track.{name}" for name in IDLE_SCORES.split())
CASES = {
    "motion": Case("motion", lambda place, _: filmed_clip(place, 9), list(range(1, 10)), "no masks", MOTION),
    "tracking": Case(
        "tracking",
        lambda place, _: walk(),
        [1, 126],
        "no true identities",
        softness=1.0,
        idle=IDLE,
        change=lambda family: family.at(5, "association"),
    ),
    "tracking of detections": Case(
        "tracking",
        lambda place, _: seen(walk(), place),
        [1, 126],
        "no true identities",
        softness=1.0,
        idle=IDLE,
        change=lambda family: family.at(5, "tracking"),
    ),
}
Made = tuple[Case, Family, Clip, list[Example]]


@pytest.fixture(scope="module", params=CASES)
def made(request, tmp_path_factory) -> Made:
    case = CASES[request.param]
    with pytest.MonkeyPatch.context() as patch:
        clip = case.clip(tmp_path_factory.mktemp("family"), patch)
        family, ticks = case.change(load_family(case.name)), list[int]()
        examples = family.examples([clip], case.settings, lambda: ticks.append(1))
    assert len(ticks) == len(examples)
    return case, family, clip, examples


def tuned(case: Case) -> Parameters:
    return Parameters(case.settings, [name for name, one in TUNABLE.items() if one.family == case.name])


def test_examples_are_the_labelled_frames_in_order_with_their_settings(made: Made) -> None:
    case, family, clip, examples = made
    assert family.measure.split(".")[0] == family.task
    assert [(example.clip, example.frame) for example in examples] == [(clip.name, frame) for frame in case.frames]
    assert all(example.settings is case.settings for example in examples)


def test_the_loss_of_an_example_does_not_depend_on_its_batch(made: Made) -> None:
    case, family, _, examples = made
    values = tuned(case).values()
    together = family.loss(values, examples, case.softness)
    alone = torch.cat([family.loss(values, [example], case.softness) for example in examples])
    assert together.shape == (len(examples),) and bool(together.isfinite().all())
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-4)


def test_every_parameter_has_a_finite_gradient(made: Made) -> None:
    case, family, _, examples = made
    parameters = tuned(case)
    family.loss(parameters.values(), examples, case.softness).sum().backward()
    slopes = {name: free.grad for name, free in zip(parameters.names, parameters.free, strict=True)}
    assert all(slope is None or bool(slope.isfinite()) for slope in slopes.values())
    assert {name for name, slope in slopes.items() if slope is None or float(slope) == 0} <= case.idle


def test_a_clip_without_truth_is_refused_by_name(made: Made) -> None:
    case, family, clip, _ = made
    with pytest.raises(InputError, match=f"bare has {case.lacks}"):
        family.examples([replace(clip, name="bare", truth=None)], case.settings)


def test_a_family_that_is_none_is_refused_with_those_that_are() -> None:
    with pytest.raises(InputError, match="give one of motion"):
        load_family("weather")
