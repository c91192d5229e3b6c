"""log.txt: what happened in a run and why, a line each, in the order of the frames."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.types import Adjustment

NAME = "log.txt"

ADJUSTED, WORLD, PROBLEM = "adjusted", "world", "problem"
"""Kinds of lines: a knob that the feedback moved; what happened in a simulated world; what went wrong."""
TOLD, ORDERED, REPAIRED, MARK = "told", "ordered", "repaired", "landmark"
"""More of them: what ground vehicles say of a target; what vehicles were asked; what was repaired; landmarks unseen."""

_NUMBER = re.compile(r"\d+(\.\d+)?")
_CLOSE = 10
"""What is said again within so many frames goes on."""


@dataclass
class Entry:
    """What happened at a frame, or in `count` frames from `first` to `last`.

    time_s: None where only the frame tells it. short: in a few words, for a picture's caption.
    """

    first: int
    kind: str
    text: str
    last: int = 0
    count: int = 1
    time_s: float | None = None
    short: str = ""

    def __post_init__(self) -> None:
        self.last = max(self.last, self.first)


@dataclass
class RunLog:
    """The entries of a run as they come. Memory grows with them: about 300 bytes each."""

    entries: list[Entry] = field(default_factory=list)
    _open: dict[str, Entry] = field(default_factory=dict)

    def add(self, frame: int, kind: str, text: str, time_s: float | None = None, short: str = "") -> None:
        """Something that happened at a frame."""
        text = " ".join(text.split())
        self.entries.append(Entry(frame, kind, text, time_s=time_s, short=short or text))

    def adjusted(self, moved: Adjustment) -> None:
        """A knob that was moved, and why."""
        change = f"{moved.knob} {number(moved.old)} -> {number(moved.new)}"
        self.add(moved.frame, ADJUSTED, f"{change}: {moved.cause}" if moved.cause else change, short=change)

    def going_on(self, frame: int, step: int, kind: str, text: str, key: str = "") -> None:
        """Something that may last: said again within a few frames it is one entry, also where its numbers differ.

        step: frames since the one before that was looked at. key: what makes it the same; its words without numbers.
        """
        key = f"{kind} {key or _NUMBER.sub('0', text)}"
        entry = self._open.get(key)
        if entry is not None and frame - entry.last <= max(_CLOSE, 2 * step):
            entry.last, entry.count = frame, entry.count + 1
            return
        self.add(frame, kind, text)
        self._open[key] = self.entries[-1]

    def ordered(self) -> list[Entry]:
        """All entries by frame, those of one frame as they came."""
        return sorted(self.entries, key=lambda entry: entry.first)


def number(value: float) -> str:
    """A knob's value for a reader."""
    return "none" if not math.isfinite(value) else f"{value:.5g}"


def lines(entries: Iterable[Entry], frame: np.ndarray, time_s: np.ndarray, heading: Sequence[str]) -> str:
    """The text of the log. frame, time_s: (N,) of the frames looked at, growing. heading: lines that go before."""
    out = [*(f"# {line}" for line in heading), "", f"{'time s':>9}  {'frame':>7}  {'what':<9} how and why"]
    for entry in entries:
        at = entry.time_s if entry.time_s is not None else time_at(entry.first, frame, time_s)
        clock = f"{at:9.3f}" if math.isfinite(at) else f"{'':9}"
        out.append(f"{clock}  {entry.first:>7}  {entry.kind:<9} {entry.text}{lasted(entry, frame)}")
    return "\n".join(out) + "\n"


def lasted(entry: Entry, frame: np.ndarray) -> str:
    """How long it lasted, in words, if longer than a frame."""
    seldom = seldom_in(entry, frame)
    return "" if entry.last == entry.first else f" (to frame {entry.last}{seldom and f', {seldom}'})"


def seldom_in(entry: Entry, frame: np.ndarray) -> str:
    """In how many of the frames looked at while it lasted, in words, if not in all. frame: (N,) those, growing."""
    among = int(np.searchsorted(frame, entry.last, side="right") - np.searchsorted(frame, entry.first))
    return f"in {entry.count} of {among} frames" if entry.count < among else ""


def time_at(number: int, frame: np.ndarray, time_s: np.ndarray) -> float:
    """When a frame was, from those looked at; NaN where nothing tells."""
    known = np.isfinite(time_s)
    if not known.any():
        return math.nan
    frame, time_s = frame[known], time_s[known]
    if len(frame) > 1 and not frame[0] <= number <= frame[-1]:
        near = (0, 1) if number < frame[0] else (-2, -1)
        rate = (time_s[near[1]] - time_s[near[0]]) / max(frame[near[1]] - frame[near[0]], 1)
        return max(float(time_s[near[1]] + (number - frame[near[1]]) * rate), 0.0)
    return float(np.interp(number, frame, time_s))
