"""Records as bytes and back: numbers as .npz, the rest as JSON, a digest before it all; nothing in it can be run."""

import dataclasses
import hashlib
import importlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

_HOME = "torchvision_dddas."
_PLAIN = (str, int, float, bool, type(None))
_CONTENT = "content"


class DamagedError(ValueError):
    """The bytes are not those that were stored."""


def packed(record: Any) -> bytes:
    """A record of this package, frozen or a NamedTuple, of numbers, texts, bytes, paths, arrays, tuples and mappings.

    Raises TypeError for anything else.
    """
    arrays: dict[str, np.ndarray] = {}
    content = json.dumps(_plain(record, arrays), ensure_ascii=True)
    arrays[_CONTENT] = np.frombuffer(content.encode("ascii"), np.uint8)
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    body = file.getvalue()
    return hashlib.sha256(body).digest() + body


def whole(content: bytes) -> bool:
    """Whether bytes are as they were stored."""
    return hashlib.sha256(memoryview(content)[32:]).digest() == content[:32]


def unpacked(content: bytes) -> Any:
    """The record of such bytes. Raises DamagedError where they are not whole, or of no record that there is."""
    if not whole(content):
        raise DamagedError("its digest is another")
    try:
        with np.load(io.BytesIO(content[32:]), allow_pickle=False) as arrays:
            return _record(json.loads(arrays[_CONTENT].tobytes()), arrays)
    except (ValueError, KeyError, TypeError, AttributeError, ImportError, zipfile.BadZipFile) as error:
        raise DamagedError(f"{type(error).__name__}: {error}") from error


def _plain(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bytes):
        return {"bytes": _kept(np.frombuffer(value, np.uint8), arrays)}
    if isinstance(value, np.ndarray):
        return {"array": _kept(value, arrays)}
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, Mapping):
        return {"map": [[_plain(k, arrays), _plain(v, arrays)] for k, v in value.items()]}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return {"of": _name(value), "fields": {name: _plain(getattr(value, name), arrays) for name in names}}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {"of": _name(value), "fields": {k: _plain(v, arrays) for k, v in value._asdict().items()}}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_plain(v, arrays) for v in value]}
    if type(value) in _PLAIN:
        return value
    raise TypeError(f"a {type(value).__name__} cannot be stored")


def _kept(array: np.ndarray, arrays: dict[str, np.ndarray]) -> str:
    name = f"a{len(arrays)}"
    arrays[name] = array
    return name


def _name(value: Any) -> str:
    kind = type(value)
    if not kind.__module__.startswith(_HOME):
        raise TypeError(f"a {kind.__module__}.{kind.__name__} cannot be stored")
    return f"{kind.__module__}:{kind.__name__}"


def _record(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(value, dict):
        return value
    if "of" in value:
        fields = {name: _record(v, arrays) for name, v in value["fields"].items()}
        return _kind(value["of"])(**fields)
    ((what, inner),) = value.items()
    if what == "bytes":
        return arrays[inner].tobytes()
    if what == "array":
        return arrays[inner]
    if what == "path":
        return Path(inner)
    if what == "map":
        return {_record(k, arrays): _record(v, arrays) for k, v in inner}
    items = [_record(v, arrays) for v in inner]
    return tuple(items) if what == "tuple" else items


def _kind(name: str) -> type:
    """The class that is named so, of this package alone, and one that only holds fields."""
    module, _, own = name.partition(":")
    if not module.startswith(_HOME):
        raise DamagedError(f"{name} is no record of this package")
    found = getattr(importlib.import_module(module), own)
    if not isinstance(found, type) or not (dataclasses.is_dataclass(found) or hasattr(found, "_fields")):
        raise DamagedError(f"{name} is no record of this package")
    return found
