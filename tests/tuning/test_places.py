from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import airborne
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.tuning.aerial_location import (
    SPREADS,
    AerialExample,
    build_view,
    default_values,
    is_only_noise,
    keep_fit,
)
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.location import UNPLACED, LocationFamily
from torchvision_dddas.tuning.parameters import Parameters

HFOV = float(np.radians(70.0))
FAMILY = LocationFamily()


def looks(count: int, settings: Settings, **how) -> list[Example]:
    found = []
    for seed in range(count):
        look = airborne.look(seed, **how)
        n = len(look.marks)
        marks = replace(
            look.marks,
            sigma_m=np.full(n, settings.landmarks.sigma_m),
            pixel_sigma=np.full(n, settings.landmarks.pixel_sigma),
        )
        flight = replace(look.flight, hfov_rad=HFOV)
        own = np.ones(n, bool)
        one = build_view(airborne.CAMERA, flight, marks, look.targets_px, look.targets, settings, own)
        found.append(Example("looks", seed, AerialExample(one, settings)))
    return found


def values(settings: Settings, names=SPREADS) -> dict[str, torch.Tensor]:
    return {name: value for name, value in default_values(settings).items() if name in names}


def test_the_loss_is_that_of_the_hard_registrar():
    settings = with_parameters(Settings(), {"aerial.correlation_s": 0.0, "aerial.tilt_sigma_deg": 1.7})
    found = FAMILY.loss({}, looks(3, settings), 1.0)
    for seed in range(3):
        look = airborne.look(seed)
        flight = replace(look.flight, hfov_rad=HFOV)
        fix = Georeferencer(airborne.CAMERA, settings, load_solver("onboard")).update(1, 0.0, flight, look.marks)
        place, covariance = locate_pixels(fix, airborne.CAMERA, look.targets_px, 1.0)
        off = place - look.targets
        squared = np.einsum("ti,tij,tj->t", off, np.linalg.inv(covariance), off)
        wanted = (squared + np.log(np.linalg.det(covariance))) / 2 + np.log(2 * np.pi)
        assert float(found[seed]) == pytest.approx(wanted.mean(), rel=1e-3)


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0])
def test_the_gradient_is_that_of_the_hard_loss(tilt_deg):
    settings = with_parameters(Settings(), {"landmarks.sigma_m": 1.0, "aerial.heading_sigma_deg": 3.0})
    batch = looks(4, settings, tilt_deg=tilt_deg)
    parameters = {name: value.requires_grad_() for name, value in values(settings).items() if float(value) > 0}
    FAMILY.loss(parameters, batch, 1.0).sum().backward()
    checked = 0
    for name, value in parameters.items():
        with torch.no_grad():
            step = 1e-3 * value
            more, less = (FAMILY.loss({**parameters, name: value + s}, batch, 1.0).sum() for s in (step, -step))
        # By the knob's logarithm, so that all are alike.
        slope = float(more - less) / 2e-3
        mine = 0.0 if value.grad is None else float(value.grad * value.detach())
        assert mine == pytest.approx(slope, rel=0.03, abs=0.03), name
        checked += abs(slope) > 0.1
    assert checked >= 3


def test_pictures_of_several_shapes_share_a_batch():
    settings = Settings()
    batch = [*looks(1, settings), *looks(1, settings, n=6), *looks(2, settings)]
    together = FAMILY.loss({}, batch, 1.0)
    assert together.tolist() == pytest.approx([float(FAMILY.loss({}, [one], 1.0)) for one in batch])


def test_a_picture_that_no_pose_explains_costs_and_has_no_slope():
    settings = Settings()
    (example,) = looks(1, settings)
    look = example.content.view
    upward = replace(look, targets_px=np.full_like(look.targets_px, 1e7))
    parameter = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    found = FAMILY.loss(
        {"aerial.tilt_sigma_deg": parameter}, [Example("looks", 0, AerialExample(upward, settings))], 1.0
    )
    found.sum().backward()
    assert float(found.detach()) == UNPLACED
    assert parameter.grad is not None
    assert float(parameter.grad) == 0


def test_a_fit_that_is_kept_is_right_about_its_settings():
    settings = Settings()
    batch = looks(4, settings, tilt_deg=30.0)
    quick = [replace(one, content=keep_fit(one.content)) for one in batch]
    for parameters in ({}, {"aerial.tilt_sigma_deg": torch.tensor(1.5)}, {"landmarks.sigma_m": torch.tensor(1.0)}):
        hard, near = (FAMILY.loss(parameters, some, 1.0) for some in (batch, quick))
        assert near.tolist() == pytest.approx(hard.tolist(), abs=0.02 if parameters else 1e-4)


def test_swapped_landmarks_are_no_matter_of_noise():
    settings = Settings()
    (example,) = looks(1, settings, sigma_m=0.02)
    look = example.content.view
    probability = settings.aerial.gate_probability
    assert is_only_noise(look, values(settings), probability)
    pixels = look.marks.image_px[[1, 0, 2, 3]]
    swapped = replace(look, marks=replace(look.marks, image_px=pixels))
    assert not is_only_noise(swapped, values(settings), probability)


def test_noise_that_was_thought_too_small_is_found():
    thought = with_parameters(Settings(), {"landmarks.sigma_m": 0.5})
    batch = looks(24, thought)
    parameters = Parameters(thought, ["landmarks.sigma_m"])
    done = descend(FAMILY, parameters, batch, Plan(steps=20, batch=12, rate=0.2, look_every=10, watched=0))
    assert done.settings.landmarks.sigma_m == pytest.approx(airborne.GPS_M, rel=0.3)
