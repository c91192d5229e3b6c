"""Association scores: histograms of boxes and their similarity; motion and size; the speed prior."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as given_settings
from hypothesis import strategies as st

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


BOX = (100, 40, 40, 120)
NOISE = np.random.default_rng(0).integers(0, 256, (200, 300, 3), np.uint8)
KNOBS = Settings().track
UNKNOWN = np.zeros(12)
SCENE = SceneState(frame=11, interval=5, speed=0.07, size=(1000.0, 800.0))
PERSON = np.array([500.0, 300, 32, 80])


def histograms(count: int) -> np.ndarray:
    """(N, 12) histograms of sum 1."""
    some = np.random.default_rng(0).random((count, 12)) ** 4
    return some / some.sum(axis=1, keepdims=True)


def test_histograms_of_boxes_outside_are_zero_and_of_boxes_cut_off_have_sum_one():
    outside = [(-50, 10, 40, 80), (300, 10, 40, 80), (10, -90, 40, 80), (10, 200, 40, 80)]
    cut = [(-20, 40, 40, 120), (0, 150, 40, 120), (-100, -100, 600, 600)]
    found = strip_histograms(NOISE, np.array(outside + cut, float))
    assert found.dtype == np.float32 and not found[:4].any() and (found >= 0).all()
    np.testing.assert_allclose(found[4:].sum(axis=1), 1, rtol=1e-5)


def test_a_target_cut_off_by_the_border_is_similar_to_itself():
    """The visible part is compared in its place in the whole box, not stretched to one."""
    image = picture((BOX, RED, BLUE), ((200, 40, 40, 120), GREEN, BLUE))
    whole, other = strip_histograms(image, np.array([BOX, (200, 40, 40, 120)], float))
    cut = strip_histograms(image[:, 115:], np.array([(-15, *BOX[1:])], float))[0]
    low = strip_histograms(image[:130], np.array([BOX], float))[0]
    alike = np.sqrt([whole, cut, low, other]) @ np.sqrt(whole)
    assert alike[0] == pytest.approx(1, abs=1e-5)
    assert alike[1:3].min() > 0.98 and alike[3] < 0.8


def test_a_grey_picture_equals_one_without_colour():
    grey, boxes = cv2.cvtColor(NOISE, cv2.COLOR_BGR2GRAY), np.array([(10, 10, 20, 50), (150, 150, 3, 2)], float)
    found = strip_histograms(grey, boxes)
    assert found.shape == (2, SIGNATURE)
    np.testing.assert_array_equal(found, strip_histograms(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), boxes))


def test_the_score_grows_with_the_similarity_and_the_visible_share_and_is_zero_if_unknown():
    one, two = histograms(2)
    alike = similarity(np.stack([one, UNKNOWN]), np.stack([one, (one + two) / 2, two, two, two, UNKNOWN]))
    score = appearance_scores(alike, np.array([1, 1, 1, 0.4, 0, 1]), KNOBS)
    assert score[0, 0] == pytest.approx(KNOBS.appearance_weight * (1 - KNOBS.appearance_offset))
    assert score[0, 0] > score[0, 1] > score[0, 2]
    assert abs(score[0, 2]) > abs(score[0, 3]) > abs(score[0, 4]) == 0
    assert score[0, 5] == 0 and not score[1].any()


BOTH = histograms(2)


@pytest.mark.parametrize(
    ("links", "known", "ambiguous"),
    [
        ([[9.0, -90], [-90, 9.0]], BOTH, False),
        ([[9.0, 8.5], [-90, -90]], BOTH, True),  # a track with two likely links
        ([[9.0, -90], [8.5, -90]], BOTH, True),  # a detection with two
        ([[9.0, -90], [-90, 9.0]], BOTH[:, :0], True),  # a track with a link has no histogram yet
        ([[9.0, -90], [-90, 9.0]], BOTH * [[1], [0]], True),
        ([[9.0, -90], [-90, -90]], BOTH * [[1], [0]], False),
    ],
)
def test_links_are_ambiguous_with_two_likely_ones_or_without_a_histogram(links, known, ambiguous):
    assert is_ambiguous(np.array(links), known) == ambiguous


def test_the_first_histogram_is_taken_whole_and_an_unknown_one_changes_nothing():
    one, none, hits = histograms(1), UNKNOWN[None], np.array([4])
    for visible in (np.array([0.1]), np.ones(1)):
        np.testing.assert_array_equal(blend_histograms(none, one, visible, hits), one)
        np.testing.assert_array_equal(blend_histograms(one, none, visible, hits), one)
        np.testing.assert_array_equal(blend_histograms(none, none, visible, hits), none)


def track(box: np.ndarray = PERSON, seen: int = 6, velocity: tuple[float, float] = (0, 0)) -> np.ndarray:
    """(1, COLUMNS) a target seen several times, last at a frame."""
    state = kalman.start(box[None], 1, KNOBS.scatter, 0.07)
    state = kalman.update(kalman.predict(state, 6, KNOBS.agility), box[None], 6, KNOBS.scatter)
    state[:, [VX, VY]] = velocity
    state[:, SEEN] = seen
    return state


def scored(boxes, state=None, scene=SCENE, left=False) -> list[float]:
    """The scores of one track's links."""
    state = track() if state is None else state
    return association_scores(state, np.full(len(state), left), np.asarray(boxes), scene, KNOBS)[0].tolist()


def moved(*steps: tuple[float, float]) -> np.ndarray:
    return np.array([[PERSON[0] + x, PERSON[1] + y, *PERSON[2:]] for x, y in steps])


@pytest.mark.parametrize("direction", [(1, 0), (0, -1), (0.6, 0.8)])
@pytest.mark.parametrize("seen", [6, 1])
def test_a_score_falls_with_distance_to_below_zero(direction, seen):
    score = scored(moved(*[(direction[0] * d, direction[1] * d) for d in (0, 5, 20, 60, 150, 400)]), track(seen=seen))
    assert score == sorted(set(score), reverse=True) and len(score) == 6
    assert score[0] > 0 > score[-1]


@given_settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000), st.floats(0.05, 20), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.sampled_from([1, 6]))
def test_scores_do_not_depend_on_the_scale_or_place_of_the_scene(seed, scale, x, y, seen):
    similar = np.array([[scale, 0, x], [0, scale, y], [0, 0, 1]])
    boxes = PERSON + np.random.default_rng(seed).normal(0, 30, (5, 4)) * [2, 2, 0.2, 0.5]
    state, scene = track(seen=seen, velocity=(6, -3)), replace(SCENE, size=None)
    there = scored(kalman.transform_boxes(boxes, similar), kalman.transform(state, similar), scene)
    np.testing.assert_allclose(there, scored(boxes, state, scene), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("tracks", "boxes"), [(0, 0), (0, 2), (2, 0)])
def test_no_tracks_or_no_boxes_give_an_empty_table(tracks, boxes):
    state, boxes_px = np.repeat(track(), tracks, axis=0), np.tile(PERSON, (boxes, 1))
    assert association_scores(state, np.zeros(tracks, bool), boxes_px, SCENE, KNOBS).shape == (tracks, boxes)


def test_a_walker_may_have_stopped_only_during_a_gap():
    at_rest, onward, back, half = moved((0, 0), (160, 0), (-120, 0), (40, 0))
    recent, lost = (track(seen=11 - gap, velocity=(8, 0)) for gap in (5, 20))
    assert scored([at_rest], track(seen=-9))[0] >= scored([at_rest], lost)[0] > 0
    assert scored([back, onward], lost)[0] < 0
    assert scored([at_rest], recent)[0] < 0.5 * scored([half], recent)[0]


@pytest.mark.parametrize(("seen", "matters"), [(6, False), (1, True)])
def test_the_border_counts_only_for_missed_tracks(seen, matters):
    edge = np.array([0.0, 300, 32, 80])
    state, unbounded = track(edge, seen), replace(SCENE, size=None)
    inside = scored([edge], state, unbounded)[0]
    assert (scored([edge], state)[0] < inside) == matters
    assert (scored([edge], state, unbounded, left=True)[0] < inside) == matters


def walkers(frame: int, speed: float, count: int = 6) -> np.ndarray:
    """(N, 4) boxes 40 px high, far apart, that walk to the right at so many heights a frame."""
    x = 300.0 * np.arange(count) + 40 * speed * frame
    return np.stack([x, np.full(count, 50.0), np.full(count, 16.0), np.full(count, 40.0)], axis=1)


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.3])
def test_the_speed_prior_converges_to_the_true_speed_whatever_comes_and_goes(speed):
    pace, strangers = SpeedPrior(0.07), walkers(0, 0.1) - np.array([5000, 0, 0, 0])
    for frame in range(0, 200, 5):
        before, now = walkers(frame, speed), walkers(frame + 5, speed)
        before = np.concatenate([strangers, before]) if frame % 2 else before
        pace.add(before, now if frame % 2 else np.concatenate([now, strangers]), 5)
    assert speed / 1.6 < pace.speed < 1.6 * speed
