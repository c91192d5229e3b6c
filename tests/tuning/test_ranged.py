from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.metres import inside
from torchvision_dddas.evaluation.metrics.truth import Positions
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.ground_location import PARAMETERS, build_ground_view
from torchvision_dddas.tuning.location import UNPLACED, LocationFamily
from torchvision_dddas.tuning.parameters import Parameters
from torchvision_dddas.types import Camera

CAMERA = Camera(
    "ground",
    (1280, 720),
    (1000.0, 1000.0),
    (639.5, 359.5),
    height_m=1.6,
    focal_sigma=0.001,
    height_sigma_m=0.01,
    pitch_sigma_rad=1e-4,
    heading_sigma_rad=1e-4,
    position_sigma_m=0.01,
)
FAMILY = LocationFamily()


def people(seed: int, count: int = 12, feet: float = 0.03, tall: float = 0.05, body: float = 0.1):
    """Boxes of people ahead of a level camera, with errors of foot rows and heights, and where they stand."""
    rng = np.random.default_rng(seed)
    ahead, aside = rng.uniform(6, 20, count), rng.uniform(-3, 3, count)
    height = 1.75 + body * rng.normal(0, 1, count)
    feet_px, head_px = (359.5 + 1000 * (1.6 - up) / ahead for up in (0 * height, height))
    size = feet_px - head_px
    foot = feet_px + feet * size * rng.normal(0, 1, count)
    size = size * (1 + tall * rng.normal(0, 1, count))
    u = 639.5 + 1000 * aside / ahead + feet * size * rng.normal(0, 1, count)
    box = np.stack([u + 0.5 - size / 5, foot + 0.5 - size, 0.4 * size, size], axis=1)
    return box, np.stack([aside, ahead], axis=1)


def example(seed: int, settings: Settings, count: int = 12, **errors: float) -> Example:
    box, true = people(seed, count, **errors)
    return Example("ground", seed, (build_ground_view(CAMERA, box, np.zeros(len(box), bool), true), settings))


def test_the_loss_is_that_of_the_hard_places():
    settings = Settings()
    one = example(0, settings)
    seen = one.content[0]
    found = range_people(seen.box_px, seen.cut, CAMERA, seen.poses, seen.here_m, settings.ground)
    off, covariance = found.east_north_m - seen.true_m, found.covariance_m2
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    wanted = (squared + np.log(np.linalg.det(covariance))) / 2 + np.log(2 * np.pi)
    assert float(FAMILY.loss({}, [one], 1.0)) == pytest.approx(wanted.mean())


def test_the_gradient_is_that_of_the_hard_loss():
    settings = Settings()
    parameters = Parameters(settings, PARAMETERS)
    batch = [example(seed, settings) for seed in range(3)]
    FAMILY.loss(parameters.values(), batch, 1.0).sum().backward()
    for free in parameters.free:
        assert free.grad is not None
        wanted = []
        for step in (1e-3, -1e-3):
            with torch.no_grad():
                free += step
                wanted.append(float(FAMILY.loss(parameters.values(), batch, 1.0).sum()))
                free -= step
        assert float(free.grad) == pytest.approx((wanted[0] - wanted[1]) / 2e-3, rel=0.01, abs=0.01)


def test_ellipses_hold_as_many_places_as_they_say_on_people_not_tuned_on():
    errors = {"feet": 0.015, "tall": 0.15, "body": 0.1}
    thought = with_parameters(Settings(), {"ground.feet_sigma": 0.05, "ground.height_sigma": 0.03})
    parameters = Parameters(thought, ["ground.feet_sigma", "ground.height_sigma"])
    batch = [example(seed, thought, 120, **errors) for seed in range(3)]
    tuned = descend(FAMILY, parameters, batch, Plan(steps=40, batch=3, rate=0.2, look_every=20, watched=0)).settings

    def held(settings: Settings) -> float:
        shares = []
        for seed in range(100, 104):
            seen = example(seed, settings, 120, **errors).content[0]
            found = range_people(seen.box_px, seen.cut, CAMERA, seen.poses, seen.here_m, settings.ground)
            shares.append(inside(found.east_north_m - seen.true_m, found.covariance_m2))
        return float(np.nanmean(np.concatenate(shares)))

    assert abs(held(tuned) - 0.95) < 0.03
    assert abs(held(thought) - 0.95) > 0.03


def test_people_without_a_place_cost_and_have_no_slope():
    settings = Settings()
    box, true = people(0, 1)
    box[:, 1] -= 400  # above the horizon
    seen = build_ground_view(CAMERA, box, np.ones(1, bool), true)
    parameters = Parameters(settings, ["ground.feet_sigma"])
    found = FAMILY.loss(parameters.values(), [Example("ground", 1, (seen, settings))], 1.0)
    found.sum().backward()
    assert float(found.detach()) == UNPLACED
    assert float(parameters.free[0].grad or 0) == 0


def written(folder: Path) -> Clip:
    """A clip of two pictures, with detections that are exact but for a box of nobody, and a camera."""
    rows, found = [], []
    for frame in (1, 2):
        box, _ = people(frame, 5, 0, 0, 0)
        for who, (x, y, w, h) in enumerate(box.tolist(), 1):
            rows.append(f"{frame},{who},{x:.3f},{y:.3f},{w:.3f},{h:.3f},1,-1,-1,-1\n")
            found.append(f"{frame},-1,{x:.3f},{y:.3f},{w:.3f},{h:.3f},1,-1,-1,-1\n")
        found.append(f"{frame},-1,20,20,30,60,1,-1,-1,-1\n")
    (folder / "gt.txt").write_text("".join(rows))
    (folder / "det.txt").write_text("".join(found))
    (folder / "camera.toml").write_text(
        "focal_px = 1000\nwidth_px = 1280\nheight_px = 720\nheight_m = 1.6\neast_m = 0\nnorth_m = 0\nheading_deg = 0\n"
    )
    numbers = np.repeat([1, 2], 5), np.tile(np.arange(1, 6), 2)
    where = Positions(*numbers, np.concatenate([people(frame, 5, 0, 0, 0)[1] for frame in (1, 2)]))
    truth = replace(truths.load_truth(folder / "gt.txt"), positions=where)
    return Clip("ground", folder, truth=truth, given=folder / "det.txt", camera=folder / "camera.toml")


def test_sightings_of_a_clip_are_those_of_people_whose_places_are_known(tmp_path):
    clip = written(tmp_path)
    found = FAMILY.examples([clip], Settings())
    assert [one.frame for one in found] == [1, 2]
    assert [len(one.content[0].true_m) for one in found] == [5, 5]
    assert float(FAMILY.loss({}, found, 1.0).mean()) < 5


def test_a_clip_without_places_is_refused(tmp_path):
    clip = Clip("bare", tmp_path, given=tmp_path / "det.txt", camera=tmp_path / "camera.toml")
    with pytest.raises(InputError, match="bare has no true positions"):
        FAMILY.examples([clip], Settings())
