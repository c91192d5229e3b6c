"""run.json (input, settings, versions, counts, problems and times of a run), and the log of a live session."""

import json
import math
import os
import platform
import re
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError, readable, without_secrets
from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.io.maps.ground_tracks import iso_utc
from torchvision_dddas.io.output.scale_record import ScaleRecord
from torchvision_dddas.runtime import VERSION
from torchvision_dddas.types import Adjustment, Source

RUN_JSON = "run.json"
NONE_LOCATED = "0 located, because "
"""Beginning of the note that explains why a run has no position."""
NO_POSE = "the camera's pose is unknown"
"""The cause of a frame that is not located, if no other cause is known."""
_STEP = math.log(1.01)
_NUMBER = re.compile(r"\d+(\.\d+)?")


class Durations:
    """Total and median of a stage's times. Times are counted in bins of 1 % width, so that memory stays constant."""

    def __init__(self) -> None:
        self.total_s = 0.0
        self._bins: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Add a time."""
        self.total_s += seconds
        self._bins[round(math.log(max(seconds, 1e-9)) / _STEP)] += 1

    @property
    def median_s(self) -> float:
        """The median with a precision of 1 %; 0 without any time."""
        bins = sorted(self._bins)
        if not bins:
            return 0.0
        count = np.cumsum([self._bins[place] for place in bins])
        return math.exp(bins[int(np.searchsorted(count, (count[-1] + 1) // 2))] * _STEP)


def without_numbers(text: str) -> str:
    """Replace each number in a text by #."""
    return _NUMBER.sub("#", text)


class Spans:
    """Remarks on frames. The same remark on successive frames is one row, with the first and the last frame.

    is_exact: whether remarks with different numbers are different remarks.
    """

    def __init__(self, is_exact: bool = False) -> None:
        self.rows: list[dict[str, Any]] = []
        self._is_exact = is_exact
        self._open: dict[str, dict[str, Any]] = {}

    def add(self, frame: int, before: int, text: str, **cells: Any) -> None:
        """Add a remark on a frame, or extend the row of an equal remark on the frame before it.

        before: the number of the frame before this frame. cells: further columns of the row.
        """
        key = text if self._is_exact else without_numbers(f"{text} {cells}")
        row = self._open.get(key)
        if row is not None and row["last"] in (before, frame):
            row["last"] = frame
        else:
            self._open[key] = row = {"first": frame, "last": frame, **cells, "cause": text}
            self.rows.append(row)


def describe_nothing_located(causes: Mapping[str, int], unplaced: int) -> str:
    """Return why a run that locates targets has no position.

    causes: causes of frames that were not located, with counts. unplaced: targets without a place in the other frames.
    """
    if unplaced:
        reason = (
            "all targets lie above the horizon or off the known ground, or their distance is uncertain by more than "
            "a fifth, as near the horizon or from a low vehicle"
        )
    elif causes:
        first = sorted(causes, key=lambda cause: -causes[cause])[:3]
        reason = first[0] if len(causes) == 1 else "; ".join(f"{cause} ({causes[cause]} frames)" for cause in first)
    else:
        reason = "no target was found"
    return f"{NONE_LOCATED}{reason}"


class AdjustmentList:
    """The first adjustments of each parameter, as listed in run.json, and the number of all adjustments.

    rows: one dictionary per adjustment. made: number of adjustments of each parameter.
    """

    def __init__(self, most: int = 1000) -> None:
        """most: largest number of listed adjustments of a parameter; further adjustments are only counted."""
        self.rows: list[dict[str, Any]] = []
        self.made: Counter[str] = Counter()
        self._most = most

    def add(self, adjustments: Sequence[Adjustment]) -> list[Adjustment]:
        """Count adjustments, and return those that are listed."""
        listed = []
        for a in adjustments:
            self.made[a.parameter] += 1
            if self.made[a.parameter] <= self._most:
                self.rows.append({"frame": a.frame, "knob": a.parameter, "old": a.old, "new": a.new, "cause": a.cause})
                listed.append(a)
        return listed


class RunRecord:
    """Collects the facts of a run. run.json says `running` from the first frame on, so that a killed run is visible.

    counts: further counts of a command beside frames and targets. scale: only for a run that detects movers.
    notes: notes for the user. has_begun: whether run.json belongs to this run.
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        """facts: facts known before the run, such as input, backend, settings and outputs."""
        self.facts = {name: without_secrets(v) if isinstance(v, str) else v for name, v in facts.items()}
        self._path = folder / RUN_JSON
        self._begun = time.perf_counter()
        self._stages: dict[str, Durations] = {}
        self.frames = self.targets = self.unreliable_frames = 0
        self.adjustments = AdjustmentList()
        self.unreliable = Spans(is_exact=True)
        self.problems: list[str] = []
        self.notes: list[str] = []
        self.counts: dict[str, Any] = {}
        self.scale: ScaleRecord | None = None
        self.last_frame = 0
        self.has_begun = False

    @property
    def input_name(self) -> str:
        """The name of the clips or the table, without folders; empty if unknown."""
        given = self.facts.get("input", "")
        names = given if isinstance(given, list) else [given]
        return readable(", ".join(Path(str(name)).name for name in names))

    def note(
        self,
        number: int,
        targets: int,
        seconds: Mapping[str, float],
        adjustments: Sequence[Adjustment] = (),
        cause: str | None = None,
    ) -> None:
        """Count a frame. cause: why the frame has no reliable result; None if it has one."""
        self.frames += 1
        self.targets += targets
        for stage, spent in seconds.items():
            self._stages.setdefault(stage, Durations()).add(spent)
        self.adjustments.add(adjustments)
        if self.scale is not None:
            self.scale.add(adjustments)
        if cause is not None:
            self.unreliable_frames += 1
            self.unreliable.add(number, self.last_frame, cause)
        self.last_frame = number

    def begin(self) -> None:
        """Write that the run is in progress."""
        self._save("running")
        self.has_begun = True

    def close(self, complete: bool) -> None:
        """Write the whole record."""
        self._save("complete" if complete else "interrupted")

    def discard(self) -> None:
        """Write that the run failed, if the run had begun."""
        if self.has_begun:
            with suppress(OSError):  # on failure, run.json still says `running`
                self._save("failed")

    def _save(self, state: str) -> None:
        stages = {
            stage: {"total": round(t.total_s, 4), "median": float(f"{t.median_s:.3g}")}
            for stage, t in self._stages.items()
        }
        record = {
            "interrupted": state == "interrupted",
            **self.facts,
            "frames": {"written": self.frames, "unreliable": self.unreliable_frames},
            "targets": self.targets,
            **self.counts,
            **({} if self.scale is None else {"scale": self.scale.facts()}),
            "notes": self.notes,
            "ok": not self.problems,
            "problems": self.problems,
            "unreliable": self.unreliable.rows,
            "adjustments": self.adjustments.rows,
            "adjustments_made": dict(self.adjustments.made),
            "seconds": {"wall": round(time.perf_counter() - self._begun, 3), "stages": stages},
        }
        write_run_record(self._path, state, record)


def write_run_record(path: Path, state: str, record: Mapping[str, Any]) -> None:
    """Replace run.json. state: running, complete, interrupted, stopped or failed. Raise OSError if that fails."""
    content = finite({"state": state, "versions": versions(), **record})
    write_whole(path, (json.dumps(content, indent=2) + "\n").encode())


def read_run_record(folder: Path) -> dict[str, Any] | None:
    """Return the content of run.json in a folder; None unless dddas wrote it."""
    try:
        record = json.loads((folder / RUN_JSON).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    versions = record.get("versions") if isinstance(record, dict) else None
    return record if isinstance(versions, dict) and "torchvision_dddas" in versions else None


def clip_facts(source: Source) -> dict[str, Any]:
    """Return the description of a clip for run.json."""
    return {"name": source.name, "size": source.size, "rate_hz": source.rate_hz, "announced_frames": source.count}


def finite(value: Any) -> Any:
    """Convert a value for JSON: numbers that are not finite become null, unknown types become text.

    Passwords are removed from texts, and the texts can be encoded as UTF-8.
    """
    if isinstance(value, dict):
        return {readable(str(k)): finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [finite(v) for v in value]
    if isinstance(value, str):
        return readable(without_secrets(value))
    if value is None or isinstance(value, (bool, int)):
        return value
    if hasattr(value, "item"):
        return finite(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return finite(str(value))


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python, and of the libraries that the run has loaded."""
    found = {"torchvision_dddas": VERSION, "python": platform.python_version(), "machine": platform.machine()}
    for name in ("numpy", "scipy", "cv2", "torch", "kornia", "onnxruntime", "av"):
        if version := getattr(sys.modules.get(name), "__version__", None):
            found[name] = str(version)
    return found


# --------------------------------------------------------------------------------------------------------------------
# The folder of one live session. Folders of earlier sessions are not changed. The files are valid at every moment:
# results.jsonl gets a line per frame, events.log gets a line per event, and run.json is replaced as a whole.

RESULTS, EVENTS = "results.jsonl", "events.log"


@dataclass(frozen=True)
class Event:
    """An event of a session. utc_s: seconds since 1970. frame: 0 if no frame belongs to the event. kind: one word."""

    utc_s: float
    frame: int
    kind: str
    text: str


def make_session_folder(out: Path, utc_s: float | None = None) -> Path:
    """Make a new folder out/<UTC start> such as 2026-03-01T120000Z. Raise InputError if that fails."""
    name = datetime.fromtimestamp(time.time() if utc_s is None else utc_s, UTC).strftime("%Y-%m-%dT%H%M%SZ")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for k in range(1, 1000):
            folder = out / (name if k == 1 else f"{name}-{k}")
            try:
                folder.mkdir()
            except FileExistsError:  # a supervisor may start two sessions within a second
                continue
            return folder
    except OSError as error:
        raise InputError(
            f"cannot write into {out}: {error.strerror or error}. Choose another folder with --out"
        ) from None
    raise InputError(f"{out} holds a thousand sessions that began at {name}; choose another folder with --out")


class SessionLog:
    """Writes events.log and run.json of a session. After OSError, as on a full disk, a method may be called again."""

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        """facts: entries of run.json that are known at the start."""
        self.folder, self.facts = folder, facts
        self._events = -1

    def append(self, events: Sequence[Event]) -> None:
        """Append one line per event: UTC time, frame or -, kind, text."""
        if self._events < 0:
            self._events = os.open(self.folder / EVENTS, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
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
            with suppress(OSError):  # remove an incomplete line; the line is written again later
                os.ftruncate(self._events, size)
            raise

    def write_state(self, state: str, now: dict[str, Any]) -> None:
        """Replace run.json. state: running, complete, stopped or failed."""
        write_run_record(self.folder / RUN_JSON, state, {**self.facts, **now})

    def close(self) -> None:
        """Close events.log."""
        if self._events >= 0:
            os.close(self._events)
