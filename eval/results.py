"""Results of studies as they are kept in docs/results, a file for each piece of a text: what the tables are made of.

A file tells which text it belongs to (`into`) and between which marks, the command that measured it, the day, and its
blocks: paragraphs, and tables as head, alignment and rows of cells. Studies write it where they used to write the text;
`make figures` makes the texts of all files.
"""

import json
import sys
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "results"
TEXTS = {"docs/benchmarks.md": "readme", "eval/README.md": "eval", "docs/tuning.md": "tuning"}
"""The texts of this project that hold what was measured, and what the files of their results begin with."""

Block = str | dict[str, Any]


@dataclass(frozen=True)
class Result:
    """blocks: in their order. command: as it is typed, with DATA for a folder of data. day: when it was measured."""

    into: str
    mark: str
    command: str
    day: str
    blocks: tuple[Block, ...]

    @property
    def path(self) -> Path:
        """Where it is kept."""
        return FOLDER / f"{TEXTS[self.into]}-{self.mark.replace(' ', '-').replace('_', '-')}.json"

    def text(self) -> str:
        """What stands between the marks."""
        return "\n\n".join(block if isinstance(block, str) else _table(block) for block in self.blocks)

    def write(self) -> None:
        """Keep it."""
        content = {"into": self.into, "mark": self.mark, "command": self.command, "day": self.day}
        lines = json.dumps({**content, "blocks": self.blocks}, indent=1, ensure_ascii=False)
        FOLDER.mkdir(parents=True, exist_ok=True)
        self.path.write_text(lines + "\n", encoding="utf-8")


def read(path: Path) -> Result:
    """One of the files."""
    told = json.loads(path.read_text(encoding="utf-8"))
    return Result(told["into"], told["mark"], told["command"], told["day"], tuple(told["blocks"]))


def every() -> list[Result]:
    """All that are kept and are pieces of a text."""
    begins = tuple(f"{begin}-" for begin in TEXTS.values())
    return [read(path) for path in sorted(FOLDER.glob("*.json")) if path.name.startswith(begins)]


def keep(name: str, content: dict[str, Any]) -> None:
    """Keep a measurement whole, for tables and plots that are made of its numbers."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def blocks_of(text: str) -> tuple[Block, ...]:
    """Paragraphs and tables of Markdown; `Result.text` makes the same Markdown of them."""
    return tuple(_block(part) for part in text.strip().split("\n\n"))


def command() -> str:
    """This program as it was called, without the places of its files."""
    name = Path(sys.argv[0]).resolve()
    program = name.relative_to(ROOT).as_posix() if name.is_relative_to(ROOT) else name.name
    return " ".join(["python", program, *(_word(word) for word in sys.argv[1:])])


def today() -> str:
    """The day of a measurement."""
    return date.today().isoformat()


def _word(word: str) -> str:
    path = Path(word)
    if not path.exists() or path.resolve().is_relative_to(ROOT):
        return word
    return "DATA" if path.is_dir() else path.name


def _block(part: str) -> Block:
    lines = part.split("\n")
    if len(lines) < 2 or not all(line.startswith("|") for line in lines):
        return part
    head, align, *rows = ([cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines)
    found = {"head": head, "align": align, "rows": rows}
    # A table whose cells are set otherwise, or hold a bar, stays as it was written.
    return found if _table(found) == part else part


def _table(block: dict[str, Any]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (block["head"], block["align"], *block["rows"]))
