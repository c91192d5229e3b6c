"""run.json: what was run, with which settings and versions, what happened, how long it took, what moved and why."""

import json
import math
import platform
import re
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.io.overlay.layers import LIKELY
from torchvision_dddas.runtime import VERSION
from torchvision_dddas.types import (
    Adjustment,
    AerialLocations,
    Confirmation,
    GroundLocations,
    PeopleFrame,
    Scene,
    Source,
    TrackedFrame,
)

RUN_JSON = "run.json"
NO_POSE = "nothing told where the camera was"
"""The cause of a frame that is not located and says nothing of why."""
_STEP = math.log(1.01)
_NUMBER = re.compile(r"\d+(\.\d+)?")


class Durations:
    """Total and median of a stage's times, in fixed memory: counts in bins 1 % wide."""

    def __init__(self) -> None:
        self.total_s = 0.0
        self._bins: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Add a time."""
        self.total_s += seconds
        self._bins[round(math.log(max(seconds, 1e-9)) / _STEP)] += 1

    @property
    def median_s(self) -> float:
        """The median to 1 %; 0 without any time."""
        left = (sum(self._bins.values()) + 1) // 2
        for place in sorted(self._bins):
            left -= self._bins[place]
            if left <= 0:
                return math.exp(place * _STEP)
        return 0.0


class Spans:
    """Remarks on frames. The same remark on successive frames is one row, with the first and the last of them.

    is_exact: whether remarks with different numbers are different remarks.
    """

    def __init__(self, is_exact: bool = False) -> None:
        self.rows: list[dict[str, Any]] = []
        self._is_exact = is_exact
        self._open: dict[str, dict[str, Any]] = {}

    def add(self, frame: int, before: int, text: str, **more: Any) -> None:
        """Add a remark on a frame. before: the number of the frame that came before it. more: further cells."""
        key = text if self._is_exact else _NUMBER.sub("0", f"{text} {more}")
        row = self._open.get(key)
        if row is not None and row["last"] in (before, frame):
            row["last"] = frame
        else:
            self._open[key] = row = {"first": frame, "last": frame, **more, "cause": text}
            self.rows.append(row)


class RunRecord:
    """Collects the facts of a run. run.json says `running` from the first frame on, so that a killed run shows.

    counts: what a command counts beside frames and targets. notes: what the user should know of the run.
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        """facts: what is known before the run, such as input, backend, settings and outputs."""
        self.facts = dict(facts)
        self._path = folder / RUN_JSON
        self._begun = time.perf_counter()
        self._stages: dict[str, Durations] = {}
        self.frames = self.targets = self.unreliable_frames = 0
        self.adjustments: list[dict[str, Any]] = []
        self.unreliable = Spans(is_exact=True)
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
        """Count a frame. cause: why nothing could be concluded from it; None where all is well."""
        if self.frames == 0:
            self._save("running")
        self.frames += 1
        self.targets += targets
        for stage, spent in seconds.items():
            self._stages.setdefault(stage, Durations()).add(spent)
        self.adjustments += [
            {"frame": a.frame, "knob": a.parameter, "old": a.old, "new": a.new, "cause": a.cause} for a in adjustments
        ]
        if cause is not None:
            self.unreliable_frames += 1
            self.unreliable.add(number, self._last, cause)
        self._last = number

    def close(self, complete: bool) -> None:
        """Write the whole record."""
        self._save("complete" if complete else "interrupted")

    def discard(self) -> None:
        """Write that the run failed, if it had begun."""
        if self.frames:
            with suppress(OSError):  # the file that says `running` stays
                self._save("failed")

    def _save(self, state: str) -> None:
        seconds = time.perf_counter() - self._begun
        record = {
            "state": state,
            "interrupted": state == "interrupted",
            "versions": versions(),
            **self.facts,
            "frames": {"written": self.frames, "unreliable": self.unreliable_frames},
            "targets": self.targets,
            **self.counts,
            "notes": list(self.notes),
            "problems": list(self.problems),
            "unreliable": self.unreliable.rows,
            "adjustments": self.adjustments,
            "seconds": {
                "wall": round(seconds, 3),
                "stages": {
                    stage: {"total": round(t.total_s, 4), "median": float(f"{t.median_s:.3g}")}
                    for stage, t in self._stages.items()
                },
            },
        }
        write_whole(self._path, (json.dumps(finite(record), indent=2) + "\n").encode())


def clip_facts(source: Source) -> dict[str, Any]:
    """What run.json says of a clip."""
    return {
        "name": source.name,
        "size": source.size,
        "rate_hz": source.rate_hz,
        "announced_frames": source.count,
    }


def finite(value: Any) -> Any:
    """A value that JSON can hold: numbers that are not finite become null, unknown types become text."""
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
    found = {"torchvision_dddas": VERSION, "python": platform.python_version(), "machine": platform.machine()}
    for name in ("numpy", "scipy", "cv2", "torch", "kornia", "onnxruntime", "av"):
        version = getattr(sys.modules.get(name), "__version__", None)
        if version:
            found[name] = str(version)
    return found


def read_run_record(folder: Path) -> dict[str, Any] | None:
    """The content of run.json in a folder; None if there is none that dddas wrote."""
    try:
        record = json.loads((folder / RUN_JSON).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    versions = record.get("versions") if isinstance(record, dict) else None
    return record if isinstance(versions, dict) and "torchvision_dddas" in versions else None


class DetectionRecord(RunRecord):
    """The record of `dddas detect`."""

    def write(self, scene: Scene) -> None:
        """Count a scene."""
        cause = None if scene.reliable else scene.cause
        self.note(scene.frame.number, len(scene.detections), scene.seconds, scene.adjustments, cause)


@dataclass
class IdentityCounts:
    """Identities so far, numbered from 1 without gaps; boxes between detections, and detections without identity."""

    identities: int = 0
    bridges: int = 0
    untracked: int = 0

    def add(self, followed: TrackedFrame) -> None:
        """Count a frame."""
        self.identities = int(followed.tracks.identity.max(initial=self.identities))
        self.bridges += int((followed.tracks.row < 0).sum())
        self.untracked += len(followed.untracked)


class TrackRecord(RunRecord):
    """The record of a run that gives identities."""

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        super().__init__(folder, facts)
        self.tracked = IdentityCounts()
        self._first = 0

    def write(self, followed: TrackedFrame) -> None:
        """Count a frame."""
        self.tracked.add(followed)
        targets, tracked = len(followed.detections), self.tracked
        self._first = self._first or followed.number
        self.counts |= {
            "first_frame": self._first,
            "last_frame": followed.number,
            "identities": tracked.identities,
            "tracked": self.targets + targets - tracked.untracked,
            "untracked": tracked.untracked,
            "bridges": tracked.bridges,
        }
        self.note(followed.number, targets, followed.seconds, followed.adjustments, followed.cause or None)


class PeopleRecord(RunRecord):
    """The record of `dddas people`.

    unlikely: people below LIKELY. cut: people whom the picture's border cuts. share: windows searched, of all windows
    of all frames. overlay: name of the video, or of the picture of a single image.
    """

    unlikely = cut = everywhere = nowhere = unread = 0
    share = 0.0
    overlay = "overlay.mp4"

    def write(self, found: PeopleFrame) -> None:
        """Count a frame."""
        self.unlikely += int((found.people.score < LIKELY).sum())
        self.cut += int(found.people.cut.sum())
        if found.cause:
            self.unread += 1
        else:
            self.everywhere += found.regions_px is None
            self.nowhere += found.share == 0
            self.share += (found.share - self.share) / (self.frames + 1 - self.unread)
        self.counts = {
            "unlikely": self.unlikely,
            "cut": self.cut,
            "searched": {
                "share_of_windows": round(self.share, 4),
                "frames_everywhere": self.everywhere,
                "frames_in_regions": self.frames + 1 - self.unread - self.everywhere - self.nowhere,
                "frames_nowhere": self.nowhere,
            },
        }
        self.note(found.frame.number, len(found.people), found.seconds, found.adjustments, found.cause or None)


class GroundRecord(RunRecord):
    """The record of `dddas locate ground`.

    people: rows of positions.csv. by: sightings by what gave their distance, `bearing` where nothing did.
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        super().__init__(folder, facts)
        self.people = 0
        self.by = dict.fromkeys(("both", "height", "feet", "bearing"), 0)
        self.counts = {"people": 0, "sightings": self.by}

    def write(self, located: GroundLocations) -> None:
        """Count a frame."""
        self.people += len(located.positions)
        self.counts["people"] = self.people
        for by in located.sightings.by.tolist():
            self.by[by] += 1
        self.note(located.frame, len(located.sightings), {})


class ConfirmationRecord(RunRecord):
    """The record of `dddas confirm`. kinds: rows of each kind."""

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        super().__init__(folder, facts)
        self.kinds: Counter[str] = Counter()
        self.counts = {"kinds": {}, "rows_looked_at": 0}

    def write(self, confirmed: Confirmation) -> None:
        """Count a frame."""
        self.kinds.update(confirmed.kind)
        self.counts["kinds"] = dict(self.kinds)
        self.counts["rows_looked_at"] += sum(bool(names) for names in confirmed.seen_by)
        self.note(confirmed.frame, len(confirmed.kind), {})


class AerialRecord(RunRecord):
    """The record of a run that locates targets from the air.

    positions: rows of positions.csv. by: frames by what gave the camera's pose, `nothing` for those not located.
    weak: spans of frames that were located with something amiss. repairs: what was changed and why.
    landmarks: of each, in how many frames it was seen, used, and left out of those located; and the spans of frames in
    which it was reassigned or excluded.
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any], names: Sequence[str]) -> None:
        super().__init__(folder, facts)
        self.names = tuple(names)
        self.positions = 0
        self.by = dict.fromkeys(("pose", "homography", "paper", "telemetry", "nothing"), 0)
        self.weak, self.repairs = Spans(), Spans()
        self.landmarks: dict[str, dict[str, Any]] = {
            name: {"seen": 0, "used": 0, "left_out": 0, "reassigned": [], "excluded": []} for name in names
        }

    def write(self, grounded: AerialLocations) -> None:
        """Count a frame."""
        frame, fix, before = grounded.frame, grounded.fix, self._last
        self.positions += len(grounded.positions)
        self.by[fix.by or "nothing"] += 1
        for which, state, is_used in zip(fix.landmark.tolist(), fix.state, fix.is_used, strict=True):
            landmark = self.landmarks[self.names[which]]
            landmark["seen"] += 1
            landmark["used"] += is_used
            landmark["left_out"] += bool(fix.by) and not is_used
            if state in ("reassigned", "excluded"):
                spans = landmark[state]
                if spans and spans[-1][1] == before:
                    spans[-1][1] = frame
                else:
                    spans.append([frame, frame])
        if fix.by and fix.cause:
            self.weak.add(frame, before, fix.cause, by=fix.by)
        for change in fix.changes:
            self.repairs.add(frame, before, change)
        self.counts |= {
            "positions": self.positions,
            "by": self.by,
            "landmarks": self.landmarks,
            "weak": self.weak.rows,
            "repairs": self.repairs.rows,
        }
        cause = None if fix.by else fix.cause or NO_POSE
        self.note(frame, len(grounded.box_px), grounded.seconds, grounded.adjustments, cause)
