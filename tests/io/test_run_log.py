"""The log of a run: one line for each thing that happened, in order, with its cause."""

import numpy as np
import pytest

from torchvision_dddas.io.output.run_log import LANDMARK, PROBLEM, WORLD, Clock, RunLog, format_log
from torchvision_dddas.types import Adjustment

FRAME = np.arange(1, 101)
TIME_S = (FRAME - 1) / 10


def text(log, frame=FRAME, time_s=TIME_S):
    """The lines below the heading."""
    return format_log(log.ordered(), Clock(frame, time_s), ["clip"]).splitlines()[3:]


def test_an_adjustment_is_told_with_its_time_its_values_and_its_cause():
    log = RunLog()
    log.adjusted(Adjustment(31, "interval.frames", 1, 3, "background flow 0.4 px a frame"))
    (line,) = text(log)
    assert " ".join(line.split()) == "3.000 31 adjusted interval.frames 1 -> 3: background flow 0.4 px a frame"


def test_a_value_that_is_no_number_is_told_as_none():
    log = RunLog()
    log.adjusted(Adjustment(1, "gates.max_size_px", np.inf, 52.0, "altitude 45 m"))
    assert "gates.max_size_px none -> 52" in text(log)[0]


def test_lines_are_in_the_order_of_the_frames_whenever_they_were_told():
    log = RunLog()
    for frame in (40, 3, 17, 3):
        log.add(frame, WORLD, f"event at {frame}")
    assert [int(line.split()[1]) for line in text(log)] == [3, 3, 17, 40]


def test_what_lasts_is_one_line_that_says_how_long_though_its_numbers_differ():
    log = RunLog()
    for frame in range(10, 20):
        log.add_lasting(frame, 1, PROBLEM, f"not located: {frame % 3} landmarks")
    (line,) = text(log)
    assert "not located: 1 landmarks (to frame 19)" in line


def test_what_comes_and_goes_is_one_line_that_says_how_often():
    log = RunLog()
    for frame in range(10, 31, 4):
        log.add_lasting(frame, 1, LANDMARK, "blue is not seen", key="blue")
    (line,) = text(log)
    assert "(to frame 30, in 6 of 21 frames)" in line


def test_where_every_fifth_frame_is_looked_at_these_count_as_all():
    log = RunLog()
    for frame in range(11, 60, 5):
        log.add_lasting(frame, 5, PROBLEM, "dark")
    (line,) = text(log, FRAME[::5], TIME_S[::5])
    assert line.endswith("dark (to frame 56)")


def test_what_comes_again_much_later_is_told_again():
    log = RunLog()
    for frame in (10, 11, 50):
        log.add_lasting(frame, 1, PROBLEM, "dark")
    assert len(text(log)) == 2


def test_words_over_several_lines_stay_on_one():
    log = RunLog()
    log.add(5, PROBLEM, "first\nsecond")
    assert len(text(log)) == 1


@pytest.mark.parametrize(("frame", "time_s"), [(1, 0.0), (11, 1.0), (51, 5.0), (101, 10.0), (121, 12.0)])
def test_the_time_of_a_frame_is_told_by_those_around_it_or_goes_on_beyond_them(frame, time_s):
    assert Clock(np.array([11, 21, 41]), np.array([1.0, 2.0, 4.0])).at(frame) == pytest.approx(time_s)


def test_without_any_clock_there_are_frames_but_no_times():
    log = RunLog()
    log.add(5, WORLD, "crowds join")
    (line,) = text(log, FRAME, np.full(100, np.nan))
    assert line.split() == ["5", "world", "crowds", "join"]
