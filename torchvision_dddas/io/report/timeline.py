"""Figures of a run over time, and a plot of them as SVG."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Protocol

import numpy as np

from torchvision_dddas.io.maps.map_frame import step_of
from torchvision_dddas.types import AerialLocations

_ROW = np.dtype(
    [(name, "f8") for name in ("frame", "time_s", "seen", "used", "sigma_m", "relative_m", "chi2", "limit", "located")]
)
_LEFT, _RIGHT, _TOP, _BOTTOM, _WIDE, _HIGH = 64, 16, 26, 34, 1080, 130
_LOW, _ROW_HIGH = 70, 20
_BINS = 540
USED = ("used", "reassigned")
"""States of a landmark that took part; one that was given another's place did."""


@dataclass(frozen=True)
class Curve:
    """A line of a plot: its name, (N,) values, its CSS colour; band: with all values about each bin's median.

    steps: it stays as it is until it jumps. area: the space down to the axis is filled.
    """

    name: str
    values: np.ndarray
    colour: str
    band: bool = False
    dashed: bool = False
    steps: bool = False
    area: bool = False


@dataclass(frozen=True)
class Ticks:
    """A line of a plot that says when something happened: (M,) places on its axis, and what it was, in words."""

    name: str
    at: np.ndarray
    words: Sequence[str]
    colour: str


Panel = tuple[str, Sequence[Curve] | Sequence[Ticks]]
"""A plot: its title and its lines, all of one kind."""


class OverTime(Protocol):
    """What can be plotted over time; located is 0 where the plots are shaded."""

    @property
    def rows(self) -> np.ndarray:
        """(N,) with frame, time_s and located."""

    def panels(self) -> list[Panel]:
        """The plots."""


class Timeline:
    """One row of figures a frame, 72 bytes each, at most three times that while the space for them grows."""

    def __init__(self) -> None:
        self._rows = np.zeros(256, _ROW)
        self._count = 0

    def add(self, grounded: AerialLocations) -> None:
        """Take note of a frame. sigma_m, relative_m: the median of its targets' roots of the covariance's trace."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros(len(self._rows), _ROW)])
        fix = grounded.fix
        self._rows[self._count] = (
            grounded.frame,
            grounded.time_s,
            len(fix.landmark),
            sum(state in USED for state in fix.state),
            _median_sigma(grounded.positions.covariance_m2),
            _median_sigma(grounded.relative_m2),
            fix.chi2,
            chi2_limit(fix.freedom),
            bool(fix.by),
        )
        self._count += 1

    @property
    def rows(self) -> np.ndarray:
        """(N,) frame, time_s, seen, used, sigma_m, relative_m, chi2, its 95 % limit, located."""
        return self._rows[: self._count]

    def panels(self) -> list[Panel]:
        """The landmarks, the standard deviations and chi-squared."""
        rows = self.rows
        return [
            (
                "landmarks",
                [Curve("seen", rows["seen"], "#b8b8b8"), Curve("used", rows["used"], "#1f5fa8")],
            ),
            (
                "standard deviation of a target's place, m (median of the frame)",
                [
                    Curve("absolute", rows["sigma_m"], "#b5541c", band=True),
                    Curve("relative to the team", rows["relative_m"], "#2b7d4f", band=True),
                ],
            ),
            (
                "chi-squared of the landmarks",
                [
                    Curve("chi-squared", rows["chi2"], "#5b3f94", band=True),
                    Curve("95 % limit", rows["limit"], "#b8b8b8", dashed=True),
                ],
            ),
        ]


def chi2_limit(freedom: int) -> float:
    """What chi-squared stays below in 95 % of all cases, to 1 %; NaN without freedom. Source: Wilson and Hilferty."""
    if freedom < 1:
        return math.nan
    part = 2 / (9 * freedom)
    return freedom * (1 - part + 1.6449 * math.sqrt(part)) ** 3


def plots(timeline: OverTime, more: Sequence[Panel] = ()) -> str:
    """Panels over time, one below the other; gaps are shaded. more: of the same frames, above the timeline's own."""
    rows = timeline.rows
    if len(rows) < 2:
        return ""
    at, unit = axis(rows)
    gap = rows["located"] == 0
    panels = [*more, *timeline.panels()]
    shown = [
        (title, lines)
        for title, lines in panels
        if any(len(one.at) if isinstance(one, Ticks) else np.isfinite(one.values).any() for one in lines)
    ]
    drawn, top = [], 0.0
    for title, lines in shown:
        ticks = [one for one in lines if isinstance(one, Ticks)]
        if ticks:
            text, high = strip(title, ticks, at, gap, top, unit)
        else:
            curves = [one for one in lines if isinstance(one, Curve)]
            high = _LOW if all(curve.steps for curve in curves) else _HIGH
            text = panel(title, curves, at, gap, top, unit, high)
        drawn.append(text)
        top += high + _TOP + _BOTTOM
    label = escape("plots over time of " + ", ".join(title for title, _ in shown))
    return f'<svg viewBox="0 0 {_LEFT + _WIDE + _RIGHT} {top:g}" role="img" aria-label="{label}">{"".join(drawn)}</svg>'


def axis(rows: np.ndarray) -> tuple[np.ndarray, str]:
    """(N,) places of frames on the axis, and what they are: seconds where all are known."""
    if np.isfinite(rows["time_s"]).all():
        return rows["time_s"], "time, s"
    return rows["frame"], "frame"


def panel(
    title: str, curves: Sequence[Curve], at: np.ndarray, gap: np.ndarray, top: float, unit: str, high: float = _HIGH
) -> str:
    """One plot. at: (N,) places on its axis, growing. gap: (N,) bool, where nothing was located. top: in pixels."""
    values = np.concatenate([curve.values for curve in curves])
    known = values[np.isfinite(values)]
    # A few wild frames do not flatten all the others; what is higher is cut.
    highest = float(np.percentile(known, 99.5)) * 1.12 or 1.0
    lowest = min(float(np.percentile(known, 0.5)) * 1.12, 0.0)
    highest = max(highest, 0.0)
    y0 = top + _TOP

    def place(x: np.ndarray, y: np.ndarray) -> list[str]:
        down = y0 + high - np.clip((y - lowest) / (highest - lowest), 0, 1) * high
        return [f"{a:.1f},{b:.1f}" for a, b in zip(_across(x, at).tolist(), down.tolist(), strict=True)]

    parts = [f'<text x="{_LEFT}" y="{y0 - 9:g}" class="title">{escape(title)}</text>', *_shaded(gap, at, y0, high)]
    step = step_of(highest - lowest, 4)
    for k in range(math.ceil(lowest / step - 1e-9), int(highest / step) + 1):
        y = y0 + high - (k * step - lowest) / (highest - lowest) * high
        parts.append(f'<path d="M{_LEFT} {y:.1f}h{_WIDE}" class="grid"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{k * step:g}</text>')
    parts += _axis(at, y0, high, unit)
    right = float(_LEFT + _WIDE)
    for curve in reversed([curve for curve in curves if curve.name]):
        right -= 7 * len(curve.name) + 34
        dash = ' stroke-dasharray="6 4"' if curve.dashed else ""
        parts.append(f'<path d="M{right:g} {y0 - 13:g}h18" stroke="{curve.colour}"{dash} class="curve"/>')
        parts.append(f'<text x="{right + 22:g}" y="{y0 - 9:g}">{escape(curve.name)}</text>')
    for curve in curves:
        middles, low, middle, top_of = _binned(at, curve.values)
        dash = ' stroke-dasharray="6 4"' if curve.dashed else ""
        for first, last in _spans(np.isfinite(middle)):
            piece = slice(first, last + 1)
            corners = _stairs(middles[piece], middle[piece]) if curve.steps else (middles[piece], middle[piece])
            if curve.band and last > first:
                outline = [*place(middles[piece], top_of[piece]), *reversed(place(middles[piece], low[piece]))]
                parts.append(f'<path d="M{"L".join(outline)}Z" fill="{curve.colour}" opacity="0.18"/>')
            way = place(*corners)
            if curve.area and last > first:
                floor = place(middles[[last, first]], np.zeros(2))
                parts.append(f'<path d="M{"L".join([*way, *floor])}Z" fill="{curve.colour}" opacity="0.75"/>')
            # A single value would be no line.
            d = f"M{way[0]}h1.5" if len(way) == 1 else f"M{'L'.join(way)}"
            parts.append(f'<path d="{d}" stroke="{curve.colour}"{dash} class="curve"/>')
    return "".join(parts)


def strip(
    title: str, lines: Sequence[Ticks], at: np.ndarray, gap: np.ndarray, top: float, unit: str
) -> tuple[str, float]:
    """A plot of what happened when, a row a line, and its height. A pointer that rests on a tick shows what it was."""
    y0, high = top + _TOP, float(_ROW_HIGH * len(lines))
    parts = [f'<text x="{_LEFT}" y="{y0 - 9:g}" class="title">{escape(title)}</text>', *_shaded(gap, at, y0, high)]
    for k, line in enumerate(lines):
        y = y0 + k * _ROW_HIGH
        parts.append(f'<path d="M{_LEFT} {y + _ROW_HIGH:g}h{_WIDE}" class="grid"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + _ROW_HIGH - 6:g}" text-anchor="end">{escape(line.name)}</text>')
        kept: dict[int, list[str]] = {}
        for x, words in zip(_across(np.clip(line.at, at[0], at[-1]), at).tolist(), line.words, strict=True):
            kept.setdefault(round(x / 2) * 2, []).append(words)
        for place, said in kept.items():
            hint = said[0][:160] + (f" and {len(said) - 1} more" if len(said) > 1 else "")
            parts.append(
                f'<path d="M{place} {y + 3:g}v{_ROW_HIGH - 6}" stroke="{line.colour}" stroke-width="2">'
                f"<title>{escape(hint)}</title></path>"
            )
    return "".join([*parts, *_axis(at, y0, high, unit)]), high


def _across(x: np.ndarray, at: np.ndarray) -> np.ndarray:
    start, span = float(at[0]), max(float(at[-1] - at[0]), 1e-9)
    return _LEFT + (x - start) / span * _WIDE


def _shaded(gap: np.ndarray, at: np.ndarray, y0: float, high: float) -> list[str]:
    parts = []
    for first, last in _spans(gap):
        west, east = _across(at[[first, last]], at).tolist()
        parts.append(
            f'<rect x="{west:.1f}" y="{y0:g}" width="{max(east - west, 1.5):.1f}" height="{high:g}" class="gap"/>'
        )
    return parts


def _axis(at: np.ndarray, y0: float, high: float, unit: str) -> list[str]:
    start, span = float(at[0]), max(float(at[-1] - at[0]), 1e-9)
    parts, step = [], step_of(span, 10)
    for k in range(math.ceil(start / step - 1e-9), math.floor((start + span) / step + 1e-9) + 1):
        x = _LEFT + (k * step - start) / span * _WIDE
        parts.append(f'<path d="M{x:.1f} {y0 + high:g}v5" class="tick"/>')
        parts.append(f'<text x="{x:.1f}" y="{y0 + high + 18:g}" text-anchor="middle">{k * step:g}</text>')
    parts.append(f'<path d="M{_LEFT} {y0:g}v{high:g}h{_WIDE}" class="tick"/>')
    parts.append(f'<text x="{_LEFT + _WIDE}" y="{y0 + high + 31:g}" text-anchor="end">{unit}</text>')
    return parts


def _stairs(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a line that stays as it is until it jumps; where it does not, nothing but its ends is needed."""
    jumps = np.flatnonzero(np.diff(y)) + 1
    corner_x = np.repeat(x[jumps], 2)
    corner_y = np.stack([y[jumps - 1], y[jumps]], axis=1).ravel()
    return np.r_[x[0], corner_x, x[-1]], np.r_[y[0], corner_y, y[-1]]


def _binned(at: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Middle of each bin of successive frames, and the lowest, median and highest value of those known in it."""
    size = max(1, math.ceil(len(at) / _BINS))
    full = np.full(math.ceil(len(at) / size) * size, np.nan)
    full[: len(at)] = values
    bins = full.reshape(-1, size)
    known = np.isfinite(bins).any(axis=1)
    found = np.full((3, len(bins)), np.nan)
    found[0, known] = np.nanmin(bins[known], axis=1)
    found[1, known] = np.nanmedian(bins[known], axis=1)
    found[2, known] = np.nanmax(bins[known], axis=1)
    middle = at[np.minimum(np.arange(len(bins)) * size + size // 2, len(at) - 1)]
    return middle, found[0], found[1], found[2]


def _spans(flags: np.ndarray) -> list[tuple[int, int]]:
    """First and last place of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _median_sigma(covariance_m2: np.ndarray) -> float:
    sigma = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2))
    sigma = sigma[np.isfinite(sigma)]
    return float(np.median(sigma)) if len(sigma) else math.nan
