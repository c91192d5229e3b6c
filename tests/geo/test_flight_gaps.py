"""What a log lacks of the camera's pose comes from the camera's file, the vehicle's nose, or the course it flew."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests import airborne
from tests.airborne import look, within_95
from torchvision_dddas.config import AerialParameters, Settings, load_config
from torchvision_dddas.geo import AerialLocator
from torchvision_dddas.geo.flight_gaps import COURSE, NOSE, course_over_ground, fill_gaps
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.types import Camera, LandmarkObservations, Telemetry, Tracks

TIME = np.arange(0, 40, 0.2)
CAMERA = Camera("drone", (1280, 720), (1000.0, 1000.0), (639.5, 359.5))
PARAMETERS = AerialParameters()


def log(place=None, **said):
    """A log of a flight to the east at 5 m/s that says a height of 50 m and nothing of the camera."""
    place = np.c_[5.0 * TIME, 0 * TIME] if place is None else place
    columns: dict[str, Any] = {name: np.full(len(TIME), value) for name, value in said.items()}
    return Telemetry(TIME, columns.pop("altitude_m", np.full(len(TIME), 50.0)), 5 + 0 * TIME, place, False, **columns)


@pytest.mark.parametrize("heading_deg", [0.0, 45.0, 200.0, 359.0])
@pytest.mark.parametrize(("noise_m", "step_m"), [(0.0, 0.0), (0.5, 0.0), (0.0, 11.0)])
def test_the_course_of_a_straight_flight_is_found_within_its_sigma(heading_deg, noise_m, step_m):
    way = np.array([np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))])
    place = 8.0 * TIME[:, None] * way + np.random.default_rng(3).normal(0, noise_m, (len(TIME), 2))
    place = np.round(place / step_m) * step_m if step_m else place
    course, sigma = course_over_ground(TIME, place)
    known = np.isfinite(course)
    assert known.mean() > (0.5 if step_m else 0.95)
    off = (np.degrees(course[known]) - heading_deg + 180) % 360 - 180
    assert np.abs(off).max() < (12.0 if step_m else 15.0) and np.median(np.abs(off)) < 5.0
    assert np.degrees(sigma[known]).max() <= 5.0


def test_a_vehicle_that_hovers_or_turns_has_no_course():
    rng = np.random.default_rng(0)
    hovering = np.cumsum(rng.normal(0, 0.05, (len(TIME), 2)), axis=0)
    turn = TIME * np.radians(20.0)
    turning = 15.0 * np.c_[np.sin(turn), np.cos(turn)]
    for place in (hovering, turning):
        assert np.isnan(course_over_ground(TIME, place)[0]).all()


def test_a_log_without_a_heading_takes_the_file_then_the_nose_then_the_course():
    given = replace(CAMERA, heading_rad=np.radians(30.0), given=frozenset({"heading_rad"}))
    nose = log(vehicle_heading_rad=np.radians(100.0))
    for telemetry, camera, heading_deg, source in (
        (nose, given, 30.0, ""),
        (nose, CAMERA, 100.0, NOSE),
        (log(), None, 90.0, COURSE),
        (log(heading_rad=np.radians(77.0), vehicle_heading_rad=0.1), given, 77.0, ""),
    ):
        filled, notes = fill_gaps(telemetry, camera, PARAMETERS)
        middle = filled.at(20.0)
        assert middle is not None
        assert np.degrees(middle.heading_rad) == pytest.approx(heading_deg, abs=0.1)
        assert middle.heading_from == source
        if source:
            assert np.degrees(middle.heading_sigma_rad) == pytest.approx(10.0, abs=0.5)
            assert any("sigma of 10 degrees" in note for note in notes)
    assert "camera drone: heading_deg not used for the camera's pose, because the log says it" in notes
    with_landmarks, _ = fill_gaps(log(), None, PARAMETERS, has_landmarks=True)
    assert np.isnan(with_landmarks.heading_rad).all()


def test_heights_above_the_sea_are_counted_from_the_take_off_of_the_cameras_file():
    above_sea = log(altitude_m=np.nan, above_sea_m=1350.0)
    started = replace(CAMERA, takeoff_above_sea_m=1300.0)
    assert fill_gaps(above_sea, started, PARAMETERS)[0].altitude_m[0] == 50.0
    # The ground's heights, where they are known, are better.
    assert np.isnan(fill_gaps(above_sea, started, PARAMETERS, has_ground=True)[0].altitude_m[0])


@pytest.mark.parametrize("has_ground", [False, True])
@pytest.mark.parametrize(
    ("height_m", "takeoff_m", "altitude_m"), [(1350.0, 1300.0, 50.0), (35.0, 1300.0, 35.0), (35.0, 0.0, 35.0)]
)
def test_heights_of_unknown_zero_count_from_the_take_off_where_they_would_lie_below_it(
    height_m, takeoff_m, altitude_m, has_ground
):
    unknown = replace(log(altitude_m=np.nan, above_sea_m=height_m), height_zero="unknown")
    started = replace(CAMERA, takeoff_above_sea_m=takeoff_m, given=frozenset({"takeoff_above_sea_m"}))
    filled, notes = fill_gaps(unknown, started, PARAMETERS, has_ground)
    assert filled.altitude_m[0] == altitude_m
    assert bool([note for note in notes if "count from the take-off point" in note]) == (height_m == altitude_m)


@pytest.mark.parametrize(
    ("heights", "unused"),
    [
        (
            {"above_sea_m": 1350.0},
            "height_m, takeoff_above_sea_m not used for the camera's pose, because the height above ground is known",
        ),
        (
            {"altitude_m": np.nan, "above_sea_m": 1350.0},
            "height_m not used for the camera's pose, because the height above ground is known",
        ),
        (
            {"altitude_m": np.nan},
            "takeoff_above_sea_m not used for the camera's pose, because the log gives no height above the sea",
        ),
    ],
)
def test_why_a_height_of_the_cameras_file_is_not_used_is_said(heights, unused):
    keys = frozenset({"height_m", "takeoff_above_sea_m"})
    _, notes = fill_gaps(
        log(**heights), replace(CAMERA, height_m=40.0, takeoff_above_sea_m=1300.0, given=keys), PARAMETERS
    )
    assert [note for note in notes if unused in note] and not [note for note in notes if "the log says it" in note]
    high = replace(CAMERA, height_m=60.0, height_sigma_m=2.0, given=frozenset({"height_m", "height_sigma_m"}))
    filled, _ = fill_gaps(log(altitude_m=np.nan), high, PARAMETERS)
    assert (filled.altitude_m[0], filled.altitude_sigma_m[0]) == (60.0, 2.0)


def one_box(camera, telemetry, **parameters):
    """Where a box in the picture's middle is located, and the fix."""
    settings = Settings(aerial=AerialParameters(point="centre", **parameters))
    track = Tracks(1, np.array([1]), np.array([[634.5, 354.5, 11, 11.0]]), np.ones(1), np.zeros(1, np.int64))
    return AerialLocator(camera, telemetry, settings=settings, size_px=(1280, 720)).locate(track)


def test_the_class_locates_by_telemetry_and_the_cameras_angles_and_says_what_the_heading_is_from():
    angled = replace(CAMERA, pitch_rad=np.pi / 4)
    found = one_box(angled, log())
    assert found.fix.by == "telemetry"
    assert found.fix.cause == "heading from the course over ground, sigma 10 degrees"
    np.testing.assert_allclose(found.positions.east_north_m, [[50.0, 0.0]], atol=0.5)
    sharp = replace(angled, heading_rad=np.pi / 2, heading_sigma_rad=np.radians(1.0), pitch_sigma_rad=np.radians(0.1))
    sharper = one_box(sharp, log())
    assert sharper.fix.cause == ""
    # Across the view a degree of heading at 50 m, along it the height and the receiver.
    spread = np.sqrt(sharper.relative_m2[0].diagonal())
    assert spread[1] == pytest.approx(np.hypot(50 * np.radians(1.0), 1.43), rel=0.1)
    assert np.sqrt(found.relative_m2[0].diagonal())[1] > 5 * np.sqrt(spread[1])


@pytest.mark.parametrize(
    ("camera", "telemetry", "missing"),
    [
        (CAMERA, log(), "pitch; add the column pitch_deg to a CSV of it, or give pitch_deg in"),
        (
            replace(CAMERA, pitch_rad=0.7),
            log(altitude_m=np.nan),
            "altitude; add the column altitude_m to a CSV of it, or give height_m or takeoff_above_sea_m",
        ),
        (replace(CAMERA, pitch_rad=0.7), log(np.zeros((len(TIME), 2))), "heading; add the column heading_deg"),
    ],
)
def test_what_is_lacking_for_a_place_is_named_with_the_column_and_the_key_that_help(camera, telemetry, missing):
    found = one_box(camera, telemetry)
    assert found.fix.by == "" and not len(found.positions)
    assert f"does not say the camera's {missing}" in found.fix.cause


@pytest.mark.parametrize("pitch_deg", [3.0, 0.0, -10.0])
def test_what_lies_above_the_horizon_or_too_near_it_has_no_place(pitch_deg):
    assert not len(one_box(CAMERA, log(heading_rad=0.0, pitch_rad=np.radians(pitch_deg))).positions)
    assert len(one_box(CAMERA, log(heading_rad=0.0, pitch_rad=np.radians(20.0))).positions)


def test_the_shipped_errors_of_rtk_are_smaller_and_of_cheap_logs_larger():
    rtk, usual, cheap = (load_config(name).aerial for name in ("rtk", None, "cheap"))
    for name in ("position_sigma_m", "altitude_sigma", "tilt_sigma_deg", "heading_sigma_deg", "focal_sigma"):
        assert getattr(rtk, name) < getattr(usual, name) < getattr(cheap, name)
    both = load_config("fast,rtk")
    assert both.aerial == rtk and not both.refine.on


@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
def test_ellipses_of_telemetry_alone_hold_95_percent_of_the_truth(tilt_deg):
    held = []
    for seed in range(300):
        seen = look(seed, tilt_deg=tilt_deg)
        georeferencer = Georeferencer(airborne.CAMERA, Settings(), load_solver("onboard"))
        fix = georeferencer.update(1, 0.0, seen.flight, LandmarkObservations())
        place, covariance = locate_pixels(fix, airborne.CAMERA, seen.targets_px, 1.0)
        held.append(within_95(place - seen.targets, covariance))
    assert fix.by == "telemetry" and 0.92 < np.mean(held) < 0.98
