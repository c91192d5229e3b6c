"""The graphs of people's scores: the shipped ones are what is made, and compute what `functional.hog` does."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("torch")

import onnx
import onnxruntime
import torch

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import hog_svm
from torchvision_dddas.lab.export import people_graphs as people
from torchvision_dddas.lab.export.graph_files import refuse_failed, write_graphs
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.detector import load_scorer
from torchvision_dddas.people.onnx_scorer import OnnxScorer
from torchvision_dddas.runtime import SHIPPED
from torchvision_dddas.types import LinearSvm, Part

LAYOUTS = {
    "default": hog_svm.Layout(),
    "small": hog_svm.Layout((32, 64), 4, 8, 4, 8),
    "signed, no gamma": hog_svm.Layout((64, 64), 8, 16, 8, 18, signed=True, gamma=False),
    "blocks of nine cells, apart": hog_svm.Layout((60, 90), 5, 15, 15),
    "one cell a block": hog_svm.Layout((48, 48), block=8),
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_graphs_of_any_layout_score_as_torch_does(layout):
    assert people.largest_difference(people.build_graphs(layout), layout) < 3e-5


def test_the_same_layout_gives_the_same_bytes():
    first, again = (people.build_graphs(hog_svm.Layout()) for _ in range(2))
    assert first == again and set(first) == {"people.onnx", "people_histograms.onnx", "people_scores.onnx"}


def test_the_shipped_graphs_are_those_that_are_made_now():
    """Node by node: the bytes may differ with the versions of onnx."""
    for name, content in people.build_graphs(hog_svm.Layout()).items():
        shipped, made = onnx.load(SHIPPED / name), onnx.load_from_string(content)
        assert list(shipped.graph.node) == list(made.graph.node)
        for one, other in zip(shipped.graph.initializer, made.graph.initializer, strict=True):
            # Windows and arcs come from functions whose last bit is the machine's.
            wanted = onnx.numpy_helper.to_array(other)
            np.testing.assert_allclose(onnx.numpy_helper.to_array(one), wanted, rtol=1e-6, atol=1e-12)


def test_the_whole_graph_scores_a_picture_as_opencv_does():
    noise = np.random.default_rng(0).integers(0, 256, (12, 10, 3)).astype(np.float32)
    image = cv2.resize(noise, (150, 190), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)
    svm, opencv = read_classifier("opencv", 3780), cv2.HOGDescriptor()
    opencv.setSVMDetector(np.append(svm.weights, svm.bias).astype(np.float32))
    for picture in (image, image[..., 0].copy()):
        places, wanted = (np.asarray(hit) for hit in opencv.detect(picture, -1e9, (8, 8), (0, 0)))
        found = whole_scores(picture, svm.weights, svm.bias)
        assert found.size == len(wanted)
        np.testing.assert_allclose(found[places[:, 1] // 8, places[:, 0] // 8], wanted.ravel(), atol=2e-5, rtol=0)


def whole_scores(image: np.ndarray, weights: np.ndarray, bias: float) -> np.ndarray:
    bordered = np.atleast_3d(cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REFLECT_101))
    session = onnxruntime.InferenceSession(str(SHIPPED / "people.onnx"), providers=["CPUExecutionProvider"])
    arranged = hog_svm.arrange_weights(torch.from_numpy(weights), hog_svm.Layout()).numpy()
    numbers = {"bias": np.array(bias, np.float32), "clip": np.array(0.2, np.float32)}
    return session.run(None, {"image": bordered, "weights": arranged} | numbers)[0]


def test_graphs_of_ones_own_serve_the_onboard_back_end(tmp_path: Path):
    sizes = {"cell": 4, "block": 8, "block_stride": 4, "window_width": 32, "window_height": 64}
    changed: dict[str, Any] = {f"{name}_px": size for name, size in sizes.items()}
    write_graphs(tmp_path / "own", people.export_people(PeopleParameters(**changed)))
    parameters = PeopleParameters(**changed, graphs=str(tmp_path / "own"), window_stride_px=6)
    image = np.random.default_rng(1).integers(0, 256, (80, 70, 3), np.uint8)
    weights = np.random.default_rng(2).normal(0, 0.05, parameters.features).astype(np.float32)
    svm, part = LinearSvm(weights, 0.1, "made up"), Part((70, 80), 0, 0, 70, 80)
    ((onboard,),) = OnnxScorer(parameters, svm).scores([image], [[part]])
    ((torch_scores,),) = load_scorer(parameters, "torch", svm).scores([image], [[part]])
    assert onboard.shape == (3, 7)
    np.testing.assert_allclose(onboard, torch_scores, atol=3e-5)


def test_graphs_that_are_off_are_refused(monkeypatch):
    monkeypatch.setattr(hog_svm, "SOFT_FIRST", 0.2)
    made = people.build_graphs(hog_svm.Layout())
    monkeypatch.undo()
    monkeypatch.setattr(people, "build_graphs", lambda _: made)
    with pytest.raises(InputError, match=r"people.onnx does not agree with functional.hog: .* score, 5e-05"):
        refuse_failed(people.export_people(PeopleParameters()))
