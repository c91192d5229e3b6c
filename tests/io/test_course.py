"""The course of a run over time: parameters as steps, time spent by stage, and what happened when."""

import re

import numpy as np
import pytest

from torchvision_dddas.io.output.run_log import WORLD, Entry
from torchvision_dddas.io.report.run_plots import Course
from torchvision_dddas.io.report.timeline import plots
from torchvision_dddas.types import Adjustment, Detections, Frame, FrameResult, TrackedFrame, Tracks

PICTURE = np.zeros((4, 4, 3), np.uint8)


def frame(number, cause=""):
    return FrameResult(
        TrackedFrame(number, Frame(number, number / 10, PICTURE), Detections(), Tracks(number), cause=cause)
    )


def course(moves=(), frames=range(1, 11), seconds=lambda number: {}, names=()):
    """A run in which parameters are moved at frames: (frame, parameter, old, new)."""
    kept = Course(names)
    for number in frames:
        moved = [Adjustment(number, parameter, old, new, "why") for at, parameter, old, new in moves if at == number]
        kept.add(frame(number), seconds(number), moved)
    return kept


def titles(kept):
    return [title for title, _ in kept.panels()]


def curves(kept, title):
    return next(lines for name, lines in kept.panels() if name == title)


def test_a_parameter_holds_its_first_value_before_it_is_moved_and_each_new_one_from_its_frame_on():
    kept = course([(4, "a.b", 1, 3), (8, "a.b", 3, 2)])
    assert kept.values("a.b").tolist() == [1, 1, 1, 3, 3, 3, 3, 2, 2, 2]


def test_a_value_that_is_no_number_is_left_out_of_the_plot():
    kept = course([(1, "a.b", np.inf, np.inf), (3, "a.b", np.inf, 7), (6, "a.b", 7, 5)])
    np.testing.assert_array_equal(kept.values("a.b"), [np.nan, np.nan, 7, 7, 7, 5, 5, 5, 5, 5])
    assert "nan" not in plots(kept) and "inf" not in plots(kept)


def test_a_parameter_that_was_set_at_first_and_stayed_has_no_plot():
    kept = course([(1, "gates.min_size_px", 0, 5), (5, "interval.frames", 1, 2)])
    assert "interval.frames" in titles(kept) and "gates.min_size_px" not in titles(kept)


def test_what_is_adjusted_of_each_vehicle_is_one_plot():
    moves = [(3, "ugv1.speed_m_s", 3, 1), (5, "ugv2.speed_m_s", 3, 1), (6, "uav.altitude_m", 50, 60)]
    kept = course(moves, names=("ugv1", "ugv2"))
    assert [curve.name for curve in curves(kept, "speed_m_s of each ground vehicle")] == ["ugv1", "ugv2"]
    assert "uav.altitude_m" in titles(kept) and "ugv1.speed_m_s" not in titles(kept)


def test_plots_of_knobs_are_limited_to_those_moved_most_often():
    moves = [(k, f"group.parameter{n:02d}", 0, k) for n in range(30) for k in range(2, 3 + n // 4)]
    shown = [title for title in titles(course(moves, range(1, 15))) if title.startswith("group")]
    assert 6 <= len(shown) <= 15 and "group.knob29" in shown and "group.knob00" not in shown


def test_stages_lie_on_top_of_each_other_up_to_all_the_time_spent():
    spent = {f"stage{k}": 0.001 * (k + 1) for k in range(11)}
    kept = course(seconds=lambda number: spent if number != 4 else {"rare": 0.5})
    lines = curves(kept, "time spent on a frame, ms, stacked")
    # The highest is drawn first, so that it hides none of the others.
    heights = np.stack([line.values for line in lines])
    assert (np.diff(heights, axis=0) <= 1e-9).all()
    np.testing.assert_allclose(heights[0], [66, 66, 66, 500, 66, 66, 66, 66, 66, 66], rtol=1e-4)
    assert lines[0].name == "other"


def test_what_happened_is_ticked_at_its_time_with_its_words():
    kept = course()
    kept.entries = [Entry(6, WORLD, "crowds <1> join")]
    drawn = plots(kept)
    assert "crowds &lt;1&gt; join" in drawn
    (tick,) = re.findall(r'<path d="M(\d+) [^>]*><title>', drawn)
    assert float(tick) == pytest.approx(64 + 5 / 9 * 1080, abs=1.5)


def test_events_before_and_after_the_frames_looked_at_stay_inside_the_plot():
    kept = course(frames=range(20, 41))
    kept.entries = [Entry(1, WORLD, "early"), Entry(99, WORLD, "late")]
    ticks = [float(x) for x in re.findall(r'<path d="M(\d+) [^>]*><title>', plots(kept))]
    assert min(ticks) >= 64 and max(ticks) <= 64 + 1080


def test_a_long_run_with_thousands_of_adjustments_stays_a_light_plot():
    moves = [(k, "interval.frames", k % 5, (k + 1) % 5) for k in range(2, 4000)]
    kept = course(moves, range(1, 4001), seconds=lambda number: {"a": 0.001 * (number % 7), "b": 0.01})
    kept.entries = [Entry(k, WORLD, f"event {k}") for k in range(1, 4001)]
    assert len(plots(kept)) < 300_000


def test_frames_of_which_nothing_could_be_found_are_shaded():
    kept = Course()
    for number in range(1, 11):
        kept.add(frame(number, "too dark" if 4 <= number <= 6 else ""), {"a": 0.01}, ())
    assert plots(kept).count('class="gap"') == 2  # of targets, and of the time spent
