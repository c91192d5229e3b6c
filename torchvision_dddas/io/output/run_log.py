"""The events of a run: log.txt, and the events, key frames and timelines of its report and map."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import readable
from torchvision_dddas.io.atomic_files import OutputPart, write_whole
from torchvision_dddas.io.maps.map_picture import Signs
from torchvision_dddas.io.output.run_record import NO_POSE, RunRecord
from torchvision_dddas.io.output.run_report import REPORT, KeyFrames, RunReport, describe_state, format_span
from torchvision_dddas.io.output.timelines import (
    ADJUSTED,
    CROWD,
    NOTICED,
    ORDERED,
    PROBLEM,
    VERDICT,
    WORLD,
    ZONE,
    Timeline,
)
from torchvision_dddas.io.output.zone_events import zone_table
from torchvision_dddas.io.overlay import RunPictures, ToMetres, command_metres
from torchvision_dddas.types import Adjustment, FrameResult

LOG_TXT = "log.txt"
REPAIRED = "repaired"  # a landmark that was reassigned or excluded
LANDMARK = "landmark"  # a landmark that the picture does not show

_WEIGHTS = {WORLD: 3.0, ADJUSTED: 2.0, NOTICED: 2.0, CROWD: 2.0, VERDICT: 1.0, PROBLEM: 1.0, ORDERED: 1.0, ZONE: 1.0}
_WEIGHTS[REPAIRED] = 0.5
"""Weights of entries for the choice of key frames."""
_LEAST_UNSEEN = 3  # a landmark that is unseen in fewer frames gets no line
_MOST_CAPTION = 260
_CLOSE_FRAMES = 10
_FAR_M = 15.0  # a goal that moved by less counts as unchanged: it follows a crowd
_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass
class Entry:
    """An event at a frame, or in `count` frames from `first` to `last`.

    time_s: None: computed from the frame. short: a few words for a picture's caption.
    """

    first: int
    kind: str
    text: str
    last: int
    count: int = 1
    time_s: float | None = None
    short: str = ""


class RunLog:
    """The entries of a run in the order of their logging, about 300 bytes each."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []
        self._open: dict[str, Entry] = {}
        self._goal: dict[str, np.ndarray] = {}

    def add(self, frame: int, kind: str, text: str, time_s: float | None = None, short: str = "") -> None:
        """Add an entry."""
        text = " ".join(text.split())
        self.entries.append(Entry(frame, kind, text, frame, time_s=time_s, short=short or text))

    def add_lasting(self, frame: int, step: int, kind: str, text: str, key: str = "") -> None:
        """Add an event that may last. A repetition within a few frames extends its entry, even if numbers differ.

        step: frames since the last processed frame. key: identifies the event, by default its text without numbers.
        """
        key = f"{kind} {key or _NUMBER.sub('0', text)}"
        entry = self._open.get(key)
        if entry is not None and frame - entry.last <= max(_CLOSE_FRAMES, 2 * step):
            entry.last, entry.count = frame, entry.count + 1
        else:
            self.add(frame, kind, text)
            self._open[key] = self.entries[-1]

    def add_adjustment(self, moved: Adjustment) -> None:
        """Add the adjustment of a parameter."""
        change = moved.describe()
        self.add(moved.frame, ADJUSTED, f"{change}: {moved.cause}" if moved.cause else change, short=change)

    def add_orders(self, result: FrameResult, explained: Iterable[str]) -> None:
        """Add the new orders of a frame, except orders of `explained` vehicles, whose adjustments are logged."""
        command, frame = result.command, result.tracked.number
        if command is None:
            return
        to_metres = command_metres(result)

        def words(place: np.ndarray) -> str:
            return (
                "{:.7g}, {:.7g}".format(*place) if to_metres is None else "({:.1f}, {:.1f}) m".format(*to_metres(place))
            )

        if command.look_at is not None and "uav" not in explained and self._is_new("uav", command.look_at, to_metres):
            height = "" if command.altitude_m is None else f" from {command.altitude_m:.0f} m"
            self.add(frame, ORDERED, f"the UAV keeps {words(command.look_at)} in view{height}", short="UAV sent")
        for order in command.orders:
            if order.vehicle not in explained and self._is_new(order.vehicle, order.goal, to_metres):
                text = f"{order.vehicle} goes to {words(order.goal)} at {order.speed_m_s:g} m/s"
                text += "" if order.look_at is None else f" and looks at {words(order.look_at)}"
                self.add(frame, ORDERED, text, short=f"{order.vehicle} sent")

    def _is_new(self, vehicle: str, goal: np.ndarray, to_metres: ToMetres | None) -> bool:
        """Return whether a goal is far from the goal of the vehicle's last order."""
        place, far = (np.asarray(goal, float), 0.0) if to_metres is None else (to_metres(goal), _FAR_M)
        if vehicle in self._goal and float(np.linalg.norm(place - self._goal[vehicle])) <= far:
            return False
        self._goal[vehicle] = place
        return True

    def ordered(self) -> list[Entry]:
        """Return the entries sorted by frame, without landmarks that were unseen in fewer than three frames."""
        entries = [e for e in self.entries if e.kind != LANDMARK or e.count >= _LEAST_UNSEEN]
        return sorted(entries, key=lambda entry: entry.first)


class LogClock:
    """The times of frames, interpolated between processed frames."""

    def __init__(self, frame: np.ndarray, time_s: np.ndarray) -> None:
        """frame, time_s: (N,) numbers and times of the processed frames, increasing; unknown times are NaN."""
        self._processed, known = frame, np.isfinite(time_s)
        self._frame, self._time_s = frame[known], time_s[known]

    def time_s(self, entry: Entry) -> float:
        """Return the time of an entry, extrapolated beyond the first and the last frame; NaN without known times."""
        number, frame, time_s = entry.first, self._frame, self._time_s
        if entry.time_s is not None:
            return entry.time_s
        if not len(frame):
            return math.nan
        if len(frame) > 1 and not frame[0] <= number <= frame[-1]:
            one, other = (0, 1) if number < frame[0] else (-2, -1)
            rate = (time_s[other] - time_s[one]) / max(frame[other] - frame[one], 1)
            return max(float(time_s[other] + (number - frame[other]) * rate), 0.0)
        return float(np.interp(number, frame, time_s))

    def occurrence(self, entry: Entry) -> str:
        """Return `in 3 of 8 frames`, counting processed frames; empty if the event occurred in all of them."""
        first, end = (
            np.searchsorted(self._processed, entry.first),
            np.searchsorted(self._processed, entry.last, "right"),
        )
        return (
            f"in {entry.count} of {end - first} frames"
            if entry.first < entry.last and entry.count < end - first
            else ""
        )


def format_log(entries: Iterable[Entry], clock: LogClock, heading: str) -> str:
    """Return the text of log.txt. heading: its first line."""
    out = [f"# {heading}", "", f"{'time s':>9}  {'frame':>7}  {'what':<9} how and why"]
    for entry in entries:
        time_s, occurrence = clock.time_s(entry), clock.occurrence(entry)
        when = f"{time_s:9.3f}" if math.isfinite(time_s) else f"{'':9}"
        lasted = "" if entry.last == entry.first else f" (to frame {entry.last}{occurrence and f', {occurrence}'})"
        out.append(f"{when}  {entry.first:>7}  {entry.kind:<9} {entry.text}{lasted}")
    return "\n".join(out) + "\n"


class RunStory(OutputPart[FrameResult]):
    """Writes log.txt, and collects the events, the timeline, the key frames and the map's signs for report.html.

    If a run locates nothing, no map exists, and this part writes report.html itself.
    record: the record of the run. It must be set before the first frame.
    """

    record: RunRecord

    def __init__(self, folder: Path, names: Sequence[str], pictures: RunPictures | None, is_located: bool) -> None:
        """names: names of the landmarks. pictures: draws key frames, None for a run without a report."""
        self.log, self.signs, self.timeline = RunLog(), Signs(), Timeline(names)
        self._folder, self._names, self._pictures, self._is_located = folder, tuple(names), pictures, is_located
        self._key_frames = KeyFrames()
        self._explained: set[str] = set()
        self._measures: dict[str, Any] = {}
        self._sentences: tuple[str, ...] = ()
        self._waiting: list[Entry] = []  # entries of later frames
        self._read = self._before = 0
        self._kind_of: dict[int, str] = {}

    def event(self, frame: int, text: str, time_s: float | None = None, kind: str = WORLD) -> None:
        """Log an event that is not part of the results. Call this before the frame of the event is written.

        time_s: None: computed from the frame. kind: as in log.txt.
        """
        self.log.add(frame, kind, text, time_s)

    def score(self, measures: Mapping[str, Any], sentences: Sequence[str] = ()) -> None:
        """Set the score of the run against the truth: measures by name, and sentences on the main measures."""
        self._measures, self._sentences = dict(measures), tuple(sentences)

    def write(self, result: FrameResult) -> None:
        """Add a frame."""
        tracked, adjustments = result.tracked, result.adjustments
        self.timeline.add_result(result)
        for moved in adjustments:
            self.log.add_adjustment(moved)
        if tracked.cause:
            self._add_lasting(tracked.number, PROBLEM, f"nothing found: {tracked.cause}")
        for event in result.events:
            self.log.add(event.frame, ZONE if event.zone else CROWD, event.describe(), event.time_s)
            self.signs.add_event(event.kind, event.east_north_m)
        self._log_location(result)
        self._log_confirmations(result)
        self._explained |= {moved.parameter.partition(".")[0] for moved in adjustments}
        self.log.add_orders(result, self._explained)
        if self._pictures is not None:
            self._consider_key_frame(result, self._pictures)
        self._before = tracked.number

    def close(self, complete: bool) -> None:
        """Write log.txt and add the run's counts to its record. Raise OSError if it cannot be written."""
        record, entries, clock = self.record, self.log.ordered(), self._clock()
        heading = f"{record.input_name or 'run'}: {describe_state(complete)}, {len(self.timeline)} frames processed"
        text = format_log(entries, clock, f"{heading}; settings and totals are in run.json")
        write_whole(self._folder / LOG_TXT, readable(text).encode())
        if events := [e for e in entries if e.kind == WORLD]:
            record.counts["events"] = [{"frame": e.first, "time_s": clock.time_s(e), "what": e.text} for e in events]
        if self._measures:
            record.counts["truth_score"] = self._measures
        if not self._is_located and self._pictures is not None and record.frames:
            identities = record.counts.get("identities", 0)
            counts = (("frames", record.frames), ("detections", record.targets), ("identities", identities))
            figures = [(name, f"{count}") for name, count in counts]
            report = RunReport(f"Detected and tracked: {record.input_name}", record, complete, self.timeline, figures)
            self.extend(report)
            write_whole(self._folder / REPORT, readable(report.html()).encode())

    def extend(self, report: RunReport) -> None:
        """Add events, key frames, timelines and the score to a report."""
        clock, rows, entries = self._clock(), [], self.log.ordered()
        for entry in entries:
            time_s, occurrence = clock.time_s(entry), clock.occurrence(entry)
            text = f"{entry.text} ({occurrence})" if occurrence else entry.text
            when = f"{time_s:.2f}" if math.isfinite(time_s) else ""
            rows.append((when, format_span(entry.first, entry.last), entry.kind, text))
            self.timeline.events.setdefault(entry.kind, []).append((entry.first, entry.text))
        title = f"What happened and why ({LOG_TXT})"
        report.tables.insert(0, (title, ("time, s", "frames", "what", "how and why"), rows, "nothing"))
        if "zones" in self.record.counts:
            report.first_tables.append(zone_table(self.record.counts["zones"]))
        kinds = Counter(self._kind_of.values())
        report.figures += [(f"judged {kind.replace('_', ' ')}", f"{count}") for kind, count in kinds.items()]
        report.figures.append(("adjustments", f"{sum(e.kind == ADJUSTED for e in entries)}"))
        measures = ("measure", "value"), list(self._measures.items()), ""
        if self._sentences:
            sentences = [(line,) for line in self._sentences]
            report.first_tables.append(("Against the truth", ("in words",), sentences, ""))
            report.tables.append(("All measures against the truth", *measures))
        elif self._measures:
            report.first_tables.append(("Against the truth", *measures))
        report.key_frames = self._key_frames.chosen()

    def _clock(self) -> LogClock:
        return LogClock(self.timeline["frame"], self.timeline["time_s"])

    def _add_lasting(self, frame: int, kind: str, text: str, key: str = "") -> None:
        self.log.add_lasting(frame, frame - self._before, kind, text, key)

    def _log_location(self, result: FrameResult) -> None:
        """Log why a frame was not located or has a warning, and log repairs and unseen landmarks."""
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
        """Count confirmations by ground vehicles, and log a confirmation that is new for its target."""
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
            for name in vehicle_m.keys() & set(by):
                self.signs.add_look(name, vehicle_m[name], at.east_north_m[row])
            before = self._kind_of.get(target)
            if kind in ("unseen", before):
                continue
            self._kind_of[target] = kind
            short = f"target {target} is {kind.replace('_', ' ')}"
            text = f"{short} (probability of being human {confirmed.probability[i]:.2f})"
            text += f", seen by {' and '.join(by)}" if by else ""
            text += f"; it was judged {before.replace('_', ' ')} before" if before else ""
            self.log.add(located.frame, VERDICT, text, short=short)
            self.signs.add_event(kind, at.east_north_m[row])

    def _consider_key_frame(self, result: FrameResult, pictures: RunPictures) -> None:
        """Offer a frame as key frame. Entries are grouped by their first word, except world events and judgements."""
        pictures.show(result)
        number = result.tracked.number
        self._waiting += self.log.entries[self._read :]
        self._read = len(self.log.entries)
        due = [e for e in self._waiting if self._before < e.first <= number and e.kind != LANDMARK]
        self._waiting = [e for e in self._waiting if e.first > number]
        text = "; ".join(dict.fromkeys(e.short for e in due))
        text = text if len(text) < _MOST_CAPTION else f"{text[: _MOST_CAPTION - 4]} ..."
        kinds = {}
        for e in due:
            word = re.sub(r"\d+", "", e.short.split(" ")[0])
            kinds[e.short if e.kind in (WORLD, VERDICT) else f"{e.kind} {word}"] = _WEIGHTS[e.kind]
        self._key_frames.add(number, self.timeline.last_time_s, kinds, text, lambda: pictures(result))
