"""The commands beside detect, what they import, and what they say while they work."""

import os
import re
import subprocess
import sys
import types
from functools import partial

import pytest
from rich.table import Table

from tests.cli.conftest import bad
from tests.synthetic_clip import film_into
from torchvision_dddas.cli import options
from torchvision_dddas.cli import progress as progress_module
from torchvision_dddas.config import Settings


def python(program, *words, **environ):
    command = [sys.executable, "-c", program, *map(str, words)]
    return subprocess.run(command, capture_output=True, env={**os.environ, **environ}, check=False)


MAIN = "from torchvision_dddas.cli import main; main()"


def test_help_loads_nothing_heavy():
    program = "import sys; from torchvision_dddas.cli import app; "
    program += "print([m for m in ('numpy', 'cv2', 'torch', 'pydantic', 'scipy') if m in sys.modules])"
    assert python(program).stdout == b"[]\n"


def test_version_and_help(dddas):
    assert dddas("--version").stdout.startswith("dddas ")
    for command in ("detect", "track", "evaluate", "demo", "settings"):
        assert dddas(command, "--help").exit_code == 0
        assert command in dddas("--help").stdout
    done = python(MAIN)
    assert done.returncode == 2 and b"detect" in done.stdout + done.stderr


def test_settings_lists_every_parameter_on_its_line(dddas):
    from torchvision_dddas.config import all_parameters

    lines = dddas("settings").stdout.splitlines()
    for parameter in all_parameters():
        assert any(parameter.name in line and str(parameter.default) in line for line in lines), parameter.name


def test_settings_of_a_group_lists_its_parameters_alone(dddas):
    lines = dddas("settings", "gates").stdout.splitlines()
    names = {name for line in lines for name in re.findall(r"^│ (\w+\.\w+)", line)}
    assert names == {f"gates.{name}" for name in Settings().gates.model_dump()}
    assert "no group of parameters is named 'gate'; did you mean gates?" in bad(dddas("settings", "gate"))
    assert "wanted one of registration, interval," in bad(dddas("settings", "zzz"))


def test_settings_of_scenarios_lists_what_changes_one(dddas, tmp_path):
    lines = dddas("settings", "scenario").stdout.splitlines()
    names = {name for line in lines for name in re.findall(r"^│ (\w+(?:\.1)?\.\w+)", line)}
    assert {"uav.altitude_m", "clip.seconds", "crowd.1.people", "fault.1.what", "gps.rate_hz"} <= names
    assert "None" not in "".join(lines) and not any("shipped" in line.lower() for line in lines)
    for name in names:  # each is known to --set, which refuses text for a number and a name that there is not
        kind, key = name.rsplit(".", 1)
        wrong = bad(dddas("simulate", "demo", "--set", f"{kind}.{key}=[[[1]]]", "--out", tmp_path / "out"))
        assert "unknown parameter" not in wrong, name


@pytest.mark.parametrize("err", [False, True])
def test_names_do_not_steer_the_terminal(capsys, err):
    name = "a\x1b[2Jb\x07\x9b\u202ec\udc80"
    options.echo(name, err=err)
    table = Table("\x1b]0;title\x07", title=name)
    table.add_row(name)
    progress_module.open_console(stderr=err).print(table)
    progress_module.print_now(name)
    for written in capsys.readouterr():
        assert all(letter.isprintable() for letter in written.replace("\n", ""))
        assert r"a\x1b[2Jb\x07\x9b\u202ec\x80" in written or not written


def test_a_terminal_of_ascii_alone_is_written_to(dddas, engine, clip, tmp_path):
    dddas("detect", clip, "--out", tmp_path / "out", "--quiet")
    done = python(MAIN, "evaluate", tmp_path / "out/masks", tmp_path / "out", PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"IoU" in done.stdout


def test_demo_films_detects_and_scores_twice_into_the_same_folder(dddas, engine, tmp_path, monkeypatch):
    small = partial(film_into, frames=3, size=(160, 120))
    monkeypatch.setattr("torchvision_dddas.lab.simulation.film_clip", lambda folder, tick: small(folder))
    for _ in range(2):
        result = dddas("demo", "--out", tmp_path / "demo")
        assert result.exit_code == 0, result.output
    assert "Look at" in result.stdout
    for name in ("overlay.mp4", "detections.csv", "metrics.json", "clip/frames/000003.jpg", "clip/masks/000003.png"):
        assert (tmp_path / "demo" / name).is_file()


def test_progress_away_from_a_terminal_is_a_plain_line_now_and_then(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress_module, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    with progress_module.progress("walk", 10, quiet=False) as tick:
        for _ in range(6):
            now[0] += 2.0
            tick()
    assert capsys.readouterr().err.splitlines() == [
        "walk: 3 of 10 frames, 0.5 frames/s, 14 s left",
        "walk: 6 of 10 frames, 0.5 frames/s, 8 s left",
    ]


def test_progress_on_a_terminal_takes_any_name(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_module.progress("a [b] clip", None, quiet=False) as tick:
        tick()
    assert "Traceback" not in capsys.readouterr().err


def test_clip_names_are_different_and_from_the_last_telling_part():
    names = progress_module.clip_names(
        ["a/walk/frames", "b/walk/frames/", "x.mp4", "run/*.png", "camera:0", "rtsp://host/cam.1", "frames"]
    )
    assert names == ["walk", "walk-2", "x", "run", "camera-0", "cam", "frames"]
