"""The accuracy ratio of the source, mismatch by mismatch."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.tracking import accuracy_ratio, mismatches

FRAME = np.array([7, 8])


def rows(*lines: tuple[int, ...]) -> np.ndarray:
    return np.array(lines)


@pytest.mark.parametrize(
    ("associated", "older", "newer", "wanted"),
    [
        (rows((1, 1), (2, 2)), [7, 8], [7, 8], 0),
        (rows((1, 2), (2, 1)), [7, 8], [7, 8], 2),  # swapped
        (rows((1, 1), (2, 0), (0, 2)), [7, 8], [7, 8], 1),  # with the dummy although it is there
        (rows((1, 1), (0, 2)), [7, 8], [7], 0),  # gone indeed
        (rows((1, 2), (0, 1)), [7, 8], [7], 2),  # 8 takes the place of 7, which is there
        (rows((1, 1), (2, 0)), [7], [7, 9], 0),  # new indeed
        (rows((1, 1)), [7], [9], 1),  # followed by another
    ],
)
def test_pairs_by_hand(associated, older, newer, wanted):
    assert mismatches(associated, [np.array(newer), np.array(older)]) == wanted
    assert accuracy_ratio(associated, [np.array(newer), np.array(older)]) == 1 - wanted / max(len(newer), len(older))


@pytest.mark.parametrize(
    ("associated", "newest", "middle", "oldest", "wanted"),
    [
        (rows((1, 1, 1), (2, 2, 2)), [7, 8], [7, 8], [7, 8], 0),
        (rows((1, 1, 2), (2, 2, 1)), [7, 8], [7, 8], [7, 8], 2),  # the older link swapped
        (rows((1, 2, 1), (2, 1, 2)), [7, 8], [7, 8], [7, 8], 4),  # both
        (rows((1, 0, 1), (2, 1, 2)), [7, 8], [8], [7, 8], 0),  # bridged rightly
        (rows((1, 0, 2), (2, 1, 0), (0, 0, 1)), [7, 8], [8], [7, 8], 1),  # 8 was there: one mismatch, not two
        (rows((1, 0, 1), (2, 0, 0)), [9, 8], [], [7], 1),  # bridged to another
        (rows((1, 0, 0), (0, 0, 1)), [7], [], [7], 0),  # a bridge that was not made
        (rows((1, 0, 0), (0, 1, 0), (0, 0, 1)), [7], [7], [7], 2),  # everybody alone
    ],
)
def test_triplets_by_hand(associated, newest, middle, oldest, wanted):
    frames = [np.array(f, int) for f in (newest, middle, oldest)]
    assert mismatches(associated, frames) == wanted
    assert accuracy_ratio(associated, frames) == 1 - wanted / (2 * max(map(len, frames)))


def test_empty_frames_are_associated_without_a_mistake():
    assert accuracy_ratio(np.zeros((0, 2), int), [np.zeros(0, int)] * 2) == 1


@pytest.mark.parametrize(
    ("associated", "wanted"),
    [
        (rows((1, 1)), "frame 0 .* has 2 targets"),
        (rows((1, 1), (2, 1)), r"frame 1 .* got rows for \[1, 1\]"),
        (rows((1, 1), (2, 3)), r"frame 1 .* got rows for \[1, 3\]"),
        (rows((1, 1, 1), (2, 2, 2)), "as many columns"),
    ],
)
def test_rows_that_are_no_assignment_are_refused(associated, wanted):
    with pytest.raises(InputError, match=wanted):
        mismatches(associated, [FRAME, FRAME])


@given(st.permutations(range(5)), st.permutations(range(5)))
@settings(max_examples=40, deadline=None)
def test_only_a_row_of_one_identity_is_free_of_mismatches(first, second):
    associated = np.stack([np.arange(5), np.array(first), np.array(second)], axis=1) + 1
    known = np.arange(5)
    wrong = (np.array(first) != known).sum() + (np.array(second) != np.array(first)).sum()
    assert mismatches(associated, [known, known, known]) == wrong
