"""The page of tuning: the loss, each parameter, and what it was worth on both sets of clips."""

import math

import pytest

from tests.browser import evaluate, needs_browser
from tests.evaluation.studies.test_comparison import CLIPS, comparison
from tests.pages import Page
from torchvision_dddas.io.output.run_record import finite
from torchvision_dddas.tuning.report import tuning_report

NAMES = ("difference.threshold", "difference.noise_levels")


def side(clips, before, after, says):
    return {
        "clips": clips,
        "pooled": {"before": before, "after": after},
        "mean": {"before": before, "after": after},
        "says": says,
        "frame_ms": {"before": 20.0, "after": 15.0},
        "changes": comparison(CLIPS),
        "notes": ["lost <one>, after: it failed"],
    }


def record(**changed):
    history = [
        {
            "step": k,
            "softness": 0.5 / max(k, 1),
            "loss": math.nan if k == 0 else 1 / k,
            "watched": 0.9 - 0.1 * k if k % 2 == 0 else None,
            "knobs": {NAMES[0]: 4.0 + k, NAMES[1]: 2.0},
        }
        for k in range(5)
    ]
    parameters = {
        name: {
            "before": 4,
            "after": 8.0,
            "unit": "-",
            "range": "0.1 to 255",
            "meaning": "a <b>larger</b> one",
            "idle": name == NAMES[1],
        }
        for name in NAMES
    }
    told = {
        "state": "complete",
        "study": {"name": "a <b> study"},
        "family": "motion",
        "plan": {"batch": 8, "seed": 3, "steps": 4, "watched": 0.25},
        "examples": 20,
        "knobs": parameters,
        "best": 4,
        "taken": 4,
        "ended": "all 4 steps were taken",
        "failed": "",
        "history": history,
        "cost": None,
        "verdict": {
            "measure": "motion.pixels.f",
            "better": "more",
            "tuned": side(["one", "two"], 0.5, 0.6, "better"),
            "held_out": side(["held"], 0.55, 0.5, "within noise"),
        },
        "seconds": {"descent": 8.0},
    }
    return finite({**told, **changed})


def said(text):
    return " ".join(" ".join(Page(text).words).split())


def test_it_says_first_what_tuning_was_worth_on_clips_tuned_on_and_held_out():
    start = said(tuning_report(record()))
    assert "Clips tuned on 0.600 F, pixels, all together; before 0.500 +0.100" in start
    assert "Clips held out 0.500 F, pixels, all together; before 0.550 −0.050" in start
    assert "mean of 2 clips: 0.500 → 0.600" in start and "20.0 → 15.0 ms a frame" in start
    assert "within noise" in start and "2.00 s a step, 20 examples" in start
    assert "4.00 s a step" in said(tuning_report(record(taken=2)))


def test_each_parameter_has_its_plot_and_its_row_and_one_without_a_slope_is_told():
    text = tuning_report(record())
    assert text.count("<svg") >= 4
    for name in NAMES:
        assert f">{name}</text>" in text
    assert said(text).count("no effect on the loss") == 1


def test_without_clips_held_out_it_says_how_to_have_some():
    verdict = {**record()["verdict"], "held_out": None}
    assert "none; give --holdout" in said(tuning_report(record(verdict=verdict)))


def test_a_descent_that_was_stopped_says_so_at_once():
    failed = "the loss of motion is no number for one, frame 3, with difference.threshold = 12, at step 2"
    assert f"Stopped: {failed}. The parameters are the last good ones." in said(tuning_report(record(failed=failed)))


def test_what_time_costs_is_told_parameter_by_parameter():
    curves = [{"knob": NAMES[0], "values": [2.0, 4.0], "times": [1.3, 1.0]}]
    text = said(tuning_report(record(cost={"weight": 0.1, "seconds": 0.02, "expected": 0.015, "curves": curves})))
    assert "a loss of 0.1. Expected: 20.0 → 15.0 ms a frame." in text and "1.3, 1" in text
    none = said(tuning_report(record(cost={"weight": 0.1, "seconds": 0.02, "expected": 0.02, "curves": []})))
    assert "No parameter changed the time by more than repeats differ." in none


def test_clips_without_any_result_make_a_page_too():
    nothing = side(["one"], None, None, "") | {"changes": None}
    text = said(tuning_report(record(verdict={"measure": "motion.pixels.f", "tuned": nothing, "held_out": None})))
    assert "no F before and after" in text and "Nothing to compare" in text


def test_words_of_the_user_are_no_markup_and_no_host_is_asked():
    text = tuning_report(record())
    assert "<b> study" not in text and "<b>larger" not in text and "lost <one>" not in text
    assert "http" not in text


@pytest.mark.browser
@needs_browser
def test_on_a_phone_nothing_hangs_over_the_edge(tmp_path):
    assert evaluate(tuning_report(record()), "return page.documentElement.scrollWidth;", tmp_path, 390) <= 390


def test_the_page_says_what_was_watched() -> None:
    told = record()
    assert "last 25% of each clip" in tuning_report(told)
    assert "The same examples are watched" in tuning_report(told | {"plan": told["plan"] | {"watched": 0.0}})
