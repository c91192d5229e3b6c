"""The Kalman filter of targets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.geometry import transfer
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import GG, GROWTH, HEIGHT, PP, PV, SEEN, SG, SS, VV, VX, VY, WIDTH, X, Y

FOCAL = 800.0
PEOPLE = np.array([[-2.0, 1.5, 12.0], [1.0, 1.6, 20.0], [3.0, 1.4, 9.0]])  # metres: right, down, ahead
STEPS = np.array([[0.05, 0.0, -0.1], [-0.08, 0.0, 0.06], [0.06, 0.01, 0.0]])  # metres a look
WANDER, SCATTER = 0.009, 0.06


def filmed(frame: float) -> np.ndarray:
    """(3, 4) boxes of people 1.7 m tall who walk straight on in front of a camera that stands still."""
    x, y, depth = (PEOPLE + frame * STEPS).T
    width, height = FOCAL * 0.6 / depth, FOCAL * 1.7 / depth
    return np.stack([FOCAL * x / depth - width / 2, FOCAL * y / depth - height / 2, width, height], axis=1)


def centres(box_px: np.ndarray) -> np.ndarray:
    return box_px[:, :2] + box_px[:, 2:] / 2


def boxes_of(state: np.ndarray) -> np.ndarray:
    size = state[:, [WIDTH, HEIGHT]]
    return np.concatenate([state[:, [X, Y]] - size / 2, size], axis=1)


def known(frame: int) -> np.ndarray:
    """States at a frame with the true velocity and growth."""
    state, e = kalman.start(filmed(frame), frame, SCATTER, 0.07), 1e-4
    state[:, [VX, VY]] = (centres(filmed(frame + e)) - centres(filmed(frame - e))) / (2 * e)
    state[:, GROWTH] = -STEPS[:, 2] / (PEOPLE + frame * STEPS)[:, 2]
    return state


def assert_possible(state: np.ndarray) -> None:
    """The covariances of place and velocity, and of size and growth, are positive semidefinite."""
    for place, both, rate in ((PP, PV, VV), (SS, SG, GG)):
        block = np.stack([state[:, [place, both]], state[:, [both, rate]]], axis=1)
        assert (np.linalg.eigvalsh(block) >= -1e-12 * np.abs(block).max(axis=(1, 2))[:, None]).all()


@pytest.mark.parametrize("gap", [1, 5, 15, 40])
def test_a_straight_walk_before_a_pinhole_camera_is_predicted_exactly(gap):
    later = kalman.predict(known(3), 3 + gap, WANDER)
    np.testing.assert_allclose(later[:, [X, Y]], centres(filmed(3 + gap)), rtol=0, atol=1e-4)
    np.testing.assert_allclose(later[:, [WIDTH, HEIGHT]], filmed(3 + gap)[:, 2:], rtol=1e-9)


def test_velocity_and_growth_are_learned_from_boxes_alone():
    state = kalman.start(filmed(0), 0, SCATTER, 0.07)
    for frame in range(1, 60):
        state = kalman.update(kalman.predict(state, frame, WANDER), filmed(frame), frame, SCATTER)
    ahead = centres(boxes_of(kalman.predict(state, 64, WANDER))) - centres(filmed(64))
    stays = centres(filmed(59)) - centres(filmed(64))
    assert (np.hypot(*ahead.T) < 0.15 * np.hypot(*stays.T)).all()
    np.testing.assert_allclose(state[:, GROWTH], known(59)[:, GROWTH], atol=2e-3)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10_000),
    st.lists(st.integers(1, 60), min_size=1, max_size=12),
    *(st.floats(1e-4, 0.1), st.floats(1e-3, 1.0), st.floats(1e-3, 10.0)),
)
def test_covariances_stay_positive_semidefinite(seed, gaps, wander, scatter, speed):
    """Also where the velocity's gain is cut off, so that the usual shrinking of the variance would take too much."""
    random = np.random.default_rng(seed)
    state = kalman.start(filmed(0), 0, scatter, speed)
    for frame in np.cumsum(gaps).tolist():
        state = kalman.predict(state, frame, wander)
        assert_possible(state)
        state = kalman.update(state, boxes_of(state) * np.exp(random.normal(0, 0.2, (3, 4))), frame, scatter)
        assert_possible(state)


@pytest.mark.parametrize("gap", [1, 5, 40])
def test_one_innovation_changes_the_velocity_by_at_most_twice_itself_over_the_gap(gap):
    later = known(0)
    later[:, [PP, PV, VV]] = 1e-4, 0.9e-1, 100.0
    box = boxes_of(later) + np.array([10, 0, 0, 0])
    seen = kalman.update(later, box, gap, 1e-3)
    np.testing.assert_allclose(seen[:, VX] - later[:, VX], 10 * 2 / gap)
    assert_possible(seen)


def homography(zoom, turn, u, v, tilt) -> np.ndarray:
    cos, sin = np.exp(zoom) * np.cos(turn), np.exp(zoom) * np.sin(turn)
    return np.array([[cos, -sin, u], [sin, cos, v], [1e-4 * tilt, -1.5e-4 * tilt, 1.0]])


PANS = st.floats(-300, 300)
HOMOGRAPHIES = st.builds(homography, st.floats(-0.5, 0.5), st.floats(-1.0, 1.0), PANS, PANS, st.integers(-2, 2))


@settings(max_examples=60, deadline=None)
@given(HOMOGRAPHIES)
def test_transformed_states_match_finite_differences_of_points(h):
    state, e = known(0), 1e-4
    new, at = kalman.transform(state, h), state[:, [X, Y]]
    np.testing.assert_allclose(new[:, [X, Y]], transfer(h, at), atol=1e-9)
    step = e * state[:, [VX, VY]]
    slope = (transfer(h, at + step) - transfer(h, at - step)) / (2 * e)
    np.testing.assert_allclose(new[:, [VX, VY]], slope, rtol=1e-6, atol=1e-6)
    along, down = (transfer(h, at + side) - transfer(h, at - side) for side in ([0.01, 0], [0, 0.01]))
    scale = np.sqrt(np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])) / 0.02
    np.testing.assert_allclose(new[:, [WIDTH, HEIGHT]] / state[:, [WIDTH, HEIGHT]], scale[:, None] * [1, 1], rtol=1e-5)
    np.testing.assert_array_equal(new[:, SEEN:], state[:, SEEN:])
    box = filmed(0)
    there = kalman.transform_boxes(box, h)
    np.testing.assert_allclose(there, boxes_of(kalman.transform(kalman.start(box, 0, 0.1, 0.1), h)), atol=1e-9)
    np.testing.assert_allclose(kalman.transform_boxes(there, np.linalg.inv(h)), box, rtol=1e-7, atol=1e-6)
