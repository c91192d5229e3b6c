from dataclasses import replace

import pytest
import torch

from tests.synthetic_clip import film_into
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.kinds import read
from torchvision_dddas.evaluation.datasets.record import Clip, Source
from torchvision_dddas.evaluation.metrics.truth import labels_of
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.tuning.family import Example, load_family
from torchvision_dddas.tuning.motion import MotionFamily, soft_masks, stack_frames
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters

SETTINGS = with_parameters(
    Settings(), {"gates.min_area_px": 30, "morphology.close_px": 7, "registration.keypoints": 200, "small.on": False}
)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    place = tmp_path_factory.mktemp("films")
    film_into(place / "film", 3, 9, (240, 180))
    (found,) = read(Source("folder", place), place).clips
    return found


@pytest.fixture(scope="module")
def examples(clip: Clip) -> list[Example]:
    return MotionFamily().examples([clip], SETTINGS)


def test_hard_masks_are_those_of_the_pipeline(clip: Clip, examples: list[Example]) -> None:
    """At the settings that the examples were prepared with: what comes after the hulls is then as it was."""
    final = {s.frame.number: s.mask > 0 for s in detect_motion(open_clip(clip), SETTINGS, "onboard")}
    assert [example.frame for example in examples] == list(range(1, 10))
    for example in examples:
        mask = soft_masks(stack_frames([example.content], CPU), {}, 0.0)[0, 0] > 0.5
        assert torch.equal(mask, torch.from_numpy(final[example.frame])), example.frame


def test_the_loss_tends_to_that_of_hard_masks(examples: list[Example]) -> None:
    parameters = {"difference.threshold": torch.tensor(4.0)}
    family = MotionFamily()
    hard = family.loss(parameters, examples, 0.0)
    misses = [float((family.loss(parameters, examples, softness) - hard).abs().mean()) for softness in (0.5, 0.1, 0.01)]
    assert misses[0] > misses[1] > misses[2] and misses[2] < 0.02


def test_the_loss_of_an_example_does_not_depend_on_its_batch(examples: list[Example]) -> None:
    parameters, family = {"difference.threshold": torch.tensor(3.5)}, MotionFamily()
    whole = family.loss(parameters, examples, 0.2)
    single = torch.stack([family.loss(parameters, [example], 0.2)[0] for example in examples])
    torch.testing.assert_close(whole, single)


def test_straight_through_gives_the_loss_of_hard_masks_and_a_gradient(examples: list[Example]) -> None:
    parameters = Parameters(SETTINGS, ["difference.threshold"])
    passing = MotionFamily(hard=True).loss(parameters.values(), examples[3:5], 0.1)
    assert torch.equal(passing.detach(), MotionFamily().loss(parameters.values(), examples[3:5], 0.0).detach())
    passing.sum().backward()
    assert parameters.free[0].grad is not None and float(parameters.free[0].grad) != 0


def test_every_parameter_of_motion_has_a_finite_gradient(examples: list[Example]) -> None:
    parameters = Parameters(SETTINGS, [name for name, parameter in TUNABLE.items() if parameter.family == "motion"])
    MotionFamily().loss(parameters.values(), examples[3:6], 0.2).sum().backward()
    for name, free in zip(parameters.names, parameters.free, strict=True):
        assert free.grad is not None and bool(free.grad.isfinite()) and float(free.grad) != 0, name


def test_a_step_down_the_slope_of_a_threshold_that_is_too_high_lowers_it(clip: Clip) -> None:
    family, settings = MotionFamily(with_later_steps=False), with_parameters(SETTINGS, {"difference.threshold": 10.0})
    examples = family.examples([clip], settings)[3:6]
    parameters = Parameters(settings, ["difference.threshold"])
    family.loss(parameters.values(), examples, 0.3).sum().backward()
    assert float(parameters.free[0].grad) > 0


def test_a_clip_without_masks_is_told_in_one_line(clip: Clip) -> None:
    assert clip.truth is not None
    for truth in (None, replace(clip.truth, masks={})):
        bare = replace(clip, name="bare", truth=truth)
        with pytest.raises(InputError, match="bare has no masks of what moves; choose clips"):
            MotionFamily().examples([clip, bare], SETTINGS, lambda: pytest.fail("a clip was computed before"))
    with pytest.raises(InputError, match=r"difference\.halved"):
        MotionFamily().examples([clip], with_parameters(SETTINGS, {"difference.halved": True}))


def test_of_a_clip_in_which_nothing_moves_whatever_is_found_is_false(clip: Clip) -> None:
    still = replace(clip, name="still", truth=None, still=True)
    family = MotionFamily(with_later_steps=False)
    examples = family.examples([still], SETTINGS)
    assert [example.clip for example in examples] == ["still"] * 9
    assert not any(bool(example.content.truth.any()) for example in examples)
    calm, alarmed = (
        family.loss({"difference.threshold": torch.tensor(at)}, examples, 0.02).mean() for at in (60.0, 4.0)
    )
    assert float(calm) < 0.01 and float(alarmed) > 0.9


def test_unlabelled_pixels_are_known_to_be_so(clip: Clip, examples: list[Example]) -> None:
    assert clip.truth is not None
    labels = labels_of(clip.truth, examples[0].frame)
    assert torch.equal(examples[0].content.truth[0, 0], torch.from_numpy(labels > 0))
    assert bool(examples[0].content.known.all())


def test_a_loss_of_another_name_is_another_loss_of_the_same_masks(examples: list[Example]) -> None:
    parameters = {"difference.threshold": torch.tensor(4.0)}
    found = {}
    for name in MotionFamily().losses:
        family = MotionFamily(hard=True).with_loss(name)
        assert isinstance(family, MotionFamily) and family.hard and family.loss_name == name
        found[name] = family.loss(parameters, examples, 0.1)
    assert MotionFamily().loss_name == "f" and torch.equal(
        found["f"], MotionFamily(hard=True).loss(parameters, examples, 0.1)
    )
    assert not torch.allclose(found["f"], found["focal"])
    # Squares of hard masks are the masks.
    torch.testing.assert_close(found["f"], found["dice"])


def test_a_loss_that_a_family_has_not_is_refused_with_those_it_has() -> None:
    with pytest.raises(InputError, match="'iou' is no loss of the family motion; wanted one of f, dice, focal"):
        MotionFamily().with_loss("iou")
    with pytest.raises(InputError, match="'f' is no loss of the family people; it has one only"):
        load_family("people").with_loss("f")


def test_the_family_is_found_by_its_name() -> None:
    assert load_family("motion").measure == "motion.pixels.f"
