"""Which few pictures of a run are kept."""

from functools import partial

import cv2
import numpy as np
import pytest

from torchvision_dddas.io.output.key_frames import MOST, KeyFrames

PICTURE = np.full((24, 32, 3), 90, np.uint8)


def run(count, happened=None, size=(32, 24)):
    """A run of frames from 1. happened: frame -> kind or {kind: weight}. Returns it and the frames that were drawn."""
    kept, drawn = KeyFrames(), []

    def draw(number):
        drawn.append(number)
        return np.full((size[1], size[0], 3), 90, np.uint8)

    for number in range(1, count + 1):
        kinds = (happened or {}).get(number, {})
        kinds = kinds if isinstance(kinds, dict) else {kinds: 1.0}
        kept.add(number, number / 10, kinds, "; ".join(kinds), partial(draw, number))
    return kept, drawn


@pytest.mark.parametrize("count", [0, 1, 5, 9, 40, 1000, 5000])
def test_few_are_kept_however_long_the_run_and_they_are_spread_over_it(count):
    kept, drawn = run(count)
    numbers = [taken.number for taken in kept.chosen()]
    assert len(numbers) == min(count, MOST)
    assert numbers == sorted(set(numbers))
    if count >= 40:
        assert np.diff([1, *numbers, count]).max() <= 0.3 * count
    assert len(drawn) < 40 + 18 * np.log2(max(count, 2))


def test_frames_at_which_something_happened_are_among_them():
    kept, _ = run(1000, {137: "join", 611: "split"})
    chosen = {taken.number: taken.text for taken in kept.chosen()}
    assert chosen[137] == "join" and chosen[611] == "split"
    assert len(chosen) == MOST


def test_of_what_happens_again_and_again_the_first_is_shown():
    _, drawn = run(1000, dict.fromkeys(range(3, 1000, 2), "flutter"))
    assert len(drawn) < 250 and 3 in drawn


def test_where_too_much_happened_what_matters_is_shown():
    little = {number: {f"k{number}": 1.0} for number in range(10, 400, 10)}
    kept, _ = run(400, {**little, 205: {"join": 50.0}})
    chosen = kept.chosen()
    assert len(chosen) <= MOST and "join" in [taken.text for taken in chosen]


@pytest.mark.parametrize("size", [(1920, 1080), (480, 4000), (31, 17)])
def test_pictures_are_small_and_keep_their_shape(size):
    kept, _ = run(1, size=size)
    shown = cv2.imdecode(np.frombuffer(kept.chosen()[0].jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape[0] * shown.shape[1] < 1.02 * 520 * 390
    assert shown.shape[1] / shown.shape[0] == pytest.approx(size[0] / size[1], rel=0.02)
