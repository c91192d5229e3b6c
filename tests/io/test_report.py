import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from tests.io.ground import grounded
from torchvision_dddas.io.report.run_report import MOST_ROWS, Story, report, span
from torchvision_dddas.io.report.timeline import Timeline, chi2_limit, plots

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Notes all elements, and fails where one is not closed in its turn."""

    def __init__(self, text):
        super().__init__()
        self.open: list[str] = []
        self.found: list[str] = []
        self.words: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.found.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        self.found.append(tag)

    def handle_data(self, data):
        self.words.append(data)


def timeline(frames):
    kept = Timeline()
    for frame in frames:
        kept.add(frame)
    return kept


def story(**more):
    rows = more.pop("rows", [("1 to 4", "too few <landmarks>")])
    tables = [("Gaps & more", ("frames", "cause"), rows, "none at all")]
    facts = {"input": "<script>alert(1)</script>", "rate_hz": float("nan"), "settings": {"a": float("inf")}}
    return Story("A <clip> & more", "complete", [("frames", "4")], facts, tables, **more)


def test_the_page_is_whole_and_all_words_are_escaped():
    text = report(story(notes=["look <b>here</b>"], map_png=b"\x89PNG<>"), timeline([grounded(k) for k in (1, 2, 3)]))
    page = Page(text)
    assert text.startswith("<!DOCTYPE html>") and text.count("</html>") == 1
    assert not {"script", "b", "clip", "landmarks"} & set(page.found)
    words = " ".join(page.words)
    assert "A <clip> & more" in words and "too few <landmarks>" in words and "<script>" in words and "<b>" in words
    (source,) = [value for tag, name, value in page.attributes if (tag, name) == ("img", "src")]
    assert base64.b64decode(source.removeprefix("data:image/png;base64,")) == b"\x89PNG<>"


def test_the_page_asks_no_host_for_anything():
    text = report(story(), timeline([grounded(k) for k in (1, 2, 3)]))
    assert not re.search(r"https?:|//|url\(|@import|<link|<script|<iframe", text)


def test_a_table_says_how_many_rows_it_leaves_out_and_an_empty_one_that_it_is_empty():
    text = report(story(rows=[(span(k, k), "x") for k in range(MOST_ROWS + 7)]), timeline([]))
    assert "and 7 more" in text and text.count("<td>x</td>") == MOST_ROWS
    assert "none at all" in report(story(rows=[]), timeline([])) and "none at all" not in text


@pytest.mark.parametrize("count", [0, 1, 2, 40, 5000])
def test_plots_are_whole_and_inside_their_frame_however_long_the_run(count):
    frames = [grounded(k, ((1, 2),), chi2=5.0 + k % 9, freedom=8) for k in range(1, min(count, 40) + 1)]
    kept = timeline(frames * max(1, count // 40))
    drawn = plots(kept)
    assert (drawn == "") == (count < 2)
    if drawn:
        page = Page(drawn)
        assert page.found.count("svg") == 1 and "nan" not in drawn and "inf" not in drawn
        (box,) = [v for tag, name, v in page.attributes if (tag, name) == ("svg", "viewbox")]
        wide, high = (float(v) for v in box.split()[2:])
        for tag, name, value in page.attributes:
            if (tag, name) == ("path", "d"):
                for x, y in re.findall(r"[ML](-?[\d.]+)[, ](-?[\d.]+)", value):
                    assert 0 <= float(x) <= wide and 0 <= float(y) <= high
        assert len(drawn) < 200_000


def test_gaps_are_shaded_and_what_is_unknown_is_not_drawn():
    kept = timeline([*(grounded(k) for k in (1, 2, 3)), *(grounded(k, by="", states=()) for k in (4, 5)), grounded(6)])
    drawn = plots(kept)
    assert drawn.count('class="gap"') == 2  # in the plots of landmarks and of errors
    assert "chi-squared" not in drawn  # nothing was expected of the landmarks
    assert kept.rows["used"].tolist() == [4, 4, 4, 0, 0, 4]
    assert np.isnan(kept.rows["sigma_m"]).tolist() == [False, False, False, True, True, False]


def test_the_median_errors_are_those_of_the_targets():
    kept = timeline([grounded(1, covariance=[[9, 0], [0, 16]])])
    assert kept.rows["sigma_m"][0] == 5 and kept.rows["relative_m"][0] == 2.5


@pytest.mark.parametrize(("freedom", "limit"), [(1, 3.841), (2, 5.991), (8, 15.507), (12, 21.026)])
def test_the_limit_of_chi_squared_is_that_of_the_tables(freedom, limit):
    assert chi2_limit(freedom) == pytest.approx(limit, rel=0.025)
    assert np.isnan(chi2_limit(0))
