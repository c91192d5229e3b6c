"""Where the sun stands, and where the feet are of bodies that are seen together with their shadows."""

from datetime import UTC, datetime

import numpy as np
import pytest

from torchvision_dddas.geo.aerial_targets import BODY_WIDTH_M, remove_shadow, shadow_m, sun_at
from torchvision_dddas.simulation.drawing import camera_axes, view_from_pose
from torchvision_dddas.types import Camera, CameraPose

CAMERA = Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5))
SUN = np.radians(140.0), np.radians(50.0)


def test_the_sun_stands_where_the_reference_algorithm_has_it():
    """NREL/TP-560-34302 (SPA), appendix A.5: azimuth 194.340 deg, zenith 50.112 deg with 0.016 deg of refraction."""
    when = datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC).timestamp()
    azimuth, height = sun_at(-105.1786, 39.742476, when)
    assert np.degrees(azimuth) == pytest.approx(194.340, abs=0.02)
    assert np.degrees(height) == pytest.approx(90 - 50.112 - 0.016, abs=0.02)


def test_shadows_fall_away_from_the_sun_as_long_as_it_is_low_and_are_not_counted_on_near_the_horizon():
    east, north = shadow_m((np.radians(90.0), np.radians(45.0)), 2.0)
    assert (east, north) == pytest.approx((-2.0, 0.0), abs=1e-12)
    assert np.hypot(*shadow_m((0.0, np.radians(30.0)), 1.0)) == pytest.approx(np.sqrt(3))
    assert shadow_m((1.0, np.radians(5.0)), 1.7).tolist() == [0, 0]


@pytest.mark.parametrize("pitch_deg", [90.0, 60.0, 45.0])
def test_the_feet_of_a_strip_of_body_and_one_of_shadow_are_found_from_the_mean_of_their_pixels(pitch_deg):
    pitch = np.radians(pitch_deg)
    back = 50 / np.tan(pitch) if pitch_deg < 90 else 0.0
    pose = CameraPose(np.array([0.0, -back, 50.0]), camera_axes(0.0, pitch, 0.0))
    view, height = view_from_pose(pose, CAMERA), 1.7
    foot, shade = np.array([6.0, 4.0, 0.0]), np.append(shadow_m(SUN, height), 0.0)
    share = np.linspace(0, 1, 2001)[:, None]
    body, cast = view.project(foot + share * (0, 0, height)), view.project(foot + share * shade)
    start = view.project(foot[None])[0]
    lengths = [np.linalg.norm(strip[-1] - start) for strip in (body, cast)]
    width = np.linalg.norm(view.project(foot[None] + (BODY_WIDTH_M, 0, 0))[0] - start)
    lengths[0] = np.hypot(lengths[0], width)
    middle = np.average([body.mean(axis=0), cast.mean(axis=0)], axis=0, weights=lengths)
    found = remove_shadow(middle[None], foot[None], pose, CAMERA, height, shade[:2])
    assert np.abs(found[0] - start).max() < 0.1
    # Without a shadow it is the body's middle that counts, half its height up.
    alone = remove_shadow(body.mean(axis=0)[None], foot[None], pose, CAMERA, height, np.zeros(2))
    assert np.abs(alone[0] - start).max() < 0.1
