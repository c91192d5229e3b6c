"""Which examples are learned from and which are watched."""

import pytest

from tests.tuning.toys import pieces
from torchvision_dddas.tuning.examples import clip_shares, draw_batch, split_examples


def test_the_last_part_of_each_clip_is_watched_and_never_learned_from() -> None:
    learned, watched = split_examples(pieces(("one", "two"), 8), 0.25, 99)
    assert [(one.clip, one.frame) for one in watched] == [("one", 7), ("one", 8), ("two", 7), ("two", 8)]
    assert not {(one.clip, one.frame) for one in learned} & {(one.clip, one.frame) for one in watched}
    assert len(learned) == 12


def test_where_clips_are_too_short_all_are_learned_from_and_watched() -> None:
    learned, watched = split_examples(pieces(("one", "two"), 2), 0.25, 99)
    assert learned == watched and len(learned) == 4


@pytest.mark.parametrize("frames", [3, 4, 5])
def test_of_a_short_clip_something_is_learned_whatever_share_is_watched(frames: int) -> None:
    learned, watched = split_examples(pieces(("one", "two"), frames), 0.9, 99)
    assert {one.clip for one in learned} == {one.clip for one in watched} == {"one", "two"}


def test_of_many_some_are_watched_from_all_over() -> None:
    _, watched = split_examples(pieces(("one", "two"), 40), 0.5, 8)
    assert len(watched) == 8 and {one.clip for one in watched} == {"one", "two"}


def test_every_example_has_its_turn_before_any_has_another() -> None:
    taken = [i for step in range(5) for i in draw_batch(step, ["one"] * 10, 4, seed=3)]
    assert sorted(taken[:10]) == sorted(taken[10:]) == list(range(10))
    assert taken[:10] != taken[10:]


def test_a_batch_is_no_larger_than_what_there_is() -> None:
    assert sorted(draw_batch(7, ["one", "two", "one"], 8, seed=0)) == [0, 1, 2]


def test_a_clip_with_few_labelled_frames_has_the_say_of_one_with_many() -> None:
    clips = ["long"] * 9 + ["short"] * 2
    taken = [i for step in range(9) for i in draw_batch(step, clips, 2, seed=0)]
    assert sorted(taken[:18]) == [*range(9), *[9] * 4, *[10] * 5] or sorted(taken[:18]) == [
        *range(9),
        *[9] * 5,
        *[10] * 4,
    ]
    assert [round(share, 3) for share in clip_shares(clips)] == [0.056] * 9 + [0.25] * 2
