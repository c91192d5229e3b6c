"""Measures of a study: those of `dddas evaluate`, their intervals, tables and costs; the goals of sweeps."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.lab.evaluation.studies.scored_clips import as_files, found_of, masked, study_of, targeted, tracked
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.output.run_record import finite
from torchvision_dddas.lab.evaluation.evaluate import evaluate
from torchvision_dddas.lab.evaluation.metrics import bootstrap
from torchvision_dddas.lab.evaluation.metrics.registry import HEADLINES, groups_of_task, is_lower_better, measure_names
from torchvision_dddas.lab.evaluation.studies import runner, summary
from torchvision_dddas.lab.evaluation.studies.records import TASKS
from torchvision_dddas.lab.evaluation.studies.scoring import score
from torchvision_dddas.lab.evaluation.studies.summary import check_possible, goal_value, measures, parse_goal, summarize


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    """Few samples: none of these properties needs many."""
    monkeypatch.setattr(bootstrap.intervals, "__defaults__", (60,))


def several(folder, make, task, count, **how):
    """Cases of some clips, in no order."""
    cases = []
    for seed in np.random.default_rng(3).permutation(count).tolist():
        clip, found = make(folder / f"clip-{seed}", seed, **how)
        cases.append((clip, task, found, score(clip, task, found), ""))
    return cases


def summed(cases, task):
    return summarize(study_of(*cases))["tasks"][task]


@pytest.mark.parametrize(("make", "task"), [(masked, "motion"), (tracked, "tracking")])
def test_clips_pooled_and_mean_are_those_of_evaluate_to_the_last_digit(tmp_path, make, task):
    cases = several(tmp_path / "truth", make, task, 6)
    for clip, _, found, *_ in cases:
        as_files(tmp_path / "out" / clip.name, found, identities=task == "tracking")
    theirs, mine = evaluate(tmp_path / "truth", tmp_path / "out"), summed(cases, task)
    assert mine["clips"].keys() == theirs["clips"].keys()
    pairs = [(mine[part], theirs[part]) for part in ("pooled", "mean")]
    for one, other in [*pairs, *((mine["clips"][name], clip) for name, clip in theirs["clips"].items())]:
        assert {group: one[group] for group in other} == other


def test_the_summary_depends_neither_on_the_order_of_cases_nor_on_the_machine(tmp_path):
    cases = several(tmp_path / "here", masked, "motion", 3)
    cause = f"{tmp_path}/here/clip-0/masks/000003.png is no picture that can be read; see /etc/fstab: it fails"
    cases.append((replace(cases[0][0], name="broken"), "motion", None, None, cause))
    slow = [(c, t, f and replace(f, seconds={"find": 99.0}, peak_mb=7.0), s, w) for c, t, f, s, w in cases]
    texts = [json.dumps(finite(summarize(study_of(*order)))) for order in (cases, cases[::-1], slow)]
    assert texts[0] == texts[1] == texts[2] and str(tmp_path) not in texts[0]
    assert json.loads(texts[0])["left_out"] == [
        {"clip": "broken", "task": "motion", "cause": "000003.png is no picture that can be read; see fstab: it fails"}
    ]


def test_intervals_hold_the_figures_and_are_over_clips_where_there_are_enough(tmp_path):
    cases = several(tmp_path, tracked, "tracking", 6)
    mine = summed(cases, "tracking")
    assert mine["pooled"]["over"] == {"tracks": "clips"}
    for place in (mine["pooled"], *mine["clips"].values()):
        low, high = place["intervals"]["tracks"]["mota"]
        assert low <= place["tracks"]["mota"] <= high and low < high
    assert mine["pooled"]["intervals"]["tracks"]["hota"] is not None
    assert "hota" not in mine["clips"]["clip-0"]["intervals"]["tracks"]  # of whole tracks, not of frames
    few = summed(cases[:3], "tracking")["pooled"]
    assert few["over"] == {"tracks": "frames"} and few["intervals"]["tracks"]["mota"] is not None
    short = summed(several(tmp_path / "short", masked, "motion", 1, frames=6), "motion")
    assert set(short["clips"]["clip-0"]["intervals"]["pixels"].values()) == {None}


@pytest.mark.parametrize(("make", "task"), [(masked, "motion"), (tracked, "tracking"), (tracked, "people")])
def test_weights_of_units_are_how_often_each_counts(tmp_path, make, task):
    scored = [case[3] for case in several(tmp_path, make, task, 3)]
    whole, twice = measures(scored), measures([scored[0], scored[0], scored[2]])
    for estimates in (summary.over_clips(scored), summary.over_frames(scored)):
        for group, one in estimates.items():
            found = one.statistic(np.ones(sum(stratum.units for stratum in one.strata)))
            assert found == pytest.approx({name: whole[group][name] for name in found}, nan_ok=True)
    for group, one in summary.over_clips(scored).items():
        found = one.statistic(np.array([2.0, 0.0, 1.0]))
        assert found == pytest.approx({name: twice[group][name] for name in found}, nan_ok=True)


def test_costs_add_up(tmp_path):
    clip, found = masked(tmp_path / "a")
    more = replace(found, seconds={"find": 1.5, "read": 1.0}, peak_mb=300.0)
    other = replace(clip, name="b")
    study = study_of((clip, "motion", found, None, ""), (other, "motion", more, None, ""))
    costs = summary.summarize_costs(study)["motion"]
    by_stage = {"find": 2000 / 24, "read": 1000 / 24}
    whole = {"frames": 24, "seconds": 3.0, "frames_per_s": 8.0, "peak_mb": 300.0, "ms_per_frame": by_stage}
    assert costs["all"] == whole
    assert costs["clips"]["a"]["frames_per_s"] == 24


def test_tables_have_every_figure_to_the_last_digit(tmp_path):
    cases = several(tmp_path / "truth", masked, "motion", 2)
    empty = found_of(np.zeros((0, 7)), 12, cases[0][2].masks, False)
    clip = replace(cases[0][0], name='odd, "name"')
    results = study_of(*cases, (clip, "motion", empty, score(clip, "motion", empty), ""))
    metrics = summarize(results)
    rows = [dict(zip(runner.METRIC_COLUMNS, row, strict=True)) for row in runner.metric_rows(metrics)]
    runner.write_csv(tmp_path / "metrics.csv", metrics)
    with (tmp_path / "metrics.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert len(read) == len(rows)
    for row in read:
        mine = metrics["tasks"][row["task"]]
        place = mine["clips"][row["clip"]] if row["scope"] == "clip" else mine[row["scope"]]
        value = place[row["group"]][row["measure"]]
        assert row["value"] == ("" if np.isnan(value) else repr(float(value)))
        span = place.get("intervals", {}).get(row["group"], {}).get(row["measure"])
        assert [row["low"], row["high"]] == (["", ""] if span is None else [repr(end) for end in span])
    assert {row["clip"] for row in read} >= {'odd, "name"', "clip-0", ""}
    parquet = pytest.importorskip("pyarrow.parquet")
    runner.write_parquet(tmp_path, metrics, results)
    np.testing.assert_equal(parquet.read_table(tmp_path / "metrics.parquet").to_pylist(), rows)
    frames = parquet.read_table(tmp_path / "frames.parquet").to_pylist()
    assert frames == [dict(zip(runner.FRAME_COLUMNS, row, strict=True)) for row in runner.frame_rows(results)]
    assert sorted(p.name for p in tmp_path.glob("*.*")) == ["frames.parquet", "metrics.csv", "metrics.parquet"]


@pytest.mark.parametrize(
    ("make", "task"), [(masked, "motion"), (targeted, "motion"), (tracked, "tracking"), (tracked, "association")]
)
def test_the_names_of_measures_are_those_that_scored_clips_have(tmp_path, make, task) -> None:
    clip, found = make(tmp_path / "clip", 0)
    having = measures([score(clip, task, found)])
    assert set(having) == set(summary.possible_groups(clip, task)) <= set(groups_of_task(task))
    for group, figures in having.items():
        names = {name for name in figures if not name.startswith("n_") or is_lower_better(name)}
        assert set(measure_names(group)) == names


def test_every_measure_can_be_a_goal_and_a_wrong_name_lists_the_right_ones() -> None:
    for task in HEADLINES:
        for group in groups_of_task(task):
            assert parse_goal(f"{task}.{group}.{measure_names(group)[0]}").group == group
    for text, message in (
        ("f", "wanted task.group.measure"),
        ("tracking.hota", r"'tracking\.hota' is not a measure; wanted .* did you mean tracking\.tracks\.hota"),
        ("quality", "docs/tuning.md lists the measures"),
        ("sight.pixels.f", "not a task"),
        ("motion.pixels.n_tp", "neither more nor less"),
        ("motion.pixels.iou", "'iou' is not a measure of motion.pixels; wanted accuracy, "),
        ("tracking.pixels.f", "not a group of measures of tracking; wanted tracks, target_track"),
    ):
        with pytest.raises(InputError, match=message):
            parse_goal(text)


def test_the_page_on_tuning_lists_every_measure() -> None:
    page = (Path(__file__).resolve().parents[4] / "docs/tuning.md").read_text(encoding="utf-8")
    rows = [line for line in page.split("## Measures")[1].split("\n## ")[0].splitlines() if line.startswith("| `")]
    listed = {
        f"{group}.{name}"
        for _, groups, names, _ in (row.split("|") for row in rows)
        for group in re.findall("`(.+?)`", groups)
        for name in re.findall("`(.+?)`", names)
    }
    pairs = [(task, group) for task in TASKS for group in groups_of_task(task)]
    assert listed == {f"{task}.{group}.{name}" for task, group in pairs for name in measure_names(group)}


def test_a_goal_that_the_truth_of_these_clips_does_not_allow_is_refused(tmp_path) -> None:
    clip, _ = masked(tmp_path / "clip", 0)
    still = replace(clip, still=True)
    check_possible(parse_goal("motion.pixels.f"), [clip])
    check_possible(parse_goal("motion.still.alarmed"), [clip, still])
    with pytest.raises(InputError, match=r"no clip has truth for motion\.target\.hit; .* motion\.pixels"):
        check_possible(parse_goal("motion.target.hit"), [clip])
    with pytest.raises(InputError, match=r"there is truth for motion\.still$"):
        check_possible(parse_goal("motion.pixels.f"), [still])


@pytest.mark.parametrize(
    ("group", "measure", "pick"), [("pixels", "f", min), ("ranking", "log_average_miss_rate", max)]
)
def test_a_goal_is_pooled_the_mean_or_the_worst_which_may_be_the_highest(tmp_path, group, measure, pick) -> None:
    cases = several(tmp_path, masked, "motion", 3)
    mine, done = summed(cases, "motion"), study_of(*cases).cases
    values = {name: clip[group][measure] for name, clip in mine["clips"].items()}
    worst = mine["worst"][group][measure]
    assert worst["value"] == values[worst["clip"]] == pick(values.values())
    goals = [parse_goal(f"motion.{group}.{measure}", by) for by in ("pooled", "mean", "worst")]
    wanted = (mine["pooled"][group][measure], mine["mean"][group][measure], worst["value"])
    assert [goal_value(goal, done)[0] for goal in goals] == pytest.approx(wanted)
    with pytest.raises(InputError, match=r"no clip has motion\.target\.hit; there are pixels\.accuracy, "):
        goal_value(parse_goal("motion.target.hit"), done)
    lost = replace(done[0], scored=None, cause="it broke")
    value, why = goal_value(goals[0], [lost, *done[1:]])
    assert np.isnan(value) and why == f"{lost.clip.name}: it broke"
