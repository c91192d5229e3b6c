"""Centroids and courses of crowds by the people that ground vehicles see."""

import numpy as np
import pytest

from torchvision_dddas.control.ground_crowds import CrowdLooks

VELOCITY = np.array([0.8, -0.6])


def crowd_at(time_s, count=12):
    """(N, 2) people on a circle of 2 m about a middle that walks."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.array([5.0, 20.0]) + VELOCITY * time_s + 2 * np.stack([np.sin(angle), np.cos(angle)], axis=1)


def watch(vehicles, times_s, target=7):
    """Looks at a crowd in turn, each at who is on the vehicle's own side: all who are further east or west."""
    looks, rng = CrowdLooks(), np.random.default_rng(0)
    for k, time_s in enumerate(times_s):
        name = vehicles[k % len(vehicles)]
        people = crowd_at(time_s)
        east = people[:, 0] > people[:, 0].mean() + 0.1
        seen = people[east if name == "east" else ~east]
        looks.add(time_s, name, np.full(len(seen), target), seen + rng.normal(0, 0.2, seen.shape))
    return looks.crowds(times_s[-1])


def test_vehicles_on_both_sides_see_the_middle_and_the_course_though_each_sees_its_own_side():
    times_s = np.arange(0, 8, 0.5)
    both, east = watch(["east", "west"], times_s), watch(["east"], times_s)
    middle = crowd_at(times_s[-1]).mean(axis=0)
    assert both.target.tolist() == [7] and both.seen_by.tolist() == ["west"] and not both.steers.any()
    np.testing.assert_allclose(both.east_north_m[0], middle, atol=0.4)
    np.testing.assert_allclose(east.east_north_m[0] - middle, (1.3, 0), atol=0.4)
    for crowds in (both, east):
        np.testing.assert_allclose(crowds.velocity_m_s[0], VELOCITY, atol=0.15)


@pytest.mark.parametrize(("times_s", "seen_s"), [([0.0], 0.0), ([0.0, 9.0], 9.0), ([8.0, 9.0], 8.5)])
def test_without_looks_over_some_time_the_course_is_unknown_and_the_last_second_counts(times_s, seen_s):
    crowds = watch(["east"], times_s)
    assert np.isnan(crowds.velocity_m_s).all() and crowds.people.tolist() == [5]
    np.testing.assert_allclose(crowds.east_north_m[0], crowd_at(seen_s).mean(axis=0) + np.array([1.3, 0.0]), atol=0.4)


def test_people_of_no_target_count_nowhere_and_crowds_that_are_not_looked_at_now_have_no_row():
    looks = CrowdLooks()
    looks.add(1.0, "ugv1", np.array([0, 3, 3]), np.array([[9.0, 9], [0, 0], [2, 0]]))
    assert (looks.crowds(1.0).target.tolist(), looks.crowds(1.0).east_north_m.tolist()) == ([3], [[1, 0]])
    assert len(looks.crowds(1.5)) == 0
