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


def run(study: Path, *words: str, command: str = "sweep"):
    files = ["--dataset", str(study), "--cache", str(study.parent / "cache")]
    one = [] if "--jobs" in words or "--scheduler" in words else ["--jobs", "1"]  # others take seconds to start
    measure = ["--measure", "motion.pixels.f"] if command == "sweep" and "--measure" not in words else []
    return CliRunner().invoke(app, [command, *files, *measure, *one, *words])


@pytest.fixture(scope="module")
def swept(study) -> tuple[Path, str]:
    """The folder of a sweep, and what it printed."""
    out = study.parent / "first"
    result = run(study, *GRID, "--holdout", "h*", "--out", str(out))
    assert result.exit_code == 0, result.output
    return out, result.output


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


def test_a_repeated_sweep_and_a_study_of_its_best_compute_nothing(study, swept, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torchvision_dddas.evaluation.studies.jobs.do_job", lambda *_: pytest.fail("computed again"))
    assert run(study, *GRID, "--holdout", "h*", "--out", str(tmp_path), "--quiet").exit_code == 0
    for name in ("sweep.json", "best.toml"):
        assert (tmp_path / name).read_bytes() == (swept[0] / name).read_bytes()
    words = ("--clips", "one,two", "--out", str(tmp_path), "--config", str(swept[0] / "best.toml"), "--quiet")
    result = run(study, *words, command="evaluate")
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
        ((*GRID, "--measure", "motion.tracks.idf1"), "no group of measures of motion; wanted pixels"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(study, swept, tmp_path, words, message) -> None:
    assert message in bad(run(study, *words, "--out", str(tmp_path / "out")))
    assert not (tmp_path / "out").exists()


def test_without_optuna_the_line_says_how_to_get_it(study, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torchvision_dddas.evaluation.studies.sweep.find_spec", lambda name: None)
    words = ("--optuna", "2", "--range", "difference.threshold=5:40", "--out", str(tmp_path / "out"))
    assert "torchvision-dddas[tune]" in bad(run(study, *words))
