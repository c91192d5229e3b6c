"""The commands beside detect, and what they import."""

import os
import subprocess
import sys
from functools import partial

import numpy as np

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


def test_a_terminal_that_knows_only_ascii_is_no_reason_to_crash(dddas, engine, clip, tmp_path):
    dddas("detect", clip, "--out", tmp_path / "out", "--quiet")
    words = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()", "evaluate"]
    words += [str(tmp_path / "out/masks"), str(tmp_path / "out")]
    done = subprocess.run(words, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "ascii"}, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"IoU" in done.stdout


def test_no_words_at_all_get_the_help():
    program = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "detect" in done.stdout + done.stderr


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


def test_progress_on_a_terminal_shows_frames_a_second(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_module.progress("a [b] clip", None, quiet=False) as tick:
        tick()
    assert "Traceback" not in capsys.readouterr().err


def test_clip_names_are_telling_and_different():
    names = progress_module.clip_names(
        ["a/walk/frames", "b/walk/frames/", "x.mp4", "run/*.png", "camera:0", "rtsp://host/cam.1", "frames"]
    )
    assert names == ["walk", "walk-2", "x", "run", "camera-0", "cam", "frames"]
