"""Times at which a log and the pictures contradict each other."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo import AerialLocator, describe_contradictions, find_contradictions
from torchvision_dddas.geometry import axes_of, ground_with_slopes, project, surface_of
from torchvision_dddas.types import Camera, CameraPose, Telemetry

CAMERA = Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5))
LENGTH_S, RATE_HZ = 40.0, 10.0
BEGIN_S, END_S = 18.0, 33.0


def fly(speed_m_s=6.0, down_deg=60.0, turn_deg=8.0):
    """A log of an oblique camera that flies and turns to and fro, and its true pixel homographies."""
    time_s = np.arange(0, LENGTH_S, 1 / RATE_HZ)
    heading = 1.0 + np.radians(turn_deg) * np.sin(time_s / 4)
    return record(time_s, np.c_[speed_m_s * time_s, np.sin(time_s / 3)], np.full(len(time_s), 60.0), heading, down_deg)


def record(time_s, place, height, heading, down_deg):
    """The log and the true pixel homographies of a flight over level ground."""
    pitch, roll = np.full(len(time_s), np.radians(down_deg)), np.zeros(len(time_s))
    telemetry = Telemetry(
        time_s, height, np.zeros(len(time_s)), place, False,
        heading_rad=heading % (2 * np.pi), pitch_rad=pitch, roll_rad=roll,
    )  # fmt: skip
    axes = axes_of(heading, pitch, roll)
    poses = [CameraPose(np.array([*at, up]), turn) for at, up, turn in zip(place, height, axes, strict=True)]
    motions = [np.full((3, 3), np.nan)]
    for before, now in pairwise(poses):
        corners = CAMERA.centre_px + np.array([[-60, -60], [60, -60], [60, 60], [-60, 60]])
        ground = ground_with_slopes(before, CAMERA, corners, 0.0, surface_of(None))[0]
        seen = project(np.c_[ground, np.zeros(4)], now, CAMERA)
        motions.append(cv2.findHomography(corners, seen)[0])
    return telemetry, list(zip(time_s.tolist(), motions, strict=True))


def contradictions(telemetry, seen, **changes):
    settings = with_parameters(Settings(), changes)
    return find_contradictions(AerialLocator(CAMERA, telemetry, None, settings=settings, rate_hz=RATE_HZ), seen)


def during(log):
    return (log.time_s >= BEGIN_S) & (log.time_s < END_S)


def stick(log, *names):
    """The log with columns that repeat their value while the fault lasts."""
    rows = np.where(during(log), np.searchsorted(log.time_s, BEGIN_S), np.arange(len(log)))
    return replace(log, **{name: getattr(log, name)[rows] for name in names})


def test_a_log_that_agrees_with_its_pictures_is_not_contradicted_within_what_is_usually_wrong():
    log, seen = fly()
    noise = np.random.default_rng(0).normal(0, 1.43, log.place.shape)
    usual = {
        "exact": log,
        "noise of a GPS": replace(log, place=log.place + noise),
        "late": replace(log, time_s=log.time_s + 0.8),
        "early": replace(log, time_s=log.time_s - 0.8),
        "too low": replace(log, altitude_m=log.altitude_m * 0.6),
        "too high": replace(log, altitude_m=log.altitude_m * 1.6),
        "one report a second": log[:: round(RATE_HZ)],
    }
    assert {name: contradictions(one, seen) for name, one in usual.items()} == {name: [] for name in usual}
    longer = replace(CAMERA, focal_px=(900.0, 900.0))
    assert find_contradictions(AerialLocator(longer, log, None, rate_hz=RATE_HZ), seen) == []


def test_flights_in_which_turn_and_shift_cancel_allow_a_wrong_height_too():
    time_s = np.arange(0, LENGTH_S, 1 / RATE_HZ)
    around = 0.2 * time_s
    place = 40 * np.c_[np.sin(around), np.cos(around)]
    log, seen = record(time_s, place, np.full(len(time_s), 40.0), around + np.pi, 45.0)
    for scale in (0.75, 1.0, 1.3):
        assert contradictions(replace(log, altitude_m=scale * log.altitude_m), seen) == []


@pytest.mark.parametrize("every", [1, 5, 10, 20, 50])
def test_a_quick_turn_agrees_with_a_slow_log_and_with_one_that_has_a_gap(every):
    time_s = np.arange(0, LENGTH_S, 1 / RATE_HZ)
    heading = np.radians(np.clip(30 * (time_s - 15), 0, 240))
    log, seen = record(time_s, np.zeros((len(time_s), 2)), np.full(len(time_s), 40.0), heading, 45.0)
    assert contradictions(log[::every], seen) == []
    assert contradictions(log[(time_s < 14) | (time_s > 19)], seen) == []


def test_the_drift_of_a_place_is_no_contradiction_on_the_ground_and_at_take_off():
    time_s = np.arange(0, LENGTH_S, 1 / RATE_HZ)
    height = np.clip(0.1 + 3 * (time_s - 15), 0.1, 50)
    log, seen = record(time_s, np.zeros((len(time_s), 2)), height, np.zeros(len(time_s)), 88.0)
    drift = np.c_[np.sin(time_s / 4), np.cos(time_s / 5)]
    assert contradictions(replace(log, place=drift), seen) == []


def test_the_error_that_a_log_states_is_allowed():
    log, seen = fly()
    wander = 4 * np.c_[np.sin(log.time_s), np.cos(log.time_s)]
    wandering = replace(log, place=log.place + wander)
    assert contradictions(replace(wandering, altitude_m=log.altitude_m / 4), seen)
    stated = replace(wandering, position_sigma_m=np.full(len(log), 5.0))
    assert contradictions(stated, seen) == []


@pytest.mark.parametrize("late_s", [3.0, -5.0])
def test_a_clock_that_is_wrong_is_no_stuck_sensor(late_s):
    log, seen = fly(turn_deg=40.0)
    assert contradictions(replace(log, time_s=log.time_s + late_s), seen) == []


@pytest.mark.parametrize("down_deg", [40.0, 60.0, 88.0])
def test_a_stuck_place_is_found_while_the_vehicle_flies(down_deg):
    log, seen = fly(down_deg=down_deg)
    found = contradictions(stick(log, "place"), [one for one in seen if one[0] < END_S - 1.5])
    assert len(found) == 1 and abs(found[0].begin_s - BEGIN_S) < 3
    assert found[0].end_s == pytest.approx(END_S - 1.5, abs=1)
    assert found[0].seen_deg > 2 * found[0].logged_deg and not found[0].leaps


def test_a_leap_of_places_or_angles_lasts_until_the_leap_back():
    log, seen = fly(speed_m_s=0.0, down_deg=88.0, turn_deg=1.0)
    place, heading = log.place.copy(), log.heading_rad.copy()
    place[during(log)] += [0.0, 110.0]
    heading[during(log)] += np.radians(30.0)
    for wrong in (replace(log, place=place), replace(log, heading_rad=heading % (2 * np.pi))):
        (found,) = contradictions(wrong, seen)
        assert found.leaps and (found.begin_s, found.end_s) == (
            pytest.approx(BEGIN_S, abs=0.5), pytest.approx(END_S, abs=0.5)
        )  # fmt: skip
        assert found.logged_deg > 20 and found.seen_deg < 2


def test_angles_that_are_stuck_while_the_camera_turns_are_found():
    log, seen = fly(turn_deg=40.0)
    found = contradictions(stick(log, "heading_rad", "pitch_rad", "roll_rad"), seen)
    assert found and BEGIN_S - 2 < found[0].begin_s < END_S


def test_what_cannot_be_compared_is_not_judged():
    log, seen = fly()
    wrong = stick(log, "place")
    assert contradictions(wrong, seen)
    nose = replace(wrong, heading_rad=np.full(len(log), np.nan), vehicle_heading_rad=log.heading_rad)
    zooming = replace(wrong, hfov_rad=np.linspace(1.0, 0.5, len(log)))
    without_roll = replace(wrong, roll_rad=np.full(len(log), np.nan))
    unknown = [(time_s, np.full((3, 3), np.nan)) for time_s, _ in seen]
    for one, motions in ((nose, seen), (zooming, seen), (without_roll, seen), (wrong, unknown), (wrong, [])):
        assert contradictions(one, motions) == []
    assert contradictions(wrong, seen[:1]) == contradictions(wrong[:1], seen) == []


def test_a_note_names_the_time_and_both_turns():
    log, seen = fly()
    locator = AerialLocator(CAMERA, stick(log, "place"), None, rate_hz=RATE_HZ)
    said = describe_contradictions(locator, seen)
    assert said.startswith("log and pictures contradict each other from 1")
    assert "the log moves less than the pictures: a sensor is stuck" in said and "in the pictures, and by 0 m" in said
    assert describe_contradictions(AerialLocator(CAMERA, log, None, rate_hz=RATE_HZ), seen) == ""
