"""The family of motion: masks that are those of the hard pipeline, regions, and the loss of masks."""

from dataclasses import replace

import pytest
import torch

from tests.lab.tuning.test_families import MOTION as SETTINGS
from tests.lab.tuning.worlds import filmed_clip
from torchvision_dddas.config import with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.metrics.pixels import Pixels, measures
from torchvision_dddas.lab.evaluation.studies.stages import open_clip
from torchvision_dddas.lab.tuning.family import Example
from torchvision_dddas.lab.tuning.motion import MotionFamily, label_regions, overlap_loss, soft_masks, stack_frames
from torchvision_dddas.nn import Core

CPU, THRESHOLD = torch.device("cpu"), "difference.threshold"


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    return filmed_clip(tmp_path_factory.mktemp("films"), 9)


@pytest.fixture(scope="module")
def examples(clip: Clip) -> list[Example]:
    return MotionFamily().examples([clip], SETTINGS)


def test_hard_masks_are_those_of_the_pipeline(clip: Clip, examples: list[Example]) -> None:
    final = {s.frame.number: s.mask > 0 for s in detect_motion(open_clip(clip), SETTINGS, "onboard")}
    assert [example.frame for example in examples] == list(range(1, 10))
    for example in examples:
        mask = soft_masks(stack_frames([example.content], CPU), SETTINGS, {}, 0.0)[0, 0] > 0.5
        assert torch.equal(mask, torch.from_numpy(final[example.frame])), example.frame


def test_the_loss_tends_to_that_of_hard_masks(examples: list[Example]) -> None:
    parameters, family = {THRESHOLD: torch.tensor(4.0)}, MotionFamily()
    hard = family.loss(parameters, examples, 0.0)
    misses = [float((family.loss(parameters, examples, softness) - hard).abs().mean()) for softness in (0.5, 0.1, 0.01)]
    assert misses[0] > misses[1] > misses[2] and misses[2] < 0.02


def test_a_clip_without_masks_is_refused_before_any_is_computed(clip: Clip) -> None:
    assert clip.truth is not None
    bare = replace(clip, name="bare", truth=replace(clip.truth, masks={}))
    with pytest.raises(InputError, match="bare has no masks of moving targets; choose clips"):
        MotionFamily().examples([clip, bare], SETTINGS, lambda: pytest.fail("a clip was computed before"))
    with pytest.raises(InputError, match=r"difference\.halved"):
        MotionFamily().examples([clip], with_parameters(SETTINGS, {"difference.halved": True}))


def test_of_a_clip_in_which_nothing_moves_all_that_is_found_is_false(clip: Clip) -> None:
    family = MotionFamily(with_later_steps=False)
    examples = family.examples([replace(clip, name="still", truth=None, still=True)], SETTINGS)
    assert [example.clip for example in examples] == ["still"] * 9
    assert not any(bool(example.content.truth.any()) for example in examples)
    calm, alarmed = (family.loss({THRESHOLD: torch.tensor(at)}, examples, 0.02).mean() for at in (60.0, 4.0))
    assert float(calm) < 0.01 and float(alarmed) > 0.9


TRUTH, KNOWN = torch.zeros(2, 1, 40, 50, dtype=torch.bool), torch.ones(2, 1, 40, 50, dtype=torch.bool)
TRUTH[:, :, 5:25, 10:30] = True


def test_of_hard_masks_the_loss_is_one_less_f() -> None:
    found = torch.zeros(2, 1, 40, 50)
    found[0, :, 10:30, 10:30] = 1
    found[1, :, 5:25, 10:30] = 1
    wanted = 1 - measures(Pixels(300, 100, 100, 1500))["f"]
    assert overlap_loss(found, TRUTH, KNOWN).tolist() == pytest.approx([wanted, 0.0], abs=1e-3)


def test_the_loss_ignores_what_nobody_labelled_accepts_empty_frames_and_has_the_right_gradient() -> None:
    loss, found = overlap_loss, TRUTH.double()
    wrong, known = found.clone(), KNOWN.clone()
    wrong[:, :, 30:], known[:, :, 30:] = 1, False
    assert torch.equal(loss(wrong, TRUTH, known), loss(found, TRUTH, known))
    assert bool((loss(wrong, TRUTH, KNOWN) > loss(found, TRUTH, KNOWN)).all())
    none = torch.zeros_like(TRUTH)
    assert float(loss(none.double(), none, KNOWN).max()) == pytest.approx(0.0, abs=1e-6)
    assert bool(torch.isfinite(loss(none.double(), none, none)).all())
    mask = 0.05 + 0.9 * torch.rand(2, 1, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    truth, known = TRUTH[..., 3:7, 8:13], KNOWN[..., 3:7, 8:13]
    assert torch.autograd.gradcheck(lambda soft: loss(soft, truth, known), (mask.requires_grad_(),))


def core(*boxes: tuple[int, int, int, int, float]) -> Core:
    """Margins of -4, and of the boxes (left, top, right, bottom, margin)."""
    margin = torch.full((1, 1, 40, 60), -4.0)
    for left, top, right, bottom, value in boxes:
        margin[..., top:bottom, left:right] = value
    return Core((margin > 0).float(), margin, margin + 4)


def test_regions_are_numbered_and_their_hulls_filled() -> None:
    bend = (5, 5, 15, 8, 1.0), (5, 5, 8, 15, 1.0)
    found = label_regions(core(*bend, (40, 20, 50, 30, 2.0)), hull=True)
    assert found.count == 2
    assert len({int(found.near[0, 0, 6, 10]), int(found.near[0, 0, 25, 45]), 0}) == 3
    assert int(found.near[0, 0, 10, 10]) == 0, "the bend of the L is no part of it"
    assert int(found.filled[0, 0, 9, 9]) == int(found.near[0, 0, 6, 6]), "but of its hull"
    plain = label_regions(core(*bend), hull=False)
    assert torch.equal(plain.filled, plain.near)
    none = label_regions(core(), hull=True, reach=1.0)
    assert none.count == 0 and not none.near.any() and not none.filled.any()


def test_a_speck_within_a_large_hull_keeps_its_own_number_and_lies_in_the_hull() -> None:
    sides = (5, 5, 30, 7, 1.0), (5, 5, 7, 30, 1.0), (5, 28, 30, 30, 1.0), (28, 5, 30, 30, 1.0)
    found = label_regions(core(*sides, (17, 17, 19, 19, 1.0)), hull=True)
    assert found.count == 2
    assert int(found.near[0, 0, 18, 18]) != int(found.near[0, 0, 5, 5])
    assert int(found.filled[0, 0, 18, 18]) == int(found.near[0, 0, 5, 5])


def test_what_just_misses_the_threshold_goes_to_the_nearest_region_or_makes_its_own() -> None:
    found = label_regions(core((5, 5, 25, 15, -0.5), (5, 5, 10, 15, 1.0), (40, 20, 50, 30, -0.5)), hull=True, reach=1.0)
    assert found.count == 2
    assert int(found.near[0, 0, 10, 20]) == int(found.near[0, 0, 10, 7])
    assert int(found.near[0, 0, 25, 45]) not in (0, int(found.near[0, 0, 10, 7]))
    assert not found.filled[0, 0, 20:30, 40:50].any(), "it is not there yet"
    assert int(found.near[0, 0, 35, 5]) == 0
