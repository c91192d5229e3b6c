"""Boxes moved to where their track was."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from torchvision_dddas.tracking.box_smoothing import between, seen_from, smoothed
from torchvision_dddas.tracking.kalman import carried_boxes

LOOKS = np.arange(10, dtype=float)


def walk(looks: ArrayLike, growth: float = 0.0) -> np.ndarray:
    """(N, 4) boxes on a straight line whose sides grow by a factor a look."""
    looks = np.asarray(looks, float)
    height = 80 * np.exp(growth * looks)
    centre = np.stack([100 + 9 * looks, 200 - 4 * looks], axis=1)
    size = np.stack([0.4 * height, height], axis=1)
    return np.concatenate([centre - size / 2, size], axis=1)


@settings(max_examples=40, deadline=None)
@given(st.sets(st.integers(0, 9), min_size=2), st.floats(-3, 12), st.floats(-0.1, 0.1))
def test_a_straight_walk_is_hardly_changed_whichever_looks_are_missing(seen, at, growth):
    """Not at all but for the faint pull to no slope, which matters where the looks are few and all on one side."""
    looks = np.array(sorted(seen), float)
    near = np.clip(at, looks[0], looks[-1])
    np.testing.assert_allclose(smoothed(walk(looks, growth), looks, near), walk([near], growth)[0], atol=0.6)


def test_a_target_at_rest_stays_exactly_where_it_is():
    box = np.tile([[10.0, 20, 30, 80]], (6, 1))
    np.testing.assert_allclose(smoothed(box, np.array([0.0, 1, 2, 4, 5, 6]), 3), box[0])


def test_one_box_or_several_at_one_time_are_their_mean():
    box = walk([0, 0])
    box[1, :2] += 4
    np.testing.assert_allclose(smoothed(box[:1], np.zeros(1), 0), box[0])
    np.testing.assert_allclose(smoothed(box, np.zeros(2), 0), box.mean(axis=0))


def test_noisy_boxes_come_nearer_to_the_truth_within_a_walk_and_at_its_end():
    random = np.random.default_rng(4)
    better: dict[int, list[np.ndarray]] = {4: [], 9: []}
    for _ in range(200):
        noisy = walk(LOOKS)
        noisy += random.normal(0, 4, noisy.shape)
        for at, found in better.items():
            truth = walk([at])[0]
            found.append(np.abs([smoothed(noisy, LOOKS, at) - truth, noisy[at] - truth]))
    for found in better.values():
        smooth, given_ = np.mean(found, axis=0)
        assert (smooth < 0.85 * given_).all()


def test_what_is_far_in_time_counts_for_little():
    looks = np.append(LOOKS, 25.0)
    box = np.concatenate([walk(LOOKS), walk([25]) + np.array([500, 0, 0, 0])])
    near = smoothed(walk(LOOKS), LOOKS, 2)
    np.testing.assert_allclose(smoothed(box, looks, 2), near, atol=1e-6)


@pytest.mark.parametrize("shift", [-7.0, 1000.0])
def test_only_the_time_between_looks_matters(shift):
    random = np.random.default_rng(2)
    box = walk(LOOKS) + random.normal(0, 3, (10, 4))
    np.testing.assert_allclose(smoothed(box, LOOKS + shift, 4 + shift), smoothed(box, LOOKS, 4))


def test_between_two_boxes():
    one, other = np.array([0.0, 10, 20, 30]), np.array([10.0, 10, 40, 60])
    assert between(one, other, 0).tolist() == one.tolist()
    assert between(one, other, 1).tolist() == other.tolist()
    assert between(one, other, 0.5).tolist() == [5, 10, 30, 45]


def test_a_box_is_seen_from_another_look():
    box, zoom = np.array([10.0, 20, 30, 40]), np.diag([2.0, 2.0, 1.0])
    assert seen_from(box, None) is box
    np.testing.assert_allclose(seen_from(box, zoom), carried_boxes(box[None], zoom)[0])
