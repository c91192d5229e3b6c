"""ONNX graphs built node by node, where what torch's exporter makes is several times slower."""

from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

OPSET, IR_VERSION = 20, 10
FAR = 2**31 - 1  # an end of a slice: the last


class Graph:
    """A graph in the making: called with an operation and its inputs, adds a node and gives its output's name."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[bytes, onnx.TensorProto] = {}

    def __call__(self, operation: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        """A node of one output; out: its name, if it matters."""
        out = out or f"{operation.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, list(inputs), [out], name=out, **attributes))
        return out

    def number(self, *values: float) -> str:
        """A float32 constant: a number, or a vector."""
        return self.constant(np.array(values if len(values) > 1 else values[0], np.float32))

    def whole(self, *values: int) -> str:
        """A vector of int64."""
        return self.constant(np.array(values, np.int64))

    def constant(self, array: np.ndarray) -> str:
        """An array, once however often it is asked for."""
        key = str(array.dtype).encode() + str(array.shape).encode() + array.tobytes()
        name = f"constant_{len(self.constants)}"
        return self.constants.setdefault(key, numpy_helper.from_array(array, name)).name

    def cut(self, name: str, axis: int, begin: int, end: int) -> str:
        """A stretch of one axis."""
        return self("Slice", name, self.whole(begin), self.whole(end), self.whole(axis))

    def model(self, inputs: dict, outputs: dict, properties: dict[str, str], name: str = "people") -> bytes:
        """The file's content. inputs, outputs: {name: (type, shape)}."""
        given, found = (
            [helper.make_tensor_value_info(value, kind, shape) for value, (kind, shape) in held.items()]
            for held in (inputs, outputs)
        )
        graph = helper.make_graph(self.nodes, name, given, found, initializer=list(self.constants.values()))
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        helper.set_model_props(made, properties)
        onnx.checker.check_model(made, full_check=True)
        return made.SerializeToString(deterministic=True)
