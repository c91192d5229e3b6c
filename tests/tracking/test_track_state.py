"""Tracks in parallel arrays."""

import numpy as np
import pytest

from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.track_state import Roster, widened


def some(*numbers: int, width: int = 0) -> Roster:
    count = len(numbers)
    box = np.stack([100.0 * np.array(numbers), np.full(count, 20.0), np.full(count, 10.0), np.full(count, 30.0)], 1)
    signature = np.full((count, width), 1 / max(width, 1), np.float32)
    state = kalman.started(box.reshape(-1, 4), 1, 0.06, 0.07)
    return Roster(state, signature, np.array(numbers) % 2 == 1, np.array(numbers), np.array(numbers) + 10)


def assert_whole(roster: Roster, numbers: list[int]) -> None:
    """Each row is still the same track in all columns."""
    assert roster.number.tolist() == numbers
    assert len(roster) == len(numbers)
    assert roster.at_border.tolist() == [number % 2 == 1 for number in numbers]
    assert roster.hits.tolist() == [number + 10 for number in numbers]
    np.testing.assert_allclose(roster.state[:, kalman.X], [100 * number + 5 for number in numbers])
    assert len(roster.signature) == len(numbers)


def test_a_new_roster_is_empty_and_its_arrays_are_its_own():
    roster, other = Roster(), Roster()
    assert len(roster) == 0
    assert roster.state.shape == (0, kalman.COLUMNS)
    assert roster.state is not other.state


def test_two_rosters_are_joined_row_by_row():
    assert_whole(some(4, 7).plus(some(2)), [4, 7, 2])
    assert_whole(some(4, 7).plus(Roster()), [4, 7])
    assert_whole(Roster().plus(some(4, 7)), [4, 7])


@pytest.mark.parametrize(("width", "other"), [(0, 0), (0, 5), (5, 0), (5, 5)])
def test_unknown_histograms_become_zeros_where_others_are_known(width, other):
    both = some(1, 2, width=width).plus(some(3, width=other))
    assert both.signature.shape == (3, max(width, other))
    assert both.signature.any(axis=1).tolist() == [width > 0, width > 0, other > 0]


def test_an_empty_roster_adds_nothing_not_even_width():
    assert some(1, width=0).plus(some(width=5)).signature.shape == (1, 0)


def test_a_mask_keeps_whole_tracks():
    roster = some(4, 7, 2, width=3)
    assert_whole(roster.only(np.array([True, False, True])), [4, 2])
    assert_whole(roster.only(np.zeros(3, bool)), [])
    assert_whole(roster.only(np.ones(3, bool)), [4, 7, 2])


def test_a_camera_moves_the_states_alone_and_the_old_roster_stays():
    roster, pan = some(4, 7, width=3), np.array([[1.0, 0, 9], [0, 1, 0], [0, 0, 1]])
    moved = roster.carried(pan)
    np.testing.assert_allclose(moved.state[:, kalman.X], roster.state[:, kalman.X] + 9)
    assert_whole(roster, [4, 7])
    assert moved.number.tolist() == [4, 7]


def test_widening_does_nothing_where_the_width_is_right():
    known = np.ones((2, 3), np.float32)
    assert widened(known, 3) is known
    assert widened(known[:, :0], 3).tolist() == [[0, 0, 0], [0, 0, 0]]
