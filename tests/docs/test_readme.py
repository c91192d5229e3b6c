"""The README: its code runs, its commands, files and settings exist."""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.synthetic_clip import film_into
from torchvision_dddas.cli import app

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [line.partition("#")[0] for line in README.splitlines() if line.startswith("dddas ")]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_python_of_the_readme_runs_and_finds_targets(tmp_path, monkeypatch, capsys):
    code, _, _ = blocks("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    film_into(tmp_path / "demo-out/clip", frames=8, size=(480, 360))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert "px a frame over the ground" in capsys.readouterr().out


def test_the_python_of_the_readme_gives_what_opencv_gives(tmp_path, monkeypatch, capsys):
    _, code, _ = blocks("python")
    photo = np.full((240, 320, 3), 200, np.uint8)
    cv2.ellipse(photo, (160, 110), (16, 40), 0, 0, 360, (40, 40, 40), -1)  # body, head, legs
    cv2.circle(photo, (160, 62), 10, (40, 40, 40), -1)
    for side in (-8, 8):
        cv2.line(photo, (160 + side, 140), (160 + 2 * side, 195), (40, 40, 40), 10)
    cv2.imwrite(str(tmp_path / "photo.jpg"), photo)
    photo = np.asarray(cv2.imread(str(tmp_path / "photo.jpg")))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    detector = cv2.HOGDescriptor()
    detector.setSVMDetector(np.asarray(cv2.HOGDescriptor.getDefaultPeopleDetector()))
    theirs, _ = detector.detectMultiScale(photo, winStride=(8, 8), padding=(0, 0), scale=1.05)
    assert len(theirs)
    found = f"{len(theirs)} people; windows {np.asarray(theirs, float).tolist()} scores "
    assert capsys.readouterr().out.startswith(found)


@pytest.mark.parametrize("line", COMMANDS)
def test_every_command_of_the_readme_exists_with_its_options(line):
    words = shlex.split(line)[1:]
    names = words[:2] if words[0] == "locate" else words[:1]
    told = CliRunner().invoke(app, [*names, "--help"])
    assert told.exit_code == 0
    for word in words:
        if word.startswith("--"):
            assert word in told.output


def test_every_file_that_the_readme_names_is_there():
    package = ROOT / "torchvision_dddas"
    rows = [line for line in README.splitlines() if line.startswith("|") and ".py`" in line]
    named = [name for line in rows for name in re.findall(r"`([\w/]+\.py)`", line)]
    named += re.findall(r"\]\(([^)]+)\)", README)
    assert len(named) >= 20
    assert [name for name in named if not ((package / name).exists() or (ROOT / name).exists())] == []


def test_the_tuning_of_the_readme_is_that_of_its_own_page_which_is_run():
    _, _, code = blocks("python")
    assert f"```python\n{code}```" in (ROOT / "docs/tuning.md").read_text(encoding="utf-8")


def test_the_camera_the_study_and_the_configuration_of_the_readme_are_taken(tmp_path):
    from torchvision_dddas.config import load_config
    from torchvision_dddas.evaluation.studies.spec import read_spec
    from torchvision_dddas.io.camera_files import describe_missing, read_camera

    camera, study, own = blocks("toml")
    (tmp_path / "study.toml").write_text(study)
    assert read_spec(tmp_path / "study.toml").tasks == ("motion", "tracking")
    (tmp_path / "ugv.toml").write_text(camera)
    assert read_camera(tmp_path / "ugv.toml").geographic
    assert describe_missing(tmp_path / "ugv.toml") == ""
    (tmp_path / "own.toml").write_text(own)
    assert load_config(tmp_path / "own.toml").gates.min_area_px == 80


def test_the_picture_is_small_and_the_tables_have_their_marks():
    assert (ROOT / "docs/demo.jpg").stat().st_size < 300_000
    for name in ("accuracy", "speed"):
        assert README.index(f"<!-- {name} -->") < README.index(f"<!-- /{name} -->")
