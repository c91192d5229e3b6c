"""The state of a descent on disk, with the facts it depends on, so that only the same descent is resumed."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, save_file

FORMAT = 4


def write_checkpoint(place: Path, asked: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Write a checkpoint. asked: facts that the descent depends on, by name. Raise InputError if the disk refuses."""
    content = io.BytesIO()
    torch.save({"format": FORMAT, "asked": dict(asked), "state": dict(state)}, content)
    save_file(place, content.getvalue())


def read_checkpoint(place: Path, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Read the state. Raise InputError if the file is not a checkpoint, or is of a descent with other facts."""
    try:
        found = _load(place)
        written, state, form = dict(found["asked"]), dict(found["state"]), found["format"]
    except OSError as error:
        raise InputError(f"{place} cannot be read: {error.strerror}") from None
    except Exception:  # torch's reader may raise any error for bytes that are not a checkpoint
        raise InputError(f"{place} is not a checkpoint, or is damaged; begin again without --resume") from None
    if form != FORMAT:
        raise InputError(f"{place} is a checkpoint of another version; begin again without --resume")
    for name, value in asked.items():
        if written.get(name) != value:
            held, wanted = (
                text if len(text) <= 80 else f"{text[:79]}…" for text in (str(written.get(name)), str(value))
            )
            raise InputError(
                f"{place} is of a descent with other {name.replace('_', ' ')}, {held} instead of {wanted}; give the "
                "same, or begin again without --resume"
            )
    return state


def set_aside(place: Path, aside: Path) -> int:
    """Keep an unfinished checkpoint that a new descent would overwrite; return its steps, 0 if none was kept.

    A checkpoint with more steps that is already at `aside` stays there. Raise InputError if the disk refuses.
    """
    steps = _unfinished_steps(place)
    if steps == 0 or steps < _unfinished_steps(aside):
        return 0
    try:
        place.replace(aside)
    except OSError as error:
        raise cannot_write(aside, error) from error
    return steps


def _unfinished_steps(place: Path) -> int:
    try:
        state = _load(place)["state"]
        return 0 if state["ended"] or state["failed"] else int(state["history"][-1]["step"])
    except Exception:  # an unreadable file cannot be resumed
        return 0


def _load(place: Path) -> Any:
    # weights_only: a checkpoint holds only tensors, numbers and texts, so that loading it runs no code.
    return torch.load(place, weights_only=True, map_location="cpu")
