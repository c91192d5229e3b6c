"""The manifest of a folder of graphs, and the folder written whole or not at all."""

import hashlib
import json
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import torch

from torchvision_dddas import __version__
from torchvision_dddas.errors import InputError
from torchvision_dddas.export.checked import Made, refuse_wrong
from torchvision_dddas.io.atomic_files import cannot_write, remove, temporary
from torchvision_dddas.runtime import MANIFEST, manifest, seal


def write(folder: Path, files: dict[str, Made]) -> None:
    """Graphs and their manifest, once all have passed their checks.

    Graphs that are there already, and are not among the files, stay listed if their manifest can be trusted. Raises
    InputError for a graph that failed, and where the disk refuses.
    """
    refuse_wrong(files)
    try:
        kept = {name: held for name, held in manifest(folder)["graphs"].items() if (folder / name).exists()}
    except InputError:
        kept = {}
    contents = {name: made.content for name, made in files.items()}
    listed = kept | {name: entry(made) for name, made in files.items()}
    contents[MANIFEST] = as_json(listed)  # the last to take its place
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


def as_json(graphs: dict[str, dict[str, Any]]) -> bytes:
    """The manifest's bytes, sealed."""
    content: dict[str, Any] = {"package": __version__, "graphs": dict(sorted(graphs.items()))}
    return (json.dumps({**content, "seal": seal(content)}, indent=1) + "\n").encode()


def entry(made: Made) -> dict[str, Any]:
    """What the manifest says of one graph."""
    model = onnx.load_from_string(made.content)
    (opset,) = (held.version for held in model.opset_import if held.domain == "")
    return {
        "about": made.about,
        "sha256": hashlib.sha256(made.content).hexdigest(),
        "opset": opset,
        "inputs": {value.name: described(value) for value in model.graph.input},
        "outputs": {value.name: described(value) for value in model.graph.output},
        "knobs": made.parameters,
        "checked_against": made.source,
        "checks": [{"unit": c.unit, "off": float(f"{c.off:.1e}"), "limit": c.limit} for c in made.checks],
        "versions": {
            "torch": torch.__version__,
            "onnx": onnx.__version__,
            "onnxruntime": onnxruntime.__version__,
        },
    }


def described(value: onnx.ValueInfoProto) -> dict[str, Any]:
    """Type and shape; sizes that are free have names."""
    kind = value.type.tensor_type
    return {
        "type": onnx.TensorProto.DataType.Name(kind.elem_type).lower(),
        "shape": [d.dim_param or d.dim_value for d in kind.shape.dim],
    }
