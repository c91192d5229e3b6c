"""Crowds, speeds and shadows: what is derived for targets seen from the air."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.geo.aerial_targets import (
    _ACCELERATION_M_S2,
    BODY_WIDTH_M,
    TargetSpeeds,
    remove_shadow,
    shadow_m,
    sun_at,
)
from torchvision_dddas.geo.landmark_watch import group_targets, merge_detections
from torchvision_dddas.geometry import middles_of
from torchvision_dddas.lab.simulation.cameras import camera_axes, view_from_pose
from torchvision_dddas.types import Camera, CameraPose, Detections

NAN = np.nan


@pytest.mark.parametrize(
    ("place", "velocity", "reach", "crowds"),
    [
        ([[0, 0], [4, 0], [8, 0], [30, 0]], 0, 2.0, [0, 0, 0, 1]),  # a chain, and one far off
        ([[0, 0], [1, 0]], [[1, 0], [6, 0]], 3.0, [0, 1]),  # a car that passes
        ([[0, 0], [1, 0]], [[1, 0], [NAN, NAN]], 3.0, [0, 0]),  # whose way nobody knows goes with all
        ([[0, 0], [NAN, NAN], [NAN, NAN]], 0, 100.0, [0, 1, 2]),
        ([], 0, 1.0, []),
    ],
)
def test_near_targets_that_go_the_same_way_are_one_crowd(place, velocity, reach, crowds):
    at = np.array(place, float).reshape(-1, 2)
    way = np.broadcast_to(np.array(velocity, float), at.shape)
    assert group_targets(at, np.ones(len(at)), way, reach, 1.5).tolist() == crowds


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), min_size=1, max_size=12), st.randoms())
def test_crowds_do_not_depend_on_the_order_of_targets(places, chance):
    place = np.array(places, float)
    order = list(range(len(place)))
    chance.shuffle(order)
    ones, still = np.ones(len(place)), np.zeros((len(place), 2))
    crowd, shuffled = (group_targets(p, ones, still, 2.0, 1.0) for p in (place, place[order]))
    same = crowd[:, None] == crowd[None]
    assert (same[np.ix_(order, order)] == (shuffled[:, None] == shuffled[None])).all()


def test_a_crowd_has_the_box_area_score_class_and_mean_motion_of_its_parts():
    mask = np.zeros((20, 30), np.uint16)
    mask[2:6, 3:7], mask[10:12, 20:28], mask[3:5, 9:11] = 1, 2, 3
    boxes = np.array([[3.0, 2, 4, 4], [20, 10, 8, 2], [9, 3, 2, 2]])
    heading, speed = np.array([0.0, np.nan, np.pi / 2]), np.array([2.0, np.nan, 2.0])
    found = Detections(boxes, np.array([0.5, 0.7, 0.9]), np.array([16.0, 16, 4]), heading, speed)
    label, number = np.array(["man", "car", "man"], object), np.array([0, 2, 0])
    found = replace(found, middle_px=middles_of(found.box_px, mask), label=label, class_id=number)
    crowds, numbered = merge_detections(found, mask, np.array([0, 1, 0]))
    assert crowds.box_px.tolist() == [[3, 2, 8, 4], [20, 10, 8, 2]]
    assert (crowds.score.tolist(), crowds.area_px.tolist()) == ([0.9, 0.7], [20, 16])
    assert (crowds.label.tolist(), crowds.class_id.tolist()) == (["man", "car"], [0, 2])
    assert crowds.middle_px[0] == pytest.approx([(16 * 4.5 + 4 * 9.5) / 20, 3.5])
    # Four fifths of it go right at 2 px a frame, one fifth down.
    assert crowds.speed_px == pytest.approx([np.hypot(1.6, 0.4), np.nan], nan_ok=True)
    assert crowds.heading_rad[0] == pytest.approx(np.arctan2(0.4, 1.6))
    assert np.array_equal(numbered, np.choose(mask, [0, 1, 2, 1]))


def fed(places, times, movers=None):
    """The velocities, one a place."""
    movers, exact = movers or TargetSpeeds(), 1e-4 * np.eye(2)[None]
    looks = zip(times, np.asarray(places, float), strict=True)
    return np.array([movers.update(t, np.array([1]), place[None], exact)[0] for t, place in looks])


def test_a_steady_target_has_its_own_velocity_and_one_that_comes_back_after_long_begins_anew():
    times, movers = np.arange(20) / 10, TargetSpeeds()
    found = fed(np.outer(times, [1.5, -0.5]), times, movers)
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[-1], [1.5, -0.5], atol=0.01)
    assert np.isnan(fed([[500.0, 0.0]], [60.0], movers)).all()


def test_the_errors_of_velocities_are_as_large_as_their_covariance_says():
    n, lapse, sigma_m, rng = 400, 0.1, 0.3, np.random.default_rng(3)
    identity, movers = np.arange(1, n + 1), TargetSpeeds()
    place, velocity = rng.normal(0, 50, (n, 2)), rng.normal(0, 2, (n, 2))
    for k in range(60):
        found = movers.update(
            k * lapse, identity, place + rng.normal(0, sigma_m, (n, 2)), sigma_m**2 * np.eye(2)[None].repeat(n, 0)
        )
        covariance = movers.covariance_of(identity)
        assert np.array_equal(np.isnan(found).any(axis=1), np.isnan(covariance).any(axis=(1, 2)))
        off = found - velocity
        place = place + lapse * velocity
        velocity = velocity + rng.normal(0, _ACCELERATION_M_S2 * np.sqrt(lapse), (n, 2))
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    assert squared.mean() == pytest.approx(2, abs=0.4)  # its standard deviation is 0.1
    assert np.isnan(movers.covariance_of(np.array([-1, n + 1]))).all()


CAMERA = Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5))


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


@pytest.mark.parametrize("pitch_deg", [90.0, 45.0])
def test_the_feet_of_a_strip_of_body_and_one_of_shadow_are_found_from_the_mean_of_their_pixels(pitch_deg):
    axes, height = camera_axes(0.0, np.radians(pitch_deg), 0.0), 1.7
    pose = CameraPose(axes[:, 2] * 50 / axes[2, 2], axes)
    view, foot = view_from_pose(pose, CAMERA), np.array([6.0, 4.0, 0.0])
    shade = np.append(shadow_m((np.radians(140.0), np.radians(50.0)), height), 0.0)
    share = np.linspace(0, 1, 2001)[:, None]
    body, cast = view.project(foot + share * (0, 0, height)), view.project(foot + share * shade)
    start, side = view.project(foot + np.array([[0, 0, 0], [BODY_WIDTH_M, 0, 0]]))
    lengths = [np.hypot(*np.linalg.norm([body[-1] - start, side - start], axis=1)), np.linalg.norm(cast[-1] - start)]
    middle = np.average([body.mean(axis=0), cast.mean(axis=0)], axis=0, weights=lengths)
    found = remove_shadow(middle[None], foot[None], pose, CAMERA, height, shade[:2])
    # Without a shadow it is the body's middle that counts, half its height up.
    alone = remove_shadow(body.mean(axis=0)[None], foot[None], pose, CAMERA, height, np.zeros(2))
    assert np.abs(found[0] - start).max() < 0.1 and np.abs(alone[0] - start).max() < 0.1
