"""HTML pages in tests: parsed, and checked to be whole."""

import re
from html.parser import HTMLParser
from typing import Any

VOID = {"meta", "img", "br", "input"}


class Page(HTMLParser):
    """The elements, attributes and words of a page. Fails where an element is not closed in its turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[str] = []
        self.words: list[str] = []
        self.attributes: list[tuple[str, str, Any]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append(tag)

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def shown(self) -> str:
        """All words, with single blanks between them."""
        return " ".join(" ".join(self.words).split())

    def values(self, tag: str, name: str) -> list[str]:
        """The values of an attribute of all elements of a kind."""
        return [value or "" for element, attribute, value in self.attributes if (element, attribute) == (tag, name)]


def points_inside(svg: str) -> list[tuple[float, float]]:
    """All points of a chart, after checking that it is one whole picture and that they lie in its frame."""
    page = Page(svg)
    assert page.found.count("svg") == 1 and "nan" not in svg and "inf" not in svg
    wide, high = (float(v) for v in page.values("svg", "viewbox")[0].split()[2:])
    found = re.findall(r"[ML](-?[\d.]+) (-?[\d.]+)", svg) + re.findall(r'cx="(-?[\d.]+)" cy="(-?[\d.]+)"', svg)
    points = [(float(x), float(y)) for x, y in found]
    assert all(0 <= x <= wide and 0 <= y <= high for x, y in points)
    return points
