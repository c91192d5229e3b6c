"""Exported graphs with what they were compared with, and the folder that holds them under one manifest."""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import torch

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, remove, temporary
from torchvision_dddas.runtime import MANIFEST, VERSION, manifest, seal


@dataclass(frozen=True)
class Check:
    """How far a graph's results are from torch's, over its examples: `off` in `unit`, at most `limit` of it."""

    unit: str
    off: float
    limit: float

    @property
    def is_passed(self) -> bool:
        """False also where the difference is not a number."""
        return self.off <= self.limit


@dataclass(frozen=True)
class ExportedGraph:
    """One file: its content, what it is for, the function it was compared with, and the parameters baked into it."""

    content: bytes
    about: str
    source: str
    parameters: dict[str, Any] = field(default_factory=dict)
    checks: tuple[Check, ...] = ()


def write_graphs(folder: Path, files: dict[str, ExportedGraph]) -> None:
    """Write graphs and their manifest, whole or not at all.

    Graphs that the folder holds already stay listed if its manifest can be trusted. Raises InputError if a graph
    failed its checks, or if the disk refuses.
    """
    refuse_failed(files)
    try:
        kept = {name: held for name, held in manifest(folder)["graphs"].items() if (folder / name).exists()}
    except InputError:
        kept = {}
    contents = {name: graph.content for name, graph in files.items()}
    entries = kept | {name: _manifest_entry(graph) for name, graph in files.items()}
    contents[MANIFEST] = _manifest_json(entries)  # the last to take its place
    parts = {folder / name: temporary(folder / name) for name in contents}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, part in parts.items():
            part.write_bytes(contents[path.name])
        for path, part in parts.items():
            part.replace(path)
    except OSError as error:
        raise cannot_write(folder, error) from None
    finally:
        for part in parts.values():
            remove(part)


def refuse_failed(files: dict[str, ExportedGraph]) -> None:
    """Raises InputError if a graph does not compute what torch computes, or was not compared at all."""
    for name, graph in files.items():
        failed = [check for check in graph.checks if not check.is_passed]
        if failed or not graph.checks:
            off = ", ".join(f"{c.off:.1e} {c.unit}, {c.limit:g} allowed" for c in failed) or "it was never compared"
            raise InputError(
                f"{name} does not agree with {graph.source}: {off}. Nothing was written; "
                "try other versions of torch, onnx and onnxruntime"
            )


def _manifest_json(graphs: dict[str, dict[str, Any]]) -> bytes:
    content: dict[str, Any] = {"package": VERSION, "graphs": dict(sorted(graphs.items()))}
    return (json.dumps({**content, "seal": seal(content)}, indent=1) + "\n").encode()


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
        "shape": [d.dim_param or d.dim_value for d in kind.shape.dim],  # sizes that are free have names
    }
