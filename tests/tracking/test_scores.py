"""Association scores, the speed prior, and how long tracks are remembered."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as given_settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from torchvision_dddas.config import Settings
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import SEEN, VX, VY
from torchvision_dddas.tracking.scores import SceneState, SpeedPrior, association_scores, is_near_border

KNOBS = Settings().track
SIGHT = SceneState(frame=11, interval=5, speed=0.07, size=(1000.0, 800.0))
BOX = np.array([500.0, 300, 32, 80])
HERE = np.zeros(1, bool)


def track(box: np.ndarray = BOX, seen: int = 6, velocity: tuple[float, float] = (0, 0)) -> np.ndarray:
    """(1, COLUMNS) a target seen several times, last at a frame."""
    state = kalman.start(box[None], 1, KNOBS.scatter, 0.07)
    state = kalman.update(kalman.predict(state, 6, KNOBS.agility), box[None], 6, KNOBS.scatter)
    state[:, [VX, VY]] = velocity
    state[:, SEEN] = seen
    return state


def scored(
    boxes: ArrayLike, state: np.ndarray | None = None, sight: SceneState = SIGHT, left: bool = False
) -> list[float]:
    """The scores of one track's links."""
    state = track() if state is None else state
    return association_scores(state, np.full(len(state), left), np.asarray(boxes), sight, KNOBS)[0].tolist()


def moved(*steps: tuple[float, float]) -> np.ndarray:
    return np.array([[BOX[0] + x, BOX[1] + y, *BOX[2:]] for x, y in steps])


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1), (0.6, 0.8)])
@pytest.mark.parametrize("seen", [6, 1])
def test_a_score_falls_with_distance_and_below_nothing(direction, seen):
    steps = [(direction[0] * d, direction[1] * d) for d in (0, 5, 20, 60, 150, 400)]
    score = scored(moved(*steps), track(seen=seen))
    assert score == sorted(score, reverse=True)
    assert len(set(score)) == len(score)
    assert score[0] > 0 > score[-1]


def test_a_score_falls_with_the_difference_in_size_either_way_but_not_for_ever():
    factors = np.array([1.0, 1.1, 1.3, 3.0, 30.0])
    for factor in (factors, 1 / factors):
        size = BOX[2:] * factor[:, None]
        score = scored(np.concatenate([BOX[:2] + BOX[2:] / 2 - size / 2, size], axis=1))
        assert score[0] > score[1] > score[2] > score[3] == pytest.approx(score[4])


def test_standing_people_move_less_up_and_down_than_across_and_lying_boxes_do_not_care():
    across, along = scored(moved((30, 0), (0, 30)))
    assert across > along
    lying = np.array([500.0, 300, 80, 32])
    across, along = scored(lying + np.array([[30, 0, 0, 0], [0, 30, 0, 0]]), track(lying))
    assert across == pytest.approx(along)


@given_settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000), st.floats(0.05, 20), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.sampled_from([1, 6]))
def test_the_scale_of_the_scene_and_its_place_do_not_matter(seed, scale, x, y, seen):
    random = np.random.default_rng(seed)
    similar = np.array([[scale, 0, x], [0, scale, y], [0, 0, 1]])
    boxes = BOX + random.normal(0, 30, (5, 4)) * [2, 2, 0.2, 0.5]
    state, sight = track(seen=seen, velocity=(6, -3)), replace(SIGHT, size=None)
    expected = association_scores(state, HERE, boxes, sight, KNOBS)
    there = association_scores(
        kalman.transform(state, similar), HERE, kalman.transform_boxes(boxes, similar), sight, KNOBS
    )
    np.testing.assert_allclose(there, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("tracks", "boxes"), [(0, 0), (0, 2), (2, 0)])
def test_nobody_or_nothing_gives_an_empty_table(tracks, boxes):
    state = np.repeat(track(), tracks, axis=0)
    assert association_scores(state, np.zeros(tracks, bool), np.tile(BOX, (boxes, 1)), SIGHT, KNOBS).shape == (
        tracks,
        boxes,
    )


def test_the_longer_a_target_was_missed_the_less_its_return_is_worth():
    score = [scored(moved((0, 0)), track(seen=11 - gap))[0] for gap in (5, 10, 20, 60)]
    assert score == sorted(score, reverse=True)
    assert score[-1] < score[0] - 1


def test_who_was_lost_may_have_stood_still_though_it_was_walking():
    """Only after a gap: a target seen in the last look is where its velocity says."""
    at_rest, onward, back, half = moved((0, 0), (160, 0), (-120, 0), (40, 0))
    walking = {gap: track(seen=11 - gap, velocity=(8, 0)) for gap in (5, 20)}
    lost, still = scored([at_rest], walking[20])[0], scored([at_rest], track(seen=-9))[0]
    assert lost > 0
    assert still >= lost
    assert scored([back, onward], walking[20])[0] < 0
    assert scored([at_rest], walking[5])[0] < 0.5 * scored([half], walking[5])[0]


def test_the_border_counts_only_for_those_that_were_missed():
    edge = np.array([0.0, 300, 32, 80])
    for seen, matters in ((6, False), (1, True)):
        state = track(edge, seen)
        inside = scored([edge], state, replace(SIGHT, size=None))[0]
        assert (scored([edge], state)[0] < inside) == matters
        assert (scored([edge], state, replace(SIGHT, size=None), left=True)[0] < inside) == matters


def test_births_count_only_for_those_that_were_missed_and_only_where_there_are_many():
    for seen, matters in ((6, False), (1, True)):
        score = [
            scored([BOX], track(seen=seen), replace(SIGHT, birth_rate=births))[0] for births in (0.0, 1e-4, 0.005, 0.02)
        ]
        assert score[0] == score[1]
        assert (score[1] > score[2] > score[3]) == matters
        assert (score[1] == score[3]) != matters


def test_boxes_at_each_side_of_the_picture_are_near_its_border_and_none_is_without_a_picture():
    boxes = np.array([[0, 300, 20, 50], [300, 0, 20, 50], [980, 300, 20, 50], [300, 750, 20, 50], [300, 300, 20, 50]])
    assert is_near_border(boxes.astype(float), (1000, 800)).tolist() == [True, True, True, True, False]
    assert not is_near_border(boxes.astype(float), None).any()


def walkers(frame: int, speed: float, count: int = 6) -> np.ndarray:
    """(N, 4) boxes 40 px high, far apart, that walk to the right at so many heights a frame."""
    x = 300.0 * np.arange(count) + 40 * speed * frame
    return np.stack([x, np.full(count, 50.0), np.full(count, 16.0), np.full(count, 40.0)], axis=1)


def learned(speed: float, interval: int = 5, looks: int = 40, start: float = 0.07) -> float:
    pace = SpeedPrior(start)
    for look in range(looks):
        pace.add(walkers(interval * look, speed), walkers(interval * (look + 1), speed), interval)
    return pace.speed


def test_it_starts_as_told_and_learns_nothing_from_nothing():
    pace = SpeedPrior(0.2)
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


@pytest.mark.parametrize("scale", [0.1, 25.0])
def test_neither_does_the_scale_of_the_picture_nor_where_its_origin_is(scale):
    pace, other = SpeedPrior(0.07), SpeedPrior(0.07)
    before, now = walkers(0, 0.1), walkers(5, 0.1)
    shift = np.array([1e4, -1e4, 0, 0])
    pace.add(before, now, 5)
    other.add(scale * before + shift, scale * now + shift, 5)
    assert other.speed == pytest.approx(pace.speed)


@pytest.mark.parametrize("left", [True, False])
def test_targets_without_a_partner_are_no_steps(left):
    """Those that left are nobody's nearest, those that came are nearest to none: their distances are no speeds."""
    pace, other = SpeedPrior(0.07), SpeedPrior(0.07)
    before, now = walkers(0, 0.1), walkers(5, 0.1)
    strangers = walkers(0, 0.1) - np.array([5000, 0, 0, 0])
    pace.add(before, now, 5)
    other.add(np.concatenate([strangers, before]) if left else before, now if left else np.r_[now, strangers], 5)
    assert other.speed == pytest.approx(pace.speed)
