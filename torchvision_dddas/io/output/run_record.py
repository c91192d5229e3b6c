"""run.json: what was run, with which settings and versions, what happened, how long it took, what moved and why."""

import json
import math
import platform
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from torchvision_dddas import __version__
from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.types import Adjustment, Scene

NAME = "run.json"
_STEP = math.log(1.01)


class Durations:
    """Total and median of a stage's times, in memory that does not grow: counts in bins 1 % wide."""

    def __init__(self) -> None:
        self.total_s = 0.0
        self._bins: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Count one more time."""
        self.total_s += seconds
        self._bins[round(math.log(max(seconds, 1e-9)) / _STEP)] += 1

    @property
    def median_s(self) -> float:
        """The median, to 1 %; 0 without any time."""
        left = (sum(self._bins.values()) + 1) // 2
        for place in sorted(self._bins):
            left -= self._bins[place]
            if left <= 0:
                return math.exp(place * _STEP)
        return 0.0


class Record:
    """Collects the facts of a run. The file says `running` from the first frame on, so that a killed run shows.

    counts: what a command wants to say beside the frames and targets. notes: what the user should know of the run.
    """

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        """Start a journal; facts are the things known before the run: input, backend, settings, outputs."""
        self._path = folder / NAME
        self._facts = facts
        self._begun = time.perf_counter()
        self._stages: dict[str, Durations] = {}
        self._unreliable: list[dict[str, Any]] = []
        self._adjustments: list[dict[str, Any]] = []
        self.frames = self.targets = self.unreliable_frames = 0
        self.problems: list[str] = []
        self.notes: list[str] = []
        self.counts: dict[str, Any] = {}
        self._last = 0  # number of the frame noted last

    def note(
        self,
        number: int,
        targets: int,
        seconds: Mapping[str, float],
        adjustments: Sequence[Adjustment] = (),
        cause: str | None = None,
    ) -> None:
        """Take note of a frame. cause: why nothing could be concluded from it; None where all is well."""
        if self.frames == 0:
            self._save("running")
        self.frames += 1
        self.targets += targets
        for stage, spent in seconds.items():
            self._stages.setdefault(stage, Durations()).add(spent)
        self._adjustments += [
            {"frame": a.frame, "knob": a.parameter, "old": a.old, "new": a.new, "cause": a.cause} for a in adjustments
        ]
        if cause is not None:
            self.unreliable_frames += 1
            last = self._unreliable[-1] if self._unreliable else None
            if last and last["last"] == self._last and last["cause"] == cause:
                last["last"] = number
            else:
                self._unreliable.append({"first": number, "last": number, "cause": cause})
        self._last = number

    def close(self, complete: bool) -> None:
        """Write the whole record."""
        self._save("complete" if complete else "interrupted")

    def discard(self) -> None:
        """Say that the run failed, if it had begun."""
        if self.frames:
            with suppress(OSError):  # the file that says `running` stays, which is true enough
                self._save("failed")

    def _save(self, state: str) -> None:
        seconds = time.perf_counter() - self._begun
        record = {
            "state": state,
            "interrupted": state == "interrupted",
            "versions": versions(),
            **self._facts,
            "frames": {"written": self.frames, "unreliable": self.unreliable_frames},
            "targets": self.targets,
            **self.counts,
            "notes": list(self.notes),
            "problems": list(self.problems),
            "unreliable": self._unreliable,
            "adjustments": self._adjustments,
            "seconds": {
                "wall": round(seconds, 3),
                "stages": {
                    stage: {"total": round(t.total_s, 4), "median": float(f"{t.median_s:.3g}")}
                    for stage, t in self._stages.items()
                },
            },
        }
        write_whole(self._path, (json.dumps(finite(record), indent=2) + "\n").encode())


class Journal(Record):
    """The record of a run that gives scenes."""

    def write(self, scene: Scene) -> None:
        """Take note of a scene."""
        cause = None if scene.reliable else scene.cause
        self.note(scene.frame.number, len(scene.detections), scene.seconds, scene.adjustments, cause)


def finite(value: Any) -> Any:
    """The same record for JSON: numbers it cannot hold become null, and what it does not know becomes text."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [finite(v) for v in value]
    if isinstance(value, bool) or value is None or isinstance(value, (str, int)):
        return value
    if hasattr(value, "item"):
        return finite(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value)


def versions() -> dict[str, str]:
    """Versions of this package, of Python, and of those libraries that the run has loaded."""
    found = {"torchvision_dddas": __version__, "python": platform.python_version(), "machine": platform.machine()}
    for name in ("numpy", "scipy", "cv2", "torch", "kornia", "onnxruntime", "av"):
        version = getattr(sys.modules.get(name), "__version__", None)
        if version:
            found[name] = str(version)
    return found


def read(folder: Path) -> dict[str, Any] | None:
    """The record of an earlier run in a folder; None if there is none, or none of ours."""
    try:
        record = json.loads((folder / NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    versions = record.get("versions") if isinstance(record, dict) else None
    return record if isinstance(versions, dict) and "torchvision_dddas" in versions else None
