"""What the look of targets says, and when it says nothing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as given_settings
from hypothesis import strategies as st

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.tracking.appearance_score import blended, in_doubt, likeness_scores, visible_share

KNOBS = Settings().track
UNKNOWN = np.zeros(12)


def looks(count: int, seed: int = 0) -> np.ndarray:
    """(N, 12) histograms of sum 1."""
    some = np.random.default_rng(seed).random((count, 12)) ** 4
    return some / some.sum(axis=1, keepdims=True)


def test_the_same_look_speaks_for_a_link_and_another_against_it():
    apart = np.eye(12)[:3]
    score = likeness_scores(apart, apart, np.ones(3), KNOBS)
    assert (np.diag(score) > 0).all()
    assert (score[~np.eye(3, dtype=bool)] < 0).all()


def test_the_same_look_scores_best_and_a_mixture_of_two_between_them():
    one, two = looks(2)
    score = likeness_scores(one[None], np.stack([one, (one + two) / 2, two]), np.ones(3), KNOBS)[0]
    assert score[0] > score[1] > score[2]
    assert score[0] == pytest.approx(KNOBS.appearance_weight * (1 - KNOBS.appearance_offset))


def test_there_is_an_end_to_what_an_unlike_look_says_against_a_link():
    """Light and turning change a look at once, so a larger weight makes the likes of it count more, not the unlikes."""
    heavy = with_parameters(Settings(), {"track.appearance_weight": 100}).track
    apart = np.eye(12)[:2]
    score, more = (likeness_scores(apart, apart, np.ones(2), parameters) for parameters in (KNOBS, heavy))
    assert more[0, 0] > score[0, 0]
    assert more[0, 1] == score[0, 1] < 0


def test_what_is_unknown_scores_nothing():
    known = looks(2)
    score = likeness_scores(np.stack([known[0], UNKNOWN]), np.stack([UNKNOWN, known[1]]), np.ones(2), KNOBS)
    assert score[0, 0] == score[1, 0] == score[1, 1] == 0
    assert score[0, 1] != 0


def test_the_less_of_a_target_is_seen_the_less_its_look_says():
    one, two = looks(2)
    score = likeness_scores(one[None], np.tile(two, (3, 1)), np.array([1.0, 0.4, 0.0]), KNOBS)[0]
    assert abs(score[0]) > abs(score[1]) > abs(score[2]) == 0


def test_no_weight_no_word():
    without = with_parameters(Settings(), {"track.appearance_weight": 0}).track
    assert not likeness_scores(looks(3), looks(4, 1), np.ones(4), without).any()


@given_settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(0, 5), st.integers(0, 5))
def test_each_pair_is_scored_by_itself(seed, count, others):
    one, other, visible = looks(count, seed), looks(others, seed + 1), np.random.default_rng(seed).random(others)
    score = likeness_scores(one, other, visible, KNOBS)
    assert score.shape == (count, others)
    for i in range(count):
        for j in range(others):
            alone = likeness_scores(one[i : i + 1], other[j : j + 1], visible[j : j + 1], KNOBS)
            assert score[i, j] == pytest.approx(alone[0, 0])


CLEAR, RIVALS = [[9.0, -90], [-90, 9.0]], [[9.0, 8.5], [-90, -90]]


def test_there_is_a_doubt_where_a_track_or_a_detection_has_two_likely_links():
    known = looks(2)
    assert not in_doubt(np.array(CLEAR), known)
    assert in_doubt(np.array(RIVALS), known)
    assert in_doubt(np.array(RIVALS).T, known)


def test_two_links_that_are_both_hopeless_or_far_apart_are_no_doubt():
    known = looks(1)
    assert not in_doubt(np.array([[-90.0, -90.0]]), known)
    assert not in_doubt(np.array([[9.0, -7.0]]), known)


def test_there_is_a_doubt_until_a_track_that_may_go_on_has_been_looked_at():
    known = looks(2)
    assert in_doubt(np.array(CLEAR), known[:, :0])
    known[1] = 0
    assert in_doubt(np.array(CLEAR), known)
    assert not in_doubt(np.array([[9.0, -90], [-90, -90]]), known)


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0)])
def test_nobody_or_nothing_leaves_no_doubt(shape):
    assert not in_doubt(np.zeros(shape), looks(shape[0]))


def test_a_first_look_is_taken_whole_and_an_unknown_one_changes_nothing():
    one = looks(1)
    hits, visible = np.array([4]), np.array([0.1])
    np.testing.assert_array_equal(blended(UNKNOWN[None], one, visible, hits), one)
    np.testing.assert_array_equal(blended(one, UNKNOWN[None], np.ones(1), hits), one)
    np.testing.assert_array_equal(blended(UNKNOWN[None], UNKNOWN[None], visible, hits), UNKNOWN[None])


def test_the_first_looks_are_averaged():
    seen = looks(3)
    memory = blended(seen[:1], seen[1:2], np.ones(1), np.array([2]))
    memory = blended(memory, seen[2:], np.ones(1), np.array([3]))
    np.testing.assert_allclose(memory[0], seen.mean(axis=0))


def test_a_memory_fades_but_does_not_vanish_at_once():
    old, new = looks(2)
    memory = old[None]
    far = []
    for hits in range(30, 60):
        memory = blended(memory, new[None], np.ones(1), np.array([hits]))
        assert memory.sum() == pytest.approx(1)
        far.append(np.abs(memory - new).sum())
    assert far[0] > 0.5 * np.abs(old - new).sum()
    assert far[-1] < 0.01
    assert far == sorted(far, reverse=True)


def test_a_covered_target_leaves_the_memory_alone():
    old, new = looks(2)
    moved = [
        np.abs(blended(old[None], new[None], np.array([visible]), np.array([8])) - old).sum() for visible in (1, 0.5, 0)
    ]
    assert moved[0] > moved[1] > moved[2] == 0


def test_who_stands_lower_in_the_picture_covers_who_stands_behind():
    behind, before = [0.0, 0, 10, 20], [5.0, 5, 10, 20]
    share = visible_share(np.array([behind, before]))
    assert share.tolist() == [pytest.approx(1 - 5 * 15 / 200), 1.0]
    assert visible_share(np.array([before, behind])).tolist() == share[::-1].tolist()


def test_boxes_apart_or_one_alone_or_two_the_same_are_wholly_visible():
    box = np.array([[0.0, 0, 10, 20], [10.0, 30, 10, 20], [0.0, 0, 10, 20]])
    assert visible_share(box).tolist() == [1, 1, 1]
    assert visible_share(box[:1]).tolist() == [1]
    assert visible_share(box[:0]).shape == (0,)


def test_a_share_is_never_below_nothing():
    crowd = np.array([[0.0, 0, 10, 20], [0.0, 1, 10, 20], [0.0, 2, 10, 20], [0.0, 3, 10, 20]])
    share = visible_share(crowd)
    assert share[0] == 0 and share[-1] == 1
    assert ((share >= 0) & (share <= 1)).all()
