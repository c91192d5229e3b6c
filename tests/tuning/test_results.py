"""What a tuning run says: figures before and after, its page, and the time that parameters cost."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from tests.browser import evaluate, needs_browser
from tests.evaluation.studies.test_comparison import CLIPS, comparison
from tests.evaluation.studies.world import filmed, study
from tests.pages import Page
from tests.tuning.worlds import filmed_clip
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import bootstrap
from torchvision_dddas.evaluation.studies.runner import read_spec, run_study
from torchvision_dddas.evaluation.studies.summary import goal_value, parse_goal
from torchvision_dddas.io.output.run_record import finite
from torchvision_dddas.tuning.report import tuning_report
from torchvision_dddas.tuning.time_cost import Curve, TimeCost, frame_timer, measure_cost, read_cost, timed_points
from torchvision_dddas.tuning.verdict import Verdict, _say_change, judge

THRESHOLD, NOISE = "difference.threshold", "difference.noise_levels"
CLOSE, BLUR = "morphology.close_px", "difference.blur_px"
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
    assert verdict.tuned.says == "the same" and verdict.held is None
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
        "cost": None,
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
TIMED = {"weight": 0.1, "seconds": 0.02, "expected": 0.015}
TIMES = [{"knob": THRESHOLD, "values": [2.0, 4.0], "times": [1.3, 1.0]}]
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
        ({"cost": TIMED | {"curves": TIMES}}, "a loss of 0.1. Expected: 20.0 → 15.0 ms a frame.|1.3, 1"),
        ({"cost": TIMED | {"curves": []}}, "No parameter changed the time by more than repeats differ."),
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


def scalar(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


def test_a_factor_is_measured_at_what_was_measured_and_lies_between_elsewhere() -> None:
    curve = Curve(THRESHOLD, (2.0, 4.0, 8.0), (2.0, 1.0, 0.8))
    # The knob's scale is that of factors: the middle of 2 and 4 is their geometric mean.
    at = {2.0: 2.0, 4.0: 1.0, 8.0: 0.8, 8**0.5: 1.5, 0.5: 2.0, 90.0: 0.8}
    assert [float(curve.factor(scalar(value)).detach()) for value in at] == pytest.approx(list(at.values()))


def test_the_term_is_nothing_at_the_settings_and_twice_the_time_costs_the_weight() -> None:
    cost = TimeCost(0.5, 0.02, (Curve(THRESHOLD, (2.0, 4.0), (2.0, 1.0)), Curve(CLOSE, (5.0, 10.0), (1.0, 1.5))))
    assert float(cost.term({THRESHOLD: scalar(4.0), CLOSE: scalar(5.0)}).detach()) == pytest.approx(0)
    assert float(cost.term({THRESHOLD: scalar(2.0), CLOSE: scalar(5.0)}).detach()) == pytest.approx(0.5)
    assert float(cost.expected({THRESHOLD: scalar(2.0), CLOSE: scalar(10.0)}).detach()) == pytest.approx(0.06)
    value = scalar(3.0)
    cost.term({THRESHOLD: value}).backward()
    assert value.grad is not None and float(value.grad) < 0
    assert torch.autograd.gradcheck(lambda v: cost.term({THRESHOLD: v}), scalar(3.0))


def test_the_points_are_allowed_values_on_either_side_of_the_parameters_own() -> None:
    settings = with_parameters(Settings(), {THRESHOLD: 200.0, BLUR: 5})
    points = [("", 0.0), (THRESHOLD, 100.0), (THRESHOLD, 255.0), (BLUR, 3.0), (BLUR, 11.0)]
    assert list(timed_points(settings, [THRESHOLD, BLUR])) == points


def test_what_depends_on_a_parameter_is_found_and_what_does_not_costs_nothing(tmp_path: Path) -> None:
    settings = with_parameters(Settings(), {THRESHOLD: 8.0})
    noise = iter(1 + 0.01 * k for k in (0, 1, -1, 2, 0, 1, -2, 0, 1, 0, 2, -1, 1, 0, -1, 0, 1, 2, 0, 0))
    cost = measure_cost(
        lambda changed: 0.1 * 8 / changed.difference.threshold * next(noise), settings, [THRESHOLD, CLOSE], 1.0
    )
    (curve,) = cost.curves
    assert curve.parameter == THRESHOLD and curve.values == (4.0, 8.0, 16.0)
    assert curve.times == pytest.approx((2, 1, 0.5), rel=0.05) and cost.seconds == pytest.approx(0.1, rel=0.05)
    assert 0 < frame_timer(filmed_clip(tmp_path, 5), "motion", load_config("fast"), "onboard")(load_config("fast")) < 10


CURVE = '{"knob": "difference.threshold", "values": [1, 2], "times": [1]}'


@pytest.mark.parametrize("curves", [None, "1", CURVE, CURVE.replace("1, 2", '"a"'), CURVE.replace("threshold", "no")])
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, curves: str | None) -> None:
    text = f'{{"weight": 1, "seconds": 1, "curves": [{curves}]}}' if curves else ""
    (tmp_path / "cost.json").write_text(text)
    with pytest.raises(InputError, match="does not hold the cost"):
        read_cost(tmp_path / "cost.json")


def test_what_was_measured_is_kept_to_the_last_digit(tmp_path: Path) -> None:
    cost = TimeCost(0.1, 1 / 3, (Curve(THRESHOLD, (2.0, 4.0), (1.1, 1.0)),))
    (tmp_path / "cost.json").write_text(json.dumps(cost.as_json()))
    assert read_cost(tmp_path / "cost.json") == cost
