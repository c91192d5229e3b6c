"""Association scores: distance, size, crowds, borders, misses, and tracks with one detection."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as given_settings
from hypothesis import strategies as st

from torchvision_dddas.config import Settings
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import HEIGHT, VX, VY, WIDTH, X, Y
from torchvision_dddas.tracking.scene import SceneState
from torchvision_dddas.tracking.scores import (
    BoxLook,
    association_scores,
    common_velocity,
    is_near_border,
    likely_velocities,
    newborn_scores,
)

KNOBS = Settings().track
SCENE = SceneState(time=5, step=0.1, density=5 / 1e6, missing=0.1, turnover=0.02, size=(1250.0, 800.0))
PERSON = np.array([584.0, 360, 32, 80])


def track(box: np.ndarray = PERSON, velocity: tuple[float, float] = (0, 0), seen: float = 4) -> np.ndarray:
    """(1, COLUMNS) a target seen several times, last at a look."""
    state = kalman.start(box[None], seen - 2, KNOBS.scatter, SCENE.step)
    for time in (seen - 1, seen):
        later = kalman.predict(state, time, KNOBS.wander * SCENE.step)
        state = kalman.update(later, box[None], time, KNOBS.scatter)
    state[:, [VX, VY]] = velocity
    return state


def scored(boxes, state=None, scene=SCENE, missed=0) -> list[float]:
    """The scores of one track's links."""
    state = track() if state is None else state
    look = BoxLook.of(state, np.full(len(state), missed), np.asarray(boxes, float), scene, KNOBS)
    return association_scores(look, KNOBS)[0].tolist()


def first(boxes, flow=None, scene=SCENE, missed=0, box=PERSON) -> list[float]:
    """The scores of links of a track with one detection."""
    state = kalman.start(box[None], scene.time - 1 - missed, KNOBS.scatter, scene.step)
    velocities = ways(state, np.zeros((0, kalman.COLUMNS)) if flow is None else flow)
    look = BoxLook.of(state, np.array([missed]), np.asarray(boxes, float), scene, KNOBS)
    return newborn_scores(look, KNOBS, velocities)[0].tolist()


def ways(state: np.ndarray, flow: np.ndarray) -> np.ndarray:
    return likely_velocities(state, flow, common_velocity(flow))


def moved(*steps: tuple[float, float], box: np.ndarray = PERSON) -> np.ndarray:
    return np.array([[box[0] + x, box[1] + y, *box[2:]] for x, y in steps])


def test_the_nearest_of_many_tracks_are_those_that_sorting_all_gives():
    random = np.random.default_rng(0)
    flow, state = (np.zeros((count, kalman.COLUMNS)) for count in (120, 30))
    flow[:, : kalman.Y + 1] = random.integers(0, 9, (120, 2))  # with many at the same distance
    state[:, : kalman.Y + 1] = random.integers(0, 9, (30, 2))
    flow[:, VX], flow[:, VY] = np.arange(120), random.normal(0, 1, 120)
    away = ((flow[None, :, :2] - state[:, None, :2]) ** 2).sum(2)
    nearest = np.argsort(away, axis=1, kind="stable")[:, :6]
    np.testing.assert_array_equal(ways(state, flow)[1:, :, 0].T, nearest)


@pytest.mark.parametrize("direction", [(1, 0), (0, -1), (0.6, 0.8)])
@pytest.mark.parametrize("score_of", [scored, first])
def test_a_score_falls_with_distance_to_below_zero(direction, score_of):
    score = score_of(moved(*[(direction[0] * d, direction[1] * d) for d in (0, 5, 15, 40, 100, 300)]))
    assert score == sorted(set(score), reverse=True) and len(score) == 6
    assert score[0] > 0 > score[-1]


@pytest.mark.parametrize("score_of", [scored, first])
def test_a_score_falls_with_the_change_of_size_and_with_the_number_of_targets(score_of):
    middle = PERSON[:2] + PERSON[2:] / 2
    sizes = np.array([[*(middle - PERSON[2:] * s / 2), *(PERSON[2:] * s)] for s in (1, 1.15, 1.5)])
    assert score_of(sizes) == sorted(score_of(sizes), reverse=True)
    few, many = (score_of([PERSON], scene=replace(SCENE, density=density))[0] for density in (1e-6, 1e-4))
    assert few - many == pytest.approx(np.log(100))


@given_settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000), st.floats(0.05, 20), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.integers(0, 3))
def test_scores_do_not_depend_on_the_scale_or_place_of_the_scene(seed, scale, x, y, missed):
    similar = np.array([[scale, 0, x], [0, scale, y], [0, 0, 1]])
    boxes = PERSON + np.random.default_rng(seed).normal(0, 30, (5, 4)) * [2, 2, 0.2, 0.5]
    state, here = track(velocity=(6, -3), seen=4 - missed), replace(SCENE, size=None)
    there = replace(here, density=here.density / scale**2)
    big = scored(kalman.transform_boxes(boxes, similar), kalman.transform(state, similar), there, missed)
    np.testing.assert_allclose(big, scored(boxes, state, here, missed), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("tracks", "boxes"), [(0, 0), (0, 2), (2, 0)])
def test_no_tracks_or_no_boxes_give_an_empty_table(tracks, boxes):
    state, boxes_px = np.repeat(track(), tracks, axis=0), np.tile(PERSON, (boxes, 1))
    look = BoxLook.of(state, np.zeros(tracks), boxes_px, SCENE, KNOBS)
    assert association_scores(look, KNOBS).shape == (tracks, boxes)
    assert newborn_scores(look, KNOBS, ways(state, track())).shape == (tracks, boxes)


def test_a_walker_may_have_stopped_only_during_a_gap():
    at_rest, half, back, onward = moved((0, 0), (10, 0), (-90, 0), (160, 0))
    assert scored([at_rest], track(velocity=(16, 0)))[0] < scored([half], track(velocity=(16, 0)))[0]
    lost = track(velocity=(16, 0), seen=-1)
    stopped, turned, far = scored([at_rest, back, onward], lost, missed=5)
    assert stopped > max(turned, far, 0)


def test_each_missed_look_lowers_a_score_more_where_few_are_missed():
    careful, careless = (
        [scored([PERSON], track(seen=4 - n), replace(SCENE, missing=share), n)[0] for n in range(4)]
        for share in (0.02, 0.2)
    )
    for score in (careful, careless):
        assert score == sorted(score, reverse=True) and len(set(score)) == 4
    assert careful[0] - careful[2] > careless[0] - careless[2]


def test_a_target_about_to_leave_scores_lower_than_one_inside_and_unknown_borders_do_not_count():
    edge = np.array([1234.0, 360, 32, 80])
    leaving, staying = ((moved((16, 0), box=box), track(box, velocity=(16, 0))) for box in (edge, PERSON))
    assert scored(*leaving)[0] < scored(*staying)[0] - 0.5
    unbounded = replace(SCENE, size=None)
    assert scored(*leaving, scene=unbounded)[0] == pytest.approx(scored(*staying, scene=unbounded)[0])
    assert is_near_border(np.stack([edge, PERSON]), SCENE.size).tolist() == [True, False]
    assert not is_near_border(np.stack([edge, PERSON]), None).any()


def neighbours(velocity: tuple[float, float], count: int = 5) -> np.ndarray:
    return np.concatenate([track(moved((60.0 * n, 0))[0], velocity) for n in range(1, count + 1)])


def test_a_target_seen_once_is_expected_to_move_as_its_neighbours_do():
    ways = moved((24, 0), (0, 0), (-24, 0))
    with_them, at_rest, against = first(ways, neighbours((24, 0)))
    assert with_them > at_rest > against
    alone = first(ways)
    assert alone[1] > alone[0] == pytest.approx(alone[2])
    one = first(ways, neighbours((24, 0), count=1))
    assert alone[0] < one[0] < with_them  # one neighbour says little


def test_the_nearest_neighbours_count_more_than_others():
    near, far = neighbours((24, 0), 6), neighbours((-24, 0), 6)
    far[:, [X, Y]] += 900, 300
    onward, back = first(moved((24, 0), (-24, 0)), np.concatenate([far, near]))
    assert onward > back


def test_the_common_velocity_is_the_median_and_zero_of_too_few():
    assert common_velocity(neighbours((24, -5))).tolist() == [24, -5]
    assert common_velocity(neighbours((24, -5), count=1)).tolist() == [0, 0]


def test_a_box_where_it_is_expected_is_worth_less_for_a_nearer_target_which_has_more_room():
    """Places spread with the height: twice as high, they fill four times the area."""
    near = track()
    near[:, [WIDTH, HEIGHT]] *= 2
    large = np.array([[*(PERSON[:2] - PERSON[2:] / 2), *(2 * PERSON[2:])]])
    unbounded = replace(SCENE, size=None)
    lead = scored([PERSON], scene=unbounded)[0] - scored(large, near, unbounded)[0]
    assert lead == pytest.approx(np.log(4))


@pytest.mark.parametrize("score_of", [scored, first])
def test_scores_do_not_depend_on_how_many_boxes_are_compared(score_of):
    # Few pairs are all compared with the reach, many by their order in x.
    boxes = moved(*np.random.default_rng(0).uniform(-300, 300, (5000, 2)))
    together, some = np.array(score_of(boxes)), np.array(score_of(boxes[:100]))
    finite = np.isfinite(some)
    np.testing.assert_allclose(together[:100][finite], some[finite])
    assert 0 < finite.sum() < 100 and (together[:100][~finite] < -4).all()
