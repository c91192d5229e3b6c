"""The report kit: pages that open offline, in light and dark, on a desk and on a phone; tables that sort; SVG charts.

    svg = chart("Loss", Axis("step"), Axis("loss"), [Line("batch", steps, losses)])
    rows = [[text_cell("a"), number_cell(0.5)]]
    html = render_page("tuning.html", title="Tuning", plots=[svg], parameters=table("parameters", columns, rows))

Charts are in `charts`. Templates lie in `templates/`, the macros that they share in `templates/parts.html`.
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
    """A cell of a table. value: what it sorts by, None last. small: a second line. best: shown in bold."""

    text: str
    value: float | str | None = None
    small: str = ""
    best: bool = False

    @property
    def sort_key(self) -> str:
        """The value as the page's script reads it, with all digits."""
        return "" if self.value is None else repr(self.value) if isinstance(self.value, float) else str(self.value)


@dataclass(frozen=True)
class Column:
    """A column's name and its meaning. text: its cells hold words and are set to the left."""

    name: str
    meaning: str = ""
    text: bool = False


@dataclass(frozen=True)
class Table:
    """A table of a page that can be a file, too. caption: its name. foot: rows that stay below the others."""

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    foot: Sequence[Sequence[Cell]] = ()

    @property
    def markup(self) -> Markup:
        """The HTML."""
        return table(self.caption, self.columns, self.rows, self.foot)


def render_page(template: str, **context: Any) -> str:
    """Fill a template of this kit. All text is escaped, except Markup such as charts and tables."""
    return environment().get_template(template).render(context)


def table(
    caption: str,
    columns: Sequence[Column],
    rows: Sequence[Sequence[Cell]],
    foot: Sequence[Sequence[Cell]] = (),
    sorts: bool = True,
) -> Markup:
    """A table that sorts by a click or a key. The first cell of a row names it.

    caption: its name for screen readers. foot: rows that stay below the others.
    """
    for row in (*rows, *foot):
        if len(row) != len(columns):
            raise ValueError(f"a row of table {caption!r} must have {len(columns)} cells, got {len(row)}")
    macros: Any = environment().get_template("parts.html").module
    return Markup(macros.table(caption, columns, rows, foot, sorts, len(rows) > TALL_ROWS))


def text_cell(text: str) -> Cell:
    """A cell of words."""
    return Cell(text, text)


def number_cell(value: float | None, digits: int = 3, interval: tuple[float, float] | None = None) -> Cell:
    """A cell of a number with its interval below it; a dash where the value is unknown."""
    if value is None or not math.isfinite(value):
        return Cell(UNKNOWN)
    small = ""
    if interval is not None and all(math.isfinite(end) for end in interval):
        small = f"{format_number(interval[0], digits)} to {format_number(interval[1], digits)}"
    return Cell(format_number(value, digits), float(value), small)


def format_number(value: float, digits: int = 3) -> str:
    """A number for a reader: an int without decimals, a float with `digits`; thin spaces, a true minus."""
    if not math.isfinite(value):
        return UNKNOWN
    text = f"{value:,}" if isinstance(value, int) else f"{value:,.{digits}f}"
    text = text.replace(",", "\u202f")
    if not text.strip("-0.\u202f"):
        text = text.lstrip("-")
    return text.replace("-", "−")


def format_count(count: int, noun: str) -> str:
    """A count with its noun: 1 frame, 2 frames."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def data_url(picture: bytes) -> str:
    """A JPEG or PNG picture as a URL that holds it."""
    kind = "jpeg" if picture[:2] == b"\xff\xd8" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"


def read_vendored(name: str) -> Markup:
    """The text of a library's file in templates/, without addresses of other files."""
    text = (_TEMPLATES / name).read_text(encoding="utf-8")
    return Markup(re.sub(r"url\([^)]*\)|//# sourceMappingURL=\S+", "", text))


@cache
def environment() -> "Environment":
    """The templates of this kit, with filters for numbers and pictures."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # here, as loading it takes 60 ms

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
