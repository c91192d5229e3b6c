"""The graphs of plane homographies: the shipped ones are what the script makes, and compute what `ops` does."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("torch")

import onnx
import onnxruntime
import torch

from export import homography_graph as script
from export.people_graph import OPSET
from torchvision_dddas.ops import homography
from torchvision_dddas.vision.onboard_plane import SHIPPED


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    return script.graphs()


def test_graphs_place_landmarks_where_torch_does_for_every_number_from_4_to_16(files):
    assert script.largest_difference(files) < 1e-6


def test_the_same_versions_give_the_same_bytes(files):
    assert script.graphs() == files and tuple(files) == script.NAMES


def test_the_shipped_graphs_are_those_that_the_script_makes(files):
    """Node by node: the bytes may differ with the versions of onnx."""
    for name, content in files.items():
        shipped, made = onnx.load(SHIPPED / name), onnx.load_from_string(content)
        assert list(shipped.graph.node) == list(made.graph.node)
        assert list(shipped.graph.initializer) == list(made.graph.initializer)


def test_the_manifest_names_the_shipped_files_by_their_hashes():
    manifest = json.loads((SHIPPED / "homography.json").read_text(encoding="utf-8"))
    assert tuple(manifest["graphs"]) == script.NAMES
    for name, held in manifest["graphs"].items():
        assert held["sha256"] == hashlib.sha256((SHIPPED / name).read_bytes()).hexdigest()
    assert manifest["graphs"]["homography.onnx"]["inputs"] == {
        "ground": ["B", "n", 2],
        "image": ["B", "n", 2],
        "weight": ["B", "n"],
    }


def test_only_standard_operations_are_used_so_that_any_runtime_of_the_opset_will_do(files):
    for content in files.values():
        model = onnx.load_from_string(content)
        assert {(entry.domain, entry.version) for entry in model.opset_import} == {("", OPSET)}
        assert {node.domain for node in model.graph.node} == {""}


@pytest.mark.parametrize("sets", [1, 3])
def test_a_batch_is_the_same_as_one_set_after_the_other(files, sets):
    given = script.example(6, sets, 1)
    session = onnxruntime.InferenceSession(files["homography.onnx"], providers=["CPUExecutionProvider"])
    together, _ = session.run(None, given)
    for k in range(sets):
        alone, _ = session.run(None, {name: array[k : k + 1] for name, array in given.items()})
        np.testing.assert_allclose(together[k : k + 1], alone, rtol=1e-9, atol=1e-9)


def test_graphs_that_are_off_are_not_written(tmp_path: Path, monkeypatch, capsys):
    with monkeypatch.context() as other:
        other.setattr(script, "centred", lambda: 1.001 * np.eye(3, 27))
        made = script.graphs()
    monkeypatch.setattr("sys.argv", ["homography_graph.py", "--out", str(tmp_path / "own")])
    monkeypatch.setattr(script, "graphs", lambda: made)
    with pytest.raises(SystemExit, match="off torch's; nothing was written"):
        script.main()
    assert not (tmp_path / "own").exists()
    monkeypatch.undo()
    monkeypatch.setattr("sys.argv", ["homography_graph.py", "--out", str(tmp_path / "own")])
    script.main()
    assert "px" in capsys.readouterr().out
    assert (tmp_path / "own" / "homography.onnx").read_bytes() == script.graphs()["homography.onnx"]


def test_the_horizon_of_the_graph_is_that_of_torch(files):
    """A landmark just before it passes, one just behind it does not."""
    corners = np.array([[[0.0, 0], [1, 0], [1, 1], [0, 1]]])
    session = onnxruntime.InferenceSession(files["homography.onnx"], providers=["CPUExecutionProvider"])
    for tilt, seen in ((-0.999, True), (-1.001, False)):
        depth = 1 + corners @ (tilt, 0)
        image = corners / depth[..., None]
        given = {"ground": corners, "image": image, "weight": np.ones((1, 4))}
        _, valid = session.run(None, given)
        torch_valid = homography.fit(*(torch.from_numpy(array) for array in given.values()))[1]
        assert valid.item() == torch_valid.item() == seen
