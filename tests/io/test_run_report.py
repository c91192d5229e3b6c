"""The log and the report of a run: what happened, which pictures are kept, the page, and its timelines."""

import re
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest

from tests.io.ground import grounded
from tests.pages import Page, points_inside
from torchvision_dddas.io.output.run_log import Entry, LogClock, RunLog, format_log
from torchvision_dddas.io.output.run_record import RunRecord
from torchvision_dddas.io.output.run_report import MOST_KEY_FRAMES, MOST_TABLE_ROWS, KeyFrames, RunReport, format_span
from torchvision_dddas.io.output.timelines import PROBLEM, WORLD, Timeline, chi2_limit
from torchvision_dddas.io.report.charts import TIME_LEFT, TIME_WIDTH
from torchvision_dddas.types import Adjustment, Detections, Frame, FrameResult, TrackedFrame, Tracks

# --------------------------------------------------------------------------------------------------------------------
# The log.

FRAME = np.arange(1, 101)
TIME_S = (FRAME - 1) / 10


def text(log, frame=FRAME, time_s=TIME_S):
    """The lines below the heading, with single blanks."""
    lines = format_log(log.ordered(), LogClock(frame, time_s), "clip").splitlines()[3:]
    return [" ".join(line.split()) for line in lines]


def test_lines_have_time_frame_values_and_cause_in_the_order_of_the_frames():
    log = RunLog()
    log.add(40, PROBLEM, "first\nsecond")
    log.add_adjustment(Adjustment(31, "interval.frames", 1, 3, "background flow 0.4 px a frame"))
    log.add_adjustment(Adjustment(3, "gates.max_size_px", np.inf, 52.0, ""))
    assert text(log) == [
        "0.200 3 adjusted gates.max_size_px none -> 52",
        "3.000 31 adjusted interval.frames 1 -> 3: background flow 0.4 px a frame",
        "3.900 40 problem first second",
    ]
    assert text(log, FRAME, np.full(100, np.nan))[0].startswith("3 adjusted")


@pytest.mark.parametrize(
    ("frames", "step", "ends"),
    [
        (range(10, 20), 1, ["(to frame 19)"]),
        (range(10, 31, 4), 1, ["(to frame 30, in 6 of 21 frames)"]),
        (range(11, 60, 5), 5, ["(to frame 56)"]),  # where every fifth frame is processed, these are all
        ((10, 11, 50), 1, ["(to frame 11)", "1 of 9"]),
    ],
)
def test_what_lasts_is_one_line_that_says_how_long_though_its_numbers_differ(frames, step, ends):
    log = RunLog()
    for frame in frames:
        log.add_lasting(frame, step, PROBLEM, f"seen {frame % 7 % 3} of 9" if len(ends) == 1 else "1 of 9")
    lines = text(log, FRAME[::step], TIME_S[::step])
    assert len(lines) == len(ends) and all(line.endswith(end) for line, end in zip(lines, ends, strict=True))


def test_the_time_of_a_frame_follows_from_those_around_it_or_goes_on_beyond_them():
    clock = LogClock(np.array([11, 21, 41]), np.array([1.0, 2.0, 4.0]))
    for frame, time_s in ((1, 0.0), (11, 1.0), (51, 5.0), (121, 12.0)):
        assert clock.time_s(Entry(frame, WORLD, "", frame)) == pytest.approx(time_s)


# --------------------------------------------------------------------------------------------------------------------
# Key frames.


def keep(count, events=None, size=(32, 24)):
    """Key frames of a run of frames from 1. events: frame -> {kind: weight}. Also returns the frames drawn."""
    kept, drawn = KeyFrames(), []

    def draw(number):
        drawn.append(number)
        return np.full((size[1], size[0], 3), 90, np.uint8)

    for number in range(1, count + 1):
        kinds = (events or {}).get(number, {})
        kept.add(number, number / 10, kinds, "; ".join(kinds), partial(draw, number))
    return kept.chosen(), drawn


@pytest.mark.parametrize("count", [0, 1, 5, 9, 40, 5000])
def test_few_key_frames_are_kept_however_long_the_run_and_they_are_spread_over_it(count):
    chosen, drawn = keep(count)
    numbers = [frame.number for frame in chosen]
    assert len(numbers) == min(count, MOST_KEY_FRAMES) and numbers == sorted(set(numbers))
    if count >= 40:
        assert np.diff([1, *numbers, count]).max() <= 0.3 * count
    assert len(drawn) < 40 + 18 * np.log2(max(count, 2))


def test_key_frames_show_events_those_that_matter_first_and_repeated_ones_once():
    chosen = {frame.number: frame.text for frame in keep(1000, {137: {"join": 1.0}, 611: {"split": 1.0}})[0]}
    assert chosen[137] == "join" and chosen[611] == "split" and len(chosen) == MOST_KEY_FRAMES
    _, drawn = keep(1000, {frame: {"flutter": 1.0} for frame in range(3, 1000, 2)})
    assert len(drawn) < 250 and 3 in drawn
    many = {number: {f"k{number}": 1.0} for number in range(10, 400, 10)}
    chosen, _ = keep(400, {**many, 205: {"join": 50.0}})
    assert len(chosen) <= MOST_KEY_FRAMES and "join" in [frame.text for frame in chosen]


@pytest.mark.parametrize("size", [(1920, 1080), (480, 4000), (31, 17)])
def test_key_frames_are_small_and_keep_their_shape(size):
    (frame,), _ = keep(1, size=size)
    shown = cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None and shown.shape[0] * shown.shape[1] < 1.02 * 520 * 390
    assert shown.shape[1] / shown.shape[0] == pytest.approx(size[0] / size[1], rel=0.02)


# --------------------------------------------------------------------------------------------------------------------
# The page.


def located(frames):
    timeline = Timeline()
    for frame in frames:
        timeline.add_locations(frame)
    return timeline


def page_of(folder, rows=(("1 to 4", "too few <landmarks>"),), notes=(), **rest):
    facts = {"input": "<script>alert(1)</script>", "rate_hz": float("nan"), "settings": {"a": float("inf")}}
    record = RunRecord(folder, facts)
    record.notes += notes
    tables: Any = [("Gaps & more", ("frames", "cause"), rows, "none at all")]
    timeline = located([grounded(k) for k in (1, 2, 3)])
    return RunReport("A <clip> & more", record, True, timeline, [("frames", "4")], tables, **rest).html()


def test_the_page_is_whole_offline_and_all_words_are_escaped(tmp_path):
    text = page_of(tmp_path, notes=["look <b>here</b>"])
    page = Page(text)
    assert text.startswith("<!DOCTYPE html>") and text.count("</html>") == 1
    assert not {"clip", "landmarks", "link", "iframe"} & set(page.found) and page.found.count("script") == 1
    assert not re.search(r"https?://|url\(|@import", text)
    words = " ".join(page.words)
    assert "A <clip> & more" in words and "too few <landmarks>" in words and "<script>" in words and "<b>" in words
    assert "leaflet" not in text  # it is in reports with a map only


def test_a_table_says_how_many_rows_it_leaves_out_or_that_it_is_empty(tmp_path):
    text = page_of(tmp_path, [(format_span(k, k), "x") for k in range(MOST_TABLE_ROWS + 7)])
    assert "and 7 more" in text and text.count(">x</td>") == MOST_TABLE_ROWS and "none at all" not in text
    assert "none at all" in page_of(tmp_path, [])


# --------------------------------------------------------------------------------------------------------------------
# Timelines.


def run(moves=(), frames=range(1, 11), seconds=lambda number: {}, names=(), events=(), causes=()):
    """The timeline of a run in which parameters are moved at frames: (frame, parameter, old, new)."""
    timeline = Timeline(names)
    for number in frames:
        moved = tuple(Adjustment(at, name, old, new, "why") for at, name, old, new in moves if at == number)
        rest: Any = {"adjustments": moved, "seconds": seconds(number), "cause": "too dark" if number in causes else ""}
        frame = Frame(number, number / 10, np.zeros((4, 4, 3), np.uint8))
        timeline.add_result(FrameResult(TrackedFrame(number, frame, Detections(), Tracks(number), **rest)))
    timeline.events[WORLD] = list(events)
    return timeline


def tick_places(svg):
    return [float(x) for x in re.findall(r'<path d="M(\d+) [^>]*><title>', svg)]


@pytest.mark.parametrize("states", [(), ("used",) * 4])
def test_landmarks_have_a_plot_only_if_the_run_saw_any(states):
    titles = [title for title, series in located([grounded(k, states=states) for k in (1, 2)]).panels() if series]
    assert ("landmarks" in titles) == bool(states)


@pytest.mark.parametrize("count", [0, 1, 2, 40, 5000])
def test_time_charts_are_whole_and_inside_their_frame_however_long_the_run(count):
    frames = [grounded(k, ((1, 2),), chi2=5.0 + k % 9, freedom=8) for k in range(1, min(count, 40) + 1)]
    svg = located(frames * max(1, count // 40)).chart()
    assert (svg == "") == (count < 2) and len(svg) < 200_000
    if svg:
        points_inside(svg)


def test_gaps_are_shaded_and_unknown_values_are_not_drawn():
    frames = [*(grounded(k) for k in (1, 2, 3)), *(grounded(k, by="", states=()) for k in (4, 5)), grounded(6)]
    timeline = located(frames)
    svg = timeline.chart()
    assert svg.count('class="gap"') == 2 and "chi-squared" not in svg  # nothing was expected of the landmarks
    assert timeline["used"].tolist() == [4, 4, 4, 0, 0, 4]
    np.testing.assert_allclose(timeline["sigma_m"], np.sqrt(2) * np.array([1, 1, 1, np.nan, np.nan, 1]))
    np.testing.assert_allclose(timeline["relative_m"], timeline["sigma_m"] / 2)
    dark = run(seconds=lambda number: {"a": 0.01}, causes=(4, 5, 6)).chart()
    assert dark.count('class="gap"') == 2  # of targets, and of the time spent


@pytest.mark.parametrize(("freedom", "limit"), [(1, 3.841), (2, 5.991), (12, 21.026)])
def test_the_limit_of_chi_squared_is_the_tabulated_quantile(freedom, limit):
    assert chi2_limit(freedom) == pytest.approx(limit, rel=1e-3) and np.isnan(chi2_limit(0))


def test_a_parameter_holds_its_first_value_until_it_is_moved_and_each_new_one_from_its_frame_on():
    assert run([(4, "a.b", 1, 3), (8, "a.b", 3, 2)]).parameter("a.b").tolist() == [1, 1, 1, 3, 3, 3, 3, 2, 2, 2]
    timeline = run([(1, "a.b", np.inf, np.inf), (3, "a.b", np.inf, 7), (6, "a.b", 7, 5)])
    np.testing.assert_array_equal(timeline.parameter("a.b"), [np.nan, np.nan, 7, 7, 7, 5, 5, 5, 5, 5])
    points_inside(timeline.chart())
    moves = [(k, "interval.frames", k % 5, (k + 1) % 5) for k in range(2, 600)]
    assert len(run(moves, range(1, 601), events=[(k, f"event {k}") for k in range(600)]).chart()) < 300_000


def test_only_the_parameters_moved_most_have_panels_and_vehicles_share_theirs():
    moves = [(1, "gates.min_size_px", 0, 5), (3, "ugv1.speed_m_s", 3, 1), (5, "ugv2.speed_m_s", 3, 1)]
    timeline = run([*moves, (6, "uav.altitude_m", 50, 60)], names=("ugv1", "ugv2"))
    assert [line.name for line in dict(timeline.panels())["speed_m_s of each ground vehicle"]] == ["ugv1", "ugv2"]
    titles = {title for title, _ in timeline.panels()}
    assert "uav.altitude_m" in titles and not {"ugv1.speed_m_s", "gates.min_size_px"} & titles  # one never changed
    many = [(k, f"group.parameter{n:02d}", 0, k) for n in range(30) for k in range(2, 3 + n // 4)]
    shown = [title for title, _ in run(many, range(1, 15)).panels() if title.startswith("group")]
    assert 6 <= len(shown) <= 15 and "group.parameter29" in shown and "group.parameter00" not in shown


def test_stages_are_stacked_up_to_all_the_time_spent():
    spent = {f"stage{k}": 0.001 * (k + 1) for k in range(11)}
    timeline = run(seconds=lambda number: spent if number != 4 else {"rare": 0.5})
    stages = dict(timeline.panels())["time spent on a frame, ms, stacked"]
    heights = np.stack([line.y for line in stages])
    assert (np.diff(heights, axis=0) <= 1e-9).all() and stages[0].name == "other"  # the highest is drawn first
    np.testing.assert_allclose(heights[0], [66, 66, 66, 500, 66, 66, 66, 66, 66, 66], rtol=1e-4)


def test_events_are_ticked_at_their_time_and_stay_inside_the_plot():
    svg = run(events=[(6, "crowds <1> join")]).chart()
    assert "crowds &lt;1&gt; join" in svg
    assert tick_places(svg) == [pytest.approx(TIME_LEFT + 5 / 9 * TIME_WIDTH, abs=1.5)]
    places = tick_places(run(frames=range(20, 41), events=[(1, "early"), (99, "late")]).chart())
    assert min(places) >= TIME_LEFT and max(places) <= TIME_LEFT + TIME_WIDTH
