"""The speed of a scene, from boxes without identities."""

import numpy as np
import pytest

from torchvision_dddas.tracking.speed_prior import Pace


def walkers(frame: int, speed: float, count: int = 6) -> np.ndarray:
    """(N, 4) boxes 40 px high, far apart, that walk to the right at so many heights a frame."""
    x = 300.0 * np.arange(count) + 40 * speed * frame
    return np.stack([x, np.full(count, 50.0), np.full(count, 16.0), np.full(count, 40.0)], axis=1)


def learned(speed: float, interval: int = 5, looks: int = 40, start: float = 0.07) -> float:
    pace = Pace(start)
    for look in range(looks):
        pace.add(walkers(interval * look, speed), walkers(interval * (look + 1), speed), interval)
    return pace.speed


def test_it_starts_as_told_and_learns_nothing_from_nothing():
    pace = Pace(0.2)
    for before, now in ((np.zeros((0, 4)), walkers(0, 0.1)), (walkers(0, 0.1), np.zeros((0, 4)))):
        pace.add(before, now, 5)
    pace.add(walkers(0, 0.1, 2), walkers(1, 0.1, 2), 1)
    assert pace.speed == 0.2


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.3])
def test_it_ends_near_the_true_speed(speed):
    assert speed / 1.6 < learned(speed) < 1.6 * speed


def test_faster_scenes_give_more_and_the_start_tells_less_and_less():
    assert learned(0.03) < learned(0.1) < learned(0.3)
    far = [abs(np.log(learned(0.1, looks=looks, start=1.0) / learned(0.1))) for looks in (1, 2, 10)]
    assert far[0] > far[1] > far[2]


def test_the_interval_of_the_looks_does_not_matter():
    assert learned(0.05, interval=1) == pytest.approx(learned(0.05, interval=7))


@pytest.mark.parametrize("scale", [0.1, 25.0])
def test_neither_does_the_scale_of_the_picture_nor_where_its_origin_is(scale):
    pace, other = Pace(0.07), Pace(0.07)
    before, now = walkers(0, 0.1), walkers(5, 0.1)
    shift = np.array([1e4, -1e4, 0, 0])
    pace.add(before, now, 5)
    other.add(scale * before + shift, scale * now + shift, 5)
    assert other.speed == pytest.approx(pace.speed)


def test_the_order_of_the_boxes_does_not_matter():
    random, pace, other = np.random.default_rng(1), Pace(0.07), Pace(0.07)
    before, now = walkers(0, 0.1), walkers(5, 0.1)
    pace.add(before, now, 5)
    other.add(random.permutation(before), random.permutation(now), 5)
    assert other.speed == pytest.approx(pace.speed)


@pytest.mark.parametrize("left", [True, False])
def test_targets_without_a_partner_are_no_steps(left):
    """Those that left are nobody's nearest, those that came are nearest to none: their distances are no speeds."""
    pace, other = Pace(0.07), Pace(0.07)
    before, now = walkers(0, 0.1), walkers(5, 0.1)
    strangers = walkers(0, 0.1) - np.array([5000, 0, 0, 0])
    pace.add(before, now, 5)
    other.add(np.concatenate([strangers, before]) if left else before, now if left else np.r_[now, strangers], 5)
    assert other.speed == pytest.approx(pace.speed)


def test_a_scene_at_rest_still_leaves_some_room():
    assert 0 < learned(0.0, looks=200) < 0.07


def test_what_was_long_ago_is_forgotten():
    pace = Pace(0.07)
    for speed in (0.5, 0.05):
        for look in range(50):
            pace.add(walkers(look, speed), walkers(look + 1, speed), 1)
    assert pace.speed == pytest.approx(learned(0.05, interval=1, looks=50))
