"""Stand-ins for the engine, so that these tests are about the command line alone, and readers of what it writes."""

import csv
import json
import types

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from torchvision_dddas import detection, pipeline
from torchvision_dddas.types import Detections, Scene


def stub_engine(found=True, after=None):
    """`detect_motion` and `load_engine` that find one target a frame; `after(scene)` runs after each scene."""

    def detect_motion(source, settings=None, backend="auto", telemetry=None, retune=None):
        for frame in source:
            mask = np.zeros(frame.image.shape[:2], np.uint16)
            mask[2:8, 3:9] = found
            boxes = np.array([[3, 2, 6, 6.0]]) if found else np.zeros((0, 4))
            n = len(boxes)
            detections = Detections(boxes, np.ones(n), np.full(n, 36.0), np.full(n, np.nan), np.full(n, np.nan))
            reliable = frame.number != 2
            scene = Scene(frame, mask, detections, 1, reliable, "" if reliable else "blank", seconds={"all": 0.01})
            yield scene
            if after:
                after(scene)

    def load_engine(backend, settings):
        return types.SimpleNamespace(name=f"stub {backend}")

    return {"detect_motion": detect_motion, "load_engine": load_engine}


@pytest.fixture
def engine(monkeypatch):
    def install(**how):
        for name, stub in stub_engine(**how).items():
            for module in (detection, pipeline.assembly, pipeline.pipeline):
                monkeypatch.setattr(module, name, stub, raising=False)

    install()
    return install


@pytest.fixture
def clip(tmp_path):
    """A folder of five small frames."""
    folder = tmp_path / "walk" / "frames"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for k in range(5):
        cv2.imwrite(str(folder / f"{k:05d}.png"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    return folder


@pytest.fixture(scope="session")
def dddas():
    """Call the command line: dddas("detect", path, ...) gives the result with exit_code, stdout and stderr."""
    from torchvision_dddas.cli import app

    return lambda *words: CliRunner().invoke(app, [str(w) for w in words])


def bad(result):
    """The one line that a user's mistake leaves on the terminal."""
    assert result.exit_code == 2, result.output
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("dddas: ")
    assert "Traceback" not in result.output
    return lines[0]


def rows(path):
    """The rows of a table that was written, each by column name."""
    with path.open(newline="") as text:
        return list(csv.DictReader(text))


def record(folder):
    """run.json of a run."""
    return json.loads((folder / "run.json").read_text())


def names(folder):
    """The names of all files in a folder, sorted."""
    return sorted(path.name for path in folder.iterdir())


class StubScorer:
    """Every picture's first window shows a person, if anybody is there."""

    name = "stub"

    def __init__(self, parameters, found):
        self.parameters, self.found = parameters, found

    def scores(self, images, parts):
        k = self.parameters

        def empty(part):
            rows, columns = (part.height - k.window_height_px) // 8 + 1, (part.width - k.window_width_px) // 8 + 1
            return np.full((rows, columns), -1, np.float32)

        maps = [[empty(part) for part in wanted] for wanted in parts]
        for of_picture in maps:
            if of_picture and self.found:
                of_picture[0][0, 0] = 3.0
        return maps


@pytest.fixture
def scorer(monkeypatch):
    """Replace the people detector's engine; gives the list of the engines that were loaded."""
    loaded = []

    def install(found=True):
        def load(parameters, backend):
            loaded.append(backend)
            return StubScorer(parameters, found)

        monkeypatch.setattr("torchvision_dddas.people.load_scorer", load)
        return loaded

    install()
    return install
