"""Timelines of a run: figures of each frame, kept in arrays, and the panels that show them."""

import math
from array import array
from collections.abc import Collection, Mapping, Sequence
from itertools import cycle

import numpy as np
from markupsafe import Markup

from torchvision_dddas.io.output.run_log import ADJUSTED, NOTICED, ORDERED, PROBLEM, VERDICT, WORLD, Entry
from torchvision_dddas.io.report import Events, Line, Panel, time_chart
from torchvision_dddas.types import Adjustment, AerialLocations, Confirmation, FrameResult

KINDS = ("human", "not_human", "unseen")
"""Kinds of a target in a Confirmation."""

_MOST_PARAMETERS, _MOST_STAGES = 12, 7
_STAGE_COLOURS = (1, 2, 3, 7, 5, 8, 4, 6)
_EVENT_COLOURS = {WORLD: 7, ADJUSTED: 1, VERDICT: 3, ORDERED: 5, NOTICED: 4, PROBLEM: 2}


class Timeline:
    """Rows of figures, one a frame, 8 bytes a figure; the space grows by doubling.

    Columns `frame` and `time_s` are the time axis; frames with `located` 0 are shaded.
    """

    columns: Sequence[str] = ("frame", "time_s", "located")

    def __init__(self) -> None:
        self._rows = np.zeros(256, np.dtype([(name, "f8") for name in self.columns]))
        self._count = 0

    @property
    def rows(self) -> np.ndarray:
        """(N,) structured array with `columns`."""
        return self._rows[: self._count]

    def panels(self) -> list[Panel]:
        """The panels to draw."""
        raise NotImplementedError

    def chart(self, more: Sequence[Panel] = ()) -> Markup:
        """Draw the panels. more: panels of the same frames that are drawn above."""
        at, unit = self.axis()
        return time_chart([*more, *self.panels()], at, self.rows["located"] == 0, unit)

    def axis(self) -> tuple[np.ndarray, str]:
        """(N,) places of the frames on the time axis and its unit: seconds where all are known."""
        if np.isfinite(self.rows["time_s"]).all():
            return self.rows["time_s"], "time, s"
        return self.rows["frame"], "frame"

    def _append(self, row: tuple[float, ...]) -> None:
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = row
        self._count += 1

    def _lines(self, columns: Mapping[str, tuple[str, int]], band: bool = False) -> list[Line]:
        at, _ = self.axis()
        return [Line(name, at, self.rows[column], colour, band=band) for column, (name, colour) in columns.items()]


class LocationTimeline(Timeline):
    """Landmarks seen and used, standard deviations, chi-squared with its 95 % limit."""

    columns = ("frame", "time_s", "seen", "used", "sigma_m", "relative_m", "chi2", "limit", "located")

    def add(self, grounded: AerialLocations) -> None:
        """Add a frame. sigma_m, relative_m: the median of its targets' roots of the covariance's trace."""
        fix = grounded.fix
        self._append(
            (
                grounded.frame,
                grounded.time_s,
                len(fix.landmark),
                sum(fix.is_used),
                _median_sigma(grounded.positions.covariance_m2),
                _median_sigma(grounded.relative_m2),
                fix.chi2,
                chi2_limit(fix.freedom),
                bool(fix.by),
            )
        )

    def panels(self) -> list[Panel]:
        """The landmarks, the standard deviations and chi-squared."""
        at, _ = self.axis()
        sigmas = {"sigma_m": ("absolute", 2), "relative_m": ("relative to the team", 3)}
        limit = Line("95 % limit", at, self.rows["limit"], 6, dashed=True)
        return [
            ("landmarks", self._lines({"seen": ("seen", 6), "used": ("used", 1)})),
            ("standard deviation of a target's place, m (median of the frame)", self._lines(sigmas, band=True)),
            ("chi-squared of the landmarks", [*self._lines({"chi2": ("chi-squared", 7)}, band=True), limit]),
        ]


class RunTimeline(Timeline):
    """Targets detected and tracked, confirmations, adjusted parameters, events, and the time spent by stage."""

    columns = ("frame", "time_s", "found", "tracked", "placed", *KINDS, "located")

    def __init__(self, vehicles: Collection[str] = ()) -> None:
        """vehicles: names of the ground vehicles; the same parameter of all of them shares a panel."""
        super().__init__()
        self._vehicles = frozenset(vehicles)
        self._seconds: dict[str, array[float]] = {}
        self._moves: dict[str, list[tuple[int, float, float]]] = {}
        self.entries: Sequence[Entry] = ()
        """The entries of the log that are shown as events."""

    def add(self, result: FrameResult, seconds: Mapping[str, float], adjustments: Sequence[Adjustment]) -> None:
        """Add a frame, the time spent on it, and what was adjusted."""
        followed, grounded = result.tracked, result.locations
        time_s = math.nan if followed.frame is None else followed.frame.time_s
        for stage in seconds:
            if stage not in self._seconds:
                self._seconds[stage] = array("f", bytes(4 * self._count))
        for stage, spent in self._seconds.items():
            spent.append(seconds.get(stage, 0.0))
        for moved in adjustments:
            self._moves.setdefault(moved.parameter, []).append((moved.frame, moved.old, moved.new))
        self._append(
            (
                followed.number,
                time_s if grounded is None else grounded.time_s,
                len(followed.detections),
                int((followed.tracks.row >= 0).sum()),
                math.nan if grounded is None else len(grounded.positions),
                *_counts(result.confirmed),
                bool(grounded.fix.by) if grounded is not None else not followed.cause,
            )
        )

    def values(self, parameter: str) -> np.ndarray:
        """(N,) values of a parameter in each frame; NaN where it is not finite."""
        moves = sorted(self._moves[parameter], key=lambda move: move[0])
        levels = np.array([moves[0][1], *(new for _, _, new in moves)], float)
        since = np.array([frame for frame, _, _ in moves])
        found = levels[np.searchsorted(since, self.rows["frame"], side="right")]
        return np.where(np.isfinite(found), found, np.nan)

    def panels(self) -> list[Panel]:
        """Events, targets, confirmations, adjusted parameters, and the time spent."""
        targets = self._lines({"found": ("found", 6), "tracked": ("with an identity", 1), "placed": ("located", 2)})
        kinds = {kind: (kind.replace("_", " "), colour) for kind, colour in zip(KINDS, (3, 2, 6), strict=True)}
        return [
            ("what happened", self._events()),
            ("targets", [line for line in targets if np.isfinite(line.y).any()]),
            ("targets by what ground vehicles say", self._lines(kinds)),
            *self._parameters(),
            *self._time_spent(),
        ]

    def _events(self) -> list[Events]:
        at, _ = self.axis()
        found = []
        for kind, colour in _EVENT_COLOURS.items():
            entries = [entry for entry in self.entries if entry.kind == kind]
            if entries and len(at):
                places = np.interp([entry.first for entry in entries], self.rows["frame"], at)
                found.append(Events(kind, places, [f"frame {e.first}: {e.text}" for e in entries], colour))
        return found

    def _parameters(self) -> list[Panel]:
        """The panels of the parameters moved most often, without those that never changed."""
        at, _ = self.axis()
        values = {parameter: self.values(parameter) for parameter in self._moves}
        panels: dict[str, list[str]] = {}
        for parameter in sorted(name for name, v in values.items() if len(np.unique(v[np.isfinite(v)])) > 1):
            who, _, what = parameter.partition(".")
            title = f"{what} of each ground vehicle" if who in self._vehicles else parameter
            panels.setdefault(title, []).append(parameter)
        by_moves = sorted(panels, key=lambda title: -sum(len(self._moves[name]) for name in panels[title]))
        found: list[Panel] = []
        for title in sorted(by_moves[:_MOST_PARAMETERS]):
            names = {p: "" if panels[title] == [title] else p.partition(".")[0] for p in panels[title]}
            shown = zip(names.items(), cycle(_STAGE_COLOURS), strict=False)
            found.append((title, [Line(name, at, values[p], colour, steps=True) for (p, name), colour in shown]))
        return found

    def _time_spent(self) -> list[Panel]:
        """The slowest stages, each stacked on those below; the highest is drawn first, so that none is hidden."""
        at, _ = self.axis()
        spent_ms = {stage: 1000 * np.asarray(times, float) for stage, times in self._seconds.items()}
        by_time = sorted(spent_ms, key=lambda stage: -float(spent_ms[stage].sum()))
        shown = {stage: spent_ms[stage] for stage in by_time[:_MOST_STAGES]}
        if rest := [spent_ms[stage] for stage in by_time[_MOST_STAGES:]]:
            shown["other"] = np.sum(rest, axis=0)
        if not shown:
            return []
        heights = np.cumsum([*shown.values()], axis=0)
        stages = zip(shown, heights, _STAGE_COLOURS, strict=False)
        lines = [Line(stage, at, height, colour, area=True) for stage, height, colour in stages]
        return [("time spent on a frame, ms, stacked", lines[::-1])]


def chi2_limit(freedom: int) -> float:
    """The 95 % quantile of chi-squared to 1 %, NaN without degrees of freedom. Source: Wilson and Hilferty."""
    if freedom < 1:
        return math.nan
    part = 2 / (9 * freedom)
    return freedom * (1 - part + 1.6449 * math.sqrt(part)) ** 3


def _median_sigma(covariance_m2: np.ndarray) -> float:
    sigma = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2))
    sigma = sigma[np.isfinite(sigma)]
    return float(np.median(sigma)) if len(sigma) else math.nan


def _counts(confirmed: Confirmation | None) -> list[float]:
    if confirmed is None:
        return [math.nan] * len(KINDS)
    return [confirmed.kind.count(kind) for kind in KINDS]
