"""report.html of a run, one offline file: figures, map, key frames, plots over time, tables, input and settings."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.io.output.run_record import RunRecord, finite
from torchvision_dddas.io.output.timelines import Timeline
from torchvision_dddas.io.report import Cell, ReportColumn, render_page, table

REPORT = "report.html"
MOST_TABLE_ROWS = 200
"""Largest number of rows of a table in the report; run.json or log.txt has all rows."""
MOST_KEY_FRAMES = 9
"""Largest number of key frames in a report."""
_FOLDED_FACTS = ("scenario", "settings")  # long facts, which the report folds
_MARKED = 7  # largest number of key frames at events
_HELD = 18  # largest number of candidates at events, and at even distances, during the run
_AREA_PX = 520 * 390  # largest area of a key frame

Table = tuple[str, Sequence[str], Sequence[Sequence[Any]], str]
"""A title, the columns' names, rows of values, and a text for a table without rows."""


@dataclass(frozen=True)
class KeyFrame:
    """A picture as JPEG with its frame number, time and a caption. weight: importance of its events."""

    number: int
    time_s: float
    text: str
    jpeg: bytes
    weight: float = 1.0

    @property
    def when(self) -> str:
        """The frame number and the time as text."""
        return f"frame {self.number}" + (f", {self.time_s:.1f} s" if math.isfinite(self.time_s) else "")


@dataclass
class RunReport:
    """The content of a run's report. Facts, notes and problems come from the record.

    figures: names and values. map: from `map_data`. map_file: a picture that replaces the map on paper.
    first_tables: tables before the map.
    """

    title: str
    record: RunRecord
    complete: bool
    timeline: Timeline
    figures: list[tuple[str, str]]
    tables: list[Table] = field(default_factory=list)
    map: dict[str, Any] | None = None
    map_file: str = ""
    first_tables: list[Table] = field(default_factory=list)
    key_frames: list[KeyFrame] = field(default_factory=list)

    def html(self) -> str:
        """Return the HTML text of the report."""
        facts = self.record.facts
        told = [(name, value) for name, value in facts.items() if name not in _FOLDED_FACTS]
        if self.record.scale is not None:
            told.append(("scale", self.record.scale.line().removeprefix("scale: ")))
        return render_page(
            "run.html",
            title=self.title,
            state=describe_state(self.complete),
            figures=self.figures,
            notes=[*self.record.notes, *self.record.problems],
            map=finite(self.map),
            map_file=self.map_file,
            key_frames=self.key_frames,
            first_tables=[_html_table(one) for one in self.first_tables],
            tables=[_html_table(one) for one in self.tables],
            plots=self.timeline.chart(),
            facts=_html_table(("What was run", ("what", "value"), told, "")),
            folded={name: json.dumps(finite(facts[name]), indent=2) for name in _FOLDED_FACTS if name in facts},
        )


def describe_state(complete: bool) -> str:
    """Return words that say whether a run was completed or interrupted."""
    return "complete" if complete else "interrupted, with results up to the last whole frame"


def format_span(first: int, last: int) -> str:
    """Return the text of a range of frame numbers, such as `3 to 7`."""
    return f"{first}" if first == last else f"{first} to {last}"


def location_tables(record: RunRecord) -> list[Table]:
    """Return the report's tables on frames, repairs, adjustments and landmarks of a run that locates from the air."""

    def rows(spans: Sequence[Mapping[str, Any]], *keys: str) -> list[tuple[Any, ...]]:
        return [(format_span(span["first"], span["last"]), *(span[key] for key in keys)) for span in spans]

    counts = record.counts
    adjustments = [
        (m["frame"], m["knob"], *(m[k] if math.isfinite(m[k]) else "none" for k in ("old", "new")), m["cause"])
        for m in record.adjustments.rows
    ]
    landmarks = [
        (name, k["seen"], k["used"], *([format_span(*s) for s in k[state]] for state in ("reassigned", "excluded")))
        for name, k in counts["landmarks"].items()
    ]
    columns = ("name", "frames seen", "used", "reassigned in frames", "excluded in frames")
    gaps, weak = rows(record.unreliable.rows, "cause"), rows(counts["weak"], "by", "cause")
    return [
        ("Frames that could not be located", ("frames", "cause"), gaps, "none"),
        ("Frames located with a warning", ("frames", "by", "cause"), weak, "none"),
        ("Repairs and exclusions", ("frames", "what and why"), rows(counts["repairs"], "cause"), "none"),
        ("Adjustments of the feedback loop", ("frame", "parameter", "from", "to", "cause"), adjustments, "none"),
        *([("Landmarks", columns, landmarks, "none")] if landmarks else []),
    ]


def _html_table(content: Table) -> dict[str, Any]:
    """Return a table's title, the HTML of its first MOST_TABLE_ROWS rows, the number of further rows, and a text."""
    title, names, rows, empty = content
    columns = [ReportColumn(name, text=True) for name in names]
    cells = [[_cell(value) for value in row] for row in rows[:MOST_TABLE_ROWS]]
    html = table(title, columns, cells) if rows else ""
    return {"title": title, "html": html, "more": len(rows) - len(cells), "empty": empty}


def _cell(value: Any) -> Cell:
    number = isinstance(value, (int, float)) and math.isfinite(value)
    return Cell(_text(value), value if number else _text(value))


def _text(value: Any) -> str:
    """Format a value for a reader."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "unknown"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(v)}" for name, v in value.items())
    if isinstance(value, Iterable) and not isinstance(value, (str, bytes)):
        return ", ".join(_text(v) for v in value)
    return str(value)


class KeyFrames:
    """Choose a few frames of a run for its report: some at even distances and some at events.

    Frames must be added in order.
    """

    def __init__(self) -> None:
        self._even: list[KeyFrame] = []
        self._marked: list[KeyFrame] = []
        self._count, self._stride = 0, 1
        self._known: set[str] = set()

    def add(
        self, number: int, time_s: float, kinds: Mapping[str, float], text: str, draw: Callable[[], np.ndarray]
    ) -> None:
        """Consider the next frame.

        kinds: weights of the kinds of events at the frame. The first frame of each kind is kept. text: the caption.
        draw: returns the frame's picture, (H, W, 3) uint8 BGR; called only if the frame is kept.
        """
        new = kinds.keys() - self._known
        is_due = self._count % self._stride == 0
        self._count += 1
        if not (is_due or new):
            return
        weight = max((kinds[kind] for kind in new), default=0.0)
        frame = KeyFrame(number, time_s, text, _small_jpeg(draw()), weight)
        if new:
            self._known |= new
            self._marked.append(frame)
            if len(self._marked) > _HELD:
                del self._marked[_least_needed(self._marked)]
        if is_due:
            self._even.append(frame)
            if len(self._even) > _HELD:
                # Drop every other frame, so that the others stay evenly spread.
                self._even, self._stride = self._even[::2], 2 * self._stride

    def chosen(self) -> list[KeyFrame]:
        """Return the key frames by number: frames at events, and further frames far from all chosen frames."""
        chosen = list(self._marked)
        while len(chosen) > _MARKED:
            del chosen[_least_needed(chosen)]
        numbers = {frame.number for frame in chosen}
        rest = [frame for frame in self._even if frame.number not in numbers]
        if rest and not chosen:
            chosen.append(rest.pop(0))
        while rest and len(chosen) < MOST_KEY_FRAMES:
            far = [min(abs(frame.number - other.number) for other in chosen) for frame in rest]
            chosen.append(rest.pop(int(np.argmax(far))))
        return sorted(chosen, key=lambda frame: frame.number)


def _least_needed(frames: Sequence[KeyFrame]) -> int:
    """Return the index of the frame with the smallest product of weight and distance to the nearest frame."""
    apart = np.diff([frame.number for frame in frames]).astype(float)
    nearest = np.minimum(np.r_[np.inf, apart], np.r_[apart, np.inf])
    return int(np.argmin(nearest * [frame.weight for frame in frames]))


def _small_jpeg(picture: np.ndarray) -> bytes:
    height, width = picture.shape[:2]
    share = (_AREA_PX / (width * height)) ** 0.5
    if share < 1:
        size = max(1, round(width * share)), max(1, round(height * share))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 78])[1].tobytes()
