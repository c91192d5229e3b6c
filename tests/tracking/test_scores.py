"""Scores of links: what they fall with, and what they do not depend on."""

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
from torchvision_dddas.tracking.scores import Sight, link_scores, near_border

KNOBS = Settings().track
SIGHT = Sight(frame=11, interval=5, speed=0.07, size=(1000.0, 800.0))
BOX = np.array([500.0, 300, 32, 80])
HERE = np.zeros(1, bool)


def track(box: np.ndarray = BOX, seen: int = 6, velocity: tuple[float, float] = (0, 0)) -> np.ndarray:
    """(1, COLUMNS) a target seen several times, last at a frame."""
    state = kalman.started(box[None], 1, KNOBS.scatter, 0.07)
    state = kalman.updated(kalman.predicted(state, 6, KNOBS.agility), box[None], 6, KNOBS.scatter)
    state[:, [VX, VY]] = velocity
    state[:, SEEN] = seen
    return state


def scored(boxes: ArrayLike, state: np.ndarray | None = None, sight: Sight = SIGHT, left: bool = False) -> list[float]:
    """The scores of one track's links."""
    state = track() if state is None else state
    return link_scores(state, np.full(len(state), left), np.asarray(boxes), sight, KNOBS)[0].tolist()


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


def test_it_is_the_predicted_place_that_counts_not_the_last():
    score = scored(moved((0, 0), (40, 0), (80, 0)), track(velocity=(8, 0)))
    assert score[1] > max(score[0], score[2])


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
    expected = link_scores(state, HERE, boxes, sight, KNOBS)
    there = link_scores(kalman.carried(state, similar), HERE, kalman.carried_boxes(boxes, similar), sight, KNOBS)
    np.testing.assert_allclose(there, expected, rtol=1e-6, atol=1e-6)


def test_each_pair_is_scored_by_itself():
    random = np.random.default_rng(3)
    state = np.concatenate([track(BOX + random.normal(0, 5, 4), seen, (1, 2)) for seen in (6, 1, 6, 3)])
    boxes, left = BOX + random.normal(0, 8, (3, 4)), np.array([True, True, False, False])
    together = link_scores(state, left, boxes, SIGHT, KNOBS)
    for i in range(4):
        for j in range(3):
            alone = link_scores(state[i : i + 1], left[i : i + 1], boxes[j : j + 1], SIGHT, KNOBS)
            assert together[i, j] == pytest.approx(alone[0, 0])


@pytest.mark.parametrize(("tracks", "boxes"), [(0, 0), (0, 2), (2, 0)])
def test_nobody_or_nothing_gives_an_empty_table(tracks, boxes):
    state = np.repeat(track(), tracks, axis=0)
    assert link_scores(state, np.zeros(tracks, bool), np.tile(BOX, (boxes, 1)), SIGHT, KNOBS).shape == (tracks, boxes)


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
            scored([BOX], track(seen=seen), replace(SIGHT, births=births))[0] for births in (0.0, 1e-4, 0.005, 0.02)
        ]
        assert score[0] == score[1]
        assert (score[1] > score[2] > score[3]) == matters
        assert (score[1] == score[3]) != matters


def test_a_missed_track_does_not_change_the_scores_of_others():
    both = np.concatenate([track(), track(seen=1)])
    sight = replace(SIGHT, births=0.5)
    together = link_scores(both, np.array([True, True]), BOX[None], sight, KNOBS)
    assert together[0, 0] == scored([BOX])[0]


def test_doubtful_detections_may_differ_more_in_size():
    taller = BOX * [1, 1, 1, 1.4]
    certain, doubtful = (scored([taller, BOX], sight=replace(SIGHT, doubt=doubt)) for doubt in (0.0, 1.0))
    assert doubtful[0] - doubtful[1] > certain[0] - certain[1]


def test_who_is_fast_turns_fast():
    slow, fast = (replace(SIGHT, speed=speed).agility(KNOBS) for speed in (0.07, 0.14))
    assert fast == pytest.approx(2 * slow) == pytest.approx(2 * KNOBS.agility)
    turned = moved((60, 0))
    assert scored(turned, sight=replace(SIGHT, speed=0.3)) > scored(turned)


def test_boxes_at_each_side_of_the_picture_are_near_its_border_and_none_is_without_a_picture():
    boxes = np.array([[0, 300, 20, 50], [300, 0, 20, 50], [980, 300, 20, 50], [300, 750, 20, 50], [300, 300, 20, 50]])
    assert near_border(boxes.astype(float), (1000, 800)).tolist() == [True, True, True, True, False]
    assert not near_border(boxes.astype(float), None).any()


def test_large_targets_are_near_the_border_from_further_away():
    distance = 12.0
    assert near_border(np.array([[distance, 300, 80, 200]]), (1000, 800))[0]
    assert not near_border(np.array([[distance, 300, 8, 20]]), (1000, 800))[0]
