"""Detection networks in ONNX files: each layout finds the same rectangle, in the picture's pixels."""

import json

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from tests.onnx_models import LAYOUTS, SIDE, write_finder
from torchvision_dddas.detection import OnnxDetector
from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Frame

BOX = [60, 40, 80, 20]
NAMES = {"names": "{0: 'car', 1: 'person', 2: 'bus'}", "task": "detect"}


def _write_constant(path, outputs, metadata=None):
    """Write a network with these outputs for every picture."""
    constants = [onnx.numpy_helper.from_array(values, f"{name}_given") for name, values in outputs.items()]
    nodes = [helper.make_node("Identity", [f"{name}_given"], [name]) for name in outputs]
    given = [helper.make_tensor_value_info(name, TensorProto.FLOAT, values.shape) for name, values in outputs.items()]
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, SIDE, SIDE])
    graph = helper.make_graph(nodes, "constant", [images], given, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, path)
    return path


@pytest.fixture
def picture():
    """A red rectangle on black, twice as wide as high, so that a letterbox has bars."""
    image = np.zeros((120, 240, 3), np.uint8)
    image[40:60, 60:140] = (0, 0, 255)
    return image


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_told_and_finds_the_same_box(layout, picture, tmp_path):
    detect = OnnxDetector(write_finder(tmp_path / "model.onnx", layout))
    assert detect.layout.name == layout and detect.size_px == (SIDE, SIDE)
    found = detect(Frame(1, 0.0, picture))
    assert len(found) == 1 and found.kind == "given"
    np.testing.assert_allclose(found.box_px, [BOX], atol=2.5)  # a pixel of the input is 1.9 px
    np.testing.assert_allclose(found.score, [0.9], atol=0.01)
    assert found.label.tolist() == ["1"] and found.class_id.tolist() == [1]
    assert any("names no classes" in note for note in detect.notes)
    assert layout == "YOLOX" or not len(detect(np.zeros_like(picture)))


def test_boxes_with_exactly_the_lowest_score_are_kept_once(tmp_path):
    table = np.zeros((1, 7, 336), np.float32)
    table[0, :4] = [[64], [64], [8], [8]]
    table[0, 4, :3] = 0.25
    detect = OnnxDetector(_write_constant(tmp_path / "model.onnx", {"output0": table}), score=0.25)
    found = detect(np.zeros((SIDE, SIDE, 3), np.uint8))
    assert found.score.tolist() == [0.25]


def test_coefficients_of_masks_are_no_classes(tmp_path):
    table = np.zeros((1, 4 + 3 + 32, 336), np.float32)
    table[0, :4] = [[64], [64], [8], [8]]
    table[0, 5, 0], table[0, 7:] = 0.9, 5.0
    outputs = {"output0": table, "output1": np.zeros((1, 32, 32, 32), np.float32)}
    detect = OnnxDetector(_write_constant(tmp_path / "model.onnx", outputs), classes=["car", "person", "bus"])
    found = detect(np.zeros((SIDE, SIDE, 3), np.uint8))
    assert (detect.layout.classes, found.label.tolist(), found.score.round(2).tolist()) == (3, ["person"], [0.9])


def test_classes_beyond_the_names_are_found_and_noted(tmp_path):
    table = np.zeros((1, 7, 336), np.float32)
    table[0, :4] = [[64], [64], [8], [8]]
    table[0, 6, 0] = 0.9
    metadata = {"names": "{0: 'car', 1: 'person'}", "task": "detect"}
    detect = OnnxDetector(_write_constant(tmp_path / "model.onnx", {"output0": table}, metadata))
    assert detect(np.zeros((SIDE, SIDE, 3), np.uint8)).label.tolist() == ["2"]
    assert detect.notes == ["model.onnx names 2 of 3 classes; others are numbers"]


def test_half_precision_and_free_sizes_find_the_same(picture, tmp_path):
    half = OnnxDetector(write_finder(tmp_path / "half.onnx", "YOLOv8", half=True))
    np.testing.assert_allclose(half(picture).box_px, [BOX], atol=2.5)
    free = OnnxDetector(
        write_finder(tmp_path / "free.onnx", "YOLO without NMS", metadata={"imgsz": "[480, 480]"}, is_free=True)
    )
    assert free.size_px == (480, 480)
    np.testing.assert_allclose(free(picture).box_px, [BOX], atol=1.1)


def test_names_are_of_the_file_or_given(picture, tmp_path):
    model = write_finder(tmp_path / "model.onnx", "YOLOv8", metadata=NAMES)
    assert OnnxDetector.delay_frames == 0
    assert OnnxDetector(model)(picture).label.tolist() == ["person"] and not OnnxDetector(model).notes
    for encoding in ("utf-8", "utf-8-sig"):  # some editors begin a file with a byte order mark
        (tmp_path / "classes.txt").write_text("lorry\nwalker\ncoach\n", encoding)
        detect = OnnxDetector(model, classes=tmp_path / "classes.txt")
        assert detect(picture).label.tolist() == ["walker"] and detect.names[0] == "lorry"
    with pytest.raises(InputError, match="has 3 classes, and 2 names"):
        OnnxDetector(model, classes=["a", "b"])


def test_a_config_of_transformers_names_classes_and_tells_the_kind(picture, tmp_path):
    model = write_finder(tmp_path / "model.onnx", "RT-DETR")
    assert "no config.json" in OnnxDetector(model).notes[0]
    config = {"model_type": "rt_detr", "id2label": {"0": "car", "1": "person", "2": "bus"}}
    (tmp_path / "config.json").write_text(json.dumps(config))
    detect = OnnxDetector(model)
    assert detect(picture).label.tolist() == ["person"] and not detect.notes


def test_grey_pictures_are_taken(tmp_path):
    grey = np.zeros((120, 240), np.uint8)
    grey[40:60, 60:140] = 255
    found = OnnxDetector(write_finder(tmp_path / "model.onnx", "YOLOv8"))(grey)
    np.testing.assert_allclose(found.box_px, [BOX], atol=2.5)


def write_constant(path, metadata=None, **outputs):
    """A network that gives the same arrays for any picture."""
    nodes = [
        helper.make_node("Constant", [], [name], value=onnx.numpy_helper.from_array(np.asarray(values, np.float32)))
        for name, values in outputs.items()
    ]
    given = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 64, 64])
    graph = helper.make_graph(nodes, "constant", [image], given)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, path)
    return path


def test_boxes_of_one_class_that_overlap_are_one_and_those_of_two_stay(tmp_path):
    table = np.zeros((1, 6, 84))  # of 64 x 64 px: 8 x 8 + 4 x 4 + 2 x 2 cells
    table[0, :, :3] = np.array([[20, 20, 10, 10, 0.9, 0], [20.5, 20, 10, 10, 0.8, 0], [20, 20, 10, 10, 0, 0.7]]).T
    table[0, :, 3] = [50, 50, 10, 10, 0.2, 0]
    found = OnnxDetector(write_constant(tmp_path / "model.onnx", output0=table))(np.zeros((64, 64, 3), np.uint8))
    assert found.score.tolist() == pytest.approx([0.9, 0.7]) and found.class_id.tolist() == [0, 1]
    np.testing.assert_allclose(found.box_px[0], [15, 15, 10, 10], atol=1e-4)


@pytest.mark.parametrize(
    ("outputs", "options", "says"),
    [
        ({"output0": np.zeros((1, 7, 7, 30))}, {}, r"output0 \(1, 7, 7, 30\); wanted YOLOv5"),
        ({"labels": np.zeros((1, 5)), "dets": np.zeros((1, 5, 5))}, {}, r"dets \(1, 5, 5\); wanted"),
        ({"output0": np.zeros((1, 6, 84))}, {"provider": "warp"}, "no provider 'warp', only .*cpu"),
        ({"output0": np.zeros((1, 6, 84))}, {"score": 25}, r"score must be in \[0, 1\], got 25"),
        ({"output0": np.zeros((1, 6, 84))}, {"classes": "none.txt"}, "none.txt cannot be read"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(outputs, options, says, tmp_path):
    with pytest.raises(InputError, match=says):
        OnnxDetector(write_constant(tmp_path / "model.onnx", **outputs), **options)


def test_other_files_and_tasks_are_refused(tmp_path):
    with pytest.raises(InputError, match="a network for 'classify'"):
        OnnxDetector(write_constant(tmp_path / "model.onnx", {"task": "classify"}, output0=np.zeros((1, 6, 84))))
    (tmp_path / "text.onnx").write_text("no graph")
    with pytest.raises(InputError, match=r"cannot open .*text\.onnx"):
        OnnxDetector(tmp_path / "text.onnx")
    with pytest.raises(InputError, match=r"none\.onnx is no file"):
        OnnxDetector(tmp_path / "none.onnx")
