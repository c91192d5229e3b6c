"""`dddas sweep` on small clips: what it writes, that it repeats, what becomes of clips held out and of bad input."""

import json
from pathlib import Path

import pytest

from tests.cli.conftest import bad
from tests.lab.evaluation.studies import world
from tests.pages import Page
from torchvision_dddas.config import load_config

GRID = ("--grid", "difference.threshold=10,60", "--grid", "morphology.erode_px=1")
HOLD = ("--holdout", "h*")


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    """A study of three small clips and the cache beside it."""
    place = tmp_path_factory.mktemp("sweep")
    for seed, name in enumerate(("one", "two", "held")):
        world.filmed(place / "clips", name, seed, frames=7)
    return world.study(place / "clips", 'config = "fast"\nset = ["gates.min_area_px=300"]')


@pytest.fixture(scope="module")
def run(study, dddas):
    def call(*words, command="sweep"):
        files = ("--dataset", study, "--cache", study.parent / "cache")
        jobs = () if "--jobs" in words else ("--jobs", 1)  # others take seconds to start
        measure = ("--measure", "motion.pixels.f") if command == "sweep" and "--measure" not in words else ()
        return dddas(command, *files, *measure, *jobs, *words)

    return call


@pytest.fixture(scope="module")
def swept(study, run) -> tuple[Path, str]:
    """The folder of a sweep, and what it printed."""
    result = run(*GRID, *HOLD, "--out", study.parent / "first")
    assert result.exit_code == 0, result.output
    return study.parent / "first", result.output


def test_the_best_of_a_grid_is_written_for_config_and_measured_on_clips_held_out(swept) -> None:
    record = json.loads((swept[0] / "sweep.json").read_text())
    assert [trial["number"] for trial in record["trials"]] == [0, 1, 2]
    values = [trial["value"] for trial in record["trials"]]
    assert record["best"] == 1 and values[1] > values[0] > values[2] - 1e-9
    best = load_config(swept[0] / "best.toml")
    assert best.difference.threshold == 10 and best.morphology.erode_px == 1
    assert best.difference.kind == load_config("fast").difference.kind
    assert record["clips"] == ["one", "two"] and record["held_out"] == ["held"]
    assert set(record["on_held_out"]) == {"before", "best"} and "Held out (held)" in swept[1]


def test_a_report_shows_the_trials_over_each_parameter_and_what_a_parameter_means_here(swept) -> None:
    folder, printed = swept
    note = "difference.threshold is in grey levels with difference.kind = to_reference"
    page = Page((folder / "report.html").read_text())
    assert note in page.shown() and f"note: {note}" in printed and "best: trial 1" in page.shown()
    assert {path.name for path in (folder / "figures").glob("*.svg")} == {
        "difference-threshold.svg",
        "morphology-erode-px.svg",
    }
    assert len((folder / "tables" / "trials.csv").read_text().splitlines()) == 4


def test_the_default_is_shown_and_marked(swept) -> None:
    default = load_config().difference.threshold
    assert json.loads((swept[0] / "sweep.json").read_text())["defaults"]["difference.threshold"] == default
    assert f"default {default:g}" in swept[1] and "3 (default)" in swept[1]
    assert f"difference.threshold: 10.0 (default {default})" in (swept[0] / "best.toml").read_text()


def test_a_repeated_sweep_and_a_study_of_its_best_compute_nothing(run, swept, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(
        "torchvision_dddas.lab.evaluation.studies.jobs.do_job", lambda *_: pytest.fail("computed again")
    )
    assert run(*GRID, *HOLD, "--out", tmp_path, "--quiet").exit_code == 0
    for name in ("sweep.json", "best.toml"):
        assert (tmp_path / name).read_bytes() == (swept[0] / name).read_bytes()
    words = ("--clips", "one,two", "--out", tmp_path, "--config", swept[0] / "best.toml", "--quiet")
    result = run(*words, command="evaluate")
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "run.json").read_text())["computed"] == 0
    f = json.loads((tmp_path / "metrics.json").read_text())["tasks"]["motion"]["pooled"]["pixels"]["f"]
    assert f == json.loads((swept[0] / "sweep.json").read_text())["trials"][1]["value"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "nothing to try"),
        (("--range", "difference.threshold=1:9"), "--optuna"),
        (("--optuna", "3"), "nothing to propose"),
        (("--optuna", "0", "--range", "difference.threshold=1:9"), "1 to 10000"),
        (("--optuna", "3", *GRID), "give only one"),
        ((*GRID, "--holdout", "x*"), "fits no clip"),
        ((*GRID, "--holdout", "*"), "leaves no clip"),
        ((*GRID, "--by", "median"), "pooled, mean, worst"),
        ((*GRID, "--jobs", "2", "--scheduler", "tcp://127.0.0.1:1"), "give only one"),
        ((*GRID, "--clips", "none*"), "no clip is left"),
        ((*GRID, "--measure", "motion.tracks.idf1"), "not a group of measures of motion; wanted pixels"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(run, tmp_path, words, message) -> None:
    assert message in bad(run(*words, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_without_optuna_the_line_says_how_to_get_it(run, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torchvision_dddas.lab.evaluation.studies.sweep.find_spec", lambda name: None)
    words = ("--optuna", 2, "--range", "difference.threshold=5:40", "--out", tmp_path / "out")
    assert "torchvision-dddas[tune]" in bad(run(*words))


def test_an_interrupt_before_the_first_trial_says_that_finished_stages_are_kept(study, run, tmp_path, monkeypatch):
    from torchvision_dddas.lab.evaluation.studies.sweep import StudyMeasure

    whole = StudyMeasure.prepare

    def stopped(*words, **more):
        whole(*words, **more)
        raise KeyboardInterrupt

    monkeypatch.setattr(StudyMeasure, "prepare", stopped)
    result = run("--grid", "difference.threshold=11", "--out", tmp_path / "out")
    assert result.exit_code == 130
    kept = f"finished stages are kept in {study.parent / 'cache'}; the same command goes on from there"
    assert result.stderr.splitlines()[-1] == f"dddas: interrupted; {kept}"
