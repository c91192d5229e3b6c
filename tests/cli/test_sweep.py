"""`dddas sweep` on small clips: what it writes, that it repeats, what becomes of clips held out and of bad input."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.cli.conftest import bad
from tests.synthetic_clip import render
from torchvision_dddas.cli import app
from torchvision_dddas.config import load_config

GRID = ("--grid", "difference.threshold=10,60", "--grid", "morphology.erode_px=1")


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    """A study of three small clips and the cache beside it."""
    place = tmp_path_factory.mktemp("sweep")
    for seed, name in enumerate(("one", "two", "held")):
        film = render(seed=seed, frames=7, size=(200, 150))
        for part, pictures in (("frames", film.images), ("masks", film.masks)):
            folder = place / "clips" / name / part
            folder.mkdir(parents=True)
            for i, picture in enumerate(pictures, 1):
                cv2.imwrite(str(folder / f"{i:06d}.png"), np.asarray(picture).astype(np.uint8))
    (place / "study.toml").write_text('config = "fast"\n[[dataset]]\nkind = "folder"\nfolder = "clips"\n')
    return place / "study.toml"


def asked(study: Path, *words: str, measure: str = "motion.pixels.f"):
    files = ["--dataset", str(study), "--cache", str(study.parent / "cache")]
    one = [] if "--jobs" in words or "--scheduler" in words else ["--jobs", "1"]  # others take seconds to start
    return CliRunner().invoke(app, ["sweep", *files, "--measure", measure, *one, *words])


@pytest.fixture(scope="module")
def swept(study) -> tuple[Path, str]:
    """The folder of a sweep, and what it said."""
    out = study.parent / "first"
    result = asked(study, *GRID, "--holdout", "h*", "--out", str(out))
    assert result.exit_code == 0, result.output
    return out, result.output


def test_the_best_of_a_grid_is_written_for_config_and_beats_the_settings_as_they_were(swept) -> None:
    told = json.loads((swept[0] / "sweep.json").read_text())
    assert [trial["number"] for trial in told["trials"]] == [0, 1, 2]
    values = [trial["value"] for trial in told["trials"]]
    assert told["best"] == 1 and values[1] > values[0] > values[2] - 1e-9
    best = load_config(swept[0] / "best.toml")
    assert best.difference.threshold == 10 and best.morphology.erode_px == 1
    assert best.difference.kind == load_config("fast").difference.kind


def test_clips_held_out_have_no_say_and_are_told_apart(swept) -> None:
    told = json.loads((swept[0] / "sweep.json").read_text())
    assert told["clips"] == ["one", "two"] and told["held_out"] == ["held"]
    assert set(told["on_held_out"]) == {"before", "best"}
    assert "Held out (held)" in swept[1]


def test_a_sweep_that_is_asked_for_again_computes_nothing_and_writes_the_same(study, swept, monkeypatch) -> None:
    def none(*_, **__):
        raise AssertionError("something was computed again")

    monkeypatch.setattr("torchvision_dddas.evaluation.studies.jobs.do_job", none)
    out = study.parent / "again"
    assert asked(study, *GRID, "--holdout", "h*", "--out", str(out), "--quiet").exit_code == 0
    for name in ("sweep.json", "best.toml"):
        assert (out / name).read_bytes() == (swept[0] / name).read_bytes()


def test_a_study_of_the_best_takes_from_the_cache_what_the_sweep_has_computed(study, swept, tmp_path) -> None:
    words = ["--cache", str(study.parent / "cache"), "--jobs", "1", "--out", str(tmp_path), "--config"]
    asks = ["evaluate", "--dataset", str(study), "--clips", "one,two", *words, str(swept[0] / "best.toml"), "--quiet"]
    result = CliRunner().invoke(app, asks)
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "run.json").read_text())["computed"] == 0
    f = json.loads((tmp_path / "metrics.json").read_text())["tasks"]["motion"]["pooled"]["pixels"]["f"]
    assert f == json.loads((swept[0] / "sweep.json").read_text())["trials"][1]["value"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "nothing to try"),
        (("--range", "difference.threshold=1:9"), "--optuna"),
        (("--optuna", "3"), "nothing to propose"),
        (("--optuna", "0", "--range", "difference.threshold=1:9"), "1 to 10000"),
        (("--optuna", "3", *GRID), "give only one"),
        (("--grid", "difference.treshold=1"), "did you mean"),
        ((*GRID, "--holdout", "x*"), "fits no clip"),
        ((*GRID, "--holdout", "*"), "leaves no clip"),
        ((*GRID, "--by", "median"), "pooled, mean, worst"),
        ((*GRID, "--jobs", "0"), "--jobs must be 1 or more"),
        ((*GRID, "--jobs", "2", "--scheduler", "tcp://127.0.0.1:1"), "give only one"),
        ((*GRID, "--clips", "none*"), "no clip is left"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(study, tmp_path, words, told) -> None:
    assert told in bad(asked(study, *words, "--out", str(tmp_path / "out")))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("measure", "told"),
    [
        ("f", "wanted task.group.measure"),
        ("sight.pixels.f", "no task"),
        ("motion.voxels.f", "no group"),
        ("motion.pixels.n_tp", "neither more nor less"),
        ("motion.tracks.idf1", "no group of measures of motion; wanted pixels"),
        ("motion.pixels.beauty", "no measure of motion.pixels; wanted accuracy, "),
        ("tracking.tracks.idf1", "no clip is left"),
    ],
)
def test_a_measure_that_is_none_is_one_line(study, swept, tmp_path, measure, told) -> None:
    assert told in bad(asked(study, *GRID, "--clips", "one,two", "--out", str(tmp_path / "out"), measure=measure))


def test_without_optuna_it_is_said_how_to_get_it(study, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torchvision_dddas.evaluation.studies.sweep.find_spec", lambda name: None)
    asks = ("--optuna", "2", "--range", "difference.threshold=5:40", "--out", str(tmp_path / "out"))
    assert "torchvision-dddas[tune]" in bad(asked(study, *asks))
