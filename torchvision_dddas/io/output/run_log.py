"""log.txt: what happened in a run and why, a line each, in the order of the frames."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.types import Adjustment

NAME = "log.txt"

ADJUSTED, WORLD, PROBLEM, NOTICED = "adjusted", "world", "problem", "noticed"
"""Kinds of lines: a knob that the feedback moved; what happened in a simulated world, as only that knows; what went
wrong; what the run itself noticed of its instruments, silent or frozen."""
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
        """A parameter that was moved, and why."""
        change = f"{moved.parameter} {number(moved.old)} -> {number(moved.new)}"
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


class Clock:
    """When frames were, from those looked at."""

    def __init__(self, frame: np.ndarray, time_s: np.ndarray) -> None:
        """frame, time_s: (N,) of the frames looked at, growing; NaN where a time is not known."""
        self._looked_at = np.array(frame, float)
        known = np.isfinite(time_s)
        self._frame, self._time_s = self._looked_at[known], np.array(time_s, float)[known]

    def at(self, number: int) -> float:
        """The time of a frame; it goes on at the same rate beyond the first and the last; NaN where nothing tells."""
        frame, time_s = self._frame, self._time_s
        if not len(frame):
            return math.nan
        if len(frame) > 1 and not frame[0] <= number <= frame[-1]:
            one, other = (0, 1) if number < frame[0] else (-2, -1)
            rate = (time_s[other] - time_s[one]) / max(frame[other] - frame[one], 1)
            return max(float(time_s[other] + (number - frame[other]) * rate), 0.0)
        return float(np.interp(number, frame, time_s))

    def of(self, entry: Entry) -> float:
        """When something began."""
        return self.at(entry.first) if entry.time_s is None else entry.time_s

    def seldom(self, entry: Entry) -> str:
        """In how many of the frames looked at while it lasted, in words, if not in all."""
        if entry.last == entry.first:
            return ""
        since = np.searchsorted(self._looked_at, entry.first)
        among = int(np.searchsorted(self._looked_at, entry.last, side="right") - since)
        return f"in {entry.count} of {among} frames" if entry.count < among else ""


def lines(entries: Iterable[Entry], clock: Clock, heading: Sequence[str]) -> str:
    """The text of the log. heading: lines that go before."""
    out = [*(f"# {line}" for line in heading), "", f"{'time s':>9}  {'frame':>7}  {'what':<9} how and why"]
    for entry in entries:
        at, seldom = clock.of(entry), clock.seldom(entry)
        when = f"{at:9.3f}" if math.isfinite(at) else f"{'':9}"
        lasted = "" if entry.last == entry.first else f" (to frame {entry.last}{seldom and f', {seldom}'})"
        out.append(f"{when}  {entry.first:>7}  {entry.kind:<9} {entry.text}{lasted}")
    return "\n".join(out) + "\n"
