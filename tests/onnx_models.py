"""Small networks of each layout, which find the red rectangle of a picture, so that coordinates are really checked."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIDE = 128
LAYOUTS = ("YOLOv5", "YOLOv6", "YOLOv8", "YOLO without NMS", "YOLOX", "DETR", "RT-DETR", "D-FINE", "RF-DETR")
"""What `write_finder` makes: networks of three classes that find class 1 with a probability of 0.9."""

_CELLS = sum((SIDE // stride) ** 2 for stride in (8, 16, 32))


class _Graph:
    """Nodes under construction; every method returns the name of a tensor."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def hold(self, values: Any, dtype: Any = np.float32) -> str:
        self.constants.append(numpy_helper.from_array(np.array(values, dtype), f"c{len(self.constants)}"))
        return str(self.constants[-1].name)

    def add(self, op: str, *inputs: str, **options: Any) -> str:
        self.nodes.append(helper.make_node(op, list(inputs), [f"n{len(self.nodes)}"], **options))
        return str(self.nodes[-1].output[0])

    def table(self, first: list[Any], rest: list[float], rows: int) -> str:
        """(1, rows, K): a row of tensors and numbers, and others that are constant."""
        parts = [part if isinstance(part, str) else self.hold([part]) for part in first]
        row = self.add("Reshape", self.add("Concat", *parts, axis=0), self.hold([1, 1, -1], np.int64))
        return self.add("Concat", row, self.hold(np.tile(rest, (1, rows - 1, 1))), axis=1)

    def extent(self, bright: str, axis: int) -> tuple[str, str]:
        """Where the bright pixels of (1, H, W) begin and end along an axis; both 0 if there are none."""
        line = self.add("ReduceMax", bright, self.hold([3 - axis], np.int64), keepdims=0)
        place = self.add(
            "CumSum", self.add("Add", self.add("Mul", line, self.hold(0)), self.hold(1)), self.hold(1, np.int64)
        )
        high = self.add("ReduceMax", self.add("Mul", line, place), keepdims=0)
        back = self.add("ReduceMax", self.add("Mul", line, self.add("Sub", self.hold(1001), place)), keepdims=0)
        there = self.add("Min", high, self.hold(1))
        low = self.add("Mul", there, self.add("Sub", self.hold(1000), back))
        first, last = (self.add("Reshape", edge, self.hold([1], np.int64)) for edge in (low, high))
        return first, last


def write_finder(
    path: Path, layout: str, *, metadata: Mapping[str, str] | None = None, half: bool = False, is_free: bool = False
) -> Path:
    """A network that finds what is red, by the levels that its layout wants. is_free: its input has any size."""
    graph, rows = (
        _Graph(),
        {"YOLOv5": 3 * _CELLS, "YOLOv8": _CELLS, "YOLOv6": _CELLS, "YOLOX": _CELLS, "DETR": 100}.get(layout, 30),
    )
    add, hold = graph.add, graph.hold
    channel, least = (2, 200.0) if layout == "YOLOX" else (0, 2.0 if layout in ("DETR", "RF-DETR") else 0.8)
    level = add("Gather", add("Cast", "images", to=TensorProto.FLOAT), hold(channel, np.int64), axis=1)
    bright = add("Cast", add("Greater", level, hold(least)), to=TensorProto.FLOAT)
    (left, right), (top, bottom) = graph.extent(bright, 2), graph.extent(bright, 1)
    corners = add("Concat", left, top, right, bottom, axis=0)
    halves = [[0.5, 0, -1, 0], [0, 0.5, 0, -1], [0.5, 0, 1, 0], [0, 0.5, 0, 1]]
    centre = add("MatMul", corners, hold(halves))
    away, odds = [100.0, 100, 2, 2], [-9.0, float(np.log(9)), -9.0]
    outputs = {}
    if layout == "YOLOv8":
        outputs["output0"] = add(
            "Transpose", graph.table([centre, 0.1, 0.9, 0.0], [*away, 0, 0, 0], rows), perm=[0, 2, 1]
        )
    elif layout in ("YOLOv5", "YOLOv6"):
        sure = 0.95 if layout == "YOLOv5" else 1.0
        outputs["output0"] = graph.table([centre, sure, 0.1, 0.9 / sure, 0.0], [*away, sure, 0, 0, 0], rows)
    elif layout == "YOLOX":  # the first cell of 8 px
        at, size = add("Split", add("Max", add("Div", centre, hold(8)), hold(1e-3)), num_outputs=2), graph.nodes[-1]
        size.output.append("size")
        outputs["output"] = graph.table([at, add("Log", "size"), 0.95, 0.1, 0.9 / 0.95, 0.0], [0.0] * 8, rows)
    elif layout == "YOLO without NMS":
        outputs["output0"] = graph.table([corners, 0.9, 1.0], [0.0] * 6, rows)
    elif layout == "D-FINE":
        outputs["boxes"] = graph.table([corners], away, rows)
        for name, value in (("labels", 1.0), ("scores", 0.9)):
            outputs[name] = add("Squeeze", graph.table([value], [0.0], rows), hold([2], np.int64))
        outputs["labels"] = add("Cast", outputs["labels"], to=TensorProto.INT64)
    else:
        box, classes = ("dets", "labels") if layout == "RF-DETR" else ("pred_boxes", "logits")
        outputs[box] = graph.table([add("Div", centre, hold(SIDE))], [0.5, 0.5, 0.1, 0.1], rows)
        none = [9.0] if layout == "DETR" else []
        odds = [-9.0, float(np.log(9)), -9.0, 0.0] if none else odds
        outputs[classes] = graph.table(odds, [-9.0] * 3 + none, rows)
    graph.nodes += [helper.make_node("Identity", [made], [name]) for name, made in outputs.items()]
    sides = ["height", "width"] if is_free else [SIDE, SIDE]
    inputs = [
        helper.make_tensor_value_info("images", TensorProto.FLOAT16 if half else TensorProto.FLOAT, [1, 3, *sides])
    ]
    if layout == "D-FINE":
        inputs.append(helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, [1, 2]))
    kinds = {"labels": TensorProto.INT64} if layout == "D-FINE" else {}
    given = [helper.make_tensor_value_info(name, kinds.get(name, TensorProto.FLOAT), None) for name in outputs]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "finder", inputs, given, graph.constants),
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=9,
    )
    helper.set_model_props(model, dict(metadata or {}))
    onnx.save(model, path)
    return path
