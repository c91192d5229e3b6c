"""The page that sets two studies side by side."""

import pytest

from tests.browser import evaluate, needs_browser
from tests.pages import Page
from torchvision_dddas.evaluation.studies.comparison import comparison_report


def entry(first, second, says, interval=None, p=0.01):
    change = None if first is None or second is None else second - first
    told = {"interval": interval, "p": p, "p_holm": 2 * p, "enough": True}
    return {"first": first, "second": second, "change": change, "over_frames": told, "says": says}


def comparison(clips):
    pooled = {
        "pixels": {"f": entry(0.5, 0.6, "better on these clips", [0.05, 0.15]), "precision": entry(0.5, None, "x")}
    }
    pooled["pixels"]["f"]["over_clips"] = {"interval": [0.01, 0.2], "p": 0.2, "p_holm": 0.4, "enough": True}
    mine = {"same": ["untouched"], "pooled": pooled, "clips": clips}
    return {"first": "a <b>", "second": "b", "tasks": {"motion": mine}, "notes": ["lost, motion: only in the first"]}


CLIPS = {
    "up <i>": {"pixels": {"f": entry(0.2, 0.5, "better", [0.1, 0.5])}},
    "down": {"pixels": {"f": entry(0.9, 0.7, "worse", [-0.3, -0.1])}},
    "quiet": {"pixels": {"f": entry(0.9, 0.901, "within noise", [-0.1, 0.1], 0.9)}},
}


def said(text):
    return " ".join(" ".join(Page(text).words).split())


def test_it_says_at_once_what_changed_by_how_much_and_whether_that_is_beyond_noise():
    text = comparison_report(comparison(CLIPS))
    start = said(text)
    assert "+0.100 F, pixels 0.500 → 0.600: better on these clips" in start
    assert "clips: 1 better beyond noise, 1 worse beyond noise, 1 not, 1 the same" in start
    assert "only in the first" in start and "untouched" in start
    assert not {"i", "b>"} & set(Page(text).found)


def test_the_interval_over_clips_goes_before_that_over_frames_and_p_is_the_corrected_one():
    text = comparison_report(comparison(CLIPS))
    assert "0.010 to 0.200" in text and "0.050 to 0.150" not in text
    values = [value for tag, name, value in Page(text).attributes if (tag, name) == ("td", "data-v")]
    assert "0.4" in values and "0.2" not in values[:6]


def test_the_largest_loss_stands_first_in_the_plot():
    text = comparison_report(comparison(CLIPS))
    rows = [text.index(f">{name}</text>") for name in ("down", "quiet", "up &lt;i&gt;")]
    assert rows == sorted(rows)


def test_studies_that_are_the_same_have_a_page():
    assert "1 the same" in said(comparison_report(comparison({})))


@pytest.mark.browser
@needs_browser
def test_in_a_browser_it_fits_a_phone_and_its_rows_sort(tmp_path):
    script = """var table=page.querySelector("table[aria-label='clip by clip']");
      table.querySelectorAll("thead button")[4].click();
      var names=Array.from(table.querySelectorAll("tbody th")).map(e=>e.textContent);
      return [page.documentElement.scrollWidth, names];"""
    width, rows = evaluate(comparison_report(comparison(CLIPS)), script, tmp_path, 390, dark=True)
    assert width <= 390 and rows == ["down", "quiet", "up <i>"]
