"""Choose the backend (torch or onboard), and open ONNX graphs that agree with the manifest of `dddas export`.

A folder of graphs has one manifest.json. It states each file's SHA-256, inputs, outputs and parameters, the version of
this package that made it, and a seal, which is the SHA-256 of the other content. This detects damage, edits and mixed
versions of graphs. It is not a signature, which would need a key.
"""

import ctypes
import hashlib
import json
import os
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError

VERSION = "0.3.0"
"""Version of this package."""

SHIPPED = Path(__file__).parent / "graphs"
MANIFEST = "manifest.json"


def opened(folder: Path, name: str, **options: Any) -> Any:
    """Open a single-threaded ONNX Runtime session of a graph.

    options: further attributes of SessionOptions. Raise InputError as `verified` and `open_session` do.
    """
    # Pass the verified bytes, not the file, which may change meanwhile.
    return open_session(verified(folder, name), folder / name, threads=1, **options)


def open_session(content: bytes | str, path: Path, provider: str = "cpu", threads: int = 0, **options: Any) -> Any:
    """Open an ONNX Runtime session. content: bytes of a graph, or the name of its file, beside which weights may lie.

    path: path of the graph, for messages. provider: one of `providers`. threads: 0 lets the runtime choose. options:
    further attributes of SessionOptions. Raise InputError for an unknown provider, and if the runtime refuses.
    """
    import onnxruntime

    known, wanted = providers(), ["cpu"] if provider == "cpu" else [provider, "cpu"]
    if provider not in known:
        raise InputError(
            f"the installed ONNX Runtime has no provider '{provider}', only {', '.join(known)}. Others come with "
            "other packages, such as onnxruntime-gpu or onnxruntime-openvino in place of onnxruntime"
        )
    chosen = onnxruntime.SessionOptions()
    chosen.intra_op_num_threads = chosen.inter_op_num_threads = threads
    for option, value in options.items():
        setattr(chosen, option, value)
    try:
        session = onnxruntime.InferenceSession(content, chosen, providers=[known[name] for name in wanted])
    except Exception as error:  # the error classes of onnxruntime have no other common base class
        first = str(error).partition("\n")[0]
        raise InputError(
            f"onnxruntime {onnxruntime.__version__} cannot open {path}: {first}; is it an ONNX model, or a newer model?"
        ) from None
    # The runtime only warns and falls back to the CPU, for example if a library of CUDA is missing.
    if known[provider] not in session.get_providers():
        raise InputError(f"ONNX Runtime could not start the provider '{provider}'; see its warning above")
    return session


def providers() -> dict[str, str]:
    """Return the providers of the installed ONNX Runtime: short names, such as cuda, with the runtime's names."""
    import onnxruntime

    names = onnxruntime.get_available_providers()
    # Leave out Azure's provider, because it sends pictures to a server.
    return {name.removesuffix("ExecutionProvider").lower(): name for name in names if "Azure" not in name}


def verified(folder: Path, name: str) -> bytes:
    """Return the bytes of a graph. Raise InputError if it is missing, not listed, or differs from the manifest."""
    held = manifest(folder)["graphs"]
    if name not in held:
        raise InputError(f"{folder / MANIFEST} lists no {name}; {_again(folder)}")
    try:
        content = (folder / name).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {folder / name}: {error.strerror or error}; {_again(folder)}") from None
    if hashlib.sha256(content).hexdigest() != held[name].get("sha256"):
        raise InputError(
            f"{folder / name} is not the graph that its {MANIFEST} lists: it is damaged or changed; {_again(folder)}"
        )
    return content


def manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a folder. Raise InputError if it is missing, changed, or made by another version."""
    path = folder / MANIFEST
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{folder} has no graphs with a {MANIFEST} ({error.strerror}); {_again(folder)}") from None
    return _checked(path, text)


@cache
def _checked(path: Path, text: bytes) -> dict[str, Any]:
    try:
        held = json.loads(text)
        made_by = held["package"]
        intact = isinstance(held["graphs"], dict) and held["seal"] == seal(held)
    except (ValueError, KeyError, TypeError, RecursionError):
        intact, held, made_by = False, {}, VERSION
    # Check the version before the seal, because another version may compute the seal in another way.
    if isinstance(made_by, str) and made_by != VERSION:
        raise InputError(
            f"the graphs in {path.parent} were made by torchvision-dddas {made_by}, "
            f"but this is version {VERSION}; {_again(path.parent)}"
        )
    if not intact:
        raise InputError(f"{path} is not as `dddas export` wrote it: it is damaged or changed; {_again(path.parent)}")
    return dict(held)


def seal(content: dict[str, Any]) -> str:
    """Return the SHA-256 of a manifest without its seal. It does not depend on the layout of the JSON text."""
    rest = {name: value for name, value in content.items() if name != "seal"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _again(folder: Path) -> str:
    """Return the advice for a bad folder of graphs."""
    if folder == SHIPPED:
        return "install torchvision-dddas again"
    return f"make the graphs again with `dddas export --out {folder}`"


def wants_torch(backend: str, auto_with_gpu: bool = True) -> bool:
    """Return whether the backend is torch, and prepare the environment for its import.

    `auto` is torch if torch sees a CUDA device, else onboard, which is faster for a single stream on a CPU.
    auto_with_gpu: False for work that a GPU does not speed up. Raise InputError for another name or missing packages.
    """
    if backend == "onboard" or (backend == "auto" and not (auto_with_gpu and _has_cuda())):
        return False
    if backend not in ("auto", "torch"):
        raise InputError(f"no backend is named '{backend}'; give auto, torch or onboard")
    if missing := _missing_packages():
        raise InputError(
            f"--backend torch needs {' and '.join(missing)}; pip install 'torchvision-dddas[torch]', "
            "or use --backend onboard"
        )
    # Without this setting, waiting threads spin and slow the others: a frame can take minutes on a busy machine.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return True


def torch_device() -> str:
    """Return the device for torch: cuda if there is a CUDA device, else cpu.

    Apple's MPS is not used, because homographies are fitted in float64, which MPS does not support.
    """
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _missing_packages() -> list[str]:
    return [name for name in ("torch", "kornia") if find_spec(name) is None]


@cache
def _has_cuda() -> bool:
    """Return whether torch sees a CUDA device. Without a driver torch is not imported, which would take seconds."""
    if _missing_packages():
        return False
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return torch_device() == "cuda"
