"""What happened in a run: log.txt, and the events, key frames and timelines of its report and map."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.io.maps.map_picture import Signs
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
    Entry,
    RunLog,
    format_log,
)
from torchvision_dddas.io.output.run_record import NO_POSE, RunRecord
from torchvision_dddas.io.output.run_report import REPORT, KeyFrames, RunReport, describe_state, format_span
from torchvision_dddas.io.output.timelines import Timeline
from torchvision_dddas.io.overlay import RunPictures
from torchvision_dddas.types import FrameResult

_WEIGHTS = {WORLD: 3.0, ADJUSTED: 2.0, NOTICED: 2.0, VERDICT: 1.0, PROBLEM: 1.0, ORDERED: 1.0, REPAIRED: 0.5}
"""Weights of entries for the choice of key frames."""
_LEAST_UNSEEN = 3  # a landmark that is unseen in fewer frames is not worth a line
_MOST_CAPTION = 260
_DIGITS = re.compile(r"\d+")


class RunStory:
    """A part that writes log.txt, and collects events, timeline, key frames and map signs for report.html.

    record: of the run; set before the first frame.
    """

    record: RunRecord

    def __init__(self, folder: Path, names: Sequence[str], pictures: RunPictures | None) -> None:
        """names: of the landmarks. pictures: draws key frames, None for a report without them."""
        self.log, self.signs, self.timeline = RunLog(), Signs(), Timeline(names)
        self._folder, self._names, self._pictures = folder, tuple(names), pictures
        self._key_frames = KeyFrames()
        self._explained: set[str] = set()
        self._measures: dict[str, Any] = {}
        self._sentences: tuple[str, ...] = ()
        self._waiting: list[Entry] = []  # logged for frames that are still to come
        self._read = self._before = 0
        self._kind_of: dict[int, str] = {}

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
        tracked, located = result.tracked, result.locations
        source = tracked if located is None else located
        self.timeline.add_result(result)
        for moved in source.adjustments:
            self.log.add_adjustment(moved)
        if tracked.cause:
            self._add_lasting(tracked.number, PROBLEM, f"nothing found: {tracked.cause}")
        self._log_location(result)
        self._log_confirmations(result)
        self._explained |= {moved.parameter.partition(".")[0] for moved in source.adjustments}
        self.log.add_orders(result, self._explained)
        if self._pictures is not None:
            self._consider_key_frame(result, self._pictures)
        self._before = tracked.number

    def close(self, complete: bool) -> None:
        """Write log.txt and add the run's counts to its record. Raises OSError if it cannot be written."""
        clock, name = self._clock(), self.record.input_name or "run"
        ended = f"{name}: {describe_state(complete)}, {len(self.timeline)} frames looked at"
        text = format_log(self._entries(), clock, [f"{ended}; settings and totals are in run.json"])
        write_whole(self._folder / LOG_TXT, text.encode())
        if events := [e for e in self.log.ordered() if e.kind == WORLD]:
            self.record.counts["events"] = [{"frame": e.first, "time_s": clock.of(e), "what": e.text} for e in events]
        if self._measures:
            self.record.counts["truth_score"] = self._measures

    def discard(self) -> None:
        """Nothing is begun before the end."""

    def extend(self, report: RunReport) -> None:
        """Add events, key frames, timelines and the score to a report."""
        self.timeline.entries = entries = self._entries()
        clock, rows = self._clock(), []
        for entry in entries:
            at, occurrence = clock.of(entry), clock.occurrence(entry)
            text = f"{entry.text} ({occurrence})" if occurrence else entry.text
            when = f"{at:.2f}" if np.isfinite(at) else ""
            rows.append((when, format_span(entry.first, entry.last), entry.kind, text))
        title = f"What happened and why ({LOG_TXT})"
        report.tables.insert(0, (title, ("time, s", "frames", "what", "how and why"), rows, "nothing"))
        kinds = Counter(self._kind_of.values())
        report.figures += [(f"told {kind.replace('_', ' ')}", f"{count}") for kind, count in kinds.items()]
        report.figures.append(("adjustments", f"{sum(e.kind == ADJUSTED for e in entries)}"))
        measures = ("measure", "value"), list(self._measures.items()), ""
        if self._sentences:
            sentences = [(line,) for line in self._sentences]
            report.first_tables.append(("Against the truth", ("in words",), sentences, ""))
            report.tables.append(("All measures against the truth", *measures))
        elif self._measures:
            report.first_tables.append(("Against the truth", *measures))
        report.key_frames = self._key_frames.chosen()

    def report(self, complete: bool) -> None:
        """Write report.html of a run that locates nothing. Raises OSError if it cannot be written."""
        record = self.record
        identities = record.counts.get("identities", 0)
        counts = (("frames", record.frames), ("detections", record.targets), ("identities", identities))
        figures = [(name, f"{count}") for name, count in counts]
        report = RunReport(f"Found and followed: {record.input_name}", record, complete, self.timeline, figures)
        self.extend(report)
        write_whole(self._folder / REPORT, report.html().encode())

    def _entries(self) -> list[Entry]:
        return [e for e in self.log.ordered() if e.kind != LANDMARK or e.count >= _LEAST_UNSEEN]

    def _clock(self) -> Clock:
        return Clock(self.timeline["frame"], self.timeline["time_s"])

    def _add_lasting(self, frame: int, kind: str, text: str, key: str = "") -> None:
        self.log.add_lasting(frame, frame - self._before, kind, text, key)

    def _log_location(self, result: FrameResult) -> None:
        """Log why a frame was not located or only partly, repairs, and unseen landmarks."""
        located = result.locations
        if located is None:
            return
        frame, fix, marks = located.frame, located.fix, located.marks
        if not fix.by:
            self._add_lasting(frame, PROBLEM, f"not located: {fix.cause or NO_POSE}")
        elif fix.cause:
            self._add_lasting(frame, PROBLEM, f"located by {fix.by}, but {fix.cause}")
        for change in fix.changes:
            self._add_lasting(frame, REPAIRED, change)
        shown = set(marks.landmark[np.isfinite(marks.image_px).all(axis=1)].tolist())
        for which, name in enumerate(self._names):
            if which not in shown:
                self._add_lasting(frame, LANDMARK, f"{name} is not seen in the picture", key=name)

    def _log_confirmations(self, result: FrameResult) -> None:
        """Count confirmations by ground vehicles, and log a target's if it is new."""
        confirmed, located = result.confirmed, result.locations
        if confirmed is None or located is None:
            return
        at, marks, counts = located.positions, located.marks, self.record.counts
        vehicle_m = dict(zip((self._names[k] for k in marks.landmark.tolist()), marks.east_north_m, strict=True))
        for i, row in enumerate(confirmed.row.tolist()):
            target, kind, by = int(at.target[row]), confirmed.kind[i], confirmed.seen_by[i]
            kinds = counts.setdefault("kinds", {})
            kinds[kind] = kinds.get(kind, 0) + 1
            counts["rows_looked_at"] = counts.get("rows_looked_at", 0) + bool(by)
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
            self.log.add(located.frame, VERDICT, text, short=short)
            self.signs.add_verdict(target, kind, at.east_north_m[row])

    def _consider_key_frame(self, result: FrameResult, pictures: RunPictures) -> None:
        pictures.show(result)
        number = result.tracked.number
        self._waiting += self.log.entries[self._read :]
        self._read = len(self.log.entries)
        due = [e for e in self._waiting if self._before < e.first <= number and e.kind != LANDMARK]
        self._waiting = [e for e in self._waiting if e.first > number]
        text = "; ".join(dict.fromkeys(e.short for e in due))
        if len(text) >= _MOST_CAPTION:
            text = f"{text[: _MOST_CAPTION - 4]} ..."
        kinds = {_event_kind(e): _WEIGHTS[e.kind] for e in due}
        self._key_frames.add(number, self.timeline.last_time_s, kinds, text, lambda: pictures(result))


def _event_kind(entry: Entry) -> str:
    """World events and targets each are a kind; adjustments and problems are grouped by parameter and first word."""
    if entry.kind in (WORLD, VERDICT):
        return entry.short
    return f"{entry.kind} {_DIGITS.sub('', entry.short.split(' ')[0])}"
