"""Put the results of eval/results into the documents: `python eval/figures.py [--check]`, or `make figures`.

The Markdown of eval/results/NAME.json (with - for _) replaces the text between `<!-- NAME -->` and `<!-- /NAME -->` in
README.md and docs/*.md, so that no measured table is typed by hand. --check changes nothing and ends with exit code 1
if a text differs from its result.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import bench

MARKED = re.compile(r"<!-- (?P<name>[\w-]+) -->(?P<text>.*?)<!-- /(?P=name) -->", re.DOTALL)


def documents(root: Path = bench.ROOT) -> list[Path]:
    """Return the documents that quote results."""
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


def fill(text: str) -> str:
    """Return the text with the results between its marks. End the program with one line for an unknown mark."""

    def replace(found: re.Match[str]) -> str:
        name = found["name"]
        try:
            result = bench.read_result(name.replace("_", "-"))
        except FileNotFoundError:
            sys.exit(f"eval/results has no {name.replace('_', '-')}.json for the marks {name}")
        return f"<!-- {name} -->\n\n{bench.result_text(result).strip()}\n\n<!-- /{name} -->"

    return MARKED.sub(replace, text)


def outdated(root: Path = bench.ROOT) -> Iterator[tuple[Path, str]]:
    """Yield the documents that differ from their results, with the correct text."""
    for path in documents(root):
        text = path.read_text(encoding="utf-8")
        if (filled := fill(text)) != text:
            yield path, filled


def update(options: bench.Options) -> tuple[str, None]:
    """Write the documents, or with --check name the documents that differ."""
    changed = list(outdated())
    if options.check and changed:
        sys.exit(
            "\n".join(
                f"{path.relative_to(bench.ROOT)} is not what eval/results gives; make figures" for path, _ in changed
            )
        )
    for path, text in changed:
        path.write_text(text, encoding="utf-8")
    return "\n".join(f"{path.relative_to(bench.ROOT)}: written" for path, _ in changed), None


if __name__ == "__main__":
    bench.main(__doc__, {"": (update, {"--check": False})})
