"""Charts and tables of the report kit."""

import math
import re

import numpy as np
import pytest

from tests.pages import Page, points_inside
from torchvision_dddas.io.report import ReportColumn, format_number, number_cell, table, text_cell
from torchvision_dddas.io.report.charts import (
    MOST_POINTS,
    MOST_ROWS,
    WIDTH,
    Axis,
    Dots,
    Interval,
    Line,
    chart,
    interval_chart,
)

NAN = math.nan
KINDS = {
    "one point": ([0.5], [0.5]),
    "none": ([], []),
    "unknown": ([NAN, NAN], [NAN, 1.0]),
    "gap": ([0, 1, 2, 3], [1.0, NAN, 2.0, 3.0]),
    "constant": ([0, 1], [7.0, 7.0]),
    "zero": ([0, 0], [0.0, 0.0]),
    "negative": ([-3, -1], [-5.0, 2.0]),
    "tiny": ([0, 1e-9], [1e-12, 2e-12]),
    "huge": ([0, 1e9], [1e12, -1e12]),
    "long": (np.arange(5000), np.sin(np.arange(5000) / 50)),
}


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("equal", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_whatever_the_values_a_plot_is_whole_and_inside_its_frame(kind, log, equal):
    x, y = (np.array(values, float) for values in KINDS[kind])
    across = Axis("x <m>", log=log and not equal)
    points_inside(chart("a & b", across, Axis("y"), [Line("l", x, y), Line("s", x, y, 2, steps=True)], equal=equal))
    points_inside(
        chart("dots", across, Axis("y"), dots=[Dots("<d>", x, y, is_ring=True), Dots("e", x, y)], equal=equal)
    )


def test_a_curve_goes_up_where_its_values_do_and_breaks_where_they_are_unknown():
    drawn = chart("t", Axis("x"), Axis("y", 0, 10), [Line("", np.arange(5.0), np.array([0, 5, NAN, 10, 0]))])
    (way,) = re.findall(r'<path d="(M[^"]*L[^"]*)" class="line', drawn)
    pieces = [[float(v) for v in re.split("[L ]", piece)] for piece in way.split("M")[1:]]
    assert len(pieces) == 2
    (x0, y0, x1, y1), (_, y3, _, y4) = pieces
    assert x1 > x0 and y1 == pytest.approx((y0 + y3) / 2, abs=0.1) and y4 == y0


def test_a_long_curve_keeps_its_ends_and_few_points():
    x = np.arange(100_000.0)
    drawn = chart("t", Axis("x"), Axis("y"), [Line("", x, x)])
    assert len(drawn) < 30 * MOST_POINTS
    places = [place for place in points_inside(drawn) if place[0] > 60]
    assert max(places)[0] == pytest.approx(max(x for x, _ in places))


def test_on_a_map_a_metre_is_as_long_in_both_directions():
    square = np.array([[500_000, -200], [500_000, -197], [500_003, -197], [500_003, -200]], float)
    drawn = chart("map", Axis("east, m"), Axis("north, m"), [Line("", *square.T)], equal=True)
    (way,) = re.findall(r'<path d="M([^"]*L[^"]*)" class="line', drawn)
    a, b, c, *_ = [np.array(place.split(), float) for place in way.split("L")]
    assert np.linalg.norm(b - a) == pytest.approx(np.linalg.norm(c - b), rel=0.01)
    assert b[1] < a[1]  # north is up


def test_each_clip_of_an_interval_plot_stands_with_its_ends_and_its_words():
    rows = [Interval("low <b>", 0.2, 0.1, 0.4), Interval("high", 0.9), Interval("unknown", NAN)]
    drawn = interval_chart("F", rows, Interval("pooled", 0.5, 0.4, 0.6))
    points_inside(drawn)
    assert "low &lt;b&gt; 0.200, 95 %: 0.100 to 0.400" in drawn and "high 0.900</title>" in drawn
    assert "unknown" not in drawn and "pooled 0.500" in drawn
    lefts = [float(x) for x in re.findall(r'<circle cx="([\d.]+)"', drawn)]
    assert lefts[0] < lefts[1]
    assert interval_chart("F", [Interval(f"clip {k}", 0.5) for k in range(500)]).count("<circle") == MOST_ROWS


@pytest.mark.parametrize("values", [[0.0], [5.5, 1e6], [-0.7, 0.2], [1e-7]])
def test_an_interval_plot_holds_values_beyond_its_span(values):
    rows = [Interval(f"clip {k}", value, value - 1, value + 1) for k, value in enumerate(values)]
    assert all(x <= WIDTH for x, _ in points_inside(interval_chart("m", rows, rows[0], (0.0, 0.0))))


NUMBERS = {
    0.12345: "0.123", -0.5: "−0.500", -0.0001: "0.000", 1234567: "1\u202f234\u202f567",
    12345.678: "12\u202f345.678", NAN: "–", math.inf: "–", 7: "7",
}  # fmt: skip


@pytest.mark.parametrize(("value", "text"), NUMBERS.items())
def test_a_number_is_written_for_a_reader(value, text):
    assert format_number(value) == text


def test_a_table_keeps_what_it_sorts_by_to_the_last_digit_and_escapes_its_words():
    value = 0.1 + 0.2
    columns = [ReportColumn("<clip>", text=True), ReportColumn("F", 'a "mean"')]
    rows = [[text_cell("<i>x</i>"), number_cell(value, 3, (0.2, 0.4))], [text_cell("y"), number_cell(NAN)]]
    page = Page(table("c", columns, rows))
    assert page.values("td", "data-v") == [repr(value), ""] and "i" not in page.found
    assert "0.200 to 0.400" in page.words and "<clip>" in page.words
    assert "button" in page.found and "button" not in Page(table("c", columns, [[text_cell("x")] * 2])).found
