"""The graphs of plane homographies: the shipped ones are what is made, and compute what `ops` does."""

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("torch")

import onnx
import onnxruntime
import torch

from torchvision_dddas.errors import InputError
from torchvision_dddas.export import plane_graphs as plane
from torchvision_dddas.export.checked import refuse_wrong
from torchvision_dddas.export.graph_builder import OPSET
from torchvision_dddas.functional import homography
from torchvision_dddas.runtime import SHIPPED


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    return plane.graphs()


def test_graphs_place_landmarks_where_torch_does_for_every_number_from_4_to_16(files):
    assert plane.largest_difference(files) < 1e-6


def test_the_same_versions_give_the_same_bytes(files):
    assert plane.graphs() == files and tuple(files) == tuple(plane.ABOUT)


def test_the_shipped_graphs_are_those_that_are_made_now(files):
    """Node by node: the bytes may differ with the versions of onnx."""
    for name, content in files.items():
        shipped, made = onnx.load(SHIPPED / name), onnx.load_from_string(content)
        assert list(shipped.graph.node) == list(made.graph.node)
        assert list(shipped.graph.initializer) == list(made.graph.initializer)


def test_only_standard_operations_are_used_so_that_any_runtime_of_the_opset_will_do(files):
    for content in files.values():
        model = onnx.load_from_string(content)
        assert {(entry.domain, entry.version) for entry in model.opset_import} == {("", OPSET)}
        assert {node.domain for node in model.graph.node} == {""}


@pytest.mark.parametrize("sets", [1, 3])
def test_a_batch_is_the_same_as_one_set_after_the_other(files, sets):
    given = plane.example(6, sets, 1)
    session = onnxruntime.InferenceSession(files["homography.onnx"], providers=["CPUExecutionProvider"])
    together, _ = session.run(None, given)
    for k in range(sets):
        alone, _ = session.run(None, {name: array[k : k + 1] for name, array in given.items()})
        np.testing.assert_allclose(together[k : k + 1], alone, rtol=1e-9, atol=1e-9)


def test_graphs_that_are_off_are_refused(monkeypatch):
    refuse_wrong(plane.made())
    monkeypatch.setattr(plane, "centred", lambda: 1.001 * np.eye(3, 27))
    with pytest.raises(InputError, match=r"homography.onnx does not agree with ops.homography: .* px where 1e-06"):
        refuse_wrong(plane.made())


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
