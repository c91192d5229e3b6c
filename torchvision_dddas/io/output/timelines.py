"""The timeline of a run: figures of each frame, kept in arrays, and the panels that show them."""

import math
from array import array
from collections.abc import Collection, Mapping, Sequence
from itertools import cycle

import numpy as np
from markupsafe import Markup

from torchvision_dddas.io.report.charts import Events, Line, Panel, time_chart
from torchvision_dddas.types import Adjustment, AerialLocations, FrameResult

# Kinds of events, named as in log.txt.
ADJUSTED = "adjusted"  # the feedback changed a parameter
WORLD = "world"  # an event of a simulated world
PROBLEM = "problem"  # a fault
NOTICED = "noticed"  # an instrument is silent or frozen
VERDICT = "told"  # ground vehicles judged a target
ORDERED = "ordered"  # a vehicle got an order
ZONE = "zone"  # an event at a zone
CROWD = "crowd"  # an event of crowds

_EVENT_COLOURS = {WORLD: 7, ADJUSTED: 1, VERDICT: 3, ORDERED: 5, NOTICED: 4, PROBLEM: 2, ZONE: 8, CROWD: 6}
_KINDS = {"human": 3, "not_human": 2, "unseen": 6}  # kinds in a Confirmation, and their colours
_COLOURS = (1, 2, 3, 7, 5, 8, 4, 6)  # colours of stages and parameters
_MOST_PARAMETERS, _MOST_STAGES = 12, 7


class Timeline:
    """Figures of each frame of a run by name. A figure takes 8 bytes, the time spent in a stage 4 bytes.

    `frame` and `time_s` are the time axis. Frames with `located` 0 are shaded.
    events: frame and text of each event, by kind.
    """

    def __init__(self, vehicles: Collection[str] = ()) -> None:
        """vehicles: names of the ground vehicles. A panel shows the same parameter of all vehicles."""
        self.events: dict[str, list[tuple[int, str]]] = {}
        self._vehicles = frozenset(vehicles)
        self._figures: dict[str, array[float]] = {}
        self._seconds: dict[str, array[float]] = {}
        self._moves: dict[str, list[tuple[int, float, float]]] = {}

    def __len__(self) -> int:
        return len(self._figures.get("frame", ()))

    def __getitem__(self, name: str) -> np.ndarray:
        """(N,) values of a figure, NaN if unknown."""
        return np.array(self._figures[name]) if name in self._figures else np.full(len(self), np.nan)

    @property
    def last_time_s(self) -> float:
        """The time of the frame added last."""
        return self._figures["time_s"][-1]

    def add_result(self, result: FrameResult) -> None:
        """Add a frame with its targets, confirmations, computing times and adjustments."""
        tracked, located, confirmed = result.tracked, result.locations, result.confirmed
        figures = {
            "frame": tracked.number,
            "time_s": math.nan if tracked.frame is None else tracked.frame.time_s,
            "located": not tracked.cause,
            "found": len(tracked.detections),
            "tracked": int((tracked.tracks.row >= 0).sum()),
            **{kind: math.nan if confirmed is None else confirmed.kind.count(kind) for kind in _KINDS},
            **({} if located is None else {"placed": len(located.positions), **_location_figures(located)}),
        }
        source = tracked if located is None else located
        self._add(figures, source.seconds, source.adjustments)

    def add_locations(self, located: AerialLocations) -> None:
        """Add a frame of a run that only locates targets."""
        self._add(_location_figures(located))

    def _add(
        self,
        figures: Mapping[str, float],
        seconds: Mapping[str, float] | None = None,
        adjustments: Sequence[Adjustment] = (),
    ) -> None:
        count = len(self)
        for name in figures.keys() - self._figures.keys():
            self._figures[name] = array("d", [math.nan]) * count
        for stage in (seconds or {}).keys() - self._seconds.keys():
            self._seconds[stage] = array("f", [0.0]) * count
        for name, values in self._figures.items():
            values.append(figures.get(name, math.nan))
        for stage, spent in self._seconds.items():
            spent.append((seconds or {}).get(stage, 0.0))
        for moved in adjustments:
            self._moves.setdefault(moved.parameter, []).append((moved.frame, moved.old, moved.new))

    def parameter(self, name: str) -> np.ndarray:
        """Return the (N,) values of a parameter in each frame; NaN if not finite."""
        moves = sorted(self._moves[name], key=lambda move: move[0])
        levels = np.array([moves[0][1], *(new for _, _, new in moves)], float)
        found = levels[np.searchsorted([frame for frame, _, _ in moves], self["frame"], side="right")]
        return np.where(np.isfinite(found), found, np.nan)

    def axis(self) -> tuple[np.ndarray, str]:
        """Return the (N,) places of the frames on the time axis, and its unit: seconds if all times are known."""
        time_s = self["time_s"]
        return (time_s, "time, s") if np.isfinite(time_s).all() else (self["frame"], "frame")

    def chart(self) -> Markup:
        """Draw the panels."""
        at, unit = self.axis()
        return time_chart(self.panels(), at, self["located"] == 0, unit)

    def panels(self) -> list[Panel]:
        """Return panels of events, targets, confirmations, adjusted parameters, computing time, and accuracy."""
        found = [("found", "found", 6), ("tracked", "with an identity", 1), ("placed", "located", 2)]
        kinds = [(kind, kind.replace("_", " "), colour) for kind, colour in _KINDS.items()]
        sigmas = [("sigma_m", "absolute", 2), ("relative_m", "relative to the team", 3)]
        seen = [("seen", "seen", 6), ("used", "used", 1)] if (self["seen"] > 0).any() else []
        limit = Line("95 % limit", self.axis()[0], self["limit"], 6, dashed=True)
        return [
            ("what happened", self._events()),
            ("targets", self._lines(found)),
            ("targets as judged by ground vehicles", self._lines(kinds)),
            *self._parameters(),
            ("time spent on a frame, ms, stacked", self._time_spent()),
            ("landmarks", self._lines(seen)),
            ("standard deviation of a target's place, m (median of the frame)", self._lines(sigmas, band=True)),
            ("chi-squared of the landmarks", [*self._lines([("chi2", "chi-squared", 7)], band=True), limit]),
        ]

    def _lines(self, figures: Sequence[tuple[str, str, int]], band: bool = False) -> list[Line]:
        """Return lines of the figures that are known in any frame. figures: names, titles and colours."""
        at, _ = self.axis()
        lines = [Line(title, at, self[name], colour, band=band) for name, title, colour in figures]
        return [line for line in lines if np.isfinite(line.y).any()]

    def _events(self) -> list[Events]:
        at, _ = self.axis()
        found = []
        for kind, colour in _EVENT_COLOURS.items():
            if len(at) and (events := self.events.get(kind)):
                places = np.interp([frame for frame, _ in events], self["frame"], at)
                found.append(Events(kind, places, [f"frame {frame}: {text}" for frame, text in events], colour))
        return found

    def _parameters(self) -> list[Panel]:
        """Return the panels of the parameters that were adjusted most often, without constant parameters."""
        at, _ = self.axis()
        values = {parameter: self.parameter(parameter) for parameter in self._moves}
        panels: dict[str, list[str]] = {}
        for parameter in sorted(name for name, v in values.items() if len(np.unique(v[np.isfinite(v)])) > 1):
            owner, _, name = parameter.partition(".")
            title = f"{name} of each ground vehicle" if owner in self._vehicles else parameter
            panels.setdefault(title, []).append(parameter)
        by_moves = sorted(panels, key=lambda title: -sum(len(self._moves[name]) for name in panels[title]))
        found: list[Panel] = []
        for title in sorted(by_moves[:_MOST_PARAMETERS]):
            names = {p: "" if panels[title] == [title] else p.partition(".")[0] for p in panels[title]}
            shown = zip(names.items(), cycle(_COLOURS), strict=False)
            found.append((title, [Line(name, at, values[p], colour, steps=True) for (p, name), colour in shown]))
        return found

    def _time_spent(self) -> list[Line]:
        """Return the slowest stages as stacked areas. The highest area is drawn first, so that no area is hidden."""
        at, _ = self.axis()
        spent_ms = {stage: 1000 * np.asarray(times, float) for stage, times in self._seconds.items()}
        by_time = sorted(spent_ms, key=lambda stage: -float(spent_ms[stage].sum()))
        shown = {stage: spent_ms[stage] for stage in by_time[:_MOST_STAGES]}
        if rest := [spent_ms[stage] for stage in by_time[_MOST_STAGES:]]:
            shown["other"] = np.sum(rest, axis=0)
        heights = np.cumsum([*shown.values()], axis=0)
        stages = zip(shown, heights, _COLOURS, strict=False)
        return [Line(stage, at, height, colour, area=True) for stage, height, colour in stages][::-1]


def _location_figures(located: AerialLocations) -> dict[str, float]:
    """Return landmarks seen and used, standard deviations, and chi-squared with its 95 % limit.

    sigma_m, relative_m: the root of the covariance's trace, as the median of the frame's targets.
    """
    fix = located.fix
    return {
        "frame": located.frame,
        "time_s": located.time_s,
        "located": bool(fix.by),
        "seen": len(fix.landmark),
        "used": sum(fix.is_used),
        "sigma_m": _median_sigma(located.positions.covariance_m2),
        "relative_m": _median_sigma(located.relative_m2),
        "chi2": fix.chi2,
        "limit": chi2_limit(fix.freedom),
    }


def chi2_limit(freedom: int) -> float:
    """Return the 95 % quantile of chi-squared; NaN without degrees of freedom."""
    from scipy.special import chdtri  # imported here, because it would slow down runs without positions

    return float(chdtri(freedom, 0.05)) if freedom >= 1 else math.nan


def _median_sigma(covariance_m2: np.ndarray) -> float:
    sigma = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2))
    sigma = sigma[np.isfinite(sigma)]
    return float(np.median(sigma)) if len(sigma) else math.nan
