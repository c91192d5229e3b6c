"""The page on a correction of MotionSegmenter runs, on scenes too small to learn much from, and its study too."""

import re
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.synthetic_clip import film_into

ROOT = Path(__file__).resolve().parents[2]
SMALL = {"scenes": 1, "held": 1, "steps": 2}


@pytest.fixture(scope="module")
def network() -> dict:
    return runpy.run_path(str(ROOT / "docs" / "network.py"))


@pytest.mark.slow
def test_it_learns_from_simulated_scenes_and_is_scored_on_another(network, capsys) -> None:
    network["main"](**SMALL, size_px=(96, 72))
    told = capsys.readouterr().out
    assert "step 2 of 2: loss " in told and "F on a scene not learned from: " in told


def test_an_untaught_network_changes_no_mask(network) -> None:
    maps = 10 * torch.rand(2, 4, 24, 32, generator=torch.Generator().manual_seed(0)) - 4
    assert torch.equal(network["Correction"]()(maps), maps[:, :1])


def test_a_clip_is_altered_alike_with_its_masks_in_all_frames(network) -> None:
    torch.manual_seed(1)
    mask = (torch.rand(2, 1, 1, 24, 32) > 0.8).float().expand(-1, 4, -1, -1, -1)
    clip, truth = network["alter"](mask.expand(-1, -1, 3, -1, -1) * 0.5 + 0.2, mask)
    assert torch.equal(truth, truth[:, :1].expand_as(truth)) and set(truth.unique().tolist()) == {0.0, 1.0}
    assert float((clip - clip[:, :1]).abs().mean()) < 0.03
    assert float(clip[:, :, :1][truth > 0].mean()) > float(clip[:, :, :1][truth == 0].mean()) + 0.1


def test_the_code_on_the_page_is_that_of_the_script() -> None:
    script, page = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("network.py", "network.md"))
    shown = re.findall(r"```python\n(.*?)\n```", page, re.DOTALL)
    assert len(shown) >= 3
    assert [code for code in shown if code not in script] == []


@pytest.mark.slow
def test_the_study_leaves_each_real_clip_out_in_turn(tmp_path, monkeypatch) -> None:
    for seed in range(3):
        film_into(tmp_path / "data" / f"clip{seed}", seed, 6, (128, 96))
    monkeypatch.syspath_prepend(str(ROOT / "eval"))
    path, modules = list(sys.path), set(sys.modules)
    try:
        measure = runpy.run_path(str(ROOT / "eval" / "correction.py"))["measure_correction"]
    finally:
        sys.path[:] = path
        for name in {"bench", "clips", "network"} - modules:  # must not shadow others later
            del sys.modules[name]
    figure = tmp_path / "figure.jpg"
    options = SimpleNamespace(
        **SMALL, size="96x72", frames=6, tuning_steps=4, data=tmp_path / "data", figure=str(figure)
    )
    text, figures = measure(options)
    assert "Real clips, each left out in turn" in text and figure.stat().st_size > 0
    assert [row["clip"] for row in figures["clips"]] == ["clip0", "clip1", "clip2"]
    assert all(0 <= row[name] <= 1 for row in figures["clips"] for name in ("segmenter", "threshold", "real", "both"))
