"""Crowds, speeds and shadows: what is derived for targets seen from the air."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.geo.aerial_targets import BODY_WIDTH_M, TargetSpeeds, remove_shadow, shadow_m, sun_at
from torchvision_dddas.geo.landmark_watch import group_targets, merge_detections
from torchvision_dddas.geometry import middles_of
from torchvision_dddas.simulation.cameras import camera_axes, view_from_pose
from torchvision_dddas.types import Camera, CameraPose, Detections

STILL = np.zeros((3, 2))


def test_a_chain_of_near_targets_is_one_crowd_and_a_far_one_is_another():
    place = np.array([[0.0, 0], [4, 0], [8, 0], [30, 0]])
    assert group_targets(place, np.full(4, 1.0), np.zeros((4, 2)), 2.0, 1.5).tolist() == [0, 0, 0, 1]


def test_a_car_that_passes_a_crowd_is_none_of_it():
    place, velocity = np.array([[0.0, 0], [1, 0]]), np.array([[1.0, 0], [6, 0]])
    assert group_targets(place, np.ones(2), velocity, 3.0, 1.5).tolist() == [0, 1]
    velocity[1] = np.nan  # whose way nobody knows goes with all
    assert group_targets(place, np.ones(2), velocity, 3.0, 1.5).tolist() == [0, 0]


def test_targets_of_unknown_place_stay_alone():
    place = np.array([[0.0, 0], [np.nan, np.nan], [np.nan, np.nan]])
    assert group_targets(place, np.ones(3), STILL, 100.0, 1.5).tolist() == [0, 1, 2]
    assert group_targets(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)), 1.0, 1.0).tolist() == []


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), min_size=1, max_size=12), st.randoms())
def test_crowds_do_not_depend_on_the_order_of_targets(places, chance):
    place = np.array(places, float)
    order = list(range(len(place)))
    chance.shuffle(order)
    ones, still = np.ones(len(place)), np.zeros((len(place), 2))
    crowd, shuffled = (group_targets(p, ones, still, 2.0, 1.0) for p in (place, place[order]))
    same = crowd[:, None] == crowd[None]
    assert (same[np.ix_(order, order)] == (shuffled[:, None] == shuffled[None])).all()


def test_a_crowd_has_the_box_area_score_and_mean_motion_of_its_parts():
    mask = np.zeros((20, 30), np.uint16)
    mask[2:6, 3:7], mask[10:12, 20:28], mask[3:5, 9:11] = 1, 2, 3
    boxes = np.array([[3.0, 2, 4, 4], [20, 10, 8, 2], [9, 3, 2, 2]])
    heading, speed = np.array([0.0, np.nan, np.pi / 2]), np.array([2.0, np.nan, 2.0])
    found = Detections(boxes, np.array([0.5, 0.7, 0.9]), np.array([16.0, 16, 4]), heading, speed)
    found = replace(found, middle_px=middles_of(found.box_px, mask))
    crowds, numbered = merge_detections(found, mask, np.array([0, 1, 0]))
    assert crowds.box_px.tolist() == [[3, 2, 8, 4], [20, 10, 8, 2]]
    assert crowds.score.tolist() == [0.9, 0.7]
    assert crowds.area_px.tolist() == [20, 16]
    assert crowds.middle_px[0] == pytest.approx([(16 * 4.5 + 4 * 9.5) / 20, 3.5])
    # Four fifths of it go right at 2 px a frame, one fifth down.
    assert crowds.speed_px[0] == pytest.approx(np.hypot(1.6, 0.4))
    assert crowds.heading_rad[0] == pytest.approx(np.arctan2(0.4, 1.6))
    assert np.isnan(crowds.speed_px[1])
    assert sorted(np.unique(numbered)) == [0, 1, 2]
    assert (numbered == 1).sum() == 20
    assert (numbered > 0).sum() == (mask > 0).sum()


EXACT = 1e-4 * np.eye(2)[None]


def fed(places, times, covariance=EXACT, identity=1, movers=None):
    """The velocities, one a place."""
    movers = movers or TargetSpeeds()
    return np.array(
        [
            movers.update(t, np.array([identity]), np.array([p], float), covariance)[0]
            for t, p in zip(times, places, strict=True)
        ]
    )


def test_a_steady_target_has_its_own_velocity():
    times = np.arange(20) / 10
    found = fed(np.outer(times, [1.5, -0.5]), times)
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[-1], [1.5, -0.5], atol=0.01)


def test_a_target_that_comes_back_after_long_begins_anew():
    movers = TargetSpeeds()
    fed(np.outer(np.arange(10) / 10, [3.0, 0.0]), np.arange(10) / 10, movers=movers)
    assert np.isnan(fed([[500.0, 0.0]], [60.0], movers=movers)).all()


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
