"""Ellipses of positions: losses and gradients of the hard locators, from the air and from the ground."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from tests import airborne
from tests.lab.tuning.worlds import CAMERA, flown, ground_clip, ground_people
from tests.overflight import Overflight
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.lab.evaluation.metrics.metres import inside
from torchvision_dddas.lab.tuning.aerial_location import build_view, default_values
from torchvision_dddas.lab.tuning.descent import Plan, descend
from torchvision_dddas.lab.tuning.family import Example
from torchvision_dddas.lab.tuning.location import GROUND, UNPLACED, GroundView, LocationFamily
from torchvision_dddas.lab.tuning.parameters import Parameters
from torchvision_dddas.types import Poses

FAMILY = LocationFamily()


def from_air(count: int, settings: Settings, **how: Any) -> list[Example]:
    """Simulated pictures whose landmarks are as exact as the settings say."""
    found = []
    for seed in range(count):
        look = airborne.look(seed, **how)
        n, landmarks = len(look.marks), settings.landmarks
        sigmas = {"sigma_m": np.full(n, landmarks.sigma_m), "pixel_sigma": np.full(n, landmarks.pixel_sigma)}
        flight = replace(look.flight, hfov_rad=float(np.radians(70.0)))
        view = build_view(
            airborne.CAMERA, flight, replace(look.marks, **sigmas), look.targets_px, look.targets, settings,
            np.ones(n, bool), np.zeros(4), np.zeros(4),
        )  # fmt: skip
        found.append(Example("looks", seed, view, settings))
    return found


def from_ground(seed: int, settings: Settings, count: int = 12, **errors: float) -> Example:
    box, true = ground_people(seed, count, **errors)
    return Example("ground", seed, GroundView(CAMERA, box, np.zeros(count, bool), true), settings)


def range_again(view: GroundView, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Errors and covariances of the hard ranging."""
    n = len(view.box_px)
    place = np.tile(CAMERA.place, (n, 1))
    poses = Poses(place, np.full(n, CAMERA.heading_rad), np.full(n, CAMERA.pitch_rad))
    found = range_people(view.box_px, view.cut, CAMERA, poses, place, settings.ground)
    return found.east_north_m - view.true_m, found.covariance_m2


def mean_nll(off_m: np.ndarray, covariance_m2: np.ndarray) -> float:
    return -float(
        np.mean([multivariate_normal(np.zeros(2), c).logpdf(o) for o, c in zip(off_m, covariance_m2, strict=True)])
    )


def test_the_loss_is_that_of_the_hard_locators() -> None:
    settings = with_parameters(Settings(), {"aerial.correlation_s": 0.0, "aerial.tilt_sigma_deg": 1.7})
    found = FAMILY.loss({}, from_air(3, settings), 1.0)
    for seed in range(3):
        look = airborne.look(seed)
        flight = replace(look.flight, hfov_rad=float(np.radians(70.0)))
        fix = Georeferencer(airborne.CAMERA, settings, load_solver("onboard")).update(1, 0.0, flight, look.marks)
        place, covariance = locate_pixels(fix, airborne.CAMERA, look.targets_px, 1.0)
        assert float(found[seed]) == pytest.approx(mean_nll(place - look.targets, covariance), rel=1e-3)
    one = from_ground(0, Settings())
    assert float(FAMILY.loss({}, [one], 1.0)) == pytest.approx(mean_nll(*range_again(one.content, Settings())))


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, None])
def test_the_gradient_is_that_of_the_hard_loss(tilt_deg: float | None) -> None:
    """None: from the ground."""
    settings = with_parameters(Settings(), {"landmarks.sigma_m": 1.0, "aerial.heading_sigma_deg": 3.0})
    if tilt_deg is None:
        batch = [from_ground(seed, settings) for seed in range(3)]
        values = {name: value.detach() for name, value in Parameters(settings, GROUND).values().items()}
    else:
        batch, values = from_air(4, settings, tilt_deg=tilt_deg), default_values(settings)
    parameters = {name: value.requires_grad_() for name, value in values.items() if float(value) > 0}
    FAMILY.loss(parameters, batch, 1.0).sum().backward()
    checked = 0
    for name, value in parameters.items():
        with torch.no_grad():
            more, less = (
                FAMILY.loss({**parameters, name: share * value}, batch, 1.0).sum() for share in (1.001, 0.999)
            )
        # By the parameter's logarithm, so that all are alike.
        slope = float(more - less) / 2e-3
        mine = 0.0 if value.grad is None else float(value.grad * value.detach())
        assert mine == pytest.approx(slope, rel=0.03, abs=0.03), name
        checked += abs(slope) > 0.1
    assert checked >= (1 if tilt_deg is None else 3)


def test_pictures_of_several_shapes_share_a_batch() -> None:
    settings = Settings()
    batch = [*from_air(1, settings), from_ground(0, settings), *from_air(1, settings, n=6), *from_air(2, settings)]
    together = FAMILY.loss({}, batch, 1.0)
    assert together.tolist() == pytest.approx([float(FAMILY.loss({}, [one], 1.0)) for one in batch])


def test_what_gets_no_position_costs_and_has_no_gradient() -> None:
    (air,) = from_air(1, Settings())
    air = replace(air, content=replace(air.content, targets_px=np.full_like(air.content.targets_px, 1e7)))
    ground = from_ground(0, Settings(), 1)
    box = ground.content.box_px - [0, 400, 0, 0]  # above the horizon
    ground = replace(ground, content=replace(ground.content, box_px=box, cut=np.ones(1, bool)))
    for example, name in ((air, "aerial.tilt_sigma_deg"), (ground, "ground.feet_sigma")):
        parameter = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
        found = FAMILY.loss({name: parameter}, [example], 1.0)
        found.sum().backward()
        assert float(found.detach()) == UNPLACED and float(parameter.grad or 0) == 0


def test_noise_larger_than_the_settings_say_is_found() -> None:
    start = with_parameters(Settings(), {"landmarks.sigma_m": 0.5})
    plan = Plan(steps=20, batch=12, rate=0.2, look_every=10, watched=0)
    done = descend(FAMILY, Parameters(start, ["landmarks.sigma_m"]), from_air(24, start), plan)
    assert done.settings.landmarks.sigma_m == pytest.approx(airborne.GPS_M, rel=0.3)


@pytest.mark.slow
def test_ellipses_hold_as_many_places_as_they_say_on_people_not_tuned_on() -> None:
    errors = {"feet": 0.015, "tall": 0.15, "body": 0.1}
    start = with_parameters(Settings(), {"ground.feet_sigma": 0.05, "ground.height_sigma": 0.03})
    parameters = Parameters(start, ["ground.feet_sigma", "ground.height_sigma"])
    batch = [from_ground(seed, start, 120, **errors) for seed in range(3)]
    tuned = descend(FAMILY, parameters, batch, Plan(steps=40, batch=3, rate=0.2, look_every=20, watched=0)).settings

    def held(settings: Settings) -> float:
        views = [from_ground(seed, settings, 120, **errors).content for seed in range(100, 104)]
        return float(np.nanmean(np.concatenate([inside(*range_again(view, settings)) for view in views])))

    assert abs(held(tuned) - 0.95) < 0.03 < abs(held(start) - 0.95)


def examples(clip, settings: Settings | None = None) -> list[Example]:
    return FAMILY.examples([clip], settings or Settings())


@pytest.mark.parametrize("geographic", [False, True])
def test_an_exact_flight_asks_for_small_ellipses(tmp_path, geographic: bool) -> None:
    found = examples(flown(tmp_path, Overflight(frames=3, geographic=geographic)))
    assert [len(example.content.true_m) for example in found] == [4, 4, 4]
    wide, fine = (FAMILY.loss({"aerial.target_sigma_px": torch.tensor(px)}, found, 1.0) for px in (1.0, 0.05))
    assert (fine < wide - 1).all()


def test_the_people_of_a_ground_clip_are_those_whose_places_are_known(tmp_path) -> None:
    found = examples(ground_clip(tmp_path))
    assert [len(one.content.true_m) for one in found] == [5, 5]
    assert float(FAMILY.loss({}, found, 1.0).mean()) < 5


def test_landmarks_that_say_how_well_they_are_known_are_not_tuned(tmp_path) -> None:
    flight = Overflight(frames=1, gps_m=0.5)
    (given,) = examples(flown(tmp_path, flight))
    assert given.content.own.tolist() == [0] * 4
    assert given.content.reported_m2.tolist() == pytest.approx([0.25] * 4)
    clip = flown(tmp_path, flight, sigma=False)
    for settings in (Settings(), with_parameters(Settings(), {"landmarks.sigma_m": 0.0})):
        (silent,) = examples(clip, settings)
        assert silent.content.own.tolist() == pytest.approx([1] * 4)
        assert silent.content.reported_m2.tolist() == pytest.approx([0] * 4, abs=1e-9)


def test_a_frame_whose_landmarks_are_swapped_is_left_out(tmp_path) -> None:
    clip = flown(tmp_path, Overflight(frames=3))
    lines = [line.split(",") for line in (tmp_path / "landmarks.csv").read_text().splitlines()]
    one, other = (next(cells for cells in lines if cells[:2] == ["2", name]) for name in ("ugv0", "ugv1"))
    one[2:4], other[2:4] = other[2:4], one[2:4]
    (tmp_path / "landmarks.csv").write_text("\n".join(",".join(cells) for cells in lines) + "\n")
    assert [example.frame for example in examples(clip)] == [1, 3]


PICTURE = "focal_px = 1000\nwidth_px = 1280\nheight_px = 720\nheight_m = 1.6\n"


def test_clips_that_cannot_be_used_are_refused(tmp_path) -> None:
    clip = flown(tmp_path, Overflight(frames=1))
    assert clip.truth is not None and clip.truth.positions is not None
    in_metres = replace(clip.truth, positions=replace(clip.truth.positions, lonlat_deg=None))
    ground, paper = replace(clip, landmarks=None), with_parameters(Settings(), {"ground.mode": "paper"})
    for wrong, settings, line in (
        (replace(clip, truth=in_metres), None, "give both in one unit"),
        (replace(clip, given=None), None, "no pictures and no detections"),
        (ground, paper, "has no error model"),
        (replace(ground, given=None), None, "locating from the ground needs both"),
    ):
        with pytest.raises(InputError, match=line):
            examples(wrong, settings)
    (tmp_path / "camera.toml").write_text(PICTURE + "latitude_deg = 45\nlongitude_deg = -75\n")
    with pytest.raises(InputError, match="the camera is given in degrees"):
        examples(ground)
