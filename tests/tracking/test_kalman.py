"""The Kalman filter of targets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import GG, GROWTH, HEIGHT, PP, PV, SEEN, SG, SS, VV, VX, VY, WIDTH, X, Y

FOCAL = 800.0
PEOPLE = np.array([[-2.0, 1.5, 12.0], [1.0, 1.6, 20.0], [3.0, 1.4, 9.0]])  # metres: right, down, ahead
STEPS = np.array([[0.05, 0.0, -0.1], [-0.08, 0.0, 0.06], [0.06, 0.01, 0.0]])  # metres a frame
AGILITY, SCATTER = 0.009, 0.06


def filmed(frame: float) -> np.ndarray:
    """(3, 4) boxes of people 1.7 m tall who walk straight on in front of a camera that stands still."""
    x, y, depth = (PEOPLE + frame * STEPS).T
    width, height = FOCAL * 0.6 / depth, FOCAL * 1.7 / depth
    return np.stack([FOCAL * x / depth - width / 2, FOCAL * y / depth - height / 2, width, height], axis=1)


def centres(box_px: np.ndarray) -> np.ndarray:
    return box_px[:, :2] + box_px[:, 2:] / 2


def known(frame: int) -> np.ndarray:
    """States at a frame with the true velocity and growth."""
    state = kalman.start(filmed(frame), frame, SCATTER, 0.07)
    e = 1e-4
    state[:, [VX, VY]] = (centres(filmed(frame + e)) - centres(filmed(frame - e))) / (2 * e)
    depth = (PEOPLE + frame * STEPS)[:, 2]
    state[:, GROWTH] = -STEPS[:, 2] / depth
    return state


def assert_possible(state: np.ndarray) -> None:
    """The covariances of place and velocity, and of size and growth, are positive semidefinite."""
    for place, both, rate in ((PP, PV, VV), (SS, SG, GG)):
        block = np.stack([state[:, [place, both]], state[:, [both, rate]]], axis=1)
        assert (np.linalg.eigvalsh(block) >= -1e-12 * np.abs(block).max(axis=(1, 2))[:, None]).all()


@pytest.mark.parametrize("gap", [1, 5, 15, 40])
def test_a_straight_walk_before_a_pinhole_camera_is_predicted_exactly_also_towards_it(gap):
    later = kalman.predict(known(3), 3 + gap, AGILITY)
    np.testing.assert_allclose(later[:, [X, Y]], centres(filmed(3 + gap)), rtol=0, atol=1e-4)
    np.testing.assert_allclose(later[:, [WIDTH, HEIGHT]], filmed(3 + gap)[:, 2:], rtol=1e-9)


def test_velocity_and_growth_are_learned_from_boxes_alone():
    state = kalman.start(filmed(0), 0, SCATTER, 0.07)
    for frame in range(1, 60):
        state = kalman.update(kalman.predict(state, frame, AGILITY), filmed(frame), frame, SCATTER)
    ahead = centres(kalman_boxes(kalman.predict(state, 64, AGILITY))) - centres(filmed(64))
    stays = centres(filmed(59)) - centres(filmed(64))
    assert (np.hypot(*ahead.T) < 0.15 * np.hypot(*stays.T)).all()
    np.testing.assert_allclose(state[:, GROWTH], known(59)[:, GROWTH], atol=2e-3)


def kalman_boxes(state: np.ndarray) -> np.ndarray:
    size = state[:, [WIDTH, HEIGHT]]
    return np.concatenate([state[:, [X, Y]] - size / 2, size], axis=1)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10_000),
    st.lists(st.integers(1, 60), min_size=1, max_size=12),
    st.floats(1e-4, 0.1),
    st.floats(1e-3, 1.0),
    st.floats(1e-3, 10.0),
)
def test_covariances_stay_positive_semidefinite_whatever_comes_when(seed, gaps, agility, scatter, speed):
    """Also where the velocity's gain is cut off, so that the usual shrinking of the variance would take too much."""
    random = np.random.default_rng(seed)
    state, frame = kalman.start(filmed(0), 0, scatter, speed), 0
    for gap in gaps:
        frame += gap
        state = kalman.predict(state, frame, agility)
        assert_possible(state)
        box = kalman_boxes(state) * np.exp(random.normal(0, 0.2, (3, 4)))
        state = kalman.update(state, box, frame, scatter)
        assert_possible(state)


@pytest.mark.parametrize("gap", [1, 5, 40])
def test_one_surprise_changes_the_velocity_by_no_more_than_twice_itself_over_the_gap(gap):
    """Though the filter takes the place for certain and the velocity for unknown."""
    later = known(0)
    later[:, [PP, PV, VV]] = 1e-4, 0.9e-1, 100.0
    box = kalman_boxes(later) + np.array([10, 0, 0, 0])
    seen = kalman.update(later, box, gap, 1e-3)
    np.testing.assert_allclose(seen[:, VX] - later[:, VX], 10 * 2 / gap)
    assert_possible(seen)


homographies = st.tuples(
    st.floats(-0.5, 0.5), st.floats(-1.0, 1.0), st.floats(-300, 300), st.floats(-300, 300), st.integers(-2, 2)
).map(
    lambda p: np.array(
        [
            [np.exp(p[0]) * np.cos(p[1]), -np.exp(p[0]) * np.sin(p[1]), p[2]],
            [np.exp(p[0]) * np.sin(p[1]), np.exp(p[0]) * np.cos(p[1]), p[3]],
            [1e-4 * p[4], -1.5e-4 * p[4], 1.0],
        ]
    )
)


def mapped(points: np.ndarray, h: np.ndarray) -> np.ndarray:
    lifted = np.c_[points, np.ones(len(points))] @ h.T
    return lifted[:, :2] / lifted[:, 2:]


@settings(max_examples=60, deadline=None)
@given(homographies)
def test_carried_states_are_the_carried_points_by_finite_differences_scale_included(h):
    state, e = known(0), 1e-4
    new = kalman.transform(state, h)
    np.testing.assert_allclose(new[:, [X, Y]], mapped(state[:, [X, Y]], h), atol=1e-9)
    step = e * state[:, [VX, VY]]
    slope = (mapped(state[:, [X, Y]] + step, h) - mapped(state[:, [X, Y]] - step, h)) / (2 * e)
    np.testing.assert_allclose(new[:, [VX, VY]], slope, rtol=1e-6, atol=1e-6)
    side = 0.01 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    for before, after in zip(state, new, strict=True):
        x, y = (mapped(before[[X, Y]] + side, h) - after[[X, Y]]).T
        area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2 / 0.02**2
        np.testing.assert_allclose(after[[WIDTH, HEIGHT]] / before[[WIDTH, HEIGHT]], np.sqrt(area), rtol=1e-5)
    np.testing.assert_array_equal(new[:, SEEN:], state[:, SEEN:])


@settings(max_examples=40, deadline=None)
@given(homographies)
def test_boxes_are_carried_as_states_are_and_back_by_the_inverse(h):
    box = filmed(0)
    there = kalman.transform_boxes(box, h)
    np.testing.assert_allclose(there, kalman_boxes(kalman.transform(kalman.start(box, 0, 0.1, 0.1), h)), atol=1e-9)
    np.testing.assert_allclose(kalman.transform_boxes(there, np.linalg.inv(h)), box, rtol=1e-7, atol=1e-6)
