"""report.html of a run: figures, map, key frames, plots over time, tables, and what was run, in one offline file."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.io.output.run_record import RunRecord, finite
from torchvision_dddas.io.output.timelines import Timeline
from torchvision_dddas.io.report import Cell, Column, render_page, table

REPORT = "report.html"
MOST_TABLE_ROWS = 200
"""Rows of a table in the report; run.json or log.txt has them all."""
MOST_KEY_FRAMES = 9
"""Pictures in a report."""
_FOLDED_FACTS = ("scenario", "settings")  # they are long
_MARKED = 7  # key frames at events, at most
_HELD = 18  # key frames of either kind while the run goes on
_AREA_PX = 520 * 390  # of a key frame

Table = tuple[str, Sequence[str], Sequence[Sequence[Any]], str]
"""A title, the columns' names, rows of values, and a text for a table without rows."""


@dataclass(frozen=True)
class KeyFrame:
    """A picture as JPEG with its frame number, time and a caption. weight: how much its events matter."""

    number: int
    time_s: float
    text: str
    jpeg: bytes
    weight: float = 1.0

    @property
    def when(self) -> str:
        """Frame number and time for a reader."""
        return f"frame {self.number}" + (f", {self.time_s:.1f} s" if math.isfinite(self.time_s) else "")


@dataclass
class RunReport:
    """The content of a run's report; facts, notes and problems are those of its record.

    figures: names and values. map: as map_data makes it. map_file: the picture that is printed in its place.
    first_tables: shown before the map.
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
        """The HTML text of the report."""
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
    """The words that say whether a run was completed or interrupted."""
    return "complete" if complete else "interrupted: up to the last whole frame"


def format_span(first: int, last: int) -> str:
    """A span of frames, such as `3 to 7`."""
    return f"{first}" if first == last else f"{first} to {last}"


def location_tables(record: RunRecord) -> list[Table]:
    """What the report of a run that locates targets from the air says of its frames and landmarks."""

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
        ("Frames located with something amiss", ("frames", "by", "cause"), weak, "none"),
        ("Repairs and exclusions", ("frames", "what and why"), rows(counts["repairs"], "cause"), "none"),
        ("Adjustments of the feedback loop", ("frame", "parameter", "from", "to", "cause"), adjustments, "none"),
        *([("Landmarks", columns, landmarks, "none")] if landmarks else []),
    ]


def _html_table(content: Table) -> dict[str, Any]:
    """Its title, the HTML of the first MOST_TABLE_ROWS rows, how many more there are, the text if there are none."""
    title, names, rows, empty = content
    columns = [Column(name, text=True) for name in names]
    cells = [[_cell(value) for value in row] for row in rows[:MOST_TABLE_ROWS]]
    html = table(title, columns, cells) if rows else ""
    return {"title": title, "html": html, "more": len(rows) - len(cells), "empty": empty}


def _cell(value: Any) -> Cell:
    number = isinstance(value, (int, float)) and math.isfinite(value)
    return Cell(_text(value), value if number else _text(value))


def _text(value: Any) -> str:
    """A value for a reader."""
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

        kinds: kinds of events at it with their weights; the first frame of each kind is kept. text: the caption.
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
                # Dropping every other one keeps the rest evenly spread.
                self._even, self._stride = self._even[::2], 2 * self._stride

    def chosen(self) -> list[KeyFrame]:
        """The key frames by number: those at events, and others that are far from all of these."""
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
    """The index of the frame with the least weight or the nearest neighbour."""
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
