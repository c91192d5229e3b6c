"""Digests of what a result depends on: the content of files, and the source code and libraries that compute it."""

import ast
import hashlib
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.storage import digest
from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.runtime import VERSION

PACKAGE = Path(__file__).resolve().parents[2]

_LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "onnxruntime", "pymap3d", "av")
_ENGINE_LIBRARIES = {"torch": ("torch", "kornia")}
_SETTLED_S = 2.0  # a file that was written a moment ago may be written again within one tick of its time stamp


@cache
def code_digest(function: Callable[..., Any], engine: str = "") -> str:
    """The digest of the code that a function can run: its own module, and all that it imports from this package.

    The import graph is read from the sources. Data files of the package, versions of libraries (those of an engine
    too) and the processor's architecture count as well.
    """
    files = {PACKAGE.parent / Path(*function.__module__.split(".")).with_suffix(".py")}
    waiting = set(_modules_used(function, set()))
    while waiting:
        path = _source(waiting.pop())
        if path is not None and path not in files:
            files.add(path)
            waiting |= set(_imports(path))
    files |= {path for path in PACKAGE.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    content = {path.relative_to(PACKAGE).as_posix(): _file_digest(path) for path in sorted(files)}
    libraries = {name: _version(name) for name in (*_LIBRARIES, *_ENGINE_LIBRARIES.get(engine, ()))}
    return digest(VERSION, content, libraries, platform.machine())


def _modules_used(function: Callable[..., Any], seen: set[Any]) -> Iterator[str]:
    """Names of the modules whose functions, classes or constants a function uses, directly or in its own module."""
    if not isinstance(function, FunctionType) or function in seen:
        return
    seen.add(function)
    for name in _names(function.__code__):
        used = function.__globals__.get(name, name)
        module = used.__name__ if isinstance(used, ModuleType) else getattr(used, "__module__", used)
        if module != function.__module__:
            if isinstance(module, str) and module.startswith(PACKAGE.name):
                yield module
        else:
            for part in vars(used).values() if isinstance(used, type) else (used,):
                yield from _modules_used(part, seen)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


@cache
def _imports(path: Path) -> tuple[str, ...]:
    """Names that may be modules of this package, which a file imports anywhere but for types alone."""
    found: list[str] = []
    waiting: list[Any] = ast.parse(path.read_bytes()).body
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            waiting += node.orelse
        else:  # statements alone, for no expression imports
            for name in ("body", "orelse", "finalbody", "handlers", "cases"):
                part = getattr(node, name, ())
                waiting += part if isinstance(part, list) else ()
    return tuple(name for name in found if name.split(".")[0] == PACKAGE.name)


def _source(module: str) -> Path | None:
    """The file of a module of this package; None if the name is no module."""
    place = PACKAGE.parent / Path(*module.split("."))
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class FileDigests:
    """Digests of lists of files. A list whose sizes and times are unchanged is not read again.

    memory: the folder that remembers them; None remembers nothing.
    """

    def __init__(self, memory: Path | None = None) -> None:
        self._memory = memory

    def digest(self, paths: Sequence[Path]) -> str:
        """The digest of the content of files, in order. Raises InputError if one cannot be read."""
        if not paths:
            return ""
        try:
            marks = [_mark(path) for path in paths]
            place = None if self._memory is None else self._memory / f"{digest(marks)}.txt"
            if place is not None:
                with suppress(OSError):
                    known = place.read_text(encoding="ascii", errors="replace").strip()
                    if len(known) == 64:
                        return known
            found = digest([_file_digest(path) for path in paths])
        except OSError as error:
            raise InputError(f"{error.filename} cannot be read: {error.strerror}") from None
        if place is not None and all(time.time() - written_ns / 1e9 > _SETTLED_S for _, _, written_ns, _ in marks):
            with suppress(OSError):  # only time is lost
                place.parent.mkdir(parents=True, exist_ok=True)
                write_whole(place, found.encode())
        return found


def _mark(path: Path) -> tuple[str, int, int, int]:
    found = path.stat()
    return str(path.absolute()), found.st_size, found.st_mtime_ns, found.st_ctime_ns
