"""The code on the page about tuning runs, on scenes too small to learn much from, and names what is there."""

import re
import runpy
from importlib import import_module
from pathlib import Path

import pytest

from tests.synthetic_clip import film_into
from torchvision_dddas.lab import tuning

DOCS = Path(__file__).parents[3] / "docs"


def code_of(heading: str) -> str:
    """The lines of Python under a heading of the text."""
    section = (DOCS / "tuning.md").read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    (code,) = re.findall(r"^```python\n(.+?)^```", section, re.M | re.S)
    return code


@pytest.mark.slow
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
