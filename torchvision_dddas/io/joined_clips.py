"""Join several clips of one flight, with their logs, into one clip."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.sources import frame_times
from torchvision_dddas.types import COLUMNS_OF_TELEMETRY, Frame, Problem, Source, Telemetry, is_sampled

# A clip that begins within this time of the previous clip's end continues that clip: log clocks are inaccurate.
_SEAM_S = 2.0


class JoinedSource:
    """A Source of clips of one flight, in order. Frame numbers and times continue from clip to clip.

    If the logs of all clips give the time of day, in any zone, pauses between clips are kept.
    """

    def __init__(self, parts: Sequence[Source], logs: Sequence[Path] = ()) -> None:
        """logs: one log for all clips, or one for each. Raise InputError for clips of different sizes or rates."""
        self._parts, self._logs, first = parts, logs, parts[0]
        if len(logs) not in (0, 1, len(parts)):
            raise InputError(
                f"{len(parts)} clips and {len(logs)} logs; give one --telemetry for all clips, or one for each in order"
            )
        for part in parts:
            if part.size != first.size or abs(part.rate_hz / first.rate_hz - 1) > 0.1:
                (width, height), (wide, high) = part.size, first.size
                raise InputError(
                    f"{part.name} is {width}x{height} at {part.rate_hz:g} Hz, {first.name} {wide}x{high} at "
                    f"{first.rate_hz:g} Hz; clips of one run must be of one size and rate: run them one after another"
                )
        self.name, self.size, self.rate_hz = ", ".join(part.name for part in parts), first.size, first.rate_hz
        counts = [part.count for part in parts]
        self.count = None if None in counts else sum(count or 0 for count in counts)
        self.exact, self.last = all(part.exact for part in parts), 0
        self.problems: list[Problem] = []
        self.notes: list[str] = []
        self.concealed = 0
        lasting = [max(frame_times(part).values(), default=((part.count or 1) - 1) / part.rate_hz) for part in parts]
        self.starts_s = np.cumsum([0.0, *(last_s + 1 / first.rate_hz for last_s in lasting[:-1])])

    def __iter__(self) -> Iterator[Frame]:
        return self.every(1)

    def every(self, interval: int) -> Iterator[Frame]:
        """Yield frames 1, 1 + interval, ..."""
        self.problems, self.notes, self.concealed, before = [], [], 0, 0
        for part, start_s in zip(self._parts, self.starts_s.tolist(), strict=True):
            for frame in part:
                self.last = number = before + frame.number
                if is_sampled(number, interval):
                    yield replace(frame, number=number, time_s=start_s + frame.time_s)
            self.problems += [Problem(before + one.frame, f"{part.name}: {one.what}") for one in part.problems]
            self.notes += [f"{part.name}: {note}" for note in getattr(part, "notes", ())]
            self.concealed += getattr(part, "concealed", 0)
            self.last = before = before + part.last

    def read_logs(self, read: Callable[[Path, str], Telemetry]) -> Telemetry:
        """Join the logs. read: reads the log of a clip. Raise InputError if their clocks contradict the order."""
        logs = [read(path, part.name) for path, part in zip(self._logs, self._parts, strict=False)]
        clocks_s = np.array([[log.start_utc_s, log.start_local_s] for log in logs])
        is_known = np.isfinite(clocks_s).all(axis=0)
        if is_known.any():
            begun_s = clocks_s[:, is_known.argmax()] - clocks_s[0, is_known.argmax()]
            for k in range(1, len(logs)):
                early_s = self.starts_s[k] - begun_s[k]
                if early_s > _SEAM_S:
                    raise InputError(
                        f"{self._parts[k].name} begins {early_s:.1f} s before {self._parts[k - 1].name} ends, by the "
                        "clocks of their logs; give the clips in the order in which they were filmed"
                    )
                self.starts_s[k:] -= min(early_s, 0.0) * (early_s < -_SEAM_S)
        elif len(logs) > 1:
            note = "the logs have no clock in common: a pause between the clips, or a wrong order, is not noticed"
            logs = [replace(log, notes=(*log.notes, note)) for log in logs]
        return _joined(logs, self.starts_s)


def _joined(logs: Sequence[Telemetry], starts_s: np.ndarray) -> Telemetry:
    """Join logs. Cut each log to its clip. Values are unknown in a pause between two clips."""
    if len({log.geographic for log in logs}) > 1:
        raise InputError("some logs have longitudes and latitudes, others local metres; give all in one kind")
    pieces = list[dict[str, Any]]()
    for k, log in enumerate(logs):
        time_s, until_s = log.time_s + starts_s[k], starts_s[k + 1] if k + 1 < len(logs) else math.inf
        rows = (time_s < until_s) & ((time_s >= starts_s[k]) | (k == 0))
        piece = {"time_s": time_s[rows], **{name: getattr(log, name)[rows] for name in COLUMNS_OF_TELEMETRY}}
        ends_s = [*(pieces[-1]["time_s"][-1:] if pieces else ()), *piece["time_s"][:1]]
        if np.ptp(ends_s) > _SEAM_S:  # keep the last sample for a while, as at the end of a log
            held = {name: column[-1:] for name, column in pieces[-1].items()}
            unknown = {name: np.full_like(column, np.nan) for name, column in held.items()}
            pieces.append(held | {"time_s": held["time_s"] + _SEAM_S / 2})
            pieces.append(unknown | {"time_s": np.array(ends_s).mean(keepdims=True)})
        pieces.append(piece)
    columns: dict[str, Any] = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    of_all = set(logs[0].notes).intersection(*(log.notes for log in logs))
    notes = dict.fromkeys(note if note in of_all else f"{log.origin}: {note}" for log in logs for note in log.notes)
    return replace(logs[0], origin=", ".join(log.origin for log in logs), notes=tuple(notes), **columns)
