"""docs/telemetry.md shows the tables of fields and of programs that the readers go by."""

import math
from pathlib import Path

import pytest

from torchvision_dddas.io.telemetry.fields import FIELDS, SUBTITLES, TABLES, UNITS, ZEROS

PAGE = Path(__file__).parents[2] / "docs" / "telemetry.md"
RECORD = {"degrees": "°", "angle": "°", "length": "m", "speed": "m/s", "time": "s"}


def names(words: str) -> str:
    return ", ".join(f"`{word}`" for word in words.split())


def fields() -> list[str]:
    rows = ["| quantity | counted from, or meaning | possible values | names |", "| --- | --- | --- | --- |"]
    for quantity, kind, low, high, zero, words in FIELDS:
        span = f"{low:g} to {high:g} {RECORD.get(kind, '')}".strip() if math.isfinite(high) else ""
        rows.append(f"| {quantity} | {zero} | {span} | {names(words)} |")
    return rows


def units() -> list[str]:
    rows = ["| kind | units |", "| --- | --- |"]
    return rows + [f"| {kind} | {names(' '.join(words))} |" for kind, words in UNITS.items()]


def meaning(part: str) -> str:
    name, _, what = part.partition("=")
    quantity, _, unit = what.partition(",")
    return f"`{name}`: {quantity or 'not read'}" + (f" in {unit}" if unit else "")


def programs(dialects) -> list[str]:
    rows = ["| program | known by | what its names mean |", "| --- | --- | --- |"]
    for program, marks, means, order in dialects:
        known = " or ".join(names(mark).replace(", ", " with ") for mark in marks.split("|"))
        said = [meaning(part) for part in means.split()] + ([f"{order} in one field"] if order else [])
        rows.append(f"| {program} | {known} | {'; '.join(said)} |")
    return rows


def subtitles() -> list[str]:
    rows = ["| form | what it means |", "| --- | --- |"]
    for program, _, means, order in SUBTITLES:
        rows.append(f"| {program} | {'; '.join([*map(meaning, means.split()), *([order] if order else [])])} |")
    return rows


def zeros() -> list[str]:
    return ["| quantity | words |", "| --- | --- |", *(f"| {name} | {names(words)} |" for name, words in ZEROS.items())]


BLOCKS = {
    "fields": fields(),
    "zeros": zeros(),
    "units": units(),
    "programs": programs(TABLES),
    "subtitles": subtitles(),
}


@pytest.mark.parametrize("block", BLOCKS)
def test_the_page_shows_the_tables_that_the_readers_go_by(block):
    shown = PAGE.read_text().split(f"<!-- table {block} -->\n")[1].split(f"<!-- /table {block} -->")[0].strip()
    wanted = "\n".join(BLOCKS[block])
    assert shown == wanted, f"write this between the marks of {block}:\n{wanted}"
