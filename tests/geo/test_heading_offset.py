"""How far a log's headings are off, by the way of the ground in the pictures."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import CAMERA
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo import AerialLocator, describe_heading_offset, find_heading_offset
from torchvision_dddas.geometry import axes_of, project
from torchvision_dddas.types import CameraPose, Telemetry

TIME_S = np.arange(0, 40, 0.5)
PITCH_RAD = np.radians(70.0)
PLANE_M = np.array([[-20.0, 20.0], [20.0, 20.0], [20.0, 60.0], [-20.0, 60.0]])


def flight(speed_m_s=6.0, pitch_rad=PITCH_RAD):
    """Telemetry of a flight that turns, and the registrations of its pictures."""
    course = 0.8 * np.sin(TIME_S / 6)
    place = np.cumsum(speed_m_s * 0.5 * np.stack([np.sin(course), np.cos(course)], axis=1), axis=0)
    telemetry = Telemetry(
        TIME_S, np.full(len(TIME_S), 80.0), np.full(len(TIME_S), speed_m_s), place, False,
        heading_rad=course, pitch_rad=np.full(len(TIME_S), pitch_rad), roll_rad=np.zeros(len(TIME_S)),
    )  # fmt: skip
    seen = [(0.0, np.full((3, 3), np.nan))]
    for k in range(1, len(TIME_S)):
        pixel_from_ground = []
        for j in (k - 1, k):
            pose = CameraPose(np.array([*place[j], 80.0]), axes_of(course[j], pitch_rad, 0.0))
            ground = place[k] + PLANE_M - [0.0, 20.0]
            pixels = project(np.c_[ground, np.zeros(4)], pose, CAMERA)
            pixel_from_ground.append(homography(ground, pixels))
        seen.append((TIME_S[k], pixel_from_ground[1] @ np.linalg.inv(pixel_from_ground[0])))
    return telemetry, seen


def homography(before, after):
    (x, y), (u, v), one, zero = before.T, after.T, np.ones(4), np.zeros(4)
    rows = np.r_[
        np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1),
        np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1),
    ]
    return np.linalg.svd(rows)[2][-1].reshape(3, 3)


def locator(telemetry, **values):
    return AerialLocator(CAMERA, telemetry, settings=with_parameters(Settings(), values))


@pytest.mark.parametrize("offset_deg", [-8.0, 0.0, 3.0])
@pytest.mark.parametrize("pitch_deg", [90.0, 70.0, 40.0])
def test_the_offset_of_the_headings_is_found_where_the_vehicle_flies(offset_deg, pitch_deg):
    telemetry, seen = flight(pitch_rad=np.radians(pitch_deg))
    logged = replace(telemetry, heading_rad=telemetry.heading_rad - np.radians(offset_deg))
    found = find_heading_offset(locator(logged), seen)
    assert found is not None and np.degrees(found[0]) == pytest.approx(offset_deg, abs=0.1)


def test_a_note_names_the_offset_with_its_sign_and_setting_it_ends_the_note():
    telemetry, seen = flight()
    logged = replace(telemetry, heading_rad=telemetry.heading_rad - np.radians(6.0))
    note = describe_heading_offset(locator(logged), seen)
    assert "6.0 degrees farther right" in note and "aerial.heading_offset_deg=6.0" in note
    corrected = locator(logged, **{"aerial.heading_offset_deg": 6.0})
    assert describe_heading_offset(corrected, seen) == ""
    assert corrected.telemetry_at(10.0).heading_rad == pytest.approx(telemetry.at(10.0).heading_rad)
    lower = locator(logged, **{"aerial.pitch_offset_deg": 2.0}).telemetry_at(10.0)
    assert lower.pitch_rad == pytest.approx(PITCH_RAD + np.radians(2.0))


def test_a_vehicle_that_hovers_shows_no_offset():
    telemetry, seen = flight(speed_m_s=0.0)
    logged = replace(telemetry, heading_rad=telemetry.heading_rad - np.radians(6.0))
    assert describe_heading_offset(locator(logged), seen) == ""


def test_a_heading_from_the_course_gets_no_offset():
    telemetry, seen = flight()
    followed = locator(replace(telemetry, heading_from="course"), **{"aerial.heading_offset_deg": 6.0})
    assert followed.telemetry_at(10.0).heading_rad == pytest.approx(telemetry.at(10.0).heading_rad)
    assert describe_heading_offset(followed, seen) == ""
