"""Every measured table in the documents is what eval/results says: none is typed by hand."""

import argparse
import importlib
import itertools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(
    not (ROOT / "eval" / "results").is_dir(), reason="results and studies are in a checkout, not in a package"
)

TEXTS = ("docs/benchmarks.md", "docs/tuning.md", "docs/network.md")
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
    assert [path.name for path, _ in figures.outdated()] == []


def test_a_figure_that_is_changed_by_hand_is_noticed_and_mended(figures, tmp_path) -> None:
    shutil.copy(ROOT / "README.md", tmp_path)
    (tmp_path / "docs").mkdir()
    text = (ROOT / TEXTS[0]).read_text(encoding="utf-8")
    changed = text.replace("| bms_cars1 | 0.85 ", "| bms_cars1 | 0.95 ")
    assert changed != text
    (tmp_path / TEXTS[0]).write_text(changed, encoding="utf-8")
    ((path, mended),) = figures.outdated(tmp_path)
    assert path.name == "benchmarks.md" and mended == text


def test_marks_without_a_result_end_the_program_with_one_line(figures) -> None:
    with pytest.raises(SystemExit, match=r"eval/results has no no-such\.json"):
        figures.fill("<!-- no_such --><!-- /no_such -->")


@pytest.mark.parametrize("text", TEXTS)
def test_every_table_of_numbers_stands_between_marks_that_results_fill(figures, text) -> None:
    content = figures.MARKED.sub("", (ROOT / text).read_text(encoding="utf-8"))
    assert "<!--" not in content
    assert MEASURED.findall(content) == []


def test_every_result_says_how_and_when_it_was_measured_and_names_no_place() -> None:
    for path in sorted((ROOT / "eval" / "results").glob("*.json")):
        text = path.read_text(encoding="utf-8")
        result = json.loads(text)
        assert result["command"].startswith("python eval/"), path.name
        # The scripts of the revision before the studies were rewritten are gone.
        assert result["revision"] == "1653584" or (ROOT / result["command"].split()[1]).is_file(), path.name
        assert re.fullmatch(r"20\d\d-\d\d-\d\d", result["date"]), path.name
        assert not re.search(r'"(?:[^"]* )?/(?:home|root|tmp|usr|work)/', text), path.name


def test_a_study_prints_its_text_and_keeps_it_with_its_figures(figures, tmp_path, monkeypatch, capsys) -> None:
    bench = figures.bench
    table = bench.format_table(["clip", "ms"], [["a", "1.5"], ["b", "–"]])
    path = tmp_path / "kept.json"
    monkeypatch.setattr(sys, "argv", [str(ROOT / "eval" / "study.py"), "/usr", "--seeds", "3", "--write", str(path)])
    bench.main(
        "A study.", {"": (lambda options: (f"Of two:\n\n{table}", [options.seeds]), {"data": Path, "--seeds": 1})}
    )
    assert capsys.readouterr().out == f"Of two:\n\n{table}\n"
    kept = json.loads(path.read_text(encoding="utf-8"))
    assert kept["command"] == "python eval/study.py DATA --seeds 3 --write kept.json"
    assert kept["figures"] == [3] and kept["blocks"][1]["rows"] == [["a", "1.5"], ["b", "–"]]
    assert bench.result_text(kept) == f"Of two:\n\n{table}"
    assert {"processor", "cores", "python", "numpy", "opencv-python-headless"} <= set(kept["machine"])


@pytest.mark.parametrize(("seconds", "words"), [(0.0, "each as long as the scenario says"), (19.0, "19 s each")])
def test_a_study_of_simulations_says_how_long_they_are(figures, seconds, words) -> None:
    simulated = importlib.import_module("simulated")
    assert simulated.about(argparse.Namespace(seeds=2, seconds=seconds)).startswith(f"2 seeds, {words}: mean")


def test_the_check_of_the_texts_says_nothing_where_all_is_well() -> None:
    command = [sys.executable, str(ROOT / "eval" / "figures.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "", "")


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
    from torchvision_dddas.lab.evaluation.studies.summary import parse_goal
    from torchvision_dddas.lab.evaluation.studies.sweep import parse_grid
    from torchvision_dddas.lab.simulation import load_scenario as load_scenario

    program, name, *words = command.split()
    options = [word for word in words if word.startswith("--")]
    if program == "python":
        script = (ROOT / name).read_text(encoding="utf-8")
        assert all(f'"{option}"' in script for option in options)
        assert not words or words[0].isupper() or words[0] in options or f'"{words[0]}": (' in script
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
