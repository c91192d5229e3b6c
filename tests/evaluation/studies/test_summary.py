import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.studies.scored_clips import as_files, found_of, masked, study_of, tracked
from torchvision_dddas.evaluation.evaluate import evaluate
from torchvision_dddas.evaluation.metrics import bootstrap
from torchvision_dddas.evaluation.studies.runner import frame_rows, metric_rows, write_csv, write_parquet
from torchvision_dddas.evaluation.studies.scoring import score
from torchvision_dddas.evaluation.studies.summary import measures, over_clips, over_frames, summarize, summarize_costs
from torchvision_dddas.io.output.run_record import finite


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


@pytest.mark.parametrize(("make", "task"), [(masked, "motion"), (tracked, "tracking")])
def test_clips_pooled_and_mean_are_those_of_evaluate_to_the_last_digit(tmp_path, make, task):
    cases = several(tmp_path / "truth", make, task, 6)
    for clip, _, found, *_ in cases:
        as_files(tmp_path / "out" / clip.name, found, identities=task == "tracking")
    theirs = evaluate(tmp_path / "truth", tmp_path / "out")
    mine = summarize(study_of(*cases))["tasks"][task]
    assert mine["clips"].keys() == theirs["clips"].keys()
    for name, clip in theirs["clips"].items():
        assert {group: mine["clips"][name][group] for group in clip} == clip
    for part in ("pooled", "mean"):
        assert {group: mine[part][group] for group in theirs[part]} == theirs[part]


def test_the_summary_does_not_depend_on_the_order_of_the_cases(tmp_path):
    cases = several(tmp_path, tracked, "tracking", 6)
    found = [json.dumps(finite(summarize(study_of(*order)))) for order in (cases, cases[::-1], cases[2:] + cases[:2])]
    assert found[0] == found[1] == found[2]


def test_nothing_of_the_machine_is_in_it(tmp_path):
    cases = several(tmp_path / "here", masked, "motion", 2)
    clip = cases[0][0]
    cause = f"{tmp_path}/here/clip-0/masks/000003.png is no picture that can be read; see /etc/fstab: it fails"
    found = summarize(study_of(*cases, (replace(clip, name="broken"), "motion", None, None, cause)))
    assert str(tmp_path) not in json.dumps(finite(found))
    assert found["left_out"] == [
        {"clip": "broken", "task": "motion", "cause": "000003.png is no picture that can be read; see fstab: it fails"}
    ]
    slow = [(c, t, replace(f, seconds={"find": 99.0}, peak_mb=7.0), s, w) for c, t, f, s, w in cases]
    assert finite(summarize(study_of(*slow))) == finite(summarize(study_of(*cases)))


def test_intervals_hold_the_figures_and_speak_of_clips_where_there_are_enough(tmp_path):
    cases = several(tmp_path, tracked, "tracking", 6)
    mine = summarize(study_of(*cases))["tasks"]["tracking"]
    assert mine["pooled"]["over"] == {"tracks": "clips"}
    for place in (mine["pooled"], *mine["clips"].values()):
        low, high = place["intervals"]["tracks"]["mota"]
        assert low <= place["tracks"]["mota"] <= high
        assert low < high
    assert mine["pooled"]["intervals"]["tracks"]["hota"] is not None
    assert "hota" not in mine["clips"]["clip-0"]["intervals"]["tracks"]  # of whole tracks, not of frames
    few = summarize(study_of(*cases[:3]))["tasks"]["tracking"]["pooled"]
    assert few["over"] == {"tracks": "frames"}
    assert few["intervals"]["tracks"]["mota"] is not None


def test_too_few_frames_have_no_interval(tmp_path):
    cases = several(tmp_path, masked, "motion", 1, frames=6)
    assert set(summarize(study_of(*cases))["tasks"]["motion"]["clips"]["clip-0"]["intervals"]["pixels"].values()) == {
        None
    }


def test_the_worst_clip_is_the_lowest_or_where_less_is_better_the_highest(tmp_path):
    cases = several(tmp_path, masked, "motion", 4)
    mine = summarize(study_of(*cases))["tasks"]["motion"]
    for group, measure, pick in (("pixels", "f", min), ("ranking", "log_average_miss_rate", max)):
        values = {name: clip[group][measure] for name, clip in mine["clips"].items()}
        worst = mine["worst"][group][measure]
        assert (worst["value"], values[worst["clip"]]) == (pick(values.values()), pick(values.values()))


def test_weights_of_one_give_the_figures_themselves(tmp_path):
    for make, task in ((masked, "motion"), (tracked, "tracking"), (tracked, "people")):
        scored = [case[3] for case in several(tmp_path / task, make, task, 3)]
        whole = measures(scored)
        for estimate in (over_clips(scored), over_frames(scored)):
            for group, one in estimate.items():
                found = one.statistic(np.ones(sum(stratum.units for stratum in one.strata)))
                assert found == pytest.approx({name: whole[group][name] for name in found}, nan_ok=True)


def test_a_clip_that_counts_twice_is_the_clip_twice(tmp_path):
    scored = [case[3] for case in several(tmp_path, tracked, "tracking", 3)]
    estimate = over_clips(scored)["tracks"]
    twice = measures([scored[0], scored[0], scored[2]])["tracks"]
    found = estimate.statistic(np.array([2.0, 0.0, 1.0]))
    assert found == pytest.approx({name: twice[name] for name in found})


def test_costs_are_told_apart_from_measures(tmp_path):
    clip, found = masked(tmp_path / "a")
    other, more = masked(tmp_path / "b", 1)
    more = replace(more, seconds={"find": 1.5, "read": 1.0}, peak_mb=300.0)
    told = summarize_costs(study_of((clip, "motion", found, None, ""), (other, "motion", more, None, "")))["motion"]
    assert told["all"] == {
        "frames": 24,
        "seconds": 3.0,
        "frames_per_s": 8.0,
        "peak_mb": 300.0,
        "ms_per_frame": {"find": 2000 / 24, "read": 1000 / 24},
    }
    assert told["clips"]["a"]["frames_per_s"] == 24


def study(tmp_path: Path):
    cases = several(tmp_path / "truth", masked, "motion", 2)
    empty = found_of(np.zeros((0, 7)), 12, {f: cases[0][2].masks[f] for f in range(1, 13)}, False)
    clip = replace(cases[0][0], name='odd, "name"')
    results = study_of(*cases, (clip, "motion", empty, score(clip, "motion", empty), ""))
    return results, summarize(results)


def test_tables_have_every_figure_to_the_last_digit(tmp_path):
    _, metrics = study(tmp_path)
    write_csv(tmp_path / "metrics.csv", metrics)
    with (tmp_path / "metrics.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert len(read) == len(metric_rows(metrics))
    for row in read:
        mine = metrics["tasks"][row["task"]]
        place = mine["clips"][row["clip"]] if row["scope"] == "clip" else mine[row["scope"]]
        value = place[row["group"]][row["measure"]]
        assert row["value"] == ("" if np.isnan(value) else repr(float(value)))
        span = place.get("intervals", {}).get(row["group"], {}).get(row["measure"])
        assert [row["low"], row["high"]] == (["", ""] if span is None else [repr(end) for end in span])
    assert {row["clip"] for row in read} >= {'odd, "name"', "clip-0", ""}


def test_parquet_says_the_same(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    results, metrics = study(tmp_path)
    write_parquet(tmp_path, metrics, results)
    table = parquet.read_table(tmp_path / "metrics.parquet").to_pylist()
    assert [row["measure"] for row in table] == [row[5] for row in metric_rows(metrics)]
    np.testing.assert_array_equal([row["value"] for row in table], [row[6] for row in metric_rows(metrics)])
    frames = parquet.read_table(tmp_path / "frames.parquet").to_pylist()
    assert [tuple(row.values()) for row in frames] == list(frame_rows(results))
    assert sorted(p.name for p in tmp_path.iterdir() if p.suffix) == ["frames.parquet", "metrics.parquet"]
