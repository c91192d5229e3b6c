"""The state of a descent on disk, whole or not at all, and whether it is that of the descent that is asked for."""

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from torchvision_dddas.config import changes
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, save_file
from torchvision_dddas.tuning.family import Family, loss_of
from torchvision_dddas.tuning.parameters import Parameters

FORMAT = 3


def facts(
    family: Family, parameters: Parameters, plan: Mapping[str, Any], seen: Sequence[str], cost: object
) -> dict[str, Any]:
    """What a descent depends on, in words and numbers. seen: its examples, in order."""
    return {
        "family": family.name,
        "task": family.task,
        "interval": getattr(family, "interval", 1),
        "loss": loss_of(family),
        "knobs": ", ".join(parameters.names),
        "settings": json.dumps(changes(parameters.base), default=str),
        **plan,
        "examples": hashlib.sha256("\n".join(seen).encode()).hexdigest()[:16],
        "cost": "" if cost is None else repr(cost),
    }


def write(place: Path, asked: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Write a state. Raises InputError where the disk refuses."""
    content = io.BytesIO()
    torch.save({"format": FORMAT, "asked": dict(asked), "state": dict(state)}, content)
    save_file(place, content.getvalue())


def read(place: Path, asked: Mapping[str, Any]) -> dict[str, Any]:
    """The state. Raises InputError where the file is none, or is of a descent that was asked for otherwise."""
    try:
        # No code is run: a checkpoint is tensors, numbers and words.
        found = torch.load(place, weights_only=True, map_location="cpu")
        told, state = dict(found["asked"]), dict(found["state"])
        form = found["format"]
    except OSError as error:
        raise InputError(f"{place} cannot be read: {error.strerror}") from None
    except Exception:  # of bytes that are no checkpoint torch's reader raises nearly anything
        raise InputError(f"{place} is no checkpoint, or is damaged; begin again without --resume") from None
    if form != FORMAT:
        raise InputError(f"{place} is a checkpoint of another version; begin again without --resume")
    for name, value in asked.items():
        if told.get(name) != value:
            raise InputError(
                f"{place} is of a descent with other {name.replace('_', ' ')}, {_short(told.get(name))} and not "
                f"{_short(value)}; ask for the same, or begin again without --resume"
            )
    return state


def set_aside(place: Path, aside: Path, more: Mapping[Path, Path] = MappingProxyType({})) -> int:
    """Keep a checkpoint that a new descent would overwrite; how many steps it took, 0 where nothing is kept.

    Kept is what could still be gone on with: a descent that did not come to its end, of more steps than one that lies
    there already. more: files that belong to it, and where to, as far as they are there. Raises InputError where the
    disk refuses.
    """
    steps = _unfinished(place)
    if steps == 0 or steps < _unfinished(aside):
        return 0
    for here, there in {**more, place: aside}.items():
        try:
            if here.is_file():
                here.replace(there)
        except OSError as error:
            raise cannot_write(there, error) from error
    return steps


def _unfinished(place: Path) -> int:
    """Steps of a descent that did not come to its end; 0 where there is none that can be read."""
    try:
        state = torch.load(place, weights_only=True, map_location="cpu")["state"]
        return 0 if state["ended"] or state["failed"] else int(state["history"][-1]["step"])
    except Exception:  # as above: what cannot be read cannot be gone on with
        return 0


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 80 else f"{text[:79]}…"
