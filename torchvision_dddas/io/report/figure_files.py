"""Write the charts of a report's page as files: SVG, and PDF if fpdf2 is installed."""

import re
from collections.abc import Sequence
from html import unescape
from itertools import count
from pathlib import Path

from torchvision_dddas.io.atomic_files import save_file

_CHART = re.compile(r'<svg viewBox="0 0 ([\d.]+) ([\d.]+)" role="img" aria-label="([^"]*)">(.*?)</svg>', re.DOTALL)
_RULE = re.compile(r"(svg [^{}]*)\{([^}]*)\}")
_TAG = re.compile(r"<(path|rect|circle|text)\b([^<>]*?)(/?)>")
_CLASS = re.compile(r' class="([^"]*)"')
_LATIN = str.maketrans({"−": "-", "–": "-", "\u202f": " ", "≥": ">=", "₂": "2", "₃": "3", "…": "...", "→": "->"})
_FONT = 'font-family="Helvetica, Arial, sans-serif"'


def save_figures(folder: Path, page: str) -> list[str]:
    """Write each chart of a page as NAME.svg and NAME.pdf, and return the names, made from the charts' titles.

    PDF needs fpdf2, and letters outside Latin-1 become "?" in it. Raise InputError if a file cannot be written.
    """
    names: list[str] = []
    for wide, high, label, body in _CHART.findall(page):
        name = _slug(unescape(label).split(":")[0], names)
        names.append(name)
        svg = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" width="{wide}" height="{high}" '
            f'role="img" aria-label="{label}" {_FONT}>'
            f'<rect width="{wide}" height="{high}" fill="#fff"/>{_with_attributes(body)}</svg>\n'
        )
        save_file(folder / f"{name}.svg", svg.encode())
        if pdf := _pdf(svg, float(wide), float(high)):
            save_file(folder / f"{name}.pdf", pdf)
    return names


def _slug(text: str, taken: Sequence[str]) -> str:
    """Make a file name from a text: lower-case letters, digits and hyphens, with a number if the name is taken."""
    name = re.sub(r"[^a-z0-9]+", "-", text.translate(_LATIN).lower()).strip("-")[:60].strip("-") or "figure"
    return next(one for k in count(1) if (one := f"{name}-{k}" if k > 1 else name) not in taken)


def _with_attributes(body: str) -> str:
    """Return a chart with the light style of the pages as attributes, so that it needs no style sheet."""
    css = (Path(__file__).parent / "templates" / "style.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"(--\w+):(#\w+)", css[: css.index("@media")]))
    rules = [
        (part.strip().removeprefix("svg "), dict(re.findall(r"([\w-]+):([^;]+)", content)))
        for selectors, content in _RULE.findall(re.sub(r"var\((--\w+)\)", lambda m: colours[m[1]], css))
        for part in selectors.split(",")
    ]

    def restyle(tag: re.Match[str]) -> str:
        found = _CLASS.search(tag[2])
        fits = {tag[1], *(f"{kind}.{one}" for one in (found[1].split() if found else ()) for kind in ("", tag[1]))}
        style: dict[str, str] = {}
        for selector, more in rules:
            style |= more if selector in fits else {}
        given = "".join(f' {name}="{value}"' for name, value in style.items())
        return f"<{tag[1]}{_CLASS.sub('', tag[2])}{given}{tag[3]}>"

    return _TAG.sub(restyle, body)


def _pdf(svg: str, wide: float, high: float) -> bytes:
    """Return the chart as PDF; empty without fpdf2."""
    try:
        from fpdf import FPDF
        from fpdf.svg import SVGObject
    except ImportError:
        return b""

    plain = re.sub(r"<title>.*?</title>", "", svg.translate(_LATIN)).encode("latin-1", "replace").decode("latin-1")
    document = FPDF(unit="pt", format=(wide, high))
    document.set_auto_page_break(False)
    document.add_page()
    document.set_font("helvetica")
    SVGObject(plain).draw_to_page(document, 0, 0)
    return bytes(document.output())
