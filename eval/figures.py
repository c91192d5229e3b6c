"""Tables and plots of README.md and eval/README.md from the results that are kept: `python eval/figures.py [--check]`.

No figure of a table is typed: studies keep theirs in docs/results, and this puts them between their marks, and draws
the plots whose measurements are kept whole. --check changes nothing and tells which texts differ.
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import geo_error
import geo_plots
import onboard_tables
import report
import results

Piece = tuple[str, str]
"""A text and a name of marks in it."""

ONBOARD = ("onboard-speed", "onboard-live", "onboard-people")
GEO = "geo-error"


def pieces() -> dict[Piece, str]:
    """What stands between all marks."""
    found = {(result.into, result.mark): result.text() for result in results.every()}
    speed, live, people = (measured(name) for name in ONBOARD)
    found["docs/benchmarks.md", "onboard"] = onboard_tables.summary(speed, live, people).strip()
    found["eval/README.md", "onboard"] = onboard_tables.details(speed, live, people).strip()
    found["eval/README.md", "geo-error"] = geo_error.told(geo_error.shown(measured(GEO))).strip()
    return found


def plots() -> Mapping[str, Callable[[Path], object]]:
    """What draws each plot whose measurements are kept."""
    return {
        "docs/onboard.png": partial(onboard_tables.draw, measured(ONBOARD[0]), measured(ONBOARD[1])),
        "docs/geo_error.png": partial(geo_plots.draw, measured(GEO)["main"]),
    }


def measured(name: str) -> dict[str, Any]:
    """A measurement that is kept whole, as its study wrote it."""
    content: dict[str, Any] = json.loads((results.FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    return content


def differing() -> list[Piece]:
    """The pieces whose text is not what the results give."""
    wrong = []
    for (into, mark), text in pieces().items():
        content = (results.ROOT / into).read_text(encoding="utf-8")
        _, begun, rest = content.partition(f"<!-- {mark} -->")
        if not begun or rest.partition(f"<!-- /{mark} -->")[0].strip() != text:
            wrong.append((into, mark))
    return wrong


def main() -> None:
    """Write all of it, or tell what differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    wrong = differing()
    if options.check:
        sys.exit("\n".join(f"{into}, {mark}: not what docs/results gives; make figures" for into, mark in wrong) or 0)
    for into, mark in wrong:
        report.place(results.ROOT / into, mark, pieces()[into, mark])
        print(f"{into}, {mark}: written")
    for name, draw in plots().items():
        draw(results.ROOT / name)
        print(f"{name}: drawn")


if __name__ == "__main__":
    main()
