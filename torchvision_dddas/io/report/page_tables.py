"""Tables of a page that sort by a click or a key, with what belongs to all rows below them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

NOTHING = "–"
"""What stands where there is no value."""


TALL = 30
"""A table of more rows scrolls in a window of its own, so that the page stays short and opens at once."""


@dataclass(frozen=True)
class Cell:
    """What stands in a table. value: what it sorts by, None for last. small: below it. link: an address."""

    text: str
    value: float | str | None = None
    small: str = ""
    link: str = ""


@dataclass(frozen=True)
class Column:
    """A column's name, what it means in words, and whether it holds words, which stand to the left."""

    name: str
    meaning: str = ""
    text: bool = False


def words(text: str, link: str = "") -> Cell:
    """A cell of words."""
    return Cell(text, text, link=link)


def figure(value: float | None, digits: int = 3, interval: tuple[float, float] | None = None) -> Cell:
    """A cell of a number, with its interval below it; a dash where it is unknown."""
    if value is None or not math.isfinite(value):
        return Cell(NOTHING)
    small = ""
    if interval is not None and all(math.isfinite(end) for end in interval):
        small = f"{number(interval[0], digits)} to {number(interval[1], digits)}"
    return Cell(number(value, digits), float(value), small)


def number(value: float, digits: int = 3) -> str:
    """A number for a reader: a whole one without decimals, others with so many. A minus is a minus."""
    if not math.isfinite(value):
        return NOTHING
    text = f"{value:,}" if isinstance(value, int) else f"{value:,.{digits}f}"
    text = text.replace(",", "\u202f")
    if not text.strip("-0.\u202f"):
        text = text.lstrip("-")
    return text.replace("-", "−")


def sorted_table(
    caption: str,
    columns: Sequence[Column],
    rows: Sequence[Sequence[Cell]],
    foot: Sequence[Sequence[Cell]] = (),
    sorts: bool = True,
) -> str:
    """The HTML of a table; the first cell of a row names it. caption: for who hears the page. foot: rows that stay."""
    heads = []
    for column in columns:
        kind = ' class="text"' if column.text else ""
        hint = f' title="{escape(column.meaning)}"' if column.meaning else ""
        inner = f'<button type="button"{hint}>' if sorts and len(rows) > 1 else f"<span{hint}>"
        heads.append(f'<th scope="col"{kind}>{inner}{escape(column.name)}</{inner[1:].split()[0].rstrip(">")}></th>')
    body = "".join(f"<tr>{_row(row, columns)}</tr>" for row in rows)
    below = f"<tfoot>{''.join(f'<tr>{_row(row, columns)}</tr>' for row in foot)}</tfoot>" if foot else ""
    kind = ' class="sorts"' if sorts else ""
    region = "wide tall" if len(rows) > TALL else "wide"
    # The region can be scrolled by keys where the table is wider than the page.
    return (
        f'<div class="{region}" role="region" tabindex="0" aria-label="{escape(caption)}">'
        f'<table{kind} aria-label="{escape(caption)}">'
        f"<thead><tr>{''.join(heads)}</tr></thead><tbody>{body}</tbody>{below}</table></div>"
    )


def _row(row: Sequence[Cell], columns: Sequence[Column]) -> str:
    parts = []
    for k, (cell, column) in enumerate(zip(row, columns, strict=True)):
        tag = 'th scope="row"' if k == 0 else "td"
        kind = ' class="text"' if column.text else ""
        value = "" if cell.value is None else repr(cell.value) if isinstance(cell.value, float) else str(cell.value)
        said = escape(cell.text)
        if cell.link:
            said = f'<a href="{escape(cell.link)}">{said}</a>'
        small = f"<small>{escape(cell.small)}</small>" if cell.small else ""
        parts.append(f'<{tag}{kind} data-v="{escape(value)}">{said}{small}</{tag.split()[0]}>')
    return "".join(parts)
