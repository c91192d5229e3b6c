"""Stand-ins for the engine, so that these tests are about the command line alone."""

import sys
import types

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from torchvision_dddas.types import Detections, Scene


def stub_engine(found=True, after=None):
    """Modules `detector` and `engine` that find one target a frame; `after(scene)` runs after each scene."""

    def run(source, engine, settings, telemetry=None, retune=None):
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

    def load(backend, settings):
        return types.SimpleNamespace(name=f"stub {backend}")

    modules = {f"torchvision_dddas.detection.{name}": types.ModuleType(name) for name in ("detector", "engine")}
    modules["torchvision_dddas.detection.detector"].__dict__["run"] = run
    modules["torchvision_dddas.detection.engine"].__dict__["load_engine"] = load
    return modules


@pytest.fixture
def engine(monkeypatch):
    from torchvision_dddas import pipeline as surveying

    def install(**how):
        stubs = stub_engine(**how)
        for name, module in stubs.items():
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setattr(surveying, "run", stubs["torchvision_dddas.detection.detector"])

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


@pytest.fixture
def dddas():
    """Call the command line: dddas("detect", path, ...) gives the result with exit_code, stdout and stderr."""
    from torchvision_dddas.cli import app

    return lambda *words: CliRunner().invoke(app, [str(w) for w in words])


@pytest.fixture
def file(tmp_path):
    """Write a file: file(name, text) gives its path."""

    def write(name, text):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write
