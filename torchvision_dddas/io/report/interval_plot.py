"""A measure of many clips as a row each: its value, how sure it is, and where all of them together lie."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from torchvision_dddas.io.maps.map_frame import step_of
from torchvision_dddas.io.report.page_tables import number

WIDE = 420
_NAMES, _RIGHT, _TOP, _ROW, _BOTTOM = 150, 46, 30, 19, 36
MOST_ROWS = 40


@dataclass(frozen=True)
class Interval:
    """A named value with an interval, NaN where unknown. link: an address of what it is about."""

    name: str
    value: float
    low: float = math.nan
    high: float = math.nan
    link: str = ""


def interval_plot(
    title: str,
    rows: Sequence[Interval],
    whole: Interval | None = None,
    span: tuple[float, float] = (0.0, 1.0),
    colour: int = 1,
) -> str:
    """The plot, rows in their order, the first MOST_ROWS; whole: a line through all of them, with its band.

    span: what the axis shows at least.
    """
    shown = [row for row in rows if math.isfinite(row.value)][:MOST_ROWS]
    ends = [end for row in shown for end in (row.value, row.low, row.high) if math.isfinite(end)]
    low, high = min([span[0], *ends]), max([span[1], *ends])
    high = high if high > low else low + 1
    high = high if high > low else low + 1.0  # all of them 0, as false alarms may be
    wide, tall = WIDE - _NAMES - _RIGHT, _ROW * len(shown)

    def across(value: float) -> float:
        return _NAMES + (value - low) / (high - low) * wide

    parts = [f'<text x="6" y="16" class="title">{escape(title)}</text>']
    step = step_of(high - low, 5)
    for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1):
        value = k * step
        x = across(value)
        parts.append(f'<path d="M{x:.1f} {_TOP}v{tall}" class="grid"/>')
        text = f"{value:g}".replace("-", "−")
        parts.append(f'<text x="{x:.1f}" y="{_TOP + tall + 16}" text-anchor="middle">{text}</text>')
    if whole is not None and math.isfinite(whole.value):
        if math.isfinite(whole.low) and math.isfinite(whole.high):
            left, right = across(max(whole.low, low)), across(min(whole.high, high))
            parts.append(
                f'<rect x="{left:.1f}" y="{_TOP}" width="{max(right - left, 1):.1f}" height="{tall}" class="band f2"/>'
            )
        x = across(whole.value)
        hint = f"<title>{escape(f'{whole.name} {number(whole.value)}')}</title>"
        parts.append(f'<path d="M{x:.1f} {_TOP - 3}v{tall + 6}" class="line c2" stroke-dasharray="5 4">{hint}</path>')
        anchor = "end" if x > WIDE - 120 else "start" if x < _NAMES + 60 else "middle"
        said = f"{whole.name} {number(whole.value)}" if whole.value else whole.name
        parts.append(
            f'<text x="{x:.1f}" y="{_TOP + tall + 31}" text-anchor="{anchor}" class="f2">{escape(said)}</text>'
        )
    for k, row in enumerate(shown):
        parts += _row(row, _TOP + _ROW * k + _ROW / 2, across, colour)
    label = escape(f"{title}, clip by clip: " + "; ".join(f"{row.name} {number(row.value)}" for row in shown[:12]))
    return f'<svg viewBox="0 0 {WIDE} {_TOP + tall + _BOTTOM}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _row(row: Interval, y: float, across: Callable[[float], float], colour: int) -> list[str]:
    name = row.name if len(row.name) <= 21 else f"{row.name[:20]}…"
    said = f'<text x="{_NAMES - 8}" y="{y + 4:g}" text-anchor="end" class="name">{escape(name)}</text>'
    if row.link:
        said = f'<a href="{escape(row.link)}">{said}</a>'
    words = f"{row.name} {number(row.value)}"
    parts = [said]
    if math.isfinite(row.low) and math.isfinite(row.high):
        words += f", 95 %: {number(row.low)} to {number(row.high)}"
        a, b = across(row.low), across(row.high)
        parts.append(f'<path d="M{a:.1f} {y - 4:g}v8m0-4H{b:.1f}m0-4v8" class="line c{colour}"/>')
    hint = f"<title>{escape(words)}</title>"
    parts.append(f'<circle cx="{across(row.value):.1f}" cy="{y:g}" r="4.5" class="f{colour}">{hint}</circle>')
    parts.append(f'<text x="{WIDE - 4}" y="{y + 4:g}" text-anchor="end">{number(row.value)}</text>')
    return parts
