"""From a torch module to an ONNX file of standard operations that holds nothing of the machine that made it.

Uses torch's older exporter, which traces: on the whole step the newer one takes minutes and this one 20 seconds. It has
no `.mT`, which is added here, and it counts a negative dimension of `unfold` wrongly without an error, so every graph
must be compared with torch.
"""

import contextlib
import io
import logging
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import torch
from torch import Tensor, nn
from torch.onnx import symbolic_helper

from torchvision_dddas.errors import InputError

OPSET = 20


def trace_graph(
    module: nn.Module,
    name: str,
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    free_axes: Mapping[str, Mapping[int, str]] | None = None,
) -> bytes:
    """The ONNX file of a module, traced on the tensors given; the same versions give the same bytes.

    free_axes: names of axes of any length, by input or output. Raises InputError if the result is not of standard
    operations.
    """
    file = io.BytesIO()
    with _quiet(), _transpose_known(), torch.no_grad():
        torch.onnx.export(
            module,
            tuple(inputs.values()),
            file,  # type: ignore[arg-type]  # the older exporter takes it
            dynamo=False,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes=free_axes,
        )
    return _strip(_fold_constants(file.getvalue()), name)


def open_session(content: bytes) -> onnxruntime.InferenceSession:
    """A session of a graph on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def _fold_constants(content: bytes) -> onnx.ModelProto:
    """The graph without nodes that do not depend on its inputs, nearly two of three: it opens sooner."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC  # standard operations
    options.log_severity_level = 3  # "the model may only work here" is true of the levels above
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "folded.onnx"
        options.optimized_model_filepath = str(path)
        onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        return onnx.load(path)


def _strip(model: onnx.ModelProto, name: str) -> bytes:
    """The model without what tells where and how it was made."""
    graph = model.graph
    graph.name, model.doc_string, model.producer_name, model.producer_version = name, "", "", ""
    del model.metadata_props[:], graph.value_info[:], model.functions[:]
    for held in (graph, *graph.node, *graph.initializer, *graph.input, *graph.output):
        held.doc_string = ""
        del held.metadata_props[:]
    if strange := {node.domain for node in graph.node} - {""}:
        raise InputError(
            f"torch's exporter made {name} of operations of {', '.join(strange)}, wanted standard ones; "
            "try another version of torch"
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
    """Teach the exporter `.mT` meanwhile."""

    def last_two_swapped(context: Any, matrix: Any) -> Any:
        rank = symbolic_helper._get_tensor_rank(matrix)
        assert rank is not None, "traced with tensors, so known"
        order = [*range(rank - 2), rank - 1, rank - 2]
        return context.op("Transpose", matrix, perm_i=order)

    torch.onnx.register_custom_op_symbolic("aten::mT", last_two_swapped, 9)  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.onnx.unregister_custom_op_symbolic("aten::mT", 9)  # type: ignore[attr-defined]
