"""The report of a run: its page, and what its timelines show."""

import base64
import re

import numpy as np
import pytest

from tests.io.ground import grounded
from tests.pages import Page, points_inside
from torchvision_dddas.io.output.run_log import WORLD, Entry
from torchvision_dddas.io.output.run_report import MOST_TABLE_ROWS, RunSummary, format_span, run_report
from torchvision_dddas.io.output.timelines import LocationTimeline, RunTimeline, chi2_limit
from torchvision_dddas.io.report.charts import TIME_LEFT, TIME_WIDTH
from torchvision_dddas.types import Adjustment, Detections, Frame, FrameResult, TrackedFrame, Tracks

PICTURE = np.zeros((4, 4, 3), np.uint8)


def locations(frames):
    timeline = LocationTimeline()
    for frame in frames:
        timeline.add(frame)
    return timeline


def frame(number, cause=""):
    return FrameResult(
        TrackedFrame(number, Frame(number, number / 10, PICTURE), Detections(), Tracks(number), cause=cause)
    )


def run(moves=(), frames=range(1, 11), seconds=lambda number: {}, names=(), entries=()):
    """The timeline of a run in which parameters are moved at frames: (frame, parameter, old, new)."""
    timeline = RunTimeline(names)
    for number in frames:
        moved = [Adjustment(number, parameter, old, new, "why") for at, parameter, old, new in moves if at == number]
        timeline.add(frame(number), seconds(number), moved)
    timeline.entries = entries
    return timeline


def summary(**more):
    rows = more.pop("rows", [("1 to 4", "too few <landmarks>")])
    tables = [("Gaps & more", ("frames", "cause"), rows, "none at all")]
    facts = {"input": "<script>alert(1)</script>", "rate_hz": float("nan"), "settings": {"a": float("inf")}}
    return RunSummary("A <clip> & more", "complete", [("frames", "4")], facts, tables, **more)


def titles(timeline):
    return [title for title, _ in timeline.panels()]


def lines(timeline, title):
    return next(lines for name, lines in timeline.panels() if name == title)


def tick_places(svg):
    return [float(x) for x in re.findall(r'<path d="M(\d+) [^>]*><title>', svg)]


def test_the_page_is_whole_offline_and_all_words_are_escaped():
    shown = summary(notes=["look <b>here</b>"], map_picture=b"\x89PNG<>")
    text = run_report(shown, locations([grounded(k) for k in (1, 2, 3)]))
    page = Page(text)
    assert text.startswith("<!DOCTYPE html>") and text.count("</html>") == 1
    assert not {"clip", "landmarks", "link", "iframe"} & set(page.found) and page.found.count("script") == 1
    assert not re.search(r"https?://|url\(|@import", text)
    words = " ".join(page.words)
    assert "A <clip> & more" in words and "too few <landmarks>" in words and "<script>" in words and "<b>" in words
    (source,) = page.values("img", "src")
    assert base64.b64decode(source.removeprefix("data:image/png;base64,")) == b"\x89PNG<>"


def test_a_table_says_how_many_rows_it_leaves_out_and_an_empty_one_that_it_is_empty():
    text = run_report(summary(rows=[(format_span(k, k), "x") for k in range(MOST_TABLE_ROWS + 7)]), locations([]))
    assert "and 7 more" in text and text.count(">x</td>") == MOST_TABLE_ROWS
    assert "none at all" in run_report(summary(rows=[]), locations([])) and "none at all" not in text


@pytest.mark.parametrize("count", [0, 1, 2, 40, 5000])
def test_time_charts_are_whole_and_inside_their_frame_however_long_the_run(count):
    frames = [grounded(k, ((1, 2),), chi2=5.0 + k % 9, freedom=8) for k in range(1, min(count, 40) + 1)]
    svg = locations(frames * max(1, count // 40)).chart()
    assert (svg == "") == (count < 2) and len(svg) < 200_000
    if svg:
        points_inside(svg)


def test_gaps_are_shaded_and_unknown_values_are_not_drawn():
    frames = [*(grounded(k) for k in (1, 2, 3)), *(grounded(k, by="", states=()) for k in (4, 5)), grounded(6)]
    timeline = locations(frames)
    svg = timeline.chart()
    assert svg.count('class="gap"') == 2 and "chi-squared" not in svg  # nothing was expected of the landmarks
    assert timeline.rows["used"].tolist() == [4, 4, 4, 0, 0, 4]
    assert np.isnan(timeline.rows["sigma_m"]).tolist() == [False, False, False, True, True, False]


def test_the_median_errors_are_those_of_the_targets():
    rows = locations([grounded(1, covariance=[[9, 0], [0, 16]])]).rows
    assert rows["sigma_m"][0] == 5 and rows["relative_m"][0] == 2.5


@pytest.mark.parametrize(("freedom", "limit"), [(1, 3.841), (2, 5.991), (8, 15.507), (12, 21.026)])
def test_the_limit_of_chi_squared_is_the_tabulated_quantile(freedom, limit):
    assert chi2_limit(freedom) == pytest.approx(limit, rel=0.025)
    assert np.isnan(chi2_limit(0))


def test_a_parameter_holds_its_first_value_until_it_is_moved_and_each_new_one_from_its_frame_on():
    assert run([(4, "a.b", 1, 3), (8, "a.b", 3, 2)]).values("a.b").tolist() == [1, 1, 1, 3, 3, 3, 3, 2, 2, 2]
    timeline = run([(1, "a.b", np.inf, np.inf), (3, "a.b", np.inf, 7), (6, "a.b", 7, 5)])
    np.testing.assert_array_equal(timeline.values("a.b"), [np.nan, np.nan, 7, 7, 7, 5, 5, 5, 5, 5])
    points_inside(timeline.chart())


def test_only_the_parameters_moved_most_have_panels_and_vehicles_share_theirs():
    moves = [(1, "gates.min_size_px", 0, 5), (3, "ugv1.speed_m_s", 3, 1), (5, "ugv2.speed_m_s", 3, 1)]
    timeline = run([*moves, (6, "uav.altitude_m", 50, 60)], names=("ugv1", "ugv2"))
    assert [line.name for line in lines(timeline, "speed_m_s of each ground vehicle")] == ["ugv1", "ugv2"]
    assert "uav.altitude_m" in titles(timeline)
    assert not {"ugv1.speed_m_s", "gates.min_size_px"} & set(titles(timeline))  # the second never changed
    many = [(k, f"group.parameter{n:02d}", 0, k) for n in range(30) for k in range(2, 3 + n // 4)]
    shown = [title for title in titles(run(many, range(1, 15))) if title.startswith("group")]
    assert 6 <= len(shown) <= 15 and "group.parameter29" in shown and "group.parameter00" not in shown


def test_stages_are_stacked_up_to_all_the_time_spent():
    spent = {f"stage{k}": 0.001 * (k + 1) for k in range(11)}
    timeline = run(seconds=lambda number: spent if number != 4 else {"rare": 0.5})
    stages = lines(timeline, "time spent on a frame, ms, stacked")
    heights = np.stack([line.y for line in stages])
    assert (np.diff(heights, axis=0) <= 1e-9).all() and stages[0].name == "other"  # the highest is drawn first
    np.testing.assert_allclose(heights[0], [66, 66, 66, 500, 66, 66, 66, 66, 66, 66], rtol=1e-4)


def test_events_are_ticked_at_their_time_and_stay_inside_the_plot():
    svg = run(entries=[Entry(6, WORLD, "crowds <1> join")]).chart()
    assert "crowds &lt;1&gt; join" in svg
    assert tick_places(svg) == [pytest.approx(TIME_LEFT + 5 / 9 * TIME_WIDTH, abs=1.5)]
    places = tick_places(
        run(frames=range(20, 41), entries=[Entry(1, WORLD, "early"), Entry(99, WORLD, "late")]).chart()
    )
    assert min(places) >= TIME_LEFT and max(places) <= TIME_LEFT + TIME_WIDTH


def test_a_long_run_with_thousands_of_adjustments_stays_a_light_chart():
    moves = [(k, "interval.frames", k % 5, (k + 1) % 5) for k in range(2, 4000)]
    entries = [Entry(k, WORLD, f"event {k}") for k in range(1, 4001)]
    timeline = run(moves, range(1, 4001), lambda number: {"a": 0.001 * (number % 7), "b": 0.01}, (), entries)
    assert len(timeline.chart()) < 300_000


def test_frames_in_which_nothing_could_be_found_are_shaded():
    timeline = RunTimeline()
    for number in range(1, 11):
        timeline.add(frame(number, "too dark" if 4 <= number <= 6 else ""), {"a": 0.01}, ())
    assert timeline.chart().count('class="gap"') == 2  # of targets, and of the time spent
