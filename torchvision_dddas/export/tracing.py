"""From a module of torch to a file that any runtime reads: standard operations only, nothing of the machine.

By torch's older exporter, which traces: on the whole step the newer one takes minutes where this one takes 20 seconds.
Two things to know of it: it has no `.mT`, which is added here, and counts a negative dimension of `unfold` wrongly
without a word, so that a graph is only worth what its comparison with torch says.
"""

import contextlib
import io
import logging
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import torch
from torch import Tensor, nn
from torch.onnx import symbolic_helper

from torchvision_dddas.errors import InputError
from torchvision_dddas.export.graph_builder import OPSET

TRANSPOSED = "aten::mT"


def traced(
    graph: nn.Module, name: str, given: Sequence[Tensor], inputs: Sequence[str], outputs: Sequence[str]
) -> bytes:
    """The file of a module, traced on the tensors given; the same versions give the same bytes.

    inputs, outputs: names of our own. Raises InputError where torch makes it of operations that are not standard.
    """
    file = io.BytesIO()
    with _quiet(), _transpose_known(), torch.no_grad():
        torch.onnx.export(
            graph,
            tuple(given),
            file,  # type: ignore[arg-type]  # the older exporter takes it
            dynamo=False,
            opset_version=OPSET,
            input_names=inputs,
            output_names=outputs,
        )
    return bare(folded(file.getvalue()), name)


def folded(content: bytes) -> onnx.ModelProto:
    """A graph without what does not depend on its inputs, which is nearly two nodes of three: it opens sooner."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC  # standard operations
    options.log_severity_level = 3  # "the model may only work here" is true of the levels above
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "folded.onnx"
        options.optimized_model_filepath = str(path)
        onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        return onnx.load(path)


def bare(model: onnx.ModelProto, name: str) -> bytes:
    """A model without what tells where and how it was made."""
    model.graph.name, model.doc_string, model.graph.doc_string = name, "", ""
    model.producer_name, model.producer_version = "", ""
    del model.metadata_props[:], model.graph.value_info[:], model.functions[:]
    graph = model.graph
    for held in (graph, *graph.node, *graph.initializer, *graph.input, *graph.output):
        held.doc_string = ""
        del held.metadata_props[:]
    if strange := {node.domain for node in graph.node} - {""}:
        raise InputError(
            f"torch's exporter made {name} of operations of {', '.join(strange)}; another torch may do better"
        )
    opsets = [held for held in model.opset_import if held.domain == ""]
    del model.opset_import[:]
    model.opset_import.extend(opsets)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    noisy = logging.getLogger("torch.onnx")
    level = noisy.level
    noisy.setLevel(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        noisy.setLevel(level)


@contextlib.contextmanager
def _transpose_known() -> Iterator[None]:
    """The exporter can do `.mT` meanwhile."""

    def last_two_swapped(context: Any, matrix: Any) -> Any:
        rank = symbolic_helper._get_tensor_rank(matrix)
        assert rank is not None, "traced with tensors, so known"
        order = [*range(rank - 2), rank - 1, rank - 2]
        return context.op("Transpose", matrix, perm_i=order)

    torch.onnx.register_custom_op_symbolic(TRANSPOSED, last_two_swapped, 9)  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.onnx.unregister_custom_op_symbolic(TRANSPOSED, 9)  # type: ignore[attr-defined]
