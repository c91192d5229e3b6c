"""Plots of a page as SVG, small enough that a phone shows their words: curves and dots over two axes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

from torchvision_dddas.io.maps.map_frame import step_of

WIDE, HIGH = 420, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 18, 28, 40
_LETTER = 6.4
"""Pixels of a letter, about."""
MOST_POINTS = 400
"""Of a curve: more cannot be told apart."""


@dataclass(frozen=True)
class Axis:
    """What is drawn along an axis, from where to where; NaN: as the values ask. log: ten times as much each step."""

    name: str
    low: float = math.nan
    high: float = math.nan
    log: bool = False


@dataclass(frozen=True)
class Line:
    """A curve of (N,) places, broken where they are NaN. colour: 1 to 6, see page.STYLE. faint: one of many.

    steps: it stays as high as it is until the next place.
    """

    name: str
    x: np.ndarray
    y: np.ndarray
    colour: int = 1
    faint: bool = False
    dashed: bool = False
    steps: bool = False


@dataclass(frozen=True)
class Dots:
    """Places (N,), each with what it is in words. sign: disc, cross or ring."""

    name: str
    x: np.ndarray
    y: np.ndarray
    colour: int = 1
    words: Sequence[str] = field(default_factory=tuple)
    sign: str = "disc"


def chart(
    title: str, across: Axis, up: Axis, lines: Sequence[Line] = (), dots: Sequence[Dots] = (), equal: bool = False
) -> str:
    """A plot. equal: as long across as up, as on a map. What lies beyond the axes is cut."""
    series: list[Line | Dots] = [*lines, *dots]
    x = _span(across, np.concatenate([one.x for one in series]) if series else np.zeros(0))
    y = _span(up, np.concatenate([one.y for one in series]) if series else np.zeros(0))
    names = [(one.name, one) for one in series if one.name]
    legend, top = _legend(names)
    wide, high = float(WIDE - _LEFT - _RIGHT), float(HIGH - _TOP - _BOTTOM)
    if equal:
        x, y, high = _equal(x, y, wide)
    y0 = float(_TOP + top)

    def place(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _LEFT + _share(a, x, across.log) * wide, y0 + high - _share(b, y, up.log) * high

    parts = [f'<text x="6" y="16" class="title">{escape(title)}</text>', *legend]
    parts += _ticks_up(up, y, y0, wide, high) + _ticks_across(across, x, y0, wide, high)
    for line in lines:
        parts.append(_path(line, *place(*_corners(*_thinned(line.x, line.y), line.steps))))
    for one in dots:
        parts += _signs(one, *place(one.x, one.y))
    total = y0 + high + _BOTTOM
    said = escape(f"{title}: {up.name} against {across.name}" + "".join(f", {name}" for name, _ in names[:8]))
    return f'<svg viewBox="0 0 {WIDE} {total:g}" role="img" aria-label="{said}">{"".join(parts)}</svg>'


def _span(axis: Axis, values: np.ndarray) -> tuple[float, float]:
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


def _equal(
    x: tuple[float, float], y: tuple[float, float], wide: float
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Spans widened about their middles, and the height of the plot, so that a metre is as long in both."""
    room = 1.1
    size_x, size_y = (x[1] - x[0]) * room, (y[1] - y[0]) * room
    high = float(min(max(wide * size_y / size_x, 150), 420))
    unit = max(size_x / wide, size_y / high)
    middle_x, middle_y = (x[0] + x[1]) / 2, (y[0] + y[1]) / 2
    return (
        (middle_x - unit * wide / 2, middle_x + unit * wide / 2),
        (middle_y - unit * high / 2, middle_y + unit * high / 2),
        high,
    )


def _share(values: np.ndarray, span: tuple[float, float], log: bool) -> np.ndarray:
    values = np.asarray(values, float)
    if log:
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.log10(np.maximum(values, 1e-30))
        span = math.log10(span[0]), math.log10(span[1])
    return np.clip((values - span[0]) / (span[1] - span[0]), 0, 1)


def _thinned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fewer points of a long curve: the first and the last stay."""
    if len(x) <= MOST_POINTS:
        return x, y
    kept = np.unique(np.linspace(0, len(x) - 1, MOST_POINTS).round().astype(int))
    return x[kept], y[kept]


def _corners(x: np.ndarray, y: np.ndarray, steps: bool) -> tuple[np.ndarray, np.ndarray]:
    return (np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]) if steps and len(x) else (x, y)


def _path(line: Line, x: np.ndarray, y: np.ndarray) -> str:
    known = np.isfinite(x) & np.isfinite(y)
    edges = np.flatnonzero(np.diff(np.r_[0, known.astype(np.int8), 0])).reshape(-1, 2)
    drawn = []
    for first, last in edges.tolist():
        way = "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x[first:last], y[first:last], strict=True))
        drawn.append(f"M{way}" + ("h1.5" if last - first == 1 else ""))  # a single point would be no line
    dash = ' stroke-dasharray="5 4"' if line.dashed else ""
    hint = f"<title>{escape(line.name)}</title>" if line.name else ""
    return f'<path d="{"".join(drawn)}" class="{"faint" if line.faint else "line"} c{line.colour}"{dash}>{hint}</path>'


def _signs(dots: Dots, x: np.ndarray, y: np.ndarray) -> list[str]:
    parts = []
    for k, (a, b) in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
        if not (math.isfinite(a) and math.isfinite(b)):
            continue
        hint = f"<title>{escape(dots.words[k])}</title>" if k < len(dots.words) else ""
        parts.append(_sign(dots.sign, dots.colour, a, b, hint))
    return parts


def _sign(kind: str, colour: int, x: float, y: float, hint: str = "") -> str:
    if kind == "cross":
        return f'<path d="M{x - 3:.1f} {y - 3:.1f}l6 6m0-6l-6 6" class="line c{colour}">{hint}</path>'
    shape = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" class="'
    return f'{shape}{f"line c{colour}" if kind == "ring" else f"f{colour}"}">{hint}</circle>'


def _legend(names: Sequence[tuple[str, Line | Dots]]) -> tuple[list[str], int]:
    """What each colour is, in rows below the title, and how high they are."""
    parts, x, row = [], 8.0, 0
    if len(names) < 2:
        return [], 0
    for name, one in names:
        shown = name if len(name) <= 40 else f"{name[:39]}…"
        wide = 30 + _LETTER * len(shown)
        if x > 8 and x + wide > WIDE:
            x, row = 8.0, row + 1
        y = 30 + 17 * row
        if isinstance(one, Line):
            dash = ' stroke-dasharray="5 4"' if one.dashed else ""
            parts.append(f'<path d="M{x:.1f} {y}h16" class="line c{one.colour}"{dash}/>')
        else:
            parts.append(_sign(one.sign, one.colour, x + 8, y))
        parts.append(f'<text x="{x + 21:.1f}" y="{y + 4}">{escape(shown)}</text>')
        x += wide
    return parts, 17 * (row + 1)


def _ticks_up(axis: Axis, span: tuple[float, float], y0: float, wide: float, high: float) -> list[str]:
    middle = f"{y0 + high / 2:g}"
    turned = f'<text x="13" y="{middle}" text-anchor="middle" transform="rotate(-90 13 {middle})">'
    parts = [f"{turned}{escape(axis.name)}</text>"]
    for value, text in _numbers(axis, span, max(2, int(high // 45))):
        y = y0 + high - float(_share(np.array(value), span, axis.log)) * high
        parts.append(f'<path d="M{_LEFT} {y:.1f}h{wide}" class="grid"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
    return parts


def _ticks_across(axis: Axis, span: tuple[float, float], y0: float, wide: float, high: float) -> list[str]:
    parts = [f'<path d="M{_LEFT} {y0:g}v{high:g}h{wide}" class="axis"/>']
    for value, text in _numbers(axis, span, 6):
        x = _LEFT + float(_share(np.array(value), span, axis.log)) * wide
        parts.append(f'<path d="M{x:.1f} {y0 + high:g}v4" class="axis"/>')
        parts.append(f'<text x="{x:.1f}" y="{y0 + high + 17:g}" text-anchor="middle">{text}</text>')
    middle = _LEFT + wide / 2
    parts.append(f'<text x="{middle:g}" y="{y0 + high + 34:g}" text-anchor="middle">{escape(axis.name)}</text>')
    return parts


def _numbers(axis: Axis, span: tuple[float, float], count: int) -> list[tuple[float, str]]:
    if axis.log:
        powers = range(math.ceil(math.log10(span[0]) - 1e-9), math.floor(math.log10(span[1]) + 1e-9) + 1)
        return [(10.0**k, f"{10.0**k:g}") for k in powers]
    step = step_of(span[1] - span[0], count)
    first, last = math.ceil(span[0] / step - 1e-9), math.floor(span[1] / step + 1e-9)
    return [(k * step, f"{k * step:g}".replace("-", "−")) for k in range(first, last + 1)]
