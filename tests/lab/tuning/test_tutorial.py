"""The tutorial runs, on scenes too small to learn much from, and its text names what is there."""

import re
import runpy
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.lab.tuning.test_colours import scene
from tests.synthetic_clip import film_into
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.lab import tuning

DOCS = Path(__file__).parents[3] / "docs"


def test_the_script_runs_and_says_what_tuning_was_worth(tmp_path, monkeypatch, capsys) -> None:
    plan = tuning.Plan
    monkeypatch.setattr(
        "torchvision_dddas.lab.simulation.film_clip", lambda folder, seed, **_: film_into(folder, seed, 6, (160, 120))
    )
    monkeypatch.setattr(tuning, "Plan", lambda **_: plan(steps=2, batch=2, look_every=1))
    runpy.run_path(str(DOCS / "tuning.py"))["main"](tmp_path)
    told = capsys.readouterr().out
    assert "step 2: " in told and "difference.threshold: 12 -> " in told
    assert "F on the clips tuned on: " in told and "F on the clips held out: " in told


def code_of(heading: str) -> str:
    """The lines of Python under a heading of the text."""
    section = (DOCS / "tuning.md").read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    (code,) = re.findall(r"^```python\n(.+?)^```", section, re.M | re.S)
    return code


def test_the_lines_on_colours_write_a_file_that_is_read_again(tmp_path, monkeypatch) -> None:
    for name in ("pictures", "labels"):
        (tmp_path / name).mkdir()
    for seed in range(2):
        picture, labels = scene(seed)
        cv2.imwrite(str(tmp_path / "pictures" / f"{seed}.png"), picture)
        cv2.imwrite(str(tmp_path / "labels" / f"{seed}.png"), labels.astype(np.uint8))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "few.py").write_text(code_of("Colours of landmarks"))
    runpy.run_path("few.py")
    assert read_colours("colours.toml").names == ("red", "blue")


def test_the_ten_lines_of_the_text_run_as_they_are(tmp_path, monkeypatch, capsys) -> None:
    code = code_of("As a library")
    assert len([line for line in code.splitlines() if line]) <= 10
    for seed, name in enumerate(("one", "held")):
        film_into(tmp_path / "clips" / name, seed, frames=6, size=(160, 120))
    (tmp_path / "study.toml").write_text('[[dataset]]\nkind = "folder"\nfolder = "clips"\n')
    plan = tuning.Plan
    monkeypatch.setattr(tuning, "Plan", lambda **_: plan(steps=2, batch=2))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ten.py").write_text(code)
    runpy.run_path("ten.py")
    assert re.fullmatch(r"\(\S+, \S+\)\n", capsys.readouterr().out)


@pytest.mark.parametrize("line", re.findall(r"^from torchvision_dddas.*$", (DOCS / "tuning.md").read_text(), re.M))
def test_what_the_text_imports_is_there(line: str) -> None:
    module, names = re.fullmatch(r"from (\S+) import (.+)", line).groups()  # type: ignore[union-attr]
    for name in names.split(", "):
        assert hasattr(import_module(module), name)
