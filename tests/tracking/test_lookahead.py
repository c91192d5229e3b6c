"""Links in view of the next look."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking.lookahead import best_links, plausible


def chosen(links, onward=None, born=None, bridging=None, ahead=0):
    """The pairs, sorted. onward: {(track, detection): scores to the next look}; what is not given is worth nothing."""
    links = np.asarray(links, float)
    tracks, now = plausible(links)
    next_look = np.full((len(tracks), ahead), -9.0)
    for (i, j), score in (onward or {}).items():
        next_look[(tracks == i) & (now == j)] = score
    none = np.full((max(links.shape), ahead), -9.0)
    born = none[: links.shape[1]] if born is None else np.asarray(born, float)
    bridging = none[: links.shape[0]] if bridging is None else np.asarray(bridging, float)
    kept = best_links(links[tracks, now], tracks, now, next_look, born, bridging)
    return sorted(zip(tracks[kept].tolist(), now[kept].tolist(), strict=True))


def test_what_is_far_below_nothing_is_not_followed():
    tracks, now = plausible(np.array([[3.0, -50.0], [-0.5, -np.inf]]))
    assert list(zip(tracks.tolist(), now.tolist(), strict=True)) == [(0, 0), (1, 0)]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 5), st.integers(0, 5))
def test_without_a_next_look_they_are_the_best_pairs_of_two_looks(seed, tracks, detections):
    links = np.random.default_rng(seed).normal(0, 3, (tracks, detections))
    assert chosen(links) == sorted(map(tuple, best_pairs(links).tolist()))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 5), st.integers(1, 5))
def test_no_two_pairs_share_a_track_or_a_detection(seed, tracks, detections, ahead):
    random = np.random.default_rng(seed)
    links = random.normal(0, 3, (tracks, detections))
    i, j = plausible(links)
    onward, born = random.normal(0, 3, (len(i), ahead)), random.normal(0, 3, (detections, ahead))
    kept = best_links(links[i, j], i, j, onward, born, random.normal(0, 3, (tracks, ahead)))
    assert kept.shape == i.shape and kept.dtype == bool
    assert len(np.unique(i[kept])) == len(np.unique(j[kept])) == kept.sum()


@pytest.mark.parametrize("score", [-1e-6, -1.0])
def test_no_link_below_nothing_is_made_for_its_own_sake(score):
    assert chosen([[score]]) == []
    assert chosen([[score]], onward={(0, 0): [-1.0]}, ahead=1) == []
    assert chosen([[1e-6]]) == [(0, 0)]


def test_the_next_look_can_speak_for_a_doubtful_link_but_not_for_an_absurd_one():
    assert chosen([[-0.5]], onward={(0, 0): [5.0]}, ahead=1) == [(0, 0)]
    assert chosen([[-20.0]], onward={(0, 0): [500.0]}, ahead=1) == []


def test_the_next_look_turns_a_near_tie():
    """Two tracks, two detections: crossed is a little better now, but leads nowhere."""
    links = [[2.0, 2.1], [2.1, 2.0]]
    straight = {(0, 0): [4.0, -9.0], (1, 1): [-9.0, 4.0]}
    assert chosen(links) == [(0, 1), (1, 0)]
    assert chosen(links, onward=straight, ahead=2) == [(0, 0), (1, 1)]


def test_the_next_look_counts_less_than_this_one():
    links, onward = [[3.0, 0.5]], {(0, 0): [0.5], (0, 1): [3.0]}
    assert chosen(links, onward=onward, ahead=1) == [(0, 0)]


def test_a_track_waits_for_the_next_look_where_a_bridge_is_worth_more():
    """The detection is another target, which begins here and goes on."""
    assert chosen([[1.0]], onward={(0, 0): [-5.0, 1.0]}, born=[[-5.0, 4.0]], bridging=[[4.0, -5.0]], ahead=2) == []
    assert chosen([[1.0]], onward={(0, 0): [-5.0, 1.0]}, ahead=2) == [(0, 0)]


def test_a_birth_and_a_bridge_each_count():
    """A link of little worth is left only if both others together are worth more."""
    links, onward = [[3.0]], {(0, 0): [-5.0, -5.0]}
    bridge, birth = [[3.0, -5.0]], [[-5.0, 3.0]]
    assert chosen(links, onward=onward, bridging=bridge, ahead=2) == [(0, 0)]
    assert chosen(links, onward=onward, born=birth, ahead=2) == [(0, 0)]
    assert chosen(links, onward=onward, born=birth, bridging=bridge, ahead=2) == []


def test_a_bridge_alone_and_a_birth_alone_are_no_pairs():
    assert chosen(np.zeros((1, 0)), bridging=[[4.0]], ahead=1) == []
    assert chosen(np.zeros((0, 1)), born=[[4.0]], ahead=1) == []


def test_nobody_and_nothing():
    assert chosen(np.zeros((0, 0))) == []
    assert chosen(np.zeros((0, 0)), ahead=2) == []


def test_boxes_in_stacks_keep_to_those_of_their_own_place_in_the_order():
    """Equal scores all over: any whole matching is as good, and it must be found without trying them all."""
    for count in (2, 9, 20):
        assert len(chosen(np.full((count, count), 5.0), born=np.full((count, count), 4.0), ahead=count)) == count
