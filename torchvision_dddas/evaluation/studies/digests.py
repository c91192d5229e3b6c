"""What a result depends on, as digests: the code, the knobs, the files; where all are the same, so is the result."""

import dataclasses
import hashlib
import platform
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import write_whole

PACKAGE = Path(__file__).resolve().parents[2]

FINDS = (
    *("types.py", "config.py", "geometry.py", "runtime.py", "pipeline.py", "functional", "detection", "tracking"),
    *("people", "geo", "control", "io", "graphs", "models", "cli/aerial.py", "cli/prepared.py"),
    *(f"evaluation/studies/{name}.py" for name in ("record", "rows", "stages", "placing")),
)
"""The files and folders of the package that decide what is found in a clip."""

SCORES = (
    *("types.py", "geometry.py", "io", "tracking", "evaluation/metrics"),
    *(f"evaluation/studies/{name}.py" for name in ("scored", "scoring", "placing_score")),
)
"""Those that decide how right it is."""

_LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "onnxruntime", "pymap3d", "av")
_ENGINES = {"torch": ("torch", "kornia")}
_SETTLED_S = 2.0  # a file that was written a moment ago may be written again within one tick of its time stamp


def of(*parts: Any) -> str:
    """The digest of numbers, texts, arrays, records and mappings."""
    digest = hashlib.sha256()
    _add(digest, parts)
    return digest.hexdigest()


def _add(digest: Any, value: Any) -> None:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        digest.update(b"{%d" % len(value))
        for key in sorted(value, key=lambda k: (type(k).__name__, k)):
            _add(digest, key)
            _add(digest, value[key])
    elif isinstance(value, np.ndarray):
        digest.update(f"a{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, bytes):
        digest.update(b"b%d:" % len(value))
        digest.update(value)
    elif isinstance(value, (tuple, list)):
        digest.update(b"(%d" % len(value))
        for item in value:
            _add(digest, item)
    else:
        text = f"{type(value).__name__}:{value!r}".encode()
        digest.update(b"%d:" % len(text))
        digest.update(text)


@cache
def code(which: tuple[str, ...], backend: str = "") -> str:
    """The digest of a part of the package, and of the libraries that it computes with. backend: as `engine.load`."""
    content = {}
    for name in which:
        place = PACKAGE / name
        for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if path.is_file() and path.suffix != ".pyc":
                content[path.relative_to(PACKAGE).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    libraries = {name: _version(name) for name in (*_LIBRARIES, *_ENGINES.get(backend, ()))}
    return of(content, libraries, platform.machine())


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


class UnreadError(Exception):
    """A digest is not known, and no file was to be read for it."""


class Files:
    """Digests of files' content. A list of files that is as it was by size and times is not read again.

    memory: a folder where they are kept; None keeps nothing. read: whether files may be read, else UnreadError.
    """

    def __init__(self, memory: Path | None, read: bool = True) -> None:
        self.memory, self.read = memory, read

    def digest(self, paths: Sequence[Path]) -> str:
        """The digest of the content of files, in order. Raises InputError for one that cannot be read."""
        if not paths:
            return ""
        marks = [_mark(path) for path in paths]
        place = None if self.memory is None else self.memory / f"{of(marks)}.txt"
        if place is not None:
            with suppress(OSError):
                known = place.read_text(encoding="ascii", errors="replace").strip()
                if len(known) == 64:
                    return known
        if not self.read:
            raise UnreadError
        digest = of(list(_contents(paths)))
        if place is not None and all(time.time() - mark[2] / 1e9 > _SETTLED_S for mark in marks):
            with suppress(OSError):  # only time is lost
                place.parent.mkdir(parents=True, exist_ok=True)
                write_whole(place, digest.encode())
        return digest


def _mark(path: Path) -> tuple[str, int, int, int]:
    try:
        found = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    return str(path.absolute()), found.st_size, found.st_mtime_ns, found.st_ctime_ns


def _contents(paths: Iterable[Path]) -> Iterable[str]:
    for path in paths:
        try:
            with path.open("rb") as file:
                yield hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}") from None
