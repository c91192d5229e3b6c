"""`dddas export` as a user meets it."""

from importlib import import_module
from pathlib import Path

import pytest

from torchvision_dddas.runtime import manifest, opened

pytest.importorskip("torch")
pytest.importorskip("onnx")


@pytest.mark.slow
def test_the_shipped_graphs_can_be_made_again_and_open(dddas, tmp_path: Path):
    out = tmp_path / "own"
    result = dddas("export", "--graph", "homography", "--graph", "people", "--out", str(out))
    assert result.exit_code == 0, result.output
    assert set(manifest(out)["graphs"]) == {path.name for path in out.glob("*.onnx")}
    assert len(manifest(out)["graphs"]) == 5 and opened(out, "homography.onnx") is not None
    assert "compared with torch" in result.output and f"{out / 'manifest.json'}" in result.output


def test_list_names_the_graphs_and_makes_none(dddas, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = dddas("export", "--list")
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.output.splitlines()] == [
        "people",
        "homography",
        "warp_difference",
        "step",
    ]
    assert not list(tmp_path.iterdir())


def test_what_is_not_installed_is_named(dddas, tmp_path: Path, monkeypatch):
    command = import_module("torchvision_dddas.cli.export")  # the name in the package is the function
    monkeypatch.setattr(command, "find_spec", lambda name: None if "onnx" in name else object())
    result = dddas("export", "--out", str(tmp_path / "own"))
    assert result.exit_code == 2 and "needs onnx, onnxscript; pip install" in result.output
