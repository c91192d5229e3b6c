"""The folder of one live session. Earlier sessions stay as they are, and its files are valid at every moment.

results.jsonl grows by a line per frame, events.log by a line per event; run.json is replaced whole.
"""

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.maps.ground_tracks import iso_utc
from torchvision_dddas.io.output.run_record import RUN_JSON, write_run_record

RESULTS, EVENTS = "results.jsonl", "events.log"


@dataclass(frozen=True)
class Event:
    """Something that happened. utc_s: seconds since 1970. frame: 0 if it belongs to none. kind: one word."""

    utc_s: float
    frame: int
    kind: str
    text: str


def make_session_folder(out: Path, utc_s: float | None = None) -> Path:
    """Make a new folder out/<UTC start> such as 2026-03-01T120000Z. Raises InputError if none can be made."""
    name = datetime.fromtimestamp(time.time() if utc_s is None else utc_s, UTC).strftime("%Y-%m-%dT%H%M%SZ")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for k in range(1, 1000):
            folder = out / (name if k == 1 else f"{name}-{k}")
            try:
                folder.mkdir()
            except FileExistsError:  # a supervisor may start it twice within a second
                continue
            return folder
    except OSError as error:
        raise InputError(
            f"cannot write into {out}: {error.strerror or error}. Choose another folder with --out"
        ) from None
    raise InputError(f"{out} holds a thousand sessions that began at {name}; choose another folder with --out")


class SessionLog:
    """events.log and run.json of a session. A method that raises OSError, as on a full disk, may be called again."""

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        """facts: what run.json says of the run from its start."""
        self.folder, self.facts = folder, facts
        self._events = os.open(folder / EVENTS, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)

    def append(self, events: Sequence[Event]) -> None:
        """Append events, a line each: UTC time, frame or -, kind, text."""
        stamps = iso_utc(np.array([event.utc_s for event in events]))
        lines = "".join(
            f"{stamp} {e.frame or '-'} {e.kind}: {' '.join(e.text.split())}\n"
            for stamp, e in zip(stamps, events, strict=True)
        )
        size, rest = os.fstat(self._events).st_size, lines.encode()
        try:
            while rest:
                rest = rest[os.write(self._events, rest) :]
        except OSError:
            with suppress(OSError):  # a line that a full disk broke off is written again whole
                os.ftruncate(self._events, size)
            raise

    def write_state(self, state: str, now: dict[str, Any]) -> None:
        """Replace run.json. state: running, complete, stopped or failed."""
        write_run_record(self.folder / RUN_JSON, state, {**self.facts, **now})

    def close(self) -> None:
        """Close events.log."""
        os.close(self._events)
