"""Charts as inline SVG: curves and points over two axes, one value per row with its interval, panels over time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape

import numpy as np
from markupsafe import Markup

from torchvision_dddas.io.maps.map_picture import round_step
from torchvision_dddas.io.report import format_number

WIDTH, HEIGHT = 420, 300
MOST_POINTS = 400
"""Largest number of points per curve of `chart`."""
MOST_ROWS = 40
"""Largest number of rows of an interval chart."""
TIME_LEFT, TIME_WIDTH = 64, 1080
"""Left edge and width in pixels of the panels of a time chart."""

_LETTER_PX = 6.4
_DASHES = ' stroke-dasharray="5 4"'
_MOST_BINS = 540


@dataclass(frozen=True)
class Axis:
    """An axis with its limits; a limit of NaN is taken from the values. log: logarithmic axis."""

    name: str
    low: float = math.nan
    high: float = math.nan
    log: bool = False


@dataclass(frozen=True)
class Line:
    """A curve through (N,) points, interrupted at NaN.

    colour: 1 to 8, see style.css. faint: drawn faintly, for one of many curves. steps: each value holds until the next
    point. area: filled down to zero. band: `time_chart` also shades the range of values in each bin.
    """

    name: str
    x: np.ndarray
    y: np.ndarray
    colour: int = 1
    faint: bool = False
    dashed: bool = False
    steps: bool = False
    area: bool = False
    band: bool = False


@dataclass(frozen=True)
class Dots:
    """(N,) points, each a disc or a ring."""

    name: str
    x: np.ndarray
    y: np.ndarray
    colour: int = 1
    is_ring: bool = False


@dataclass(frozen=True)
class Interval:
    """A named value with an interval; unknown limits are NaN."""

    name: str
    value: float
    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True)
class Events:
    """A row of ticks at (N,) places on the time axis, each with a text that appears under the pointer."""

    name: str
    x: np.ndarray
    texts: Sequence[str]
    colour: int = 1


Panel = tuple[str, Sequence[Line] | Sequence[Events]]
"""A title and the content of a panel of a time chart: either lines or events."""


def chart(
    title: str, across: Axis, up: Axis, lines: Sequence[Line] = (), dots: Sequence[Dots] = (), equal: bool = False
) -> Markup:
    """Draw lines and points over two axes. equal: use the same scale for both. Values beyond the axes are clipped."""
    series: list[Line | Dots] = [*lines, *dots]
    named = [one for one in series if one.name]
    legend, legend_high = _legend(named if len(named) > 1 else [], 8, 30, WIDTH)
    x, y = (_limits(axis, [getattr(one, name) for one in series]) for axis, name in ((across, "x"), (up, "y")))
    plot = _Plot(58, 28 + legend_high, WIDTH - 76, HEIGHT - 68, x, y, across.log, up.log)
    if equal:
        plot = _with_equal_scales(plot)
    middle = f"{plot.top + plot.high / 2:g}"
    parts = [
        _text(6, 16, title, "start", "title"),
        *legend,
        f'<text x="13" y="{middle}" text-anchor="middle" transform="rotate(-90 13 {middle})">{escape(up.name)}</text>',
        *plot.grid(max(2, int(plot.high // 45))),
        *plot.base(6),
        _text(plot.left + plot.wide / 2, plot.low + 34, across.name, "middle"),
    ]
    for line in lines:
        kept = np.unique(np.linspace(0, len(line.x) - 1, min(len(line.x), MOST_POINTS)).round().astype(int))
        parts += plot.curve(replace(line, x=line.x[kept], y=line.y[kept]))
    for one in dots:
        for a, b in zip(*plot.place(one.x, one.y), strict=True):
            if math.isfinite(a) and math.isfinite(b):
                parts.append(_sign(one, a, b))
    label = f"{title}: {up.name} against {across.name}" + "".join(f", {one.name}" for one in named[:8])
    return _svg(WIDTH, plot.low + 40, label, parts)


def interval_chart(
    title: str, rows: Sequence[Interval], whole: Interval | None = None, limits: tuple[float, float] = (0.0, 1.0)
) -> Markup:
    """Draw one row per value with its interval, for the first MOST_ROWS known values, in the given order.

    whole: drawn as a line with a band through all rows. limits: smallest range of the axis.
    """
    shown = [row for row in rows if math.isfinite(row.value)][:MOST_ROWS]
    ends = [end for row in shown for end in (row.value, row.low, row.high) if math.isfinite(end)]
    low, high = min([limits[0], *ends]), max([limits[1], *ends])
    high = high if high > low else low + 1
    plot = _Plot(150, 30, WIDTH - 196, 19 * len(shown), (low, high), (0, 1))
    parts = [_text(6, 16, title, "start", "title")]
    for x, text in plot.numbers_across(5):
        parts += [f'<path d="M{x:.1f} {plot.top}v{plot.high}" class="grid"/>', _text(x, plot.low + 16, text, "middle")]
    if whole is not None and math.isfinite(whole.value):
        if math.isfinite(whole.low) and math.isfinite(whole.high):
            parts.append(plot.shade(max(whole.low, low), min(whole.high, high), 1.0, "band f2"))
        (x,) = plot.across([whole.value])
        said = f"{whole.name} {format_number(whole.value)}"
        parts.append(f'<path d="M{x:.1f} {plot.top - 3}v{plot.high + 6}" class="line c2"{_DASHES}>{_hint(said)}</path>')
        anchor = "end" if x > WIDTH - 120 else "start" if x < plot.left + 60 else "middle"
        parts.append(_text(x, plot.low + 31, said if whole.value else whole.name, anchor, "f2"))
    for k, row in enumerate(shown):
        y = plot.top + 19 * k + 9.5
        parts.append(_text(142, y + 4, row.name if len(row.name) <= 21 else f"{row.name[:20]}…", "end", "name"))
        said = f"{row.name} {format_number(row.value)}"
        if math.isfinite(row.low) and math.isfinite(row.high):
            said += f", 95 %: {format_number(row.low)} to {format_number(row.high)}"
            a, b = plot.across([row.low, row.high])
            parts.append(f'<path d="M{a:.1f} {y - 4:g}v8m0-4H{b:.1f}m0-4v8" class="line c1"/>')
        (x,) = plot.across([row.value])
        parts.append(f'<circle cx="{x:.1f}" cy="{y:g}" r="4.5" class="f1">{_hint(said)}</circle>')
        parts.append(_text(WIDTH - 4, y + 4, format_number(row.value), "end"))
    values = "; ".join(f"{row.name} {format_number(row.value)}" for row in shown[:12])
    return _svg(WIDTH, plot.low + 36, f"{title}: {values}", parts)


def time_chart(panels: Sequence[Panel], at: np.ndarray, has_gap: np.ndarray, unit: str) -> Markup:
    """Draw panels one below the other over a shared time axis. Return empty markup for fewer than two frames.

    at: (N,) increasing places of the frames on the axis; each line has N values. has_gap: (N,) bool, frames to shade.
    unit: name of the axis. Panels without a known value are left out.
    """
    panels = [(title, series) for title, series in panels if any(map(_is_known, series))]
    if len(at) < 2 or not panels:
        return Markup("")
    parts: list[str] = []
    top = 0.0
    gaps = [at[[gap.start, gap.stop - 1]] for gap in _runs(has_gap)]
    for title, series in panels:
        lines = [one for one in series if isinstance(one, Line)]
        events = [one for one in series if isinstance(one, Events)]
        high = 20.0 * len(events) if events else 70.0 if all(line.steps for line in lines) else 130.0
        legend, legend_high = _legend([line for line in lines if line.name], 90 + 7 * len(title), top + 13, 1160)
        top += legend_high - 17 if legend_high else 0
        plot = _Plot(TIME_LEFT, top + 26, TIME_WIDTH, high, (float(at[0]), max(float(at[-1]), at[0] + 1e-9)), (0, 1))
        parts += [_text(TIME_LEFT, plot.top - 9, title, "start", "title"), *legend]
        parts += [plot.shade(west, east, 1.5, "gap") for west, east in gaps]
        parts += _event_rows(events, plot) if events else _panel(lines, at, plot)
        parts += [*plot.base(10), _text(TIME_LEFT + TIME_WIDTH, plot.low + 31, unit, "end")]
        top += high + 60
    label = "plots over time of " + ", ".join(title for title, _ in panels)
    return _svg(TIME_LEFT + TIME_WIDTH + 16, top, label, parts)


@dataclass(frozen=True)
class _Plot:
    """A rectangle of a picture and the values at its edges."""

    left: float
    top: float
    wide: float
    high: float
    x: tuple[float, float]
    y: tuple[float, float]
    log_x: bool = False
    log_y: bool = False

    @property
    def low(self) -> float:
        return self.top + self.high

    def across(self, x: Sequence[float] | np.ndarray) -> list[float]:
        return (self.left + _share(np.asarray(x, float), self.x, self.log_x) * self.wide).tolist()

    def place(self, x: np.ndarray, y: np.ndarray) -> tuple[list[float], list[float]]:
        return self.across(x), (self.low - _share(y, self.y, self.log_y) * self.high).tolist()

    def grid(self, count: int) -> list[str]:
        parts = []
        for value, text in _ticks(self.y, self.log_y, count):
            (y,) = self.place(np.zeros(1), np.array([value]))[1]
            parts.append(f'<path d="M{self.left} {y:.1f}h{self.wide}" class="grid"/>')
            parts.append(_text(self.left - 6, y + 4, text, "end"))
        return parts

    def numbers_across(self, count: int) -> list[tuple[float, str]]:
        return [(self.across([value])[0], text) for value, text in _ticks(self.x, self.log_x, count)]

    def base(self, count: int) -> list[str]:
        parts = [f'<path d="M{self.left} {self.top:g}v{self.high:g}h{self.wide}" class="axis"/>']
        for x, text in self.numbers_across(count):
            parts += [f'<path d="M{x:.1f} {self.low:g}v4" class="axis"/>', _text(x, self.low + 17, text, "middle")]
        return parts

    def shade(self, west: float, east: float, least_px: float, style: str) -> str:
        left, right = self.across([west, east])
        place = f'x="{left:.1f}" y="{self.top:g}" width="{max(right - left, least_px):.1f}" height="{self.high:g}"'
        return f'<rect {place} class="{style}"/>'

    def curve(self, line: Line) -> list[str]:
        """Return the path of a line, after the filled area below it, if there is one."""
        pieces, areas = [], []
        for piece in _runs(np.isfinite(line.x) & np.isfinite(line.y)):
            x, y = line.x[piece], line.y[piece]
            if line.steps:
                # Add the corners of the steps.
                jumps = np.flatnonzero(np.diff(y)) + 1
                corner_y = np.stack([y[jumps - 1], y[jumps]], axis=1).ravel()
                x, y = np.r_[x[0], np.repeat(x[jumps], 2), x[-1]], np.r_[y[0], corner_y, y[-1]]
            way = _way(*self.place(x, y))
            pieces.append(f"M{way}" + ("h1.5" if len(x) == 1 else ""))  # draw a single point as a short line
            if line.area and len(x) > 1:
                areas.append(f"M{way}L{_way(*self.place(x[[-1, 0]], np.zeros(2)))}Z")
        dashes, kind = _DASHES if line.dashed else "", "faint" if line.faint else "line"
        drawn = f'<path d="{"".join(pieces)}" class="{kind} c{line.colour}"{dashes}>{_hint(line.name)}</path>'
        return [*([f'<path d="{"".join(areas)}" class="area f{line.colour}"/>'] if areas else []), drawn]


def _limits(axis: Axis, series: Sequence[np.ndarray]) -> tuple[float, float]:
    values = np.concatenate([np.zeros(0), *series])
    known = values[np.isfinite(values) & ((values > 0) | (not axis.log))]
    low = axis.low if math.isfinite(axis.low) else float(known.min(initial=math.inf))
    high = axis.high if math.isfinite(axis.high) else float(known.max(initial=-math.inf))
    if not (math.isfinite(low) and math.isfinite(high)):
        low, high = (0.1, 1.0) if axis.log else (0.0, 1.0)
    if axis.log:
        low, high = (10 ** math.floor(math.log10(low) + 1e-9), 10 ** math.ceil(math.log10(high) - 1e-9))
        return (low, high) if high > low else (low / 10, high)
    if high <= low:
        return (low - 0.5, low + 0.5) if low else (0.0, 1.0)
    return (low, high) if math.isfinite(axis.high) else (low, high + 0.05 * (high - low))


def _with_equal_scales(plot: _Plot) -> _Plot:
    """Widen the limits and choose the height so that a unit has the same length in both directions."""
    (west, east), (south, north) = plot.x, plot.y
    size_x, size_y = 1.1 * (east - west), 1.1 * (north - south)
    high = float(min(max(plot.wide * size_y / size_x, 150), 420))
    unit = max(size_x / plot.wide, size_y / high)
    x, y = (west + east) / 2, (south + north) / 2
    half_x, half_y = unit * plot.wide / 2, unit * high / 2
    return replace(plot, high=high, x=(x - half_x, x + half_x), y=(y - half_y, y + half_y))


def _share(values: np.ndarray, limits: tuple[float, float], log: bool) -> np.ndarray:
    """Return the positions of values between the limits, from 0 to 1."""
    if log:
        values, limits = np.log10(np.maximum(values, 1e-30)), (math.log10(limits[0]), math.log10(limits[1]))
    return np.clip((values - limits[0]) / (limits[1] - limits[0]), 0, 1)


def _ticks(limits: tuple[float, float], log: bool, count: int) -> list[tuple[float, str]]:
    if log:
        powers = range(math.ceil(math.log10(limits[0]) - 1e-9), math.floor(math.log10(limits[1]) + 1e-9) + 1)
        return [(10.0**k, f"{10.0**k:g}") for k in powers]
    step = round_step(limits[1] - limits[0], count)
    first, last = math.ceil(limits[0] / step - 1e-9), math.floor(limits[1] / step + 1e-9)
    return [(k * step, f"{k * step:g}".replace("-", "−")) for k in range(first, last + 1)]


def _panel(lines: Sequence[Line], at: np.ndarray, plot: _Plot) -> list[str]:
    """Draw lines through the medians of bins of successive frames."""
    values = np.concatenate([line.y for line in lines])
    low, high = np.percentile(values[np.isfinite(values)], [0.5, 99.5]) * 1.12  # ignore a few outliers
    plot = replace(plot, y=(min(float(low), 0.0), max(float(high) or 1.0, 0.0)))
    parts = plot.grid(4)
    size = math.ceil(len(at) / _MOST_BINS)
    count = math.ceil(len(at) / size)
    middle = at[np.minimum(np.arange(count) * size + size // 2, len(at) - 1)]
    for line in lines:
        bins = np.full(count * size, np.nan)
        bins[: len(at)] = np.where(np.isfinite(line.y), line.y, np.nan)
        ordered = np.sort(bins.reshape(count, size), axis=1)  # NaN is sorted last
        known, row = np.maximum(np.isfinite(ordered).sum(axis=1), 1), np.arange(count)
        median = (ordered[row, (known - 1) // 2] + ordered[row, known // 2]) / 2
        for piece in _runs(np.isfinite(median)) if line.band else ():
            upper = _way(*plot.place(middle[piece], ordered[row, known - 1][piece]))
            lower = _way(*plot.place(middle[piece][::-1], ordered[piece, 0][::-1]))
            parts.append(f'<path d="M{upper}L{lower}Z" class="band f{line.colour}"/>')
        parts += plot.curve(replace(line, x=middle, y=median))
    return parts


def _event_rows(events: Sequence[Events], plot: _Plot) -> list[str]:
    parts = []
    for k, one in enumerate(events):
        y = plot.top + 20 * k
        parts.append(f'<path d="M{plot.left} {y + 20:g}h{plot.wide}" class="grid"/>')
        parts.append(_text(plot.left - 8, y + 14, one.name, "end"))
        texts: dict[int, list[str]] = {}
        for x, text in zip(plot.across(one.x), one.texts, strict=True):
            texts.setdefault(round(x / 2) * 2, []).append(text)
        for x, said in texts.items():
            hint = said[0][:160] + (f" and {len(said) - 1} more" if len(said) > 1 else "")
            parts.append(f'<path d="M{x} {y + 3:g}v14" class="line c{one.colour}">{_hint(hint)}</path>')
    return parts


def _legend(series: Sequence[Line | Dots], left: float, top: float, right: float) -> tuple[list[str], int]:
    """Return the legend, with a sign and a name for each series in rows, and the height of the rows."""
    parts, x, row = [], left, 0
    for one in series:
        name = one.name if len(one.name) <= 40 else f"{one.name[:39]}…"
        wide = 30 + _LETTER_PX * len(name)
        if x > left and x + wide > right:
            x, row = left, row + 1
        y = top + 17 * row
        if isinstance(one, Line):
            parts.append(f'<path d="M{x:.1f} {y:g}h16" class="line c{one.colour}"{_DASHES if one.dashed else ""}/>')
        else:
            parts.append(_sign(one, x + 8, y))
        parts.append(_text(x + 21, y + 4, name, "start"))
        x += wide
    return parts, 17 * (row + 1) if series else 0


def _sign(dots: Dots, x: float, y: float) -> str:
    style = f"line c{dots.colour}" if dots.is_ring else f"f{dots.colour}"
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" class="{style}"/>'


def _text(x: float, y: float, text: str, anchor: str, style: str = "") -> str:
    kind = f' class="{style}"' if style else ""
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}"{kind}>{escape(text)}</text>'


def _hint(text: str) -> str:
    return f"<title>{escape(text)}</title>" if text else ""


def _svg(wide: float, high: float, label: str, parts: Sequence[str]) -> Markup:
    box = f'viewBox="0 0 {wide:g} {high:g}" role="img" aria-label="{escape(label)}"'
    return Markup(f"<svg {box}>{''.join(parts)}</svg>")


def _way(x: Sequence[float], y: Sequence[float]) -> str:
    return "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))


def _runs(flags: np.ndarray) -> list[slice]:
    """Return the slices of successive True values."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(np.int8), 0])).reshape(-1, 2)
    return [slice(first, last) for first, last in edges.tolist()]


def _is_known(one: Line | Events) -> bool:
    return len(one.x) > 0 if isinstance(one, Events) else bool(np.isfinite(one.y).any())
