"""Histograms of boxes, their similarity, and the association score that follows."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.tracking.appearance import (
    SIGNATURE,
    appearance_scores,
    blend_histograms,
    is_ambiguous,
    similarity,
    strip_histograms,
    visible_shares,
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


def score_of(signature, other, visible, parameters):
    return appearance_scores(similarity(signature, other), visible, parameters)


def likeness(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.sqrt(one) @ np.sqrt(other))


BOX = (100, 40, 40, 120)
BOXES = np.array([BOX, (10, 10, 20, 50), (200.4, 100.7, 30.2, 80.9), (150, 150, 3, 2)], float)


def test_all_histograms_of_a_box_sum_to_one_together_and_none_is_negative():
    found = strip_histograms(noise(), BOXES)
    assert found.shape == (4, SIGNATURE) and found.dtype == np.float32
    np.testing.assert_allclose(found.sum(axis=1), 1, rtol=1e-5)
    assert (found >= 0).all()


def test_the_likeness_of_a_target_to_itself_is_one_and_to_another_colour_less():
    image = picture((BOX, RED, BLUE), ((200, 40, 40, 120), GREEN, BLUE), ((20, 40, 40, 120), RED, BLUE))
    same, other, again = strip_histograms(image, np.array([BOX, (200, 40, 40, 120), (20, 40, 40, 120)], float))
    assert likeness(same, same) == pytest.approx(1, abs=1e-5)
    assert likeness(same, again) == pytest.approx(1, abs=1e-5)
    assert likeness(same, other) < 0.8


def test_the_size_of_a_target_hardly_matters():
    image = picture((BOX, RED, BLUE), ((200, 100, 15, 45), RED, BLUE))
    one, small = strip_histograms(image, np.array([BOX, (200, 100, 15, 45)], float))
    assert likeness(one, small) > 0.95


def test_the_middle_of_a_box_counts_more_than_its_sides():
    middle, sides = picture(), picture()
    middle[40:160, 113:127] = RED
    sides[40:160, 100:107] = sides[40:160, 133:140] = RED
    body = strip_histograms(picture((BOX, RED, RED)), np.array([BOX], float))[0]
    in_the_middle, at_the_sides = (strip_histograms(image, np.array([BOX], float))[0] for image in (middle, sides))
    assert likeness(body, in_the_middle) > likeness(body, at_the_sides) + 0.1


def test_a_box_outside_has_zeros_and_one_half_outside_has_its_inside():
    image = noise()
    outside = [(-50, 10, 40, 80), (300, 10, 40, 80), (10, -90, 40, 80), (10, 200, 40, 80)]
    found = strip_histograms(
        image, np.array([*outside, (-20, 40, 40, 120), (0, 150, 40, 120), (-100, -100, 600, 600)], float)
    )
    assert not found[:4].any()
    np.testing.assert_allclose(found[4:].sum(axis=1), 1, rtol=1e-5)


def test_a_target_cut_off_by_the_border_still_looks_like_itself():
    """What is left of it is compared in its place in the whole box, not stretched to one."""
    image = picture((BOX, RED, BLUE))
    whole, cut = (
        strip_histograms(image, np.array([BOX], float))[0],
        strip_histograms(image[:, 115:], np.array([(-15, *BOX[1:])], float))[0],
    )
    low = strip_histograms(image[:130], np.array([BOX], float))[0]
    assert likeness(whole, cut) > 0.98
    assert likeness(whole, low) > 0.98


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


def test_the_same_look_scores_best_and_a_mixture_of_two_between_them():
    one, two = looks(2)
    score = score_of(one[None], np.stack([one, (one + two) / 2, two]), np.ones(3), KNOBS)[0]
    assert score[0] > score[1] > score[2]
    assert score[0] == pytest.approx(KNOBS.appearance_weight * (1 - KNOBS.appearance_offset))


def test_there_is_an_end_to_what_an_unlike_look_says_against_a_link():
    """Light and turning change a look at once, so a larger weight makes the likes of it count more, not the unlikes."""
    heavy = with_parameters(Settings(), {"track.appearance_weight": 100}).track
    apart = np.eye(12)[:2]
    score, more = (score_of(apart, apart, np.ones(2), parameters) for parameters in (KNOBS, heavy))
    assert more[0, 0] > score[0, 0]
    assert more[0, 1] == score[0, 1] < 0


def test_what_is_unknown_scores_nothing():
    known = looks(2)
    score = score_of(np.stack([known[0], UNKNOWN]), np.stack([UNKNOWN, known[1]]), np.ones(2), KNOBS)
    assert score[0, 0] == score[1, 0] == score[1, 1] == 0
    assert score[0, 1] != 0


def test_the_less_of_a_target_is_seen_the_less_its_look_says():
    one, two = looks(2)
    score = score_of(one[None], np.tile(two, (3, 1)), np.array([1.0, 0.4, 0.0]), KNOBS)[0]
    assert abs(score[0]) > abs(score[1]) > abs(score[2]) == 0


CLEAR, RIVALS = [[9.0, -90], [-90, 9.0]], [[9.0, 8.5], [-90, -90]]


def test_there_is_a_doubt_where_a_track_or_a_detection_has_two_likely_links():
    known = looks(2)
    assert not is_ambiguous(np.array(CLEAR), known)
    assert is_ambiguous(np.array(RIVALS), known)
    assert is_ambiguous(np.array(RIVALS).T, known)


def test_there_is_a_doubt_until_a_track_that_may_go_on_has_been_looked_at():
    known = looks(2)
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


def test_a_memory_fades_but_does_not_vanish_at_once():
    old, new = looks(2)
    memory = old[None]
    far = []
    for hits in range(30, 60):
        memory = blend_histograms(memory, new[None], np.ones(1), np.array([hits]))
        assert memory.sum() == pytest.approx(1)
        far.append(np.abs(memory - new).sum())
    assert far[0] > 0.5 * np.abs(old - new).sum()
    assert far[-1] < 0.01
    assert far == sorted(far, reverse=True)


def test_a_covered_target_leaves_the_memory_alone():
    old, new = looks(2)
    moved = [
        np.abs(blend_histograms(old[None], new[None], np.array([visible]), np.array([8])) - old).sum()
        for visible in (1, 0.5, 0)
    ]
    assert moved[0] > moved[1] > moved[2] == 0


def test_who_stands_lower_in_the_picture_covers_who_stands_behind():
    behind, before = [0.0, 0, 10, 20], [5.0, 5, 10, 20]
    share = visible_shares(np.array([behind, before]))
    assert share.tolist() == [pytest.approx(1 - 5 * 15 / 200), 1.0]
    assert visible_shares(np.array([before, behind])).tolist() == share[::-1].tolist()


def test_a_share_is_never_below_nothing():
    crowd = np.array([[0.0, 0, 10, 20], [0.0, 1, 10, 20], [0.0, 2, 10, 20], [0.0, 3, 10, 20]])
    share = visible_shares(crowd)
    assert share[0] == 0 and share[-1] == 1
    assert ((share >= 0) & (share <= 1)).all()
