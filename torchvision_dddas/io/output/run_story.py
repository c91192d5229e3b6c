"""The story of a run: its log, and the events, key frames and timelines of its report and map."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary, write_whole
from torchvision_dddas.io.maps import Signs
from torchvision_dddas.io.output.key_frames import KeyFrames
from torchvision_dddas.io.output.run_log import (
    ADJUSTED,
    LANDMARK,
    LOG_TXT,
    NOTICED,
    ORDERED,
    PROBLEM,
    REPAIRED,
    VERDICT,
    WORLD,
    Clock,
    CommandLog,
    Entry,
    RunLog,
    format_log,
)
from torchvision_dddas.io.output.run_record import NO_POSE, RunRecord
from torchvision_dddas.io.output.run_report import REPORT, RunSummary, Table, describe_state, format_span, run_report
from torchvision_dddas.io.output.timelines import RunTimeline
from torchvision_dddas.io.overlay import RunPictures
from torchvision_dddas.types import FrameResult

WEIGHTS = {WORLD: 3.0, ADJUSTED: 2.0, NOTICED: 2.0, VERDICT: 1.0, PROBLEM: 1.0, ORDERED: 1.0, REPAIRED: 0.5}
"""Weights of entries for the choice of key frames."""
_LEAST_UNSEEN = 3
"""A landmark that is unseen in fewer frames is not worth a line."""
_MOST_CAPTION = 260
_DIGITS = re.compile(r"\d+")


class RunStory:
    """A part that writes log.txt, and collects events, timeline, key frames and map signs for report.html."""

    def __init__(
        self, folder: Path, name: str, record: RunRecord, names: Sequence[str], pictures: RunPictures | None
    ) -> None:
        """name: of the clip. names: of the landmarks. pictures: draws key frames, None for a report without them."""
        self.record = record
        self.log, self.signs = RunLog(), Signs()
        self._folder, self._name, self._names, self._pictures = folder, name, tuple(names), pictures
        self._timeline, self._key_frames = RunTimeline(names), KeyFrames()
        self._commands = CommandLog()
        self._explained: set[str] = set()
        self._measures: dict[str, Any] = {}
        self._sentences: tuple[str, ...] = ()
        self._waiting: list[Entry] = []  # logged for frames that are still to come
        self._read = self._before = 0
        self._kind_of: dict[int, str] = {}
        self._kinds: Counter[str] = Counter()
        self._looks = 0

    def event(self, frame: int, text: str, time_s: float | None = None, kind: str = WORLD) -> None:
        """Log an event that the results do not hold, best before its frame is written.

        time_s: None where it follows from the frame. kind: one of run_log's.
        """
        self.log.add(frame, kind, text, time_s)

    def score(self, measures: Mapping[str, Any], sentences: Sequence[str] = ()) -> None:
        """Set how good the run was against the truth: measures by name, and the main ones in sentences."""
        self._measures, self._sentences = dict(measures), tuple(sentences)

    def write(self, result: FrameResult) -> None:
        """Add a frame."""
        followed, grounded = result.tracked, result.locations
        number, source = followed.number, followed if grounded is None else grounded
        self._timeline.add(result, source.seconds, source.adjustments)
        for moved in source.adjustments:
            self.log.adjusted(moved)
        if followed.cause:
            self._lasting(number, PROBLEM, f"nothing found: {followed.cause}")
        self._log_location(result)
        self._log_confirmations(result)
        self._explained |= {moved.parameter.partition(".")[0] for moved in source.adjustments}
        self._commands.add(result, self.log, self._explained)
        if self._pictures is not None:
            self._add_picture(result, float(self._timeline.rows["time_s"][-1]), self._pictures)
        self._before = number

    def close(self, complete: bool) -> None:
        """Write log.txt and add the run's counts to its record. Raises OSError if it cannot be written."""
        clock, rows = self._clock(), self._timeline.rows
        ended = f"{self._name or 'run'}: {describe_state(complete)}"
        heading = [f"{ended}, {len(rows)} frames looked at; settings and totals are in run.json"]
        write_whole(self._folder / LOG_TXT, format_log(self._entries(), clock, heading).encode())
        counts = self.record.counts
        if events := [e for e in self.log.ordered() if e.kind == WORLD]:
            counts["events"] = [{"frame": e.first, "time_s": clock.of(e), "what": e.text} for e in events]
        if self._kinds:
            counts |= {"kinds": dict(self._kinds), "rows_looked_at": self._looks}
        if self._measures:
            counts["truth_score"] = self._measures

    def discard(self) -> None:
        """Remove what was begun."""
        for name in (LOG_TXT, REPORT):
            remove(temporary(self._folder / name))

    def extend(self, summary: RunSummary) -> RunSummary:
        """Add events, key frames, timelines and the score to a report."""
        self._timeline.entries = entries = self._entries()
        clock = self._clock()
        columns = ("time, s", "frames", "what", "how and why")
        tables: list[Table] = [
            (f"What happened and why ({LOG_TXT})", columns, [_table_row(e, clock) for e in entries], "nothing"),
            *summary.tables,
        ]
        kinds = Counter(self._kind_of.values())
        figures = [(f"told {kind.replace('_', ' ')}", f"{count}") for kind, count in kinds.items() if count]
        figures.append(("adjustments", f"{sum(e.kind == ADJUSTED for e in entries)}"))
        first: list[Table] = []
        if self._sentences:
            first.append(("Against the truth", ("in words",), [(line,) for line in self._sentences], ""))
        if self._measures:
            title = "All measures against the truth" if first else "Against the truth"
            (tables if first else first).append((title, ("measure", "value"), list(self._measures.items()), ""))
        return replace(
            summary,
            figures=[*summary.figures, *figures],
            tables=tables,
            first_tables=first,
            key_frames=self._key_frames.chosen(),
            panels=self._timeline.panels(),
        )

    def report(self, complete: bool) -> None:
        """Write report.html of a run that locates nothing. Raises OSError if it cannot be written."""
        record = self.record
        identities = record.counts.get("identities", 0)
        counts = (("frames", record.frames), ("detections", record.targets), ("identities", identities))
        figures = [(name, f"{count}") for name, count in counts]
        summary = self.extend(RunSummary.of(record, f"Found and followed: {self._name}", complete, figures))
        text = run_report(replace(summary, panels=()), self._timeline)
        write_whole(self._folder / REPORT, text.encode())

    def _entries(self) -> list[Entry]:
        return [e for e in self.log.ordered() if e.kind != LANDMARK or e.count >= _LEAST_UNSEEN]

    def _clock(self) -> Clock:
        return Clock(self._timeline.rows["frame"], self._timeline.rows["time_s"])

    def _lasting(self, frame: int, kind: str, text: str, key: str = "") -> None:
        self.log.add_lasting(frame, frame - self._before, kind, text, key)

    def _log_location(self, result: FrameResult) -> None:
        """Log why a frame was not located or only partly, repairs, and unseen landmarks."""
        grounded = result.locations
        if grounded is None:
            return
        frame, fix, marks = grounded.frame, grounded.fix, grounded.marks
        if not fix.by:
            self._lasting(frame, PROBLEM, f"not located: {fix.cause or NO_POSE}")
        elif fix.cause:
            self._lasting(frame, PROBLEM, f"located by {fix.by}, but {fix.cause}")
        for change in fix.changes:
            self._lasting(frame, REPAIRED, change)
        shown = set(marks.landmark[np.isfinite(marks.image_px).all(axis=1)].tolist())
        for which, name in enumerate(self._names):
            if which not in shown:
                self._lasting(frame, LANDMARK, f"{name} is not seen in the picture", key=name)

    def _log_confirmations(self, result: FrameResult) -> None:
        """Log a target's confirmation by ground vehicles if it is new."""
        confirmed, grounded = result.confirmed, result.locations
        if confirmed is None or grounded is None:
            return
        at, marks = grounded.positions, grounded.marks
        vehicle_m = dict(zip((self._names[k] for k in marks.landmark.tolist()), marks.east_north_m, strict=True))
        self._kinds.update(confirmed.kind)
        for i, row in enumerate(confirmed.row.tolist()):
            target, kind, by = int(at.target[row]), confirmed.kind[i], confirmed.seen_by[i]
            self._looks += bool(by)
            for name in by:
                if name in vehicle_m:
                    self.signs.add_look(name, vehicle_m[name], at.east_north_m[row])
            before = self._kind_of.get(target)
            if kind in ("unseen", before):
                continue
            self._kind_of[target] = kind
            short = f"target {target} is {kind.replace('_', ' ')}"
            text = f"{short} (probability of being human {confirmed.probability[i]:.2f})"
            text += f", seen by {' and '.join(by)}" if by else ""
            text += f"; it was told {before.replace('_', ' ')} before" if before else ""
            self.log.add(grounded.frame, VERDICT, text, short=short)
            self.signs.add_verdict(target, kind, at.east_north_m[row])

    def _add_picture(self, result: FrameResult, time_s: float, pictures: RunPictures) -> None:
        pictures.show(result)
        number = result.tracked.number
        self._waiting += self.log.entries[self._read :]
        self._read = len(self.log.entries)
        due = [e for e in self._waiting if self._before < e.first <= number and e.kind != LANDMARK]
        self._waiting = [e for e in self._waiting if e.first > number]
        text = "; ".join(dict.fromkeys(e.short for e in due))
        if len(text) >= _MOST_CAPTION:
            text = f"{text[: _MOST_CAPTION - 4]} ..."
        kinds = {_event_kind(e): WEIGHTS[e.kind] for e in due}
        self._key_frames.add(number, time_s, kinds, text, lambda: pictures(result))


def _event_kind(entry: Entry) -> str:
    """World events and targets each are a kind; adjustments and problems are grouped by parameter and first word."""
    if entry.kind in (WORLD, VERDICT):
        return entry.short
    return f"{entry.kind} {_DIGITS.sub('', entry.short.split(' ')[0])}"


def _table_row(entry: Entry, clock: Clock) -> tuple[str, str, str, str]:
    at, occurrence = clock.of(entry), clock.occurrence(entry)
    text = f"{entry.text} ({occurrence})" if occurrence else entry.text
    return f"{at:.2f}" if np.isfinite(at) else "", format_span(entry.first, entry.last), entry.kind, text
