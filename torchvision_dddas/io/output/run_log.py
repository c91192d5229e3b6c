"""log.txt: the events of a run with their causes, a line each, in the order of the frames."""

import math
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.io.overlay import ToMetres, command_metres
from torchvision_dddas.types import Adjustment, FrameResult

LOG_TXT = "log.txt"

# Kinds of entries, as log.txt names them.
ADJUSTED = "adjusted"  # a parameter that the feedback moved
WORLD = "world"  # an event of a simulated world
PROBLEM = "problem"  # something that went wrong
NOTICED = "noticed"  # an instrument that is silent or frozen
VERDICT = "told"  # a target's confirmation by ground vehicles
ORDERED = "ordered"  # an order to a vehicle
REPAIRED = "repaired"  # a landmark that was reassigned or excluded
LANDMARK = "landmark"  # a landmark that the picture does not show

_NUMBER = re.compile(r"\d+(\.\d+)?")
_CLOSE_FRAMES = 10
_FAR_M = 15.0  # a goal that moved by less counts as the same: it follows a crowd


@dataclass
class Entry:
    """An event at a frame, or in `count` frames from `first` to `last`.

    time_s: None where it follows from the frame. short: a few words for a picture's caption.
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


class RunLog:
    """The entries of a run in the order of their logging, about 300 bytes each."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []
        self._open: dict[str, Entry] = {}
        self._goal: dict[str, np.ndarray] = {}

    def add(self, frame: int, kind: str, text: str, time_s: float | None = None, short: str = "") -> None:
        """Add an entry."""
        text = " ".join(text.split())
        self.entries.append(Entry(frame, kind, text, time_s=time_s, short=short or text))

    def add_lasting(self, frame: int, step: int, kind: str, text: str, key: str = "") -> None:
        """Add an event that may last: repeated within a few frames it stays one entry, also if its numbers differ.

        step: frames since the last one processed. key: identifies the event, by default its text without numbers.
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
        old, new = (f"{value:.5g}" if math.isfinite(value) else "none" for value in (moved.old, moved.new))
        change = f"{moved.parameter} {old} -> {new}"
        self.add(moved.frame, ADJUSTED, f"{change}: {moved.cause}" if moved.cause else change, short=change)

    def add_orders(self, result: FrameResult, explained: Collection[str] = ()) -> None:
        """Add the new orders of a frame. explained: vehicles whose orders adjustments explain already."""
        command, frame = result.command, result.tracked.number
        if command is None:
            return
        scale = command_metres(result)
        if command.look_at is not None and "uav" not in explained and self._is_new("uav", command.look_at, scale):
            height = "" if command.altitude_m is None else f" from {command.altitude_m:.0f} m"
            text = f"the UAV keeps {_place(command.look_at, scale)} in view{height}"
            self.add(frame, ORDERED, text, short="UAV sent")
        for order in command.orders:
            if order.vehicle not in explained and self._is_new(order.vehicle, order.goal, scale):
                text = f"{order.vehicle} goes to {_place(order.goal, scale)} at {order.speed_m_s:g} m/s"
                text += "" if order.look_at is None else f" and looks at {_place(order.look_at, scale)}"
                self.add(frame, ORDERED, text, short=f"{order.vehicle} sent")

    def _is_new(self, vehicle: str, goal: np.ndarray, scale: ToMetres | None) -> bool:
        """Whether a goal is far from that of the vehicle's last order."""
        there, far = (np.asarray(goal, float), 0.0) if scale is None else (scale(goal), _FAR_M)
        last = self._goal.get(vehicle)
        if last is not None and float(np.linalg.norm(there - last)) <= far:
            return False
        self._goal[vehicle] = there
        return True

    def ordered(self) -> list[Entry]:
        """All entries by frame, those of one frame in the order of their logging."""
        return sorted(self.entries, key=lambda entry: entry.first)


def _place(place: np.ndarray, scale: ToMetres | None) -> str:
    return "{:.7g}, {:.7g}".format(*place) if scale is None else "({:.1f}, {:.1f}) m".format(*scale(place))


class Clock:
    """The times of frames, interpolated between those that were processed."""

    def __init__(self, frame: np.ndarray, time_s: np.ndarray) -> None:
        """frame, time_s: (N,) of the processed frames, growing; NaN where a time is not known."""
        self._processed = np.array(frame, float)
        known = np.isfinite(time_s)
        self._frame, self._time_s = self._processed[known], np.array(time_s, float)[known]

    def at(self, number: int) -> float:
        """The time of a frame, extrapolated beyond the first and the last; NaN where no time is known."""
        frame, time_s = self._frame, self._time_s
        if not len(frame):
            return math.nan
        if len(frame) > 1 and not frame[0] <= number <= frame[-1]:
            one, other = (0, 1) if number < frame[0] else (-2, -1)
            rate = (time_s[other] - time_s[one]) / max(frame[other] - frame[one], 1)
            return max(float(time_s[other] + (number - frame[other]) * rate), 0.0)
        return float(np.interp(number, frame, time_s))

    def of(self, entry: Entry) -> float:
        """The time of an entry."""
        return self.at(entry.first) if entry.time_s is None else entry.time_s

    def occurrence(self, entry: Entry) -> str:
        """`in 3 of 8 frames`: the processed frames in which it occurred; empty if in all."""
        if entry.last == entry.first:
            return ""
        since = np.searchsorted(self._processed, entry.first)
        among = int(np.searchsorted(self._processed, entry.last, side="right") - since)
        return f"in {entry.count} of {among} frames" if entry.count < among else ""


def format_log(entries: Iterable[Entry], clock: Clock, heading: Sequence[str]) -> str:
    """The text of log.txt. heading: its first lines."""
    out = [*(f"# {line}" for line in heading), "", f"{'time s':>9}  {'frame':>7}  {'what':<9} how and why"]
    for entry in entries:
        at, occurrence = clock.of(entry), clock.occurrence(entry)
        when = f"{at:9.3f}" if math.isfinite(at) else f"{'':9}"
        lasted = "" if entry.last == entry.first else f" (to frame {entry.last}{occurrence and f', {occurrence}'})"
        out.append(f"{when}  {entry.first:>7}  {entry.kind:<9} {entry.text}{lasted}")
    return "\n".join(out) + "\n"
