"""The README and the pages under docs/ hold: commands, links, files and examples exist and run."""

import ast
import csv
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.lab.evaluation.studies.world import three
from tests.overflight import ORIGIN, Overflight, pictures
from tests.synthetic_clip import film_into
from torchvision_dddas.cli import app
from torchvision_dddas.config import load_config
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.io.telemetry import autopilots, nmea

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = {
    "README.md": (ROOT / "README.md").read_text(encoding="utf-8"),
    **{path.relative_to(DOCS).as_posix(): path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))},
}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page], re.DOTALL)


COMMANDS = sorted(
    {
        line.partition("#")[0].removeprefix("$ ").strip()
        for page in PAGES
        for block in [*blocks(page, "sh"), *blocks(page, "console")]
        for line in block.splitlines()
        if line.removeprefix("$ ").startswith("dddas ") and "COMMAND" not in line
    }
)


@pytest.mark.parametrize("line", COMMANDS)
def test_every_command_exists_with_its_options(line: str) -> None:
    words = shlex.split(line)[1:]
    names = words[:2] if words[0] == "locate" else words[:1]
    result = CliRunner().invoke(app, [*names, "--help"])
    assert result.exit_code == 0
    assert [word for word in words if word.startswith("--") and word not in result.output] == []


def imported_by(path: Path) -> Iterator[Path]:
    """The files of the package whose names a file imports; a room's list of names leads to the files behind it."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    rooms = {a.asname: a.name for node in nodes if isinstance(node, ast.Import) for a in node.names}
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if rooms.get(node.value.id, "").startswith("torchvision_dddas"):
                yield from defined_in(rooms[node.value.id], node.attr)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchvision_dddas"):
            for alias in node.names:
                yield from defined_in(str(node.module), alias.name)


def defined_in(module: str, name: str) -> Iterator[Path]:
    """The file that defines a name which a module offers."""
    place = ROOT / module.replace(".", "/")
    if (place / f"{name}.py").exists():
        yield place / f"{name}.py"
    elif place.with_suffix(".py").exists():
        yield place.with_suffix(".py")
    elif module.startswith("torchvision_dddas"):
        for node in ast.parse((place / "__init__.py").read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and name in [alias.asname or alias.name for alias in node.names]:
                yield from defined_in(str(node.module), name)


def test_the_table_from_equation_to_file_names_code_that_the_product_runs() -> None:
    package = ROOT / "torchvision_dddas"
    table = PAGES["method.md"].partition("## Beyond")[0]
    # Tuning and export repeat steps: what they alone run is not the product's.
    reached: set[Path] = set()
    waiting = [path for path in (package / "cli").glob("*.py") if path.stem not in ("tune", "export")]
    while waiting:
        if (path := waiting.pop()) not in reached and path.parent.name not in ("tuning", "export"):
            reached.add(path)
            waiting += imported_by(path)
    files = {package / name for name in re.findall(r"`((?:\w+/)*\w+\.py)`", table)}
    assert len(files) > 40
    assert [str(path.relative_to(package)) for path in sorted(files - reached)] == []
    settings = re.findall(r"`--set ([^`]+)`", table)
    assert len(settings) > 3 and load_config(None, settings)


@pytest.mark.parametrize("page", PAGES)
def test_every_link_and_picture_leads_to_a_file(page: str) -> None:
    home = ROOT if page == "README.md" else (DOCS / page).parent
    links = [link.partition("#") for link in re.findall(r"\]\(([^)]+)\)", PAGES[page]) if "://" not in link]
    assert [file for file, _, _ in links if file and not (home / file).exists()] == []
    targets = [((home / file if file else DOCS / page).resolve(), anchor) for file, _, anchor in links if anchor]
    assert [anchor for file, anchor in targets if anchor not in anchors(file.read_text(encoding="utf-8"))] == []


def anchors(page: str) -> set[str]:
    """The anchors of a page's headings, as hosts of repositories and the site's generator make them."""
    headings = re.findall(r"^#+ (.+)$", page, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [page for page in PAGES if "```toml" in PAGES[page]])
def test_every_block_of_toml_can_be_read(page: str) -> None:
    for block in blocks(page, "toml"):
        tomllib.loads(block)


def test_every_file_that_the_method_page_names_is_there() -> None:
    named = re.findall(r"`([\w/]+\.(?:py|toml|onnx))`", PAGES["method.md"])
    assert len(named) >= 40
    assert [
        name for name in named if not (ROOT / "torchvision_dddas" / name).exists() and not (ROOT / name).exists()
    ] == []


def test_every_room_is_on_the_architecture_page() -> None:
    rooms = sorted(path.parent.name for path in (ROOT / "torchvision_dddas").glob("*/__init__.py"))
    assert [room for room in rooms if f"{room}/" not in PAGES["architecture.md"]] == []


@pytest.fixture(scope="module")
def demo_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    film_into(folder / "demo-out/clip", frames=12, size=(480, 360))
    return folder


def test_the_first_example_of_the_formats_page_runs(demo_folder: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(demo_folder)
    exec(compile(blocks("formats.md", "python")[0], "formats.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) == 2


@pytest.mark.parametrize("page", ["README.md", "python.md", "quickstart/python.md"])
def test_the_python_examples_run_one_after_another(page: str, demo_folder: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(demo_folder)
    names: dict[str, object] = {}
    for code in blocks(page, "python"):
        exec(compile(code, page, "exec"), names)
    assert len(capsys.readouterr().out.splitlines()) >= 5


def test_the_camera_and_the_configuration_of_the_commands_page_can_be_read(tmp_path: Path) -> None:
    from torchvision_dddas.io.camera_files import describe_missing, read_camera

    own, _, camera, *_ = blocks("commands.md", "toml")
    (tmp_path / "own.toml").write_text(own)
    assert load_config(tmp_path / "own.toml").gates.min_area_px == 80
    (tmp_path / "ugv.toml").write_text(camera)
    assert read_camera(tmp_path / "ugv.toml").geographic
    assert describe_missing(tmp_path / "ugv.toml") == ""


def test_the_path_of_a_drones_log_alone_can_be_followed(tmp_path: Path, monkeypatch) -> None:
    """The commands of that section run one after another, on a clip and a log that says neither angles nor lens."""
    section = PAGES["commands.md"].split("## A drone's log alone")[1].split("\n## ")[0]
    flight = Overflight(frames=16, size=(640, 360), focal_px=457.0, height_m=45.0, heading_rad=0.1, pitch_deg=55)
    monkeypatch.chdir(tmp_path)
    film = cv2.VideoWriter("clip.mp4", cv2.VideoWriter.fourcc(*"mp4v"), flight.rate_hz, flight.size)
    subtitles = []
    for frame, picture in zip(flight.numbers(), pictures(flight), strict=True):
        film.write(picture)
        (longitude, latitude), second = lonlat(flight.vehicle(frame)[None, :2], ORIGIN)[0], flight.time(frame)
        subtitles.append(
            f"{frame}\n00:00:{second:06.3f} --> 00:00:{second + 0.1:06.3f}\n2024-07-01 14:00:{second:06.3f}\n"
            f"[latitude: {latitude:.7f}] [longitude: {longitude:.7f}] [rel_alt: 45.000 abs_alt: 79.000]\n\n"
        )
    film.release()
    Path("flight.srt").write_text("".join(subtitles))
    (angles,) = re.findall(r"```toml\n(.*?)```", section, re.DOTALL)
    Path("drone.toml").write_text(angles)
    lines = [line.partition("#")[0] for line in section.split("```sh\n")[1].split("```")[0].splitlines()]
    said: list[str] = []
    for line in lines:
        result = CliRunner().invoke(app, shlex.split(line)[1:])
        assert result.exit_code == (0 if said else 3), result.output
        said.append(result.output)
    assert "0 located, because the telemetry does not say the camera's heading, pitch" in said[0]
    assert not [words for words in said[1:] if "0 located" in words]
    assert "clock" not in said[2] and (tmp_path / "rtk/tracks.cot.xml").exists()
    with (tmp_path / "dddas-positions/positions.csv").open() as table:
        found = list(csv.DictReader(table))
    # The origin of both is the vehicle's first place.
    missed = [
        np.linalg.norm(
            flight.targets(int(row["frame"])) - flight.vehicle(1)[:2] - (float(row["east_m"]), float(row["north_m"])),
            axis=1,
        ).min()
        for row in found
    ]
    assert len(found) > 20 and np.median(missed) < 3.0


@pytest.mark.slow
def test_the_path_of_a_study_that_was_killed_can_be_followed(tmp_path: Path) -> None:
    """The commands of that section: the first is killed after a clip, the second keeps it and does the others."""
    pytest.importorskip("distributed")
    three(tmp_path / "clips").rename(tmp_path / "STUDY.toml")
    section = PAGES["datasets.md"].split("A study that was killed")[1]
    first, second = [shlex.split(line, comments=True)[1:] for line in section.split("```")[1].splitlines()[1:]]
    environ = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    program = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()"]

    def state() -> str:
        return str(json.loads((tmp_path / "study/run.json").read_text())["state"])

    with subprocess.Popen([*program, *first], cwd=tmp_path, env=environ, stderr=subprocess.PIPE, text=True) as run:
        assert run.stderr is not None
        assert any("1 of 3" in line for line in run.stderr)
        run.kill()
    assert state() == "running" and not (tmp_path / "study/metrics.json").exists()
    done = subprocess.run([*program, *second], cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=300)
    assert (done.returncode, state()) == (0, "complete"), done.stderr
    kept = re.search(r"cases scored: \d+ stages computed, (\d+) cases taken from the cache", done.stdout)
    assert kept is not None and int(kept[1]) > 0
    assert "kept" in done.stderr and (tmp_path / "study/metrics.json").exists()


def test_the_readme_is_short_and_its_picture_small() -> None:
    assert len(PAGES["README.md"].splitlines()) <= 170
    assert len(PAGES["README.md"].encode()) <= 12_000
    assert (ROOT / "docs/demo.jpg").stat().st_size < 300_000


def test_the_page_on_telemetry_names_each_message_field_and_sentence_that_is_read():
    page = PAGES["telemetry.md"]
    fields = {field for group in autopilots._PLACES for row in group.values() for field in re.findall(r"=(\w+)/", row)}
    # The page names the fields from which these are computed.
    computed = {"speed", "height"}
    assert [name for name in {*autopilots.NAMES, *nmea._FIELDS, *fields} - computed if f"`{name}`" not in page] == []
