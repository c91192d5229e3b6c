"""What computes: torch, or ONNX graphs, opened only where they are what the manifest of `dddas export` says.

A folder of graphs has one manifest.json. It holds each file's SHA-256, inputs, outputs and parameters, the version of
this package that made it, and a seal: the SHA-256 of everything else in it. This reveals damage, edits and mixed-up
versions from the graphs that were checked; it is no signature, which would need a key.
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

VERSION = "0.1.0"
"""Of this package."""

SHIPPED = Path(__file__).parent / "graphs"
MANIFEST = "manifest.json"


def opened(folder: Path, name: str, **options: Any) -> Any:
    """An ONNX Runtime session of a graph, on one thread of this process's own.

    options: further attributes of SessionOptions. Raises InputError as `verified`, and where the runtime refuses.
    """
    content = verified(folder, name)
    import onnxruntime

    chosen = onnxruntime.SessionOptions()
    chosen.intra_op_num_threads = chosen.inter_op_num_threads = 1
    for option, value in options.items():
        setattr(chosen, option, value)
    try:
        # The bytes that were verified, not the file, which may change meanwhile.
        return onnxruntime.InferenceSession(content, chosen, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own classes have no common ancestor but this
        first = str(error).partition("\n")[0]
        raise InputError(
            f"onnxruntime {onnxruntime.__version__} cannot open {folder / name}: {first}; a newer one may"
        ) from None


def verified(folder: Path, name: str) -> bytes:
    """A graph's bytes. Raises InputError where it is not there, not listed, or not the one that is listed."""
    held = manifest(folder)["graphs"]
    if name not in held:
        raise InputError(f"{folder / MANIFEST} lists no {name}; {_again(folder)}")
    try:
        content = (folder / name).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {folder / name}: {error.strerror or error}; {_again(folder)}") from None
    if hashlib.sha256(content).hexdigest() != held[name].get("sha256"):
        raise InputError(
            f"{folder / name} is not the graph that its {MANIFEST} lists: damaged or changed; {_again(folder)}"
        )
    return content


def manifest(folder: Path) -> dict[str, Any]:
    """What a folder's manifest says. Raises InputError for none, a changed one, or another version's."""
    path = folder / MANIFEST
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{folder} holds no graphs with their {MANIFEST} ({error.strerror}); {_again(folder)}"
        ) from None
    return _checked(path, text)


@cache
def _checked(path: Path, text: bytes) -> dict[str, Any]:
    try:
        held = json.loads(text)
        made_by = held["package"]
        intact = isinstance(held["graphs"], dict) and held["seal"] == seal(held)
    except (ValueError, KeyError, TypeError, RecursionError):
        intact, held, made_by = False, {}, VERSION
    # Before the seal, which another version may make in another way.
    if isinstance(made_by, str) and made_by != VERSION:
        raise InputError(
            f"the graphs in {path.parent} were made by torchvision-dddas {made_by}, "
            f"and this is {VERSION}; {_again(path.parent)}"
        )
    if not intact:
        raise InputError(f"{path} is not as `dddas export` wrote it: damaged or changed; {_again(path.parent)}")
    return dict(held)


def seal(content: dict[str, Any]) -> str:
    """The SHA-256 of a manifest without its seal, independent of its layout."""
    rest = {name: value for name, value in content.items() if name != "seal"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _again(folder: Path) -> str:
    """What to do."""
    if folder == SHIPPED:
        return "install torchvision-dddas again"
    return f"make the graphs again with `dddas export --out {folder}`"


def wants_torch(backend: str, auto_with_gpu: bool = True) -> bool:
    """Whether the back end is torch, which is then made ready to be imported.

    `auto` is torch where it sees a CUDA device, else onboard, the quicker one for a single stream on a CPU.
    auto_with_gpu: False for work that a GPU does not help. Raises InputError for another name or missing packages.
    """
    if backend == "onboard" or (backend == "auto" and not (auto_with_gpu and _has_cuda())):
        return False
    if backend not in ("auto", "torch"):
        raise InputError(f"no back end is named '{backend}'; give auto, torch or onboard")
    if missing := _missing_packages():
        raise InputError(
            f"--backend torch needs {' and '.join(missing)}; pip install 'torchvision-dddas[torch]', "
            "or take --backend onboard"
        )
    # Waiting threads that spin take the cores from the threads they wait for, minutes a frame on a busy machine.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return True


def torch_device() -> str:
    """Where torch computes: on the CUDA device if there is one, else on the CPU.

    Apple's MPS is not taken: homographies are fitted in float64, which it does not have.
    """
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _missing_packages() -> list[str]:
    return [name for name in ("torch", "kornia") if find_spec(name) is None]


@cache
def _has_cuda() -> bool:
    """Whether torch sees a CUDA device; where there is no driver it is not loaded to be asked, which takes seconds."""
    if _missing_packages():
        return False
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return torch_device() == "cuda"
