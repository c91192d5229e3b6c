"""Association scores: histograms of boxes and their similarity; motion and size; the speed prior."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as given_settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from torchvision_dddas.config import Settings
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import SEEN, VX, VY
from torchvision_dddas.tracking.scores import (
    SIGNATURE,
    SceneState,
    SpeedPrior,
    appearance_scores,
    association_scores,
    blend_histograms,
    is_ambiguous,
    similarity,
    strip_histograms,
)

RED, GREEN, BLUE = (0, 0, 200), (0, 200, 0), (200, 0, 0)
GROUND = (110, 120, 115)


def picture(*people: tuple[tuple[int, int, int, int], tuple[int, int, int], tuple[int, int, int]]) -> np.ndarray:
    """A (200, 300, 3) picture with people of a box, a colour above and a colour below."""
    image = np.full((200, 300, 3), GROUND, np.uint8)
    for (x, y, width, height), above, below in people:
        image[y : y + height // 2, x : x + width] = above
        image[y + height // 2 : y + height, x : x + width] = below
    return image


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (200, 300, 3), np.uint8)


def likeness(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.sqrt(one) @ np.sqrt(other))


BOX = (100, 40, 40, 120)
BOXES = np.array([BOX, (10, 10, 20, 50), (200.4, 100.7, 30.2, 80.9), (150, 150, 3, 2)], float)


def test_a_box_outside_has_zeros_and_one_half_outside_has_its_inside():
    image = noise()
    outside = [(-50, 10, 40, 80), (300, 10, 40, 80), (10, -90, 40, 80), (10, 200, 40, 80)]
    found = strip_histograms(
        image, np.array([*outside, (-20, 40, 40, 120), (0, 150, 40, 120), (-100, -100, 600, 600)], float)
    )
    assert found.dtype == np.float32 and not found[:4].any() and (found >= 0).all()
    np.testing.assert_allclose(found[4:].sum(axis=1), 1, rtol=1e-5)


def test_a_target_cut_off_by_the_border_still_looks_like_itself():
    """What is left of it is compared in its place in the whole box, not stretched to one."""
    image = picture((BOX, RED, BLUE), ((200, 40, 40, 120), GREEN, BLUE))
    whole, other = strip_histograms(image, np.array([BOX, (200, 40, 40, 120)], float))
    cut = strip_histograms(image[:, 115:], np.array([(-15, *BOX[1:])], float))[0]
    low = strip_histograms(image[:130], np.array([BOX], float))[0]
    assert likeness(whole, whole) == pytest.approx(1, abs=1e-5)
    assert likeness(whole, cut) > 0.98 and likeness(whole, low) > 0.98
    assert likeness(whole, other) < 0.8


def test_a_grey_picture_is_one_without_colour():
    grey = cv2.cvtColor(noise(), cv2.COLOR_BGR2GRAY)
    small = BOXES[1:2]
    np.testing.assert_array_equal(
        strip_histograms(grey, small), strip_histograms(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), small)
    )
    assert strip_histograms(grey, BOXES).shape == (4, SIGNATURE)


KNOBS = Settings().track
UNKNOWN = np.zeros(12)


def looks(count: int, seed: int = 0) -> np.ndarray:
    """(N, 12) histograms of sum 1."""
    some = np.random.default_rng(seed).random((count, 12)) ** 4
    return some / some.sum(axis=1, keepdims=True)


def test_a_similar_histogram_scores_more_the_more_of_the_target_is_seen_and_an_unknown_one_nothing():
    one, two = looks(2)
    alike = similarity(np.stack([one, UNKNOWN]), np.stack([one, (one + two) / 2, two, two, two, UNKNOWN]))
    score = appearance_scores(alike, np.array([1, 1, 1, 0.4, 0, 1]), KNOBS)
    assert score[0, 0] == pytest.approx(KNOBS.appearance_weight * (1 - KNOBS.appearance_offset))
    assert score[0, 0] > score[0, 1] > score[0, 2]
    assert abs(score[0, 2]) > abs(score[0, 3]) > abs(score[0, 4]) == 0
    assert score[0, 5] == 0 and not score[1].any()


CLEAR, RIVALS = [[9.0, -90], [-90, 9.0]], [[9.0, 8.5], [-90, -90]]


def test_there_is_a_doubt_where_a_track_or_a_detection_has_two_likely_links():
    known = looks(2)
    assert not is_ambiguous(np.array(CLEAR), known)
    assert is_ambiguous(np.array(RIVALS), known)
    assert is_ambiguous(np.array(RIVALS).T, known)
    # Until a track that may go on has a histogram.
    assert is_ambiguous(np.array(CLEAR), known[:, :0])
    known[1] = 0
    assert is_ambiguous(np.array(CLEAR), known)
    assert not is_ambiguous(np.array([[9.0, -90], [-90, -90]]), known)


def test_a_first_look_is_taken_whole_and_an_unknown_one_changes_nothing():
    one = looks(1)
    hits, visible = np.array([4]), np.array([0.1])
    np.testing.assert_array_equal(blend_histograms(UNKNOWN[None], one, visible, hits), one)
    np.testing.assert_array_equal(blend_histograms(one, UNKNOWN[None], np.ones(1), hits), one)
    np.testing.assert_array_equal(blend_histograms(UNKNOWN[None], UNKNOWN[None], visible, hits), UNKNOWN[None])


SIGHT = SceneState(frame=11, interval=5, speed=0.07, size=(1000.0, 800.0))
PERSON = np.array([500.0, 300, 32, 80])
HERE = np.zeros(1, bool)


def track(box: np.ndarray = PERSON, seen: int = 6, velocity: tuple[float, float] = (0, 0)) -> np.ndarray:
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
    return np.array([[PERSON[0] + x, PERSON[1] + y, *PERSON[2:]] for x, y in steps])


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1), (0.6, 0.8)])
@pytest.mark.parametrize("seen", [6, 1])
def test_a_score_falls_with_distance_and_below_nothing(direction, seen):
    steps = [(direction[0] * d, direction[1] * d) for d in (0, 5, 20, 60, 150, 400)]
    score = scored(moved(*steps), track(seen=seen))
    assert score == sorted(score, reverse=True)
    assert len(set(score)) == len(score)
    assert score[0] > 0 > score[-1]


@given_settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000), st.floats(0.05, 20), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.sampled_from([1, 6]))
def test_the_scale_of_the_scene_and_its_place_do_not_matter(seed, scale, x, y, seen):
    random = np.random.default_rng(seed)
    similar = np.array([[scale, 0, x], [0, scale, y], [0, 0, 1]])
    boxes = PERSON + random.normal(0, 30, (5, 4)) * [2, 2, 0.2, 0.5]
    state, sight = track(seen=seen, velocity=(6, -3)), replace(SIGHT, size=None)
    expected = association_scores(state, HERE, boxes, sight, KNOBS)
    there = association_scores(
        kalman.transform(state, similar), HERE, kalman.transform_boxes(boxes, similar), sight, KNOBS
    )
    np.testing.assert_allclose(there, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("tracks", "boxes"), [(0, 0), (0, 2), (2, 0)])
def test_nobody_or_nothing_gives_an_empty_table(tracks, boxes):
    state = np.repeat(track(), tracks, axis=0)
    assert association_scores(state, np.zeros(tracks, bool), np.tile(PERSON, (boxes, 1)), SIGHT, KNOBS).shape == (
        tracks,
        boxes,
    )


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


def walkers(frame: int, speed: float, count: int = 6) -> np.ndarray:
    """(N, 4) boxes 40 px high, far apart, that walk to the right at so many heights a frame."""
    x = 300.0 * np.arange(count) + 40 * speed * frame
    return np.stack([x, np.full(count, 50.0), np.full(count, 16.0), np.full(count, 40.0)], axis=1)


def learned(speed: float, interval: int = 5, looks: int = 40, start: float = 0.07) -> float:
    pace = SpeedPrior(start)
    for look in range(looks):
        pace.add(walkers(interval * look, speed), walkers(interval * (look + 1), speed), interval)
    return pace.speed


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.3])
def test_it_ends_near_the_true_speed(speed):
    assert speed / 1.6 < learned(speed) < 1.6 * speed


@pytest.mark.parametrize("left", [True, False])
def test_targets_without_a_partner_are_no_steps(left):
    """Those that left are nobody's nearest, those that came are nearest to none: their distances are no speeds."""
    pace, other = SpeedPrior(0.07), SpeedPrior(0.07)
    before, now = walkers(0, 0.1), walkers(5, 0.1)
    strangers = walkers(0, 0.1) - np.array([5000, 0, 0, 0])
    pace.add(before, now, 5)
    other.add(np.concatenate([strangers, before]) if left else before, now if left else np.r_[now, strangers], 5)
    assert other.speed == pytest.approx(pace.speed)
