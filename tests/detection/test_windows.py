"""Which frames a window looks at."""

import pytest

from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.detection import windows

SHIPPED = {name: load_config(name) for name in ("source", "fast")} | {"default": load_config()}
ENDS = [(0, 40), (0, 20), (20, 40), (19, 21), (20, 22), (18, 20)]


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("interval", [1, 2, 3, 4, 6, 12])
@pytest.mark.parametrize(("first", "last"), ENDS)
def test_every_frame_of_a_window_hangs_together_with_it_and_lies_at_most_two_intervals_ahead(
    name, interval, first, last
):
    near, wide, small = windows.choose_pairs(20, interval, first, last, SHIPPED[name])
    used = [i for pair in [*near, wide, small] if pair for i in pair]
    assert all(first <= i <= min(last, 20 + 2 * interval) for i in used)
    assert 20 not in used or SHIPPED[name].difference.kind == "between_later"
    assert all(a != b for a, b in near)


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize(("first", "last"), ENDS)
def test_three_frames_that_hang_together_are_enough_for_a_window(name, first, last):
    near, _, _ = windows.choose_pairs(20, 3, first, last, SHIPPED[name])
    assert near


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("interval", [1, 2, 3, 4, 6, 12])
def test_reach_covers_all_that_a_window_looks_at(name, interval):
    """What comes after the reach must not matter, or a stream would give other results than a file."""
    ahead = windows.look_ahead(interval, SHIPPED[name])
    for first in (0, 17, 19, 20):
        seen = windows.choose_pairs(20, interval, first, 20 + ahead, SHIPPED[name])
        assert windows.choose_pairs(20, interval, first, 60, SHIPPED[name]) == seen


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("interval", [2, 3, 4, 6, 12])
def test_reach_and_delay_together_are_at_most_two_intervals(name, interval):
    settings = SHIPPED[name]
    assert windows.look_ahead(interval, settings) + windows.settling_delay(interval, settings) <= 2 * interval


def test_the_source_looks_at_one_and_two_intervals_ahead_and_back_at_the_end():
    settings = load_config("source")
    assert windows.choose_pairs(20, 4, 0, 40, settings)[0] == [(24, 28)]
    assert windows.choose_pairs(20, 4, 0, 20, settings)[0] == [(16, 12)]
    assert windows.choose_pairs(20, 4, 0, 25, settings)[0] == [(16, 12)]
    assert windows.choose_pairs(20, 4, 19, 23, settings)[0] == [(21, 22)]


def test_small_targets_are_looked_for_only_over_long_intervals_and_where_they_are_switched_on():
    settings = with_parameters(load_config(), {"small.from_interval": 3, "small.gap_frames": 3})
    assert windows.choose_pairs(20, 2, 0, 40, settings)[2] is None
    assert windows.choose_pairs(20, 3, 0, 40, settings)[2] == (17, 23)
    assert windows.choose_pairs(20, 3, 0, 40, with_parameters(settings, {"small.on": False}))[2] is None
