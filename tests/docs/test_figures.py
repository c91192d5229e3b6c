"""What the texts say was measured is what the results say: no figure of a table is typed by hand."""

import importlib
import itertools
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(
    not (ROOT / "docs" / "results").is_dir(), reason="results and studies are in a checkout, not in a package"
)

TEXTS = ("docs/benchmarks.md", "eval/README.md", "docs/tuning.md")
# A table with a column of numbers, which are set to the right.
MEASURED = re.compile(r"^\|[- |:]*---:[- |:]*\|$", re.M)


@pytest.fixture(scope="module")
def figures():
    sys.path.insert(0, str(ROOT / "eval"))
    try:
        yield importlib.import_module("figures")
    finally:
        sys.path.remove(str(ROOT / "eval"))


def test_the_tables_of_the_texts_are_those_that_the_results_give(figures) -> None:
    assert figures.differing() == []


def test_a_figure_that_is_changed_by_hand_is_told(figures, tmp_path, monkeypatch) -> None:
    for text in TEXTS:
        (tmp_path / text).parent.mkdir(exist_ok=True)
        (tmp_path / text).write_text((ROOT / text).read_text())
    readme = tmp_path / "docs" / "benchmarks.md"
    changed = readme.read_text().replace("| bms_cars1 | 0.85 ", "| bms_cars1 | 0.95 ")
    assert changed != readme.read_text()
    readme.write_text(changed)
    monkeypatch.setattr(figures.results, "ROOT", tmp_path)
    assert figures.differing() == [("docs/benchmarks.md", "accuracy")]


@pytest.mark.parametrize("text", TEXTS)
def test_every_table_of_numbers_stands_between_marks_that_results_fill(figures, text) -> None:
    content = (ROOT / text).read_text(encoding="utf-8")
    for into, mark in figures.pieces():
        if into == text:
            content = re.sub(rf"<!-- {re.escape(mark)} -->.*?<!-- /{re.escape(mark)} -->", "", content, flags=re.S)
    assert "<!--" not in content
    assert MEASURED.findall(content) == []


def test_every_result_says_how_and_when_it_was_measured_and_names_no_place() -> None:
    for path in sorted((ROOT / "docs" / "results").glob("*.json")):
        told = json.loads(path.read_text(encoding="utf-8"))
        assert told["command"].startswith("python eval/"), path.name
        assert (ROOT / told["command"].split()[1]).is_file(), path.name
        assert re.fullmatch(r"20\d\d-\d\d-\d\d", told["day"]), path.name
        assert not re.search(r'"(?:[^"]* )?/(?:home|root|tmp|usr|work)/', path.read_text(encoding="utf-8")), path.name


def test_a_study_that_writes_a_text_keeps_what_it_wrote(figures, tmp_path, monkeypatch) -> None:
    results, report = figures.results, figures.report
    monkeypatch.setattr(results, "ROOT", tmp_path)
    monkeypatch.setattr(results, "FOLDER", tmp_path / "docs" / "results")
    (tmp_path / "data").mkdir()
    (tmp_path / "docs").mkdir(exist_ok=True)
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "eval" / "study.py"), "/usr", "--seeds", "3"])
    (tmp_path / "docs" / "benchmarks.md").write_text("before\n<!-- gain -->\n<!-- /gain -->\nafter\n")
    table = "Of two clips:\n\n| clip | ms |\n| --- | ---: |\n| a | 1.5 |\n| b | – |"
    report.put(tmp_path / "docs" / "benchmarks.md", "gain", table)
    (kept,) = results.every()
    assert (kept.into, kept.mark, kept.command) == ("docs/benchmarks.md", "gain", "python eval/study.py DATA --seeds 3")
    assert kept.blocks[1]["rows"] == [["a", "1.5"], ["b", "–"]] and kept.text() == table
    assert f"<!-- gain -->\n\n{table}\n\n<!-- /gain -->\nafter" in (tmp_path / "docs" / "benchmarks.md").read_text()


def test_a_text_elsewhere_is_written_and_nothing_is_kept(figures, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(figures.results, "FOLDER", tmp_path / "results")
    (tmp_path / "text.md").write_text("<!-- gain -->\n<!-- /gain -->\n")
    figures.report.put(tmp_path / "text.md", "gain", "nothing")
    assert "nothing" in (tmp_path / "text.md").read_text() and not (tmp_path / "results").exists()


def test_the_check_of_the_texts_says_nothing_where_all_is_well() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "eval" / "figures.py"), "--check"], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# -- the source's tables and figures ---------------------------------------------------------------------------------


def commands() -> list[str]:
    """Those of the table of the source's tables and figures."""
    if not (ROOT / "eval" / "README.md").is_file():
        return []
    content = (ROOT / "eval" / "README.md").read_text(encoding="utf-8")
    section = content.partition("## The source's tables and figures")[2].partition("\n## ")[0]
    return sorted(set(re.findall(r"`((?:python eval/|dddas )[^`]+)`", section)))


def test_there_is_a_command_for_every_figure_of_the_source_that_measures_something() -> None:
    content = (ROOT / "eval" / "README.md").read_text(encoding="utf-8")
    section = content.partition("## The source's tables and figures")[2].partition("\n## ")[0]
    named: dict[str, set[str]] = {"A": set(), "B": set(), "C": set()}
    for row in section.splitlines():
        for appendix, figures_of in re.findall(r"\b([ABC]) Fig\. ([\d, ab]+)", row.split("|")[1] if "|" in row else ""):
            named[appendix] |= set(re.findall(r"\d+", figures_of))
    assert {appendix: len(found) for appendix, found in named.items()} == {"A": 9, "B": 9, "C": 6}


@pytest.mark.parametrize("command", commands())
def test_a_command_that_the_texts_give_can_be_typed(command) -> None:
    from typer.main import get_command

    from torchvision_dddas.cli import app
    from torchvision_dddas.config import load_config
    from torchvision_dddas.evaluation.studies.goals import parse_goal
    from torchvision_dddas.evaluation.studies.search_space import parse_grid
    from torchvision_dddas.simulation import load_scenario as load_scenario

    program, name, *words = command.split()
    options = [word for word in words if word.startswith("--")]
    if program == "python":
        said = "".join((ROOT / path).read_text(encoding="utf-8") for path in (name, "eval/sim_runs.py"))
        assert all(f'"{option}"' in said for option in options)
        return
    known = {
        option
        for parameter in get_command(app).commands[name].params  # type: ignore[attr-defined]
        for option in parameter.opts
    }
    assert set(options) <= known
    values = dict(itertools.pairwise(words))
    load_config(values.get("--config"), [values["--set"]] if "--set" in values else [])
    parse_grid([value for option, value in itertools.pairwise(words) if option == "--grid"], load_config())
    if "--measure" in values:
        parse_goal(values["--measure"])
    for word in words:
        if word.startswith("sim:") or (name == "simulate" and word == words[0]):
            load_scenario(word.removeprefix("sim:"))
