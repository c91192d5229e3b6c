"""The TOML file of a study, read and checked."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from torchvision_dddas.config import read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets import kinds
from torchvision_dddas.evaluation.studies.record import TASKS, Source, Spec, Task

KEYS = ("name", "tasks", "config", "set", "backend", "interval", "dataset")
BACKENDS = ("auto", "torch", "onboard")
NAME = re.compile(r"[\w][\w .+-]{0,99}")


def read_spec(path: Path) -> Spec:
    """A study's file: folders stay as they stand there, relative to the file's own folder.

    Raises InputError with one line: unreadable, a key that is unknown or lacks, a value that will not do, an unknown
    kind of data set.
    """
    said = read_toml(path, "study")
    where = f"study {path}"
    _known(said, KEYS, where)
    name = _text(said, "name", where, path.stem)
    if not NAME.fullmatch(name):
        raise InputError(f"{where}: name = {name!r} will not do; wanted letters, digits, blanks, and . + - _")
    tasks = _texts(said, "tasks", where)
    if strange := [task for task in tasks if task not in TASKS]:
        raise InputError(f"{where}: '{strange[0]}' is no task; wanted some of {', '.join(TASKS)}")
    backend = _text(said, "backend", where, "auto")
    if backend not in BACKENDS:
        raise InputError(f"{where}: backend = '{backend}' will not do; wanted one of {', '.join(BACKENDS)}")
    interval = said.get("interval", 1)
    if not isinstance(interval, int) or isinstance(interval, bool) or not 1 <= interval <= 1000:
        raise InputError(f"{where}: interval = {interval!r} will not do; wanted a whole number of frames, 1 to 1000")
    tables = said.get("dataset", [])
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{where} names no data set; wanted [[dataset]] with kind and folder, once or more")
    sources = tuple(_source(table, f"{where}, data set {k}") for k, table in enumerate(tables, 1))
    config = _text(said, "config", where, "") or None
    chosen: tuple[Task, ...] = tuple(task for task in get_args(Task) if task in tasks)
    return Spec(name, sources, chosen, config, tuple(_texts(said, "set", where)), backend, interval)


def _source(table: Mapping[str, Any], where: str) -> Source:
    for key in ("kind", "folder"):
        if key not in table:
            raise InputError(f"{where} has no {key}; wanted kind = one of {', '.join(kinds.KINDS)}, and folder")
    kind, folder = _text(table, "kind", where, ""), _text(table, "folder", where, "")
    try:
        kinds.known(kind)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    if not folder:
        raise InputError(f"{where}: folder is empty; wanted where the data set lies")
    patterns = tuple(_texts(table, "clips", where)) if "clips" in table else ("*",)
    if not patterns:
        raise InputError(f'{where}: clips is empty; wanted patterns of names, as clips = ["cars*"], or leave it out')
    options = {key: value for key, value in table.items() if key not in ("kind", "folder", "clips")}
    return Source(kind, Path(folder), patterns, options)


def _known(table: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    if strange := [key for key in table if key not in keys]:
        raise InputError(f"{where} has no key '{strange[0]}'; wanted {', '.join(keys)}")


def _text(table: Mapping[str, Any], key: str, where: str, default: str) -> str:
    value = table.get(key, default)
    if not isinstance(value, str):
        raise InputError(f"{where}: {key} = {value!r} will not do; wanted a text")
    return value


def _texts(table: Mapping[str, Any], key: str, where: str) -> list[str]:
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise InputError(f"{where}: {key} = {value!r} will not do; wanted a list of texts")
    return value
