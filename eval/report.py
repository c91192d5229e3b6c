"""Measured tables in a text file: `python eval/report.py README.md --speed FILE.json`, FILE made by speed.py --json.

A table stands between `<!-- name -->` and `<!-- /name -->`, and is replaced whole. What goes into the texts of this
project is kept in docs/results too, with the command and the day, and `make figures` puts it there again.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import results


def put(path: Path, name: str, text: str) -> None:
    """Put a measurement between the marks of a name, and keep it. Ends the program with one line without marks."""
    place(path, name, text)
    where = path.resolve()
    into = where.relative_to(results.ROOT).as_posix() if where.is_relative_to(results.ROOT) else ""
    if into in results.TEXTS:
        results.Result(into, name, results.command(), results.today(), results.blocks_of(text)).write()


def place(path: Path, name: str, text: str) -> None:
    """Replace what stands between the marks of a name. Ends the program with one line if they are not there."""
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    try:
        content = path.read_text(encoding="utf-8")
        before, _, rest = content.partition(begin)
        _, found, after = rest.partition(end)
    except OSError as error:
        sys.exit(f"{path} cannot be read: {error.strerror}")
    if not found:
        sys.exit(f"{path} has no marks {begin} and {end}: nothing was written")
    path.write_text(f"{before}{begin}\n\n{text.strip()}\n\n{end}{after}", encoding="utf-8")


def speed_table(figures: dict[str, Any]) -> str:
    """Markdown: time a frame, ratio to the plain chain in the same turns, and what registration misses by."""
    clips = figures["clips"]
    machine = f"{figures['machine']['cores']} cores, OpenCV {figures['machine']['opencv']}"
    rows = [f"{machine}; ms a frame, ratio to plain as the median over turns (quartiles):", ""]
    for clip, found in clips.items():
        width, height = found["size"]
        rows += [f"| {clip}, {width}×{height} | median ms | mean ms | ratio |", "| --- | ---: | ---: | ---: |"]
        for chain, r in found["chains"].items():
            ratio = f"{r['ratio']:.2f} ({r['ratio_25']:.2f}–{r['ratio_75']:.2f})"
            rows.append(f"| {chain} | {r['median_ms']:.1f} | {r['mean_ms']:.1f} | {ratio} |")
        errors = [f"{c} {e['median']:.3f} ({e['p90']:.3f})" for c, e in found.get("registration_px", {}).items()]
        rows += ["", f"Registration, px, median (90th percentile): {'; '.join(errors)}.", ""]
    return "\n".join(rows)


def main() -> None:
    """Put the speed table into a file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("text", type=Path)
    parser.add_argument("--speed", type=Path, required=True)
    options = parser.parse_args()
    put(options.text, "speed", speed_table(json.loads(options.speed.read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
