"""Results on disk: records as npz with JSON inside, in a cache by key, and the scores.bin of a study.

A key is the digest of the settings, the content of the files, and the source code and libraries that compute a result.
"""

import dataclasses
import hashlib
import io
import json
import os
import platform
import time
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, remove, remove_left_behind, write_whole
from torchvision_dddas.lab.evaluation.metrics.boxes import BoxCounts, OneTarget
from torchvision_dddas.lab.evaluation.metrics.metres import LocatedCounts
from torchvision_dddas.lab.evaluation.metrics.pixels import Pixels, Still
from torchvision_dddas.lab.evaluation.metrics.tracking import Clear, Hota, Identity, TargetTrack, TrackCounts, Windows
from torchvision_dddas.lab.evaluation.studies.records import Findings, Scored, ScoredCase, ScoredStudy
from torchvision_dddas.runtime import VERSION

SCORES = "scores.bin"
"""The file of a study's folder that holds its counts, frame by frame."""

_COUNTS = (Pixels, OneTarget, TrackCounts, TargetTrack, Still, Clear, Hota, Identity, Windows)
# The names of records in files. Three differ from the class names, because files of earlier versions have them.
_RECORDS: dict[str, Any] = {"Found": Findings, "Boxes": BoxCounts, "GroundLocations": LocatedCounts}
_RECORDS |= {kind.__name__: kind for kind in (Scored, ScoredCase, ScoredStudy, *_COUNTS)}
_NAMES = {kind: name for name, kind in _RECORDS.items()}


class DamagedError(ValueError):
    """The bytes differ from those that were stored."""


def pack(record: Any) -> bytes:
    """Return a record as bytes: dataclasses, NamedTuples, arrays, mappings, tuples, texts, numbers, bytes.

    The first 32 bytes are the SHA-256 of the rest. Raise TypeError for any other content.
    """
    arrays: dict[str, np.ndarray] = {}
    content = json.dumps(_encode(record, arrays))
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, content=np.frombuffer(content.encode(), np.uint8), **arrays)
    body = file.getvalue()
    return hashlib.sha256(body).digest() + body


def unpack(content: bytes) -> Any:
    """Return the record in these bytes. Raise DamagedError if they are damaged, or contain no known record."""
    if not _is_whole(content):
        raise DamagedError("its digest does not match")
    try:
        with np.load(io.BytesIO(content[32:]), allow_pickle=False) as arrays:
            return _decode(json.loads(arrays["content"].tobytes()), arrays)
    except (ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise DamagedError(f"{type(error).__name__}: {error}") from error


def digest(*values: Any) -> str:
    """Return the SHA-256 of values that `pack` takes. It depends on their content, type and order."""
    return pack(values)[:32].hex()


def _is_whole(content: bytes) -> bool:
    return hashlib.sha256(memoryview(content)[32:]).digest() == content[:32]


def _encode(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or type(value) in (str, int, float, bool):
        return value
    if isinstance(value, bytes | np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value if isinstance(value, np.ndarray) else np.frombuffer(value, np.uint8)
        return {"array" if isinstance(value, np.ndarray) else "bytes": name}
    if isinstance(value, Mapping):
        return {"map": [[_encode(k, arrays), _encode(v, arrays)] for k, v in value.items()]}
    fields = value._asdict() if hasattr(value, "_asdict") else vars(value) if dataclasses.is_dataclass(value) else None
    if fields is not None:
        name = _NAMES.get(type(value), type(value).__name__)
        return {"of": name, "fields": {key: _encode(v, arrays) for key, v in fields.items()}}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_encode(v, arrays) for v in value]}
    raise TypeError(f"a {type(value).__name__} cannot be stored")


def _decode(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(value, dict):
        return value
    if "of" in value:
        kind = _RECORDS[value["of"].rpartition(":")[2]]  # older files contain module:class
        return kind(**{name: _decode(v, arrays) for name, v in value["fields"].items()})
    ((kind, inner),) = value.items()
    if kind in ("array", "bytes"):
        return arrays[inner] if kind == "array" else arrays[inner].tobytes()
    if kind == "map":
        return {_decode(k, arrays): _decode(v, arrays) for k, v in inner}
    return {"tuple": tuple, "list": list}[kind](_decode(v, arrays) for v in inner)


def cache_folder() -> Path:
    """Return the default folder of cached results."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "torchvision_dddas" / "studies"


class Cache:
    """A folder of records, one file per key. Each file is whole or absent. Several processes may use it at once.

    notes: a line for each damaged entry that was found. Raise InputError if the folder cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.notes: list[str] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot make the folder {folder}: {error.strerror}; choose another --cache") from None

    def path(self, key: str) -> Path:
        """Return the file of a key."""
        return self.folder / key[:2] / f"{key}.npz"

    def has_newer(self, since_s: float) -> bool:
        """Return whether an entry was written after a time, in the unit of `time.time`."""
        with suppress(OSError):
            return any(entry.stat().st_mtime > since_s for entry in self.folder.glob("*/*.npz"))
        return False

    def has(self, key: str) -> bool:
        """Return whether there is a whole entry. A damaged entry is noted and removed."""
        content = self.read(key)
        return content is not None and (_is_whole(content) or self._drop(key))

    def get(self, key: str) -> Any | None:
        """Return the record of a key; None if there is none. A damaged entry is noted and removed."""
        content = self.read(key)
        try:
            return None if content is None else unpack(content)
        except DamagedError:
            self._drop(key)
            return None

    def read(self, key: str) -> bytes | None:
        """Return the bytes of an entry, unchecked; None if there is none. The entry counts as used now."""
        path = self.path(key)
        try:
            content = path.read_bytes()
        except OSError:
            return None
        with suppress(OSError):  # the cache may be read-only
            path.touch()
        return content

    def put(self, key: str, record: Any) -> None:
        """Store a record. Raise InputError if the disk refuses."""
        self.write(key, pack(record))

    def write(self, key: str, content: bytes) -> None:
        """Store the bytes of a record. Raise InputError if the disk refuses."""
        path = self.path(key)
        try:
            path.parent.mkdir(exist_ok=True)
            write_whole(path, content)
        except OSError as error:
            raise InputError(str(cannot_write(path, error)).replace("another --out", "another --cache")) from None

    def tidy(self) -> None:
        """Remove hidden files that killed processes left unfinished."""
        for folder in self.folder.glob("??"):
            remove_left_behind(folder)

    def prune(self, days: float) -> tuple[int, int]:
        """Remove entries that were not used for `days`, and return their number and bytes."""
        count = size = 0
        for path in self.folder.rglob("*"):
            with suppress(OSError):  # another process may remove entries at the same time
                found = path.stat()
                if path.is_file() and time.time() - found.st_mtime > days * 86400:
                    path.unlink()
                    count, size = count + 1, size + found.st_size
        return count, size

    def _drop(self, key: str) -> bool:
        self.notes.append(f"{self.path(key)} is damaged and is computed again")
        remove(self.path(key))
        return False


def write_scores(folder: Path, name: str, cases: Iterable[ScoredCase]) -> None:
    """Write scores.bin, whole or not at all. Raise OSError."""
    ordered = tuple(sorted(cases, key=lambda case: (case.task, case.clip)))
    write_whole(folder / SCORES, pack(ScoredStudy(name, ordered)))


def read_scores(folder: Path) -> ScoredStudy:
    """Read scores.bin. Raise InputError if the folder is not a study's, or the file is damaged."""
    path = folder / SCORES
    try:
        study = unpack(path.read_bytes())
    except FileNotFoundError:
        raise InputError(
            f"{folder} is not a study: it lacks {SCORES}; wanted a folder that dddas evaluate --dataset wrote, or "
            "a method's folder from dddas evaluate --names"
        ) from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except DamagedError as error:
        raise InputError(f"{path} is damaged or of another version ({error}); run the study again") from None
    if not isinstance(study, ScoredStudy):
        raise InputError(f"{path} holds no scores of a study; run the study again")
    return study


PACKAGE = Path(__file__).resolve().parents[3]

_ABOVE = ("cli", "live", "lab/tuning", "lab/export", "lab/evaluation/report")
"""Folders of the package that no stage and no score imports. Changes there do not affect results."""

_LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "onnxruntime", "pymap3d", "av", "torch", "kornia")
_SETTLED_S = 2.0  # a file that was just written may be written again within one tick of its time stamp


@cache
def code_digest(backend: str) -> str:
    """Return the digest of everything besides the inputs that results depend on.

    It covers the files of the package, also data files; the versions of the libraries, of torch only if torch is the
    backend; and the processor's architecture. Machines with the same digest get the same results.
    """
    above = tuple(PACKAGE / folder for folder in _ABOVE)
    files = [path for path in sorted(PACKAGE.rglob("*")) if path.is_file() and path.suffix != ".pyc"]
    files = [path for path in files if not any(path.is_relative_to(folder) for folder in above)]
    content = {path.relative_to(PACKAGE).as_posix(): _file_digest(path) for path in files}
    libraries = {}
    for name in _LIBRARIES[: None if backend == "torch" else -2]:
        with suppress(PackageNotFoundError):
            libraries[name] = version(name)
    return digest(VERSION, content, libraries, platform.machine())


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_digest(paths: Sequence[Path], memory: Path | None = None) -> str:
    """Return the digest of the content of files, in order. Raise InputError if a file cannot be read.

    memory: folder that stores digests. Files whose sizes and times have not changed are not read again.
    """
    if not paths:
        return ""
    try:
        stats = [(path, path.stat()) for path in paths]
        marks = [(str(path.absolute()), s.st_size, s.st_mtime_ns, s.st_ctime_ns) for path, s in stats]
        place = None if memory is None else memory / f"{digest(marks)}.txt"
        if place is not None:
            with suppress(OSError):
                known = place.read_text(encoding="ascii", errors="replace").strip()
                if len(known) == 64:
                    return known
        found = digest([_file_digest(path) for path in paths])
    except OSError as error:
        raise InputError(f"{error.filename} cannot be read: {error.strerror}") from None
    if place is not None and all(time.time() - stat.st_mtime > _SETTLED_S for _, stat in stats):
        with suppress(OSError):  # only time is lost
            place.parent.mkdir(parents=True, exist_ok=True)
            write_whole(place, found.encode())
    return found
