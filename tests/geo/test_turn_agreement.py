"""Times at which a log and the pictures contradict each other."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo import AerialLocator, describe_contradictions, find_contradictions
from torchvision_dddas.geometry.projection import axes_of, project
from torchvision_dddas.types import Camera, CameraPose, Telemetry

CAMERA = Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5))
LENGTH_S, RATE_HZ = 40.0, 10.0
BEGIN_S, END_S = 18.0, 33.0


def fly(speed_m_s=6.0, down_deg=60.0, turn_deg=8.0):
    """A log of an oblique camera that flies and turns to and fro, and its true pixel homographies."""
    time_s = np.arange(0, LENGTH_S, 1 / RATE_HZ)
    heading = 1.0 + np.radians(turn_deg) * np.sin(time_s / 4)
    pitch, roll = np.full(len(time_s), np.radians(down_deg)), np.zeros(len(time_s))
    place = np.c_[speed_m_s * time_s, np.sin(time_s / 3)]
    telemetry = Telemetry(
        time_s, np.full(len(time_s), 60.0), np.full(len(time_s), speed_m_s), place, False,
        heading_rad=heading % (2 * np.pi), pitch_rad=pitch, roll_rad=roll,
    )  # fmt: skip
    poses = [
        CameraPose(np.array([*place[k], 60.0]), axes_of(heading[k], pitch[k], roll[k])) for k in range(len(time_s))
    ]
    corners = np.array([[-20.0, 20], [20, 20], [20, 60], [-20, 60]])
    motions = [np.full((3, 3), np.nan)]
    for k in range(1, len(poses)):
        ahead = np.array([np.sin(heading[k]), np.cos(heading[k])])
        ground = np.c_[place[k] + np.c_[corners[:, 1], corners[:, 1]] * ahead + corners * 0.3, np.zeros(4)]
        seen = [project(ground, pose, CAMERA) for pose in poses[k - 1 : k + 1]]
        motions.append(cv2.findHomography(seen[0], seen[1])[0])
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


@pytest.mark.parametrize("down_deg", [40.0, 60.0, 88.0])
def test_a_stuck_place_is_found_while_the_vehicle_flies(down_deg):
    log, seen = fly(down_deg=down_deg)
    found = contradictions(stick(log, "place"), [one for one in seen if one[0] < END_S - 1.5])
    assert found and BEGIN_S < found[0].begin_s < BEGIN_S + 11
    assert found[0].seen_deg > 2 * found[0].logged_deg


def test_a_leap_of_places_or_angles_is_found_on_a_hovering_vehicle():
    log, seen = fly(speed_m_s=0.0, down_deg=88.0, turn_deg=1.0)
    place, heading = log.place.copy(), log.heading_rad.copy()
    place[during(log)] += [0.0, 110.0]
    heading[during(log)] += np.radians(30.0)
    for wrong in (replace(log, place=place), replace(log, heading_rad=heading % (2 * np.pi))):
        found = contradictions(wrong, seen)
        assert found and BEGIN_S < found[0].begin_s < BEGIN_S + 3
        assert found[0].logged_deg > 20 and found[0].seen_deg < 2


def test_angles_that_are_stuck_while_the_camera_turns_are_found():
    log, seen = fly(turn_deg=40.0)
    found = contradictions(stick(log, "heading_rad", "pitch_rad", "roll_rad"), seen)
    assert found and BEGIN_S < found[0].begin_s < END_S


def test_what_cannot_be_compared_is_not_judged():
    log, seen = fly()
    wrong = stick(log, "place")
    assert contradictions(wrong, seen)
    nose = replace(wrong, heading_rad=np.full(len(log), np.nan), vehicle_heading_rad=log.heading_rad)
    zooming = replace(wrong, hfov_rad=np.linspace(1.0, 0.5, len(log)))
    unknown = [(time_s, np.full((3, 3), np.nan)) for time_s, _ in seen]
    assert [contradictions(*given) for given in ((nose, seen), (zooming, seen), (wrong, unknown), (wrong, []))] == [
        []
    ] * 4
    assert contradictions(wrong, seen[:1]) == contradictions(wrong[:1], seen) == []


def test_a_note_names_the_time_and_both_turns():
    log, seen = fly()
    locator = AerialLocator(CAMERA, stick(log, "place"), None, rate_hz=RATE_HZ)
    said = describe_contradictions(locator, seen)
    assert said.startswith("log and pictures contradict each other from ")
    assert "degrees in the pictures" in said and "a sensor may be stuck" in said
    assert describe_contradictions(AerialLocator(CAMERA, log, None, rate_hz=RATE_HZ), seen) == ""
