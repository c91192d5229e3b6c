"""The report kit: offline pages in light and dark for desktop and phone, sortable tables, and SVG charts.

    svg = chart("Loss", Axis("step"), Axis("loss"), [Line("batch", steps, losses)])
    rows = [[text_cell("a"), number_cell(0.5)]]
    html = render_page("tuning.html", title="Tuning", plots=[svg], parameters=table("parameters", columns, rows))

Charts are in `charts`. Templates are in `templates/`, and their shared macros are in `templates/parts.html`.
"""

import base64
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

if TYPE_CHECKING:
    from jinja2 import Environment

UNKNOWN = "–"
"""The text of an unknown value."""
TALL_ROWS = 30
"""A table with more rows scrolls inside the page."""


_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Cell:
    """A cell of a table. value: sort key, None last. small: text of a second line. best: shown in bold."""

    text: str
    value: float | str | None = None
    small: str = ""
    best: bool = False

    @property
    def sort_key(self) -> str:
        """The value with all digits, for the script that sorts tables."""
        return "" if self.value is None else repr(self.value) if isinstance(self.value, float) else str(self.value)


@dataclass(frozen=True)
class ReportColumn:
    """A column's name and its meaning. text: the cells hold words and are aligned to the left."""

    name: str
    meaning: str = ""
    text: bool = False


@dataclass(frozen=True)
class ReportTable:
    """A table for a page or a file. caption: name of the table. foot: rows that stay below the others."""

    caption: str
    columns: Sequence[ReportColumn]
    rows: Sequence[Sequence[Cell]]
    foot: Sequence[Sequence[Cell]] = ()

    @property
    def markup(self) -> Markup:
        """The table as HTML."""
        return table(self.caption, self.columns, self.rows, self.foot)


def render_page(template: str, **context: Any) -> str:
    """Fill a template of this kit. All text is escaped, except Markup such as charts and tables."""
    return environment().get_template(template).render(context)


def table(
    caption: str,
    columns: Sequence[ReportColumn],
    rows: Sequence[Sequence[Cell]],
    foot: Sequence[Sequence[Cell]] = (),
    sorts: bool = True,
) -> Markup:
    """Return a table as HTML, which the reader can sort. The first cell of a row is its heading.

    caption: name for screen readers. foot: rows that stay below the others. sorts: whether the table can be sorted.
    """
    for row in (*rows, *foot):
        if len(row) != len(columns):
            raise ValueError(f"a row of table {caption!r} must have {len(columns)} cells, got {len(row)}")
    macros: Any = environment().get_template("parts.html").module
    return Markup(macros.table(caption, columns, rows, foot, sorts, len(rows) > TALL_ROWS))


def text_cell(text: str) -> Cell:
    """Return a cell of words."""
    return Cell(text, text)


def number_cell(value: float | None, digits: int = 3, interval: tuple[float, float] | None = None) -> Cell:
    """Return a cell of a number with its interval below; a dash if the value is unknown."""
    if value is None or not math.isfinite(value):
        return Cell(UNKNOWN)
    small = ""
    if interval is not None and all(math.isfinite(end) for end in interval):
        small = f"{format_number(interval[0], digits)} to {format_number(interval[1], digits)}"
    return Cell(format_number(value, digits), float(value), small)


def format_number(value: float, digits: int = 3) -> str:
    """Format a number: an int without decimals, a float with `digits` decimals, with thin spaces and a true minus."""
    if not math.isfinite(value):
        return UNKNOWN
    text = f"{value:,}" if isinstance(value, int) else f"{value:,.{digits}f}"
    text = text.replace(",", "\u202f")
    if not text.strip("-0.\u202f"):
        text = text.lstrip("-")
    return text.replace("-", "−")


def format_count(count: int, noun: str) -> str:
    """Return a count with its noun, such as 1 frame or 2 frames."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def data_url(picture: bytes) -> str:
    """Return a data URL of a JPEG or PNG picture."""
    kind = "jpeg" if picture[:2] == b"\xff\xd8" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"


def read_vendored(name: str) -> Markup:
    """Return the text of a library's file in templates/, without addresses of other files."""
    text = (_TEMPLATES / name).read_text(encoding="utf-8")
    return Markup(re.sub(r"url\([^)]*\)|//# sourceMappingURL=\S+", "", text))


@cache
def environment() -> "Environment":
    """Return the templates of this kit, with filters for numbers and pictures."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # imported here, because it takes 60 ms

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    environment.globals["read_vendored"] = read_vendored
    environment.filters |= {"number": format_number, "data_url": data_url, "format_count": format_count}
    return environment
