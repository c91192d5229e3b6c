"""The commands beside detect, and what they import."""

import json
import os
import subprocess
import sys
from functools import partial

import cv2
import numpy as np
import pytest

from tests.synthetic_clip import film_into
from torchvision_dddas.cli import progress as progress_module


def test_help_loads_nothing_heavy():
    program = (
        "import sys; from torchvision_dddas.cli import app; "
        "print([m for m in ('numpy', 'cv2', 'torch', 'pydantic', 'scipy') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_version_and_help(dddas):
    assert dddas("--version").stdout.startswith("dddas ")
    for command in ("detect", "track", "evaluate", "demo", "settings"):
        assert dddas(command, "--help").exit_code == 0
        assert command in dddas("--help").stdout


def test_settings_lists_every_parameter_on_its_line(dddas):
    from torchvision_dddas.config import all_parameters

    lines = dddas("settings").stdout.splitlines()
    for parameter in all_parameters():
        assert any(parameter.name in line and str(parameter.default) in line for line in lines), parameter.name


def test_evaluate_prints_a_table_and_writes_metrics(dddas, engine, clip, tmp_path):
    (tmp_path / "truth").mkdir()
    mask = np.zeros((48, 64), np.uint8)
    mask[2:8, 3:12] = 1
    cv2.imwrite(str(tmp_path / "truth/00001.png"), mask)
    dddas("detect", clip, "--out", tmp_path / "out", "--quiet")
    result = dddas("evaluate", tmp_path / "truth", tmp_path / "out")
    assert result.exit_code == 0
    assert "0.800" in result.stdout  # F of a third missed
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["clips"]["out"]["pixels"]["n_fn"] == 18


def test_evaluate_of_a_parent_folder_pools(dddas, engine, clip, tmp_path):
    mask = np.zeros((48, 64), np.uint8)
    mask[2:8, 3:9] = 1
    for name in ("a", "b"):
        (tmp_path / "truth" / name / "masks").mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "truth" / name / "masks/00000.png"), mask)
        dddas("detect", clip, "--out", tmp_path / "out" / name, "--quiet")
    result = dddas("evaluate", tmp_path / "truth", tmp_path / "out", "--out", tmp_path / "score")
    assert result.exit_code == 0
    assert "pooled" in result.stdout
    assert json.loads((tmp_path / "score/metrics.json").read_text())["pooled"]["pixels"]["f"] == 1


def test_a_terminal_that_knows_only_ascii_is_no_reason_to_crash(dddas, engine, clip, tmp_path):
    dddas("detect", clip, "--out", tmp_path / "out", "--quiet")
    words = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()", "evaluate"]
    words += [str(tmp_path / "out/masks"), str(tmp_path / "out")]
    done = subprocess.run(words, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "ascii"}, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"IoU" in done.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["detect"], "Missing argument"),
        (["detect", "x", "--backend", "gpu"], "'onboard'; see"),
        (["detect", "x", "--nosuch"], "--nosuch"),
        (["nosuch"], "'nosuch'"),
    ],
)
def test_a_command_line_that_will_not_do_gets_one_line(words, says):
    program = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()", *words]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("dddas: ") and says in line


def test_no_words_at_all_get_the_help():
    program = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "detect" in done.stdout + done.stderr


def test_a_demo_that_cannot_be_written_is_one_line(dddas, tmp_path):
    (tmp_path / "file").write_text("")
    result = dddas("demo", "--out", tmp_path / "file/demo")
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith("dddas: cannot write")


def test_evaluate_of_nothing_is_one_line(dddas, tmp_path):
    result = dddas("evaluate", tmp_path / "nosuch", tmp_path)
    assert result.exit_code == 2
    assert result.stderr == f"dddas: no truth at {tmp_path / 'nosuch'}\n"


def test_metrics_that_cannot_be_written_are_one_line(dddas, engine, clip, tmp_path):
    dddas("detect", clip, "--out", tmp_path / "out", "--quiet")
    (tmp_path / "file").write_text("")
    result = dddas("evaluate", tmp_path / "out/masks", tmp_path / "out", "--out", tmp_path / "file/deep")
    assert result.exit_code == 2
    assert "cannot write" in result.stderr


def test_demo_films_detects_and_scores_twice_into_the_same_folder(dddas, engine, tmp_path, monkeypatch):
    small = partial(film_into, frames=3, size=(160, 120))
    monkeypatch.setattr("torchvision_dddas.simulation.film_clip", lambda folder, tick: small(folder))
    for _ in range(2):
        result = dddas("demo", "--out", tmp_path / "demo")
        assert result.exit_code == 0, result.output
    assert "Look at" in result.stdout
    for name in ("overlay.mp4", "detections.csv", "metrics.json", "clip/frames/000003.jpg", "clip/masks/000003.png"):
        assert (tmp_path / "demo" / name).is_file()


def test_progress_away_from_a_terminal_is_a_plain_line_now_and_then(capsys, monkeypatch):
    clock = iter(np.arange(0, 100, 2.0))
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    with progress_module.progress("walk", 10, quiet=False) as tick:
        for _ in range(6):
            tick()
    assert capsys.readouterr().err.splitlines() == [
        "walk: 3 of 10 frames, 0.5 frames/s, 14 s left",
        "walk: 6 of 10 frames, 0.5 frames/s, 8 s left",
    ]


def test_progress_of_large_pictures_is_told_in_seconds_a_frame(capsys, monkeypatch):
    clock = iter(np.arange(0, 100, 40.0))
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    with progress_module.progress("walk", 3, quiet=False) as tick:
        tick()
    assert capsys.readouterr().err == "walk: 1 of 3 frames, 40 s a frame, 80 s left\n"


def test_progress_on_a_terminal_shows_frames_a_second(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_module.progress("a [b] clip", None, quiet=False) as tick:
        tick()
    assert "Traceback" not in capsys.readouterr().err
