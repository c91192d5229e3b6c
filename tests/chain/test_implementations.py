"""Which implementation computes each operation: the table, and what a run of the torch engine really calls."""

import json
import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

pytest.importorskip("torch")

import torch
from typer.testing import CliRunner

import torchvision_dddas.functional as F
from tests.synthetic_clip import render
from torchvision_dddas.chain import IMPLEMENTATIONS, uses_kornia
from torchvision_dddas.cli.commands import app
from torchvision_dddas.config import Settings
from torchvision_dddas.detection import MotionDetector
from torchvision_dddas.detection.torch_engine import TorchEngine
from torchvision_dddas.functional import filters, keypoints

ROOT = Path(__file__).parents[2]
CALLS = ("remap", "gaussian_blur2d", "oneway_transfer_error", "transform_points")


def test_our_own_forms_stand_only_where_kornia_takes_twice_the_time_or_for_a_reason() -> None:
    for line in IMPLEMENTATIONS:
        if line.form != "Kornia":
            assert line.ratio > 2 or line.reason, line
        elif line.ratio == line.ratio:
            assert line.ratio <= 2 or line.reason, line


def test_the_table_is_printed() -> None:
    found = CliRunner().invoke(app, ["settings", "--backends"])
    assert found.exit_code == 0 and all(line.operation in found.output for line in IMPLEMENTATIONS)


def test_the_ratios_of_a_cpu_are_those_of_the_results() -> None:
    measured = json.loads((ROOT / "eval/results/operations.json").read_text())["figures"]
    rows = {"HSV conversion": "RGB to HSV", "gradient": "gradient, box mean 5", "corners": "smaller eigenvalue 5"}
    rows |= {"pyramid": "pyramid of 4", "morphology": "erosion 3", "histograms": "histograms of 10 boxes"}
    for line in IMPLEMENTATIONS:
        if line.device == "cpu" and line.operation in rows:
            assert line.ratio == pytest.approx(measured[rows[line.operation]]["kornia_by_ours"], rel=0.25), line


def traced(settings: Settings, batch: int) -> tuple[Counter[str], dict[str, list[int]]]:
    """How often a run of the detector calls functions of Kornia, and on how many pictures ours work at once."""
    calls, sizes = Counter[str](), dict[str, list[int]]()
    watched = {"warp_perspective": "src", "gaussian_blur2d": "input", "close_masks": "mask", "erosion": "tensor"}

    def watch(frame: FrameType, event: str, _: Any) -> None:
        name, module = frame.f_code.co_name, frame.f_globals.get("__name__", "")
        if event == "call" and module.startswith("kornia."):
            calls[name] += 1
        elif event == "call" and name in watched and module.startswith("torchvision_dddas.functional"):
            sizes.setdefault(name, []).append(len(frame.f_locals[watched[name]]))

    detector = MotionDetector(settings, backend=TorchEngine(settings, "cpu"), batch=batch)
    sys.setprofile(watch)
    try:
        for image in render(1, 56, (160, 120)).images:
            detector.update(image)
        detector.flush()
    finally:
        sys.setprofile(None)
    return calls, sizes


def test_a_run_of_the_torch_engine_calls_kornia_and_works_on_full_batches() -> None:
    calls, sizes = traced(Settings(), 8)
    assert all(calls[name] for name in CALLS), calls
    for name, counts in sizes.items():
        # The first and the last frames of a clip have windows of their own structure.
        assert max(counts) == 8 and counts.count(8) >= len(counts) / 4, (name, Counter(counts))


@pytest.mark.parametrize("operation", ["gradient", "corners"])
def test_what_kornia_computes_on_a_gpu_is_what_we_compute_on_a_cpu(operation, monkeypatch) -> None:
    assert uses_kornia(operation, "cuda") and not uses_kornia(operation, "cpu")
    levels = F.gaussian_blur2d(torch.randint(0, 256, (2, 1, 60, 80), dtype=torch.uint8), 7).float()
    compute = {"gradient": F.mean_gradient, "corners": lambda x: F.corner_min_eigenvalue(x / 255, block=5)}[operation]
    ours = compute(levels)
    for module in (filters, keypoints):
        monkeypatch.setattr(module, "uses_kornia", lambda *_: True)
    inner = (..., slice(8, -8), slice(8, -8))  # at the rim Kornia repeats the edge pixel
    torch.testing.assert_close(compute(levels)[inner], ours[inner], rtol=1e-3, atol=1e-6)
