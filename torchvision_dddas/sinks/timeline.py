"""Figures of a run over time, and a plot of them as SVG."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from torchvision_dddas.sinks.map_frame import step_of
from torchvision_dddas.types import Grounded

_ROW = np.dtype(
    [(name, "f8") for name in ("frame", "time_s", "seen", "used", "sigma_m", "relative_m", "chi2", "limit", "located")]
)
_LEFT, _RIGHT, _TOP, _BOTTOM, _WIDE, _HIGH = 64, 16, 26, 34, 1080, 130
_BINS = 540
USED = ("used", "reassigned")
"""States of a landmark that took part; one that was given another's place did."""


@dataclass(frozen=True)
class Curve:
    """A line of a plot: its name, (N,) values, its CSS colour; band: with all values about each bin's median."""

    name: str
    values: np.ndarray
    colour: str
    band: bool = False
    dashed: bool = False


class Timeline:
    """One row of figures a frame, 72 bytes each, at most three times that while the space for them grows."""

    def __init__(self) -> None:
        self._rows = np.zeros(256, _ROW)
        self._count = 0

    def add(self, grounded: Grounded) -> None:
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


def chi2_limit(freedom: int) -> float:
    """What chi-squared stays below in 95 % of all cases, to 1 %; NaN without freedom. Source: Wilson and Hilferty."""
    if freedom < 1:
        return math.nan
    part = 2 / (9 * freedom)
    return freedom * (1 - part + 1.6449 * math.sqrt(part)) ** 3


def plots(timeline: Timeline) -> str:
    """The landmarks, the standard deviations and chi-squared over time, one below the other; gaps are shaded."""
    rows = timeline.rows
    if len(rows) < 2:
        return ""
    timed = np.isfinite(rows["time_s"]).all()
    at, unit = (rows["time_s"], "time, s") if timed else (rows["frame"], "frame")
    gap = rows["located"] == 0
    panels = [
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
    shown = [(title, curves) for title, curves in panels if any(np.isfinite(c.values).any() for c in curves)]
    height = len(shown) * (_HIGH + _TOP + _BOTTOM)
    drawn = [
        panel(title, curves, at, gap, k * (_HIGH + _TOP + _BOTTOM), unit) for k, (title, curves) in enumerate(shown)
    ]
    label = escape("plots over time of " + ", ".join(title for title, _ in shown))
    return (
        f'<svg viewBox="0 0 {_LEFT + _WIDE + _RIGHT} {height}" role="img" aria-label="{label}">{"".join(drawn)}</svg>'
    )


def panel(title: str, curves: Sequence[Curve], at: np.ndarray, gap: np.ndarray, top: float, unit: str) -> str:
    """One plot. at: (N,) places on its axis, growing. gap: (N,) bool, where nothing was located. top: in pixels."""
    start, span = float(at[0]), max(float(at[-1] - at[0]), 1e-9)
    values = np.concatenate([curve.values for curve in curves])
    # A few wild frames do not flatten all the others; what is higher is cut.
    highest = float(np.percentile(values[np.isfinite(values)], 99.5)) * 1.12 or 1.0
    y0 = top + _TOP

    def place(x: np.ndarray, y: np.ndarray) -> list[str]:
        across = _LEFT + (x - start) / span * _WIDE
        down = y0 + _HIGH - np.clip(y / highest, 0, 1) * _HIGH
        return [f"{a:.1f},{b:.1f}" for a, b in zip(across.tolist(), down.tolist(), strict=True)]

    parts = [f'<text x="{_LEFT}" y="{y0 - 9}" class="title">{escape(title)}</text>']
    for first, last in _spans(gap):
        west, east = (_LEFT + (float(v) - start) / span * _WIDE for v in (at[first], at[last]))
        parts.append(
            f'<rect x="{west:.1f}" y="{y0}" width="{max(east - west, 1.5):.1f}" height="{_HIGH}" class="gap"/>'
        )
    step = step_of(highest, 4)
    for k in range(int(highest / step) + 1):
        y = y0 + _HIGH - k * step / highest * _HIGH
        parts.append(f'<path d="M{_LEFT} {y:.1f}h{_WIDE}" class="grid"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{k * step:g}</text>')
    step = step_of(span, 10)
    for k in range(math.ceil(start / step - 1e-9), math.floor((start + span) / step + 1e-9) + 1):
        x = _LEFT + (k * step - start) / span * _WIDE
        parts.append(f'<path d="M{x:.1f} {y0 + _HIGH}v5" class="tick"/>')
        parts.append(f'<text x="{x:.1f}" y="{y0 + _HIGH + 18}" text-anchor="middle">{k * step:g}</text>')
    parts.append(f'<path d="M{_LEFT} {y0}v{_HIGH}h{_WIDE}" class="tick"/>')
    parts.append(f'<text x="{_LEFT + _WIDE}" y="{y0 + _HIGH + 31}" text-anchor="end">{unit}</text>')
    right = _LEFT + _WIDE
    for curve in reversed(curves):
        right -= 7 * len(curve.name) + 34
        dash = ' stroke-dasharray="6 4"' if curve.dashed else ""
        parts.append(f'<path d="M{right} {y0 - 13}h18" stroke="{curve.colour}"{dash} class="curve"/>')
        parts.append(f'<text x="{right + 22}" y="{y0 - 9}">{escape(curve.name)}</text>')
    for curve in curves:
        middles, low, middle, high = _binned(at, curve.values)
        dash = ' stroke-dasharray="6 4"' if curve.dashed else ""
        for first, last in _spans(np.isfinite(middle)):
            piece = slice(first, last + 1)
            if curve.band and last > first:
                outline = [*place(middles[piece], high[piece]), *reversed(place(middles[piece], low[piece]))]
                parts.append(f'<path d="M{"L".join(outline)}Z" fill="{curve.colour}" opacity="0.18"/>')
            way = place(middles[piece], middle[piece])
            # A single value would be no line.
            d = f"M{way[0]}h1.5" if len(way) == 1 else f"M{'L'.join(way)}"
            parts.append(f'<path d="{d}" stroke="{curve.colour}"{dash} class="curve"/>')
    return "".join(parts)


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
