"""The course of a run: what was found, how long it took and which knobs were moved, frame by frame, and its plots."""

import math
from array import array
from collections.abc import Collection, Mapping, Sequence
from itertools import cycle

import numpy as np

from torchvision_dddas.io.output.run_log import ADJUSTED, NOTICED, ORDERED, PROBLEM, TOLD, WORLD, Entry
from torchvision_dddas.io.report.timeline import Curve, Panel, Ticks, axis
from torchvision_dddas.types import Adjustment, Confirmation, FrameResult

KINDS = ("human", "not_human", "unseen")
"""What a target can be to ground vehicles, as Confirmation has it."""

_ROW = np.dtype([(name, "f8") for name in ("frame", "time_s", "found", "tracked", "placed", *KINDS, "located")])
_MOST_KNOBS, _MOST_STAGES = 12, 7
_KIND_COLOURS = ("#2b7d4f", "#b5541c", "#b8b8b8")
_STAGE_COLOURS = ("#1f5fa8", "#b5541c", "#2b7d4f", "#5b3f94", "#c9a227", "#3f8f94", "#a8446f", "#b8b8b8")
_EVENTS = {
    WORLD: "#5b3f94",
    ADJUSTED: "#1f5fa8",
    TOLD: "#2b7d4f",
    ORDERED: "#c9a227",
    NOTICED: "#c2701c",
    PROBLEM: "#c0392b",
}


class Course:
    """A row of figures a frame: 72 bytes and 4 for each stage, up to three times that while the space grows."""

    def __init__(self, names: Collection[str] = ()) -> None:
        """names: of the ground vehicles; what is adjusted of each of them is one plot."""
        self._names = frozenset(names)
        self._rows = np.zeros(256, _ROW)
        self._count = 0
        self._seconds: dict[str, array[float]] = {}
        self._moves: dict[str, list[tuple[int, float, float]]] = {}
        self.entries: Sequence[Entry] = ()
        """What is told of the run, for the ticks."""

    def add(self, surveyed: FrameResult, seconds: Mapping[str, float], adjustments: Sequence[Adjustment]) -> None:
        """Take note of a frame, of the time spent on it, and of what was adjusted."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros(len(self._rows), _ROW)])
        followed, grounded = surveyed.followed, surveyed.grounded
        time_s = math.nan if followed.frame is None else followed.frame.time_s
        self._rows[self._count] = (
            followed.number,
            time_s if grounded is None else grounded.time_s,
            len(followed.detections),
            int((followed.tracks.row >= 0).sum()),
            math.nan if grounded is None else len(grounded.positions),
            *_counts(surveyed.confirmed),
            bool(grounded.fix.by) if grounded is not None else not followed.cause,
        )
        for stage in seconds:
            if stage not in self._seconds:
                self._seconds[stage] = array("f", bytes(4 * self._count))
        for stage, spent in self._seconds.items():
            spent.append(seconds.get(stage, 0.0))
        for moved in adjustments:
            self._moves.setdefault(moved.parameter, []).append((moved.frame, moved.old, moved.new))
        self._count += 1

    @property
    def rows(self) -> np.ndarray:
        """(N,) frame, time_s, targets found, tracked and placed on the ground, of each kind; located."""
        return self._rows[: self._count]

    def values(self, parameter: str) -> np.ndarray:
        """(N,) of a knob in each frame: as it was before it was moved for the first time, then what it was moved to."""
        moves = sorted(self._moves[parameter], key=lambda move: move[0])
        levels = np.array([moves[0][1], *(new for _, _, new in moves)], float)
        since = np.array([frame for frame, _, _ in moves])
        found = levels[np.searchsorted(since, self.rows["frame"], side="right")]
        return np.where(np.isfinite(found), found, np.nan)

    def panels(self) -> list[Panel]:
        """What happened when; targets; what ground vehicles say of them; parameters that were moved; time spent."""
        rows = self.rows
        told: list[Panel] = [("what happened", self._ticks())]
        targets = [
            Curve("found", rows["found"], "#b8b8b8"),
            Curve("with an identity", rows["tracked"], "#1f5fa8"),
            Curve("located", rows["placed"], "#b5541c"),
        ]
        told.append(("targets", [curve for curve in targets if np.isfinite(curve.values).any()]))
        named = zip(KINDS, _KIND_COLOURS, strict=True)
        told.append(
            (
                "targets by what ground vehicles say",
                [Curve(kind.replace("_", " "), rows[kind], colour) for kind, colour in named],
            )
        )
        # One that was set at the first frame and stayed is a line in the log, and no plot.
        values = {parameter: self.values(parameter) for parameter in self._moves}
        moved = [parameter for parameter, v in values.items() if len(np.unique(v[np.isfinite(v)])) > 1]
        plots: dict[str, list[str]] = {}
        for parameter in sorted(moved):
            who, _, what = parameter.partition(".")
            plots.setdefault(f"{what} of each ground vehicle" if who in self._names else parameter, []).append(
                parameter
            )
        often = sorted(plots, key=lambda title: -sum(len(self._moves[parameter]) for parameter in plots[title]))[
            :_MOST_KNOBS
        ]
        for title in sorted(often):
            alone = plots[title] == [title]
            shown = zip(plots[title], cycle(_STAGE_COLOURS), strict=False)
            curves = [Curve("" if alone else k.partition(".")[0], values[k], c, steps=True) for k, c in shown]
            told.append((title, curves))
        return [*told, *self._time_spent()]

    def _ticks(self) -> list[Ticks]:
        at, _ = axis(self.rows)
        found = []
        for kind, colour in _EVENTS.items():
            those = [entry for entry in self.entries if entry.kind == kind]
            if those and len(at):
                places = np.interp([entry.first for entry in those], self.rows["frame"], at)
                found.append(Ticks(kind, places, [f"frame {e.first}: {e.text}" for e in those], colour))
        return found

    def _time_spent(self) -> list[Panel]:
        spent = {stage: 1000 * np.asarray(times, float) for stage, times in self._seconds.items()}
        often = sorted(spent, key=lambda stage: -float(spent[stage].sum()))
        shown = [(stage, spent[stage]) for stage in often[:_MOST_STAGES]]
        if rest := [spent[stage] for stage in often[_MOST_STAGES:]]:
            shown.append(("other", np.sum(rest, axis=0)))
        # Each on top of those below it; the highest is drawn first, so that none is hidden.
        heights: Sequence[np.ndarray] = [*np.cumsum([times for _, times in shown], axis=0)] if shown else []
        curves = [
            Curve(stage, height, colour, area=True)
            for (stage, _), height, colour in zip(shown, heights, _STAGE_COLOURS, strict=False)
        ]
        return [("time spent on a frame, ms, stacked", curves[::-1])] if curves else []


def _counts(confirmed: Confirmation | None) -> list[float]:
    if confirmed is None:
        return [math.nan] * len(KINDS)
    return [confirmed.kind.count(kind) for kind in KINDS]
