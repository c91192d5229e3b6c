"""What a tuning run says: figures before and after, and its page."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from tests.browser import evaluate, needs_browser
from tests.lab.evaluation.studies.test_comparison import CLIPS, comparison
from tests.lab.evaluation.studies.world import filmed, study
from tests.pages import Page
from torchvision_dddas.config import load_config
from torchvision_dddas.io.output.run_record import finite
from torchvision_dddas.lab.evaluation.metrics import bootstrap
from torchvision_dddas.lab.evaluation.studies.runner import read_spec, run_study
from torchvision_dddas.lab.evaluation.studies.summary import goal_value, parse_goal
from torchvision_dddas.lab.tuning.report import tuning_report
from torchvision_dddas.lab.tuning.verdict import Verdict, _say_change, judge

THRESHOLD, NOISE = "difference.threshold", "difference.noise_levels"
GOAL = parse_goal("motion.pixels.f")


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """A study of three small clips."""
    place = tmp_path_factory.mktemp("verdict") / "clips"
    for seed, name in enumerate(("one", "two", "held")):
        filmed(place, name, seed, frames=7)
    return study(place, 'config = "fast"')


@pytest.fixture(scope="module")
def found(clips) -> Verdict:
    with pytest.MonkeyPatch.context() as here:
        here.setattr(bootstrap, "effects", partial(bootstrap.effects, resamples=40, most=200))
        spec = read_spec(clips)
        return judge(spec, clips.parent, GOAL, {THRESHOLD: 40.0}, ("one", "two"), ("held",), 1, clips.parent / "cache")


def test_the_figures_are_those_of_the_study_before_and_after(clips, found) -> None:
    for when, overrides in enumerate(((), ("difference.threshold=40.0",))):
        one = replace(read_spec(clips), overrides=overrides, tasks=("motion",))
        cases = run_study(one, clips.parent, cache=clips.parent / "cache").cases
        of = {names: [case for case in cases if case.clip.name in names] for names in (("one", "two"), ("held",))}
        assert found.tuned.pooled[when] == goal_value(GOAL, of["one", "two"])[0]
        assert found.held is not None and found.held.pooled[when] == goal_value(GOAL, of["held",])[0]
    assert found.tuned.mean[0] > found.tuned.mean[1] and "better" not in found.tuned.says


@pytest.mark.parametrize(
    ("goal", "p", "over_clips", "wanted"),
    [
        ("motion.pixels.f", 0.03, None, "worse on these clips"),
        ("motion.target.other_blobs_per_frame", 0.03, None, "better on these clips"),
        ("motion.pixels.f", 0.03, 0.01, "worse"),
        ("motion.pixels.f", 0.2, None, "within noise"),
    ],
)
def test_the_goal_is_judged_by_itself_and_less_may_be_better(goal, p, over_clips, wanted) -> None:
    way = {"p": p, "p_holm": 0.4, "interval": [-0.3, -0.1], "enough": True}
    entry = {"change": -0.2, "over_clips": over_clips and {**way, "p": over_clips}, "over_frames": way}
    pooled = {"pixels": {"f": entry}, "target": {"other_blobs_per_frame": entry}}
    assert _say_change(parse_goal(goal), {"tasks": {"motion": {"pooled": pooled}}}) == wanted


def test_parameters_that_did_not_move_change_nothing(clips) -> None:
    same = {THRESHOLD: load_config("fast").difference.threshold}
    spec = read_spec(clips)
    verdict = judge(spec, clips.parent, GOAL, same, ("held",), (), 1, clips.parent / "cache")
    assert verdict.tuned.says == "no change" and verdict.held is None
    assert math.isnan(verdict.tuned.frame_ms[1])  # nothing was measured again
    assert verdict.tuned.changes is not None and verdict.tuned.changes["tasks"]["motion"]["same"] == ["held"]


def side(clips, before, after, says):
    both, frame_ms = {"before": before, "after": after}, {"before": 20.0, "after": 15.0}
    figures = {"clips": clips, "pooled": both, "mean": both, "frame_ms": frame_ms, "says": says}
    return figures | {"changes": comparison(CLIPS), "notes": ["lost <one>, after: it failed"]}


def record(**changed):
    history = [
        {
            "step": k,
            "softness": 0.5 / max(k, 1),
            "loss": math.nan if k == 0 else 1 / k,
            "watched": 0.9 - 0.1 * k if k % 2 == 0 else None,
            "knobs": {THRESHOLD: 4.0 + k, NOISE: 2.0},
        }
        for k in range(5)
    ]
    knob = {"before": 4, "after": 8.0, "unit": "-", "range": "0.1 to 255", "meaning": "a <b>larger</b> one"}
    whole = {
        "state": "complete",
        "study": {"name": "a <b> study"},
        "family": "motion",
        "plan": {"batch": 8, "seed": 3, "steps": 4, "watched": 0.25},
        "examples": 20,
        "knobs": {THRESHOLD: knob | {"idle": False}, NOISE: knob | {"idle": True}},
        "best": 4,
        "taken": 4,
        "ended": "all 4 steps were taken",
        "failed": "",
        "history": history,
        "verdict": {
            "measure": "motion.pixels.f",
            "better": "more",
            "tuned": side(["one", "two"], 0.5, 0.6, "better"),
            "held_out": side(["held"], 0.55, 0.5, "within noise"),
        },
        "seconds": {"descent": 8.0},
    }
    return finite(whole | changed)


NOTHING = side(["one"], None, None, "") | {"changes": None}
FAILED = "the loss of motion is no number for one, frame 3, with difference.threshold = 12, at step 2"


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, "Clips tuned on 0.600 F, pixels, all together; before 0.500 +0.100|mean of 2 clips: 0.500 → 0.600"),
        ({}, "Clips held out 0.500 F, pixels, all together; before 0.550 −0.050|within noise"),
        ({}, "20.0 → 15.0 ms a frame|2.00 s a step, 20 examples|last 25% of each clip"),
        ({"taken": 2}, "4.00 s a step"),
        ({"verdict": record()["verdict"] | {"held_out": None}}, "none; give --holdout"),
        ({"failed": FAILED}, f"Stopped: {FAILED}. The parameters are the last good ones."),
        (
            {"verdict": {"measure": "motion.pixels.f", "tuned": NOTHING, "held_out": None}},
            "no F before and after|Nothing to compare",
        ),
        ({"plan": record()["plan"] | {"watched": 0.0}}, "The same examples are watched"),
    ],
)
def test_the_page_says_what_tuning_was_worth_and_how_it_went(changed, words):
    text = " ".join(" ".join(Page(tuning_report(record(**changed))).words).split())
    for part in words.split("|"):
        assert part in text


def test_each_parameter_has_its_plot_and_row_and_words_of_the_user_are_no_markup():
    text = tuning_report(record())
    assert text.count("<svg") >= 4
    assert f">{THRESHOLD}</text>" in text and f">{NOISE}</text>" in text
    assert " ".join(Page(text).words).count("no effect on the loss") == 1
    assert "<b> study" not in text and "<b>larger" not in text and "lost <one>" not in text
    assert "http" not in text


@pytest.mark.browser
@needs_browser
def test_on_a_phone_nothing_hangs_over_the_edge(tmp_path):
    assert evaluate(tuning_report(record()), "return page.documentElement.scrollWidth;", tmp_path, 390) <= 390
