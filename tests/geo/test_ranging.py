"""Ranging by a camera on the ground and its calibration: exact on exact boxes, with errors as large as stated."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import within_95
from tests.upright import boxes, camera, poses
from torchvision_dddas.config import GroundParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.camera_calibration import calibrate_focal_length, calibrate_pose
from torchvision_dddas.geo.ranging import range_people, touches_border

PEOPLE = np.array([[0.0, 8.0], [2.5, 12.0], [-3.0, 20.0], [1.0, 30.0]])


def seen(box_px, cam, cut=None, place=(0.0, 0.0), **parameters):
    cut = np.zeros(len(box_px), bool) if cut is None else cut
    where = poses(cam, len(box_px), place)
    return range_people(box_px, cut, cam, where, where.place, GroundParameters(**{"body_height_m": 1.75, **parameters}))


@pytest.mark.parametrize("use", ["height", "feet", "both"])
@pytest.mark.parametrize(
    "turned",
    [
        {"pitch_rad": 0.2, "height_m": 3.0},
        {"pitch_rad": -0.05},
        {"pitch_rad": 0.1, "heading_rad": 2.0},
        {"focal_px": (1000.0, 1020.0), "centre_px": (600.0, 500.0)},
    ],
)
def test_exact_boxes_give_exact_places(use, turned):
    cam, place = camera(**turned), (40.0, -7.0)
    ahead, right = np.array([[np.sin(a), np.cos(a)] for a in (cam.heading_rad, cam.heading_rad + np.pi / 2)])
    people = PEOPLE @ [right, ahead] + place
    found = seen(boxes(people, 1.75, cam, place), cam, place=place, use=use)
    assert np.allclose(found.east_north_m, people, atol=1e-6) and found.by.tolist() == [use] * 4
    assert np.allclose(found.distance_m, np.linalg.norm(PEOPLE, axis=1))
    way = np.stack([np.sin(found.bearing_rad), np.cos(found.bearing_rad)], axis=1)
    assert np.allclose(found.distance_m[:, None] * way, people - place)


def test_a_pixel_that_the_lens_cannot_fill_has_no_ray():
    box = np.array([[600.0, 400.0, 40.0, 160.0], [1200.0, 700.0, 60.0, 240.0]])
    found = seen(box, camera(focal_px=(500.0, 500.0), k1=-0.3))
    assert found.by.tolist() == ["both", "bearing"]
    assert np.isfinite(found.bearing_rad).tolist() == [True, False]


def test_a_level_camera_ranges_by_eq_13_as_depth_and_paper_mode_as_the_way_over_the_ground():
    box, depth, angle = np.array([[939.5 - 0.2 * 200, 380.0, 80.0, 200.0]]), 1000 * 1.75 / 200, np.arctan(299.5 / 1000)
    level = seen(box, camera(), use="height")
    assert (level.distance_m[0], level.bearing_rad[0]) == pytest.approx((depth / np.cos(angle), angle))
    printed = seen(box, camera(pitch_rad=0.2, heading_rad=1.0), mode="paper")
    assert printed.distance_m[0] == pytest.approx(depth)
    assert np.allclose(printed.east_north_m, [[depth * np.sin(1.0 + angle), depth * np.cos(1.0 + angle)]])
    assert np.isnan(printed.covariance_m2).all()


def with_noise(box, rng, parameters):
    """Boxes with errors of their edges as the parameters have them."""
    n, tall = len(box), box[:, 3]
    row, top = (np.hypot(sigma * tall, 0.5) for sigma in (parameters.feet_sigma, parameters.height_sigma))
    feet, height = box[:, 1] + tall + rng.normal(0, 1, n) * row, tall + rng.normal(0, 1, n) * top
    return np.stack([box[:, 0] + rng.normal(0, 1, n) * row, feet - height, box[:, 2], height], axis=1)


def erring(cam, rng):
    """The camera as it may be, where the file says this."""
    return replace(
        cam,
        heading_rad=cam.heading_rad + rng.normal(0, cam.heading_sigma_rad),
        pitch_rad=cam.pitch_rad + rng.normal(0, cam.pitch_sigma_rad),
        height_m=cam.height_m + rng.normal(0, cam.height_sigma_m),
        focal_px=tuple(np.multiply(cam.focal_px, 1 + rng.normal(0, cam.focal_sigma))),
    )


@pytest.mark.parametrize(
    ("column", "known", "sigma"),
    [
        (2, "heading_rad", "heading_sigma_rad"),
        (3, "pitch_rad", "pitch_sigma_rad"),
        (4, "height_m", "height_sigma_m"),
        (5, "focal_px", "focal_sigma"),
    ],
)
@pytest.mark.parametrize("use", ["height", "feet"])
def test_the_errors_of_the_camera_are_the_derivatives_of_the_place(column, known, sigma, use):
    cam = camera(pitch_rad=0.1, height_m=2.0, heading_rad=0.5)
    box, step, value = boxes(PEOPLE, 1.75, cam), 1e-4 * getattr(cam, sigma), getattr(cam, known)
    there, back = (
        seen(box, replace(cam, **{known: tuple(np.multiply(value, 1 + s)) if column == 5 else value + s}), use=use)
        for s in (step, -step)
    )
    slope = (there.east_north_m - back.east_north_m) / 2e-4
    assert np.allclose(seen(box, cam, use=use).camera_m[:, :, column], slope, atol=1e-5)


@pytest.mark.parametrize(
    ("use", "distance", "pitch"), [("both", 6.0, 0.0), ("both", 20.0, 0.15), ("height", 12.0, 0.15), ("feet", 8.0, 0.0)]
)
def test_95_percent_ellipses_hold_93_to_97_percent(use, distance, pitch):
    rng, cam, parameters = np.random.default_rng(4), camera(pitch_rad=pitch, heading_rad=0.7), GroundParameters()
    person, crowd = distance * np.array([[np.sin(0.9), np.cos(0.9)]]), []
    for _ in range(1500):
        tall = parameters.body_height_m + rng.normal(0, parameters.body_height_sigma_m)
        crowd.append(boxes(person, tall, erring(cam, rng), rng.normal(0, cam.position_sigma_m, 2)))
    found = seen(with_noise(np.concatenate(crowd), rng, parameters), cam, use=use)
    assert 0.93 < within_95(found.east_north_m - person, found.covariance_m2).mean() < 0.97


def test_a_person_cut_at_the_feet_has_a_bearing_and_no_place():
    box = np.array([[600.0, 700.0, 150.0, 260.0]])  # the lower edge is the picture's
    found = seen(box, camera(), cut=touches_border(box, (1280, 960)))
    assert found.by.tolist() == ["bearing"] and np.isfinite(found.bearing_rad).all()
    assert np.isnan(found.east_north_m).all() and np.isnan(found.distance_m).all()


def test_without_a_camera_height_there_is_the_body_height_alone():
    cam = camera(height_m=float("nan"))
    found = seen(boxes(PEOPLE, 1.75, camera()), cam)
    assert found.by.tolist() == ["height"] * 4
    assert np.allclose(found.east_north_m, PEOPLE) and np.isfinite(found.covariance_m2).all()
    with pytest.raises(InputError, match=r"has no height_m; ground\.use = feet needs"):
        seen(boxes(PEOPLE, 1.75, camera()), cam, use="feet")


# Calibration.


def crowd(n=40, noise=0.03, scatter=0.08):
    rng, cam = np.random.default_rng(0), camera(height_m=3.0, pitch_rad=0.1)
    people = np.stack([rng.uniform(-4, 4, n), rng.uniform(8, 30, n)], axis=1)
    box = boxes(people, rng.normal(1.75, scatter, n), cam)
    grown = box[:, 3] * rng.normal(1, noise, n)
    return np.stack([box[:, 0], box[:, 1] + box[:, 3] - grown, box[:, 2], grown], axis=1)


def test_exact_people_give_the_exact_pose():
    found = calibrate_pose(crowd(noise=0, scatter=0), camera(), 1.75, 0.05)
    assert found.height_m == pytest.approx(3.0, abs=1e-4)
    assert found.pitch_rad == pytest.approx(0.1, abs=1e-5)


def test_people_in_one_row_and_a_lens_that_shows_nothing_are_refused():
    rng = np.random.default_rng(0)
    box = np.stack([rng.uniform(0, 1000, 100), np.zeros(100), np.full(100, 40.0), rng.normal(100, 8, 100)], axis=1)
    box[:, 1] = rng.normal(500, 3, 100) - box[:, 3]
    with pytest.raises(InputError, match="too few to find the camera's pose"):
        calibrate_pose(box, camera(), 1.75, 0.05)
    with pytest.raises(InputError, match="where the lens shows nothing: check k1, k2 and k3"):
        calibrate_pose(crowd(), replace(camera(), k1=-10.0), 1.75, 0.05)


def test_an_outlier_is_named_and_not_used():
    height = np.array([180.0, 181.0, 179.0, 120.0, 180.0])
    found = calibrate_focal_length(np.full(5, 10.0), height, 1.8)
    assert found.outlier.tolist() == [False, False, False, True, False]
    assert found.focal_px == pytest.approx(1000)
    assert found.spread_px == pytest.approx(1000 * np.std([180, 181, 179, 180], ddof=1) / 180)


@pytest.mark.parametrize(
    ("distance", "height", "body", "words"),
    [
        ([], [], 1.8, "calibration needs one or more heights in pixels"),
        ([0.0], [100.0], 1.8, "a distance must be a number above 0, got 0"),
        ([5.0], [np.nan], 1.8, "a height in pixels must be a number above 0, got nan"),
        ([5.0], [100.0], -1.8, r"a body height must be a number above 0, got -1\.8"),
    ],
)
def test_what_cannot_calibrate_is_named(distance, height, body, words):
    with pytest.raises(InputError, match=words):
        calibrate_focal_length(np.array(distance), np.array(height), body)
