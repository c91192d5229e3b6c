"""What a run tells of itself at the end: its log, the plots, key frames and signs for its report and map."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary, write_whole
from torchvision_dddas.io.maps.map_signs import Signs
from torchvision_dddas.io.output.command_log import Orders
from torchvision_dddas.io.output.run_log import (
    ADJUSTED,
    MARK,
    NAME,
    NOTICED,
    ORDERED,
    PROBLEM,
    REPAIRED,
    TOLD,
    WORLD,
    Clock,
    Entry,
    RunLog,
    lines,
)
from torchvision_dddas.io.output.run_record import Record
from torchvision_dddas.io.overlay import RunPictures
from torchvision_dddas.io.report.keyframes import KeyFrames
from torchvision_dddas.io.report.run_report import RunSummary, Table, format_span, run_report
from torchvision_dddas.io.report.timelines import RunTimeline
from torchvision_dddas.types import FrameResult

REPORT = "report.html"
WEIGHTS = {WORLD: 3.0, ADJUSTED: 2.0, NOTICED: 2.0, TOLD: 1.0, PROBLEM: 1.0, ORDERED: 1.0, REPAIRED: 0.5}
"""How much what happened matters for the choice of key frames."""
_BRIEF = 3
"""A landmark that is not seen in fewer frames is not worth a line."""
_DIGITS = re.compile(r"\d+")


class RunStory:
    """A sink of all that is known of a frame. Its log is always written; a report of its own only by `report`."""

    def __init__(
        self, folder: Path, name: str, kept: Record, names: Sequence[str], pictures: RunPictures | None
    ) -> None:
        """name: of the clip. names: of the landmarks. pictures: of the frames, None where no key frames are wanted."""
        self._folder, self._name, self._kept, self._names, self._pictures = folder, name, kept, tuple(names), pictures
        self.log, self.course, self.frames, self.signs = RunLog(), RunTimeline(names), KeyFrames(), Signs()
        self._orders = Orders()
        self._explained: set[str] = set()
        self._score: dict[str, Any] = {}
        self._in_words: tuple[str, ...] = ()
        self._waiting: list[Entry] = []  # told, but not yet seen in a picture
        self._read = self._before = 0
        self._said: dict[int, str] = {}
        self._counts: Counter[str] = Counter()
        self._looks = 0

    def event(self, frame: int, text: str, time_s: float | None = None, kind: str = WORLD) -> None:
        """Something that the frames do not tell themselves. time_s: None where the frame tells when."""
        self.log.add(frame, kind, text, time_s)

    def scored(self, measures: Mapping[str, Any], said: Sequence[str] = ()) -> None:
        """How good the run was against the truth: values by name, and the most telling of them in words."""
        self._score, self._in_words = dict(measures), tuple(said)

    def write(self, surveyed: FrameResult) -> None:
        """Take note of a frame."""
        followed, grounded = surveyed.followed, surveyed.grounded
        number, source = followed.number, followed if grounded is None else grounded
        self.course.add(surveyed, source.seconds, source.adjustments)
        for moved in source.adjustments:
            self.log.adjusted(moved)
        if followed.cause:
            self.log.going_on(number, self._step(number), PROBLEM, f"nothing found: {followed.cause}")
        if grounded is not None:
            self._laid(surveyed, self._step(number))
        self._told(surveyed)
        self._explained |= {moved.parameter.partition(".")[0] for moved in source.adjustments}
        self._orders.note(surveyed, self.log, self._explained)
        if self._pictures is not None:
            self._picture(surveyed, float(self.course.rows["time_s"][-1]), self._pictures)
        self._before = number

    def close(self, complete: bool) -> None:
        """Write log.txt. Raises OSError if it cannot be written."""
        rows, state = self.course.rows, "complete" if complete else "interrupted: up to the last whole frame"
        heading = [f"{self._name or 'run'}: {state}, {len(rows)} frames looked at; settings and totals are in run.json"]
        text = lines(self.entries(), self._clock(), heading)
        write_whole(self._folder / NAME, text.encode())
        clock, happened = self._clock(), [e for e in self.log.ordered() if e.kind == WORLD]
        if happened:
            self._kept.counts["events"] = [{"frame": e.first, "time_s": clock.of(e), "what": e.text} for e in happened]
        if self._counts:
            self._kept.counts |= {"kinds": dict(self._counts), "rows_looked_at": self._looks}
        if self._score:
            self._kept.counts["truth_score"] = self._score

    def discard(self) -> None:
        """Remove what was begun."""
        for name in (NAME, REPORT):
            remove(temporary(self._folder / name))

    def entries(self) -> list[Entry]:
        """The log's entries by frame."""
        return [e for e in self.log.ordered() if e.kind != MARK or e.count >= _BRIEF]

    def told(self, story: RunSummary) -> RunSummary:
        """A report's story with what is known of the run beside."""
        self.course.entries = entries = self.entries()
        clock = self._clock()
        happened = [_row(entry, clock) for entry in entries]
        told: Table = (
            f"What happened and why ({NAME})",
            ("time, s", "frames", "what", "how and why"),
            happened,
            "nothing",
        )
        tables: list[Table] = [told, *story.tables]
        figures = [(f"told {kind.replace('_', ' ')}", f"{count}") for kind, count in self._verdicts().items() if count]
        figures.append(("adjustments", f"{sum(e.kind == ADJUSTED for e in entries)}"))
        said: list[Table] = []
        if self._in_words:
            said.append(("Against the truth", ("in words",), [(line,) for line in self._in_words], ""))
        if self._score:
            title = "All measures against the truth" if said else "Against the truth"
            measured: Table = (title, ("measure", "value"), list(self._score.items()), "")
            (tables if said else said).append(measured)
        return replace(
            story,
            figures=[*story.figures, *figures],
            tables=tables,
            first_tables=said,
            key_frames=self.frames.chosen(),
            panels=self.course.panels(),
        )

    def report(self, facts: Mapping[str, Any], figures: Sequence[tuple[str, str]], complete: bool) -> None:
        """Write report.html of a run that locates nothing. Raises OSError if it cannot be written."""
        state = "complete" if complete else "interrupted: up to the last whole frame"
        notes = [*self._kept.notes, *self._kept.problems]
        story = self.told(RunSummary(f"Found and followed: {self._name}", state, figures, facts, [], notes))
        write_whole(self._folder / REPORT, run_report(replace(story, panels=()), self.course).encode())

    def _clock(self) -> Clock:
        return Clock(self.course.rows["frame"], self.course.rows["time_s"])

    def _step(self, number: int) -> int:
        return number - self._before

    def _laid(self, surveyed: FrameResult, step: int) -> None:
        """How the picture lies on the ground, and which landmarks it does not show."""
        grounded = surveyed.grounded
        assert grounded is not None
        frame, fix, marks = grounded.frame, grounded.fix, grounded.marks
        if not fix.by:
            cause = fix.cause or "nothing told where the camera was"
            self.log.going_on(frame, step, PROBLEM, f"not located: {cause}")
        elif fix.cause:
            self.log.going_on(frame, step, PROBLEM, f"located by {fix.by}, but {fix.cause}")
        for change in fix.changes:
            self.log.going_on(frame, step, REPAIRED, change)
        shown = set(marks.landmark[np.isfinite(marks.image_px).all(axis=1)].tolist())
        for which, name in enumerate(self._names):
            if which not in shown:
                self.log.going_on(frame, step, MARK, f"{name} is not seen in the picture", key=name)

    def _told(self, surveyed: FrameResult) -> None:
        """What ground vehicles say of the targets, where it is new."""
        confirmed, grounded = surveyed.confirmed, surveyed.grounded
        if confirmed is None or grounded is None:
            return
        at, marks = grounded.positions, grounded.marks
        vehicle_m = dict(zip((self._names[k] for k in marks.landmark.tolist()), marks.east_north_m, strict=True))
        self._counts.update(confirmed.kind)
        for i, row in enumerate(confirmed.row.tolist()):
            target, kind, by = int(at.target[row]), confirmed.kind[i], confirmed.seen_by[i]
            self._looks += bool(by)
            for name in by:
                if name in vehicle_m:
                    self.signs.look(name, vehicle_m[name], at.east_north_m[row])
            if kind == "unseen" or self._said.get(target) == kind:
                continue
            was = self._said.get(target)
            self._said[target] = kind
            words = f"target {target} is {kind.replace('_', ' ')}"
            more = f" (probability of being human {confirmed.probability[i]:.2f})"
            seen = f", seen by {' and '.join(by)}" if by else ""
            changed = f"; it was told {was.replace('_', ' ')} before" if was else ""
            self.log.add(grounded.frame, TOLD, words + more + seen + changed, short=words)
            self.signs.told(target, kind, at.east_north_m[row])

    def _verdicts(self) -> Counter[str]:
        return Counter(self._said.values())

    def _picture(self, surveyed: FrameResult, time_s: float, pictures: RunPictures) -> None:
        pictures.show(surveyed)
        number = surveyed.followed.number
        self._waiting += self.log.entries[self._read :]
        self._read = len(self.log.entries)
        due = [e for e in self._waiting if self._before < e.first <= number and e.kind != MARK]
        self._waiting = [e for e in self._waiting if e.first > number]
        words = "; ".join(dict.fromkeys(e.short for e in due))
        kinds = {_sort(e): WEIGHTS[e.kind] for e in due}
        self.frames.add(
            number, time_s, kinds, words if len(words) < 260 else f"{words[:256]} ...", lambda: pictures(surveyed)
        )


def _sort(entry: Entry) -> str:
    """What sort of thing happened: each event of a world and each target is one; of knobs and mishaps all alike are."""
    return entry.short if entry.kind in (WORLD, TOLD) else f"{entry.kind} {_DIGITS.sub('', entry.short.split(' ')[0])}"


def _row(entry: Entry, clock: Clock) -> tuple[str, str, str, str]:
    """An entry as a row of a report's table."""
    at, seldom = clock.of(entry), clock.seldom(entry)
    text = f"{entry.text} ({seldom})" if seldom else entry.text
    return f"{at:.2f}" if np.isfinite(at) else "", format_span(entry.first, entry.last), entry.kind, text
