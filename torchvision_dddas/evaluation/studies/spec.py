"""What a study asks for: its data sets, tasks and settings, and the TOML file that says so."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torchvision_dddas.config import read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets import kinds
from torchvision_dddas.evaluation.datasets.record import Source

Task = Literal["motion", "tracking", "association", "people", "location"]

TASKS: Mapping[Task, str] = {
    "motion": "what moves in the clip's pictures, against masks, boxes or one target; in a still clip all is false",
    "tracking": "identities of what was found, or of the data set's own detections, against true tracks",
    "association": "identities of the true boxes, at each interval-th frame, against the true identities",
    "people": "persons in each picture, against true boxes",
    "location": "places on the ground, in metres, against the true ones",
}

BACKENDS = ("auto", "torch", "onboard")

_KEYS = ("name", "tasks", "config", "set", "backend", "interval", "dataset")
_NAME = re.compile(r"[\w][\w .+-]{0,99}")


@dataclass(frozen=True)
class Spec:
    """A study. tasks: empty for all that each clip allows. config, overrides: as --config and --set."""

    name: str
    sources: tuple[Source, ...]
    tasks: tuple[Task, ...] = ()
    config: str | None = None
    overrides: tuple[str, ...] = ()
    backend: str = "auto"
    interval: int = 1


def read_spec(path: Path) -> Spec:
    """Read a study's TOML file. Folders of data sets stay relative to the file's own folder.

    Raises InputError with one line for an unreadable file, an unknown or missing key, or a bad value.
    """
    content = read_toml(path, "study")
    where = f"study {path}"
    if unknown := [key for key in content if key not in _KEYS]:
        raise InputError(f"{where} has no key '{unknown[0]}'; wanted {', '.join(_KEYS)}")
    name = _text(content, "name", where, path.stem)
    if not _NAME.fullmatch(name):
        raise InputError(f"{where}: name must consist of letters, digits, blanks, and . + - _, got {name!r}")
    tasks = _texts(content, "tasks", where)
    if unknown := [task for task in tasks if task not in TASKS]:
        raise InputError(f"{where}: tasks must be some of {', '.join(TASKS)}, got '{unknown[0]}'")
    backend = _text(content, "backend", where, "auto")
    if backend not in BACKENDS:
        raise InputError(f"{where}: backend must be one of {', '.join(BACKENDS)}, got '{backend}'")
    interval = content.get("interval", 1)
    if type(interval) is not int or not 1 <= interval <= 1000:
        raise InputError(f"{where}: interval must be a whole number of frames from 1 to 1000, got {interval!r}")
    tables = content.get("dataset", [])
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{where} names no data set; wanted [[dataset]] with kind and folder, once or more")
    return Spec(
        name,
        tuple(_source(table, f"{where}, data set {k}") for k, table in enumerate(tables, 1)),
        tuple(task for task in TASKS if task in tasks),
        _text(content, "config", where, "") or None,
        tuple(_texts(content, "set", where)),
        backend,
        interval,
    )


def _source(table: Mapping[str, Any], where: str) -> Source:
    for key in ("kind", "folder"):
        if not _text(table, key, where, ""):
            raise InputError(f"{where} has no {key}; wanted kind = one of {', '.join(kinds.KINDS)}, and folder")
    try:
        kinds.check_kind(table["kind"])
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    patterns = tuple(_texts(table, "clips", where)) if "clips" in table else ("*",)
    if not patterns:
        raise InputError(f'{where}: clips is empty; wanted patterns of names, as clips = ["cars*"], or leave it out')
    options = {key: value for key, value in table.items() if key not in ("kind", "folder", "clips")}
    return Source(table["kind"], Path(table["folder"]), patterns, options)


def _text(table: Mapping[str, Any], key: str, where: str, default: str) -> str:
    value = table.get(key, default)
    if not isinstance(value, str):
        raise InputError(f"{where}: {key} must be a text, got {value!r}")
    return value


def _texts(table: Mapping[str, Any], key: str, where: str) -> list[str]:
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise InputError(f"{where}: {key} must be a list of texts, got {value!r}")
    return value
