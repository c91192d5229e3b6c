"""Export a torch module to an ONNX file of standard operations. Write such files into a folder with a manifest.

The code uses torch's older, tracing exporter. It takes 20 seconds for the whole step; the newer exporter takes minutes.
The older exporter lacks `.mT`, which is added here. It also miscounts negative dimensions of `unfold` without an error,
so every graph must be compared with torch.
"""

import contextlib
import hashlib
import io
import json
import logging
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import torch
from torch import Tensor, nn
from torch.onnx import symbolic_helper

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import PartFile, cannot_write, claimed
from torchvision_dddas.runtime import MANIFEST, VERSION, manifest, seal

OPSET = 20


@dataclass(frozen=True)
class Check:
    """Largest difference `off` of a graph's results from torch's over its examples, in `unit`; at most `limit`."""

    unit: str
    off: float
    limit: float

    @property
    def is_passed(self) -> bool:
        """Whether the difference is within the limit. NaN fails."""
        return self.off <= self.limit


@dataclass(frozen=True)
class ExportedGraph:
    """A file: content, purpose (about), function for comparison (source), and the parameters built into it."""

    content: bytes
    about: str
    source: str
    parameters: dict[str, Any] = field(default_factory=dict)
    checks: tuple[Check, ...] = ()


def write_graphs(folder: Path, files: dict[str, ExportedGraph]) -> None:
    """Write graphs and their manifest, either all files or none.

    Graphs that are already in the folder stay listed if its manifest is valid. Raises InputError if a graph failed its
    checks, or if the files cannot be written.
    """
    refuse_failed(files)
    try:
        kept = {name: held for name, held in manifest(folder)["graphs"].items() if (folder / name).exists()}
    except InputError:
        kept = {}
    contents = {name: graph.content for name, graph in files.items()}
    entries = kept | {name: _manifest_entry(graph) for name, graph in files.items()}
    listed: dict[str, Any] = {"package": VERSION, "graphs": dict(sorted(entries.items()))}
    # The manifest takes its place last.
    contents[MANIFEST] = (json.dumps({**listed, "seal": seal(listed)}, indent=1) + "\n").encode()
    parts: list[PartFile] = []
    try:
        with claimed(folder):
            for name, content in contents.items():
                parts.append(PartFile(folder / name))
                parts[-1].write(content)
            for part in parts:
                part.keep()
    except OSError as error:
        raise cannot_write(folder, error) from None
    finally:
        for part in parts:
            part.discard()


def refuse_failed(files: dict[str, ExportedGraph]) -> None:
    """Raise InputError if a graph's results differ from torch's, or if the graph was not compared."""
    for name, graph in files.items():
        failed = [check for check in graph.checks if not check.is_passed]
        if failed or not graph.checks:
            off = ", ".join(f"{c.off:.1e} {c.unit}, {c.limit:g} allowed" for c in failed) or "it was never compared"
            raise InputError(
                f"{name} does not agree with {graph.source}: {off}. Nothing was written; "
                "try other versions of torch, onnx and onnxruntime"
            )


def _manifest_entry(graph: ExportedGraph) -> dict[str, Any]:
    model = onnx.load_from_string(graph.content)
    (opset,) = (held.version for held in model.opset_import if held.domain == "")
    return {
        "about": graph.about,
        "sha256": hashlib.sha256(graph.content).hexdigest(),
        "opset": opset,
        "inputs": {value.name: _type_and_shape(value) for value in model.graph.input},
        "outputs": {value.name: _type_and_shape(value) for value in model.graph.output},
        "knobs": graph.parameters,
        "checked_against": graph.source,
        "checks": [{"unit": c.unit, "off": float(f"{c.off:.1e}"), "limit": c.limit} for c in graph.checks],
        "versions": {
            "torch": torch.__version__,
            "onnx": onnx.__version__,
            "onnxruntime": onnxruntime.__version__,
        },
    }


def _type_and_shape(value: onnx.ValueInfoProto) -> dict[str, Any]:
    kind = value.type.tensor_type
    return {
        "type": onnx.TensorProto.DataType.Name(kind.elem_type).lower(),
        "shape": [d.dim_param or d.dim_value for d in kind.shape.dim],  # free sizes have names
    }


def trace_graph(
    module: nn.Module,
    name: str,
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    free_axes: Mapping[str, Mapping[int, str]] | None = None,
) -> bytes:
    """Trace a module on input tensors and return its ONNX file. The same library versions give the same bytes.

    free_axes: names of axes of free length, by input or output. Raises InputError if the result contains non-standard
    operations.
    """
    file = io.BytesIO()
    with _quiet(), _transpose_known(), torch.no_grad():
        torch.onnx.export(
            module,
            tuple(inputs.values()),
            file,  # type: ignore[arg-type]  # the older exporter accepts it
            dynamo=False,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes=free_axes,
        )
    # Fold the nodes that do not depend on the inputs (nearly two of three), so that the graph opens faster.
    with tempfile.TemporaryDirectory() as folder:
        options = _options()
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC  # standard operations
        options.log_severity_level = 3  # hide a warning that concerns higher levels only
        options.optimized_model_filepath = str(Path(folder) / "folded.onnx")
        onnxruntime.InferenceSession(file.getvalue(), options, providers=["CPUExecutionProvider"])
        return _strip(onnx.load(options.optimized_model_filepath), name)


def open_session(content: bytes) -> onnxruntime.InferenceSession:
    """Open a session of a graph on one thread."""
    return onnxruntime.InferenceSession(content, _options(), providers=["CPUExecutionProvider"])


def _options() -> onnxruntime.SessionOptions:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return options


def _strip(model: onnx.ModelProto, name: str) -> bytes:
    """Return the model without records of its origin."""
    graph = model.graph
    graph.name, model.doc_string, model.producer_name, model.producer_version = name, "", "", ""
    del model.metadata_props[:], graph.value_info[:], model.functions[:]
    for held in (graph, *graph.node, *graph.initializer, *graph.input, *graph.output):
        held.doc_string = ""
        del held.metadata_props[:]
    if strange := {node.domain for node in graph.node} - {""}:
        raise InputError(
            f"torch's exporter used operations of {', '.join(strange)} in {name}; wanted standard operations; "
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
    """Register `.mT` with the exporter inside the context."""

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
