"""The definition file of a clip of BMS-26 or FBMS-59, *Def.dat: a line that says what comes, then the value.

Total number of regions:                    3
Scale of region 0:                          the value of its pixels, for each region
Confusion penality matrix:                  not read
Total number of frames in this shot:        19
Total number of labeled frames for this shot:
Frame number:  File name:  Input file name: of each labelled frame: its number, labels and picture
"""

import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from torchvision_dddas.errors import InputError

_LONGEST = 250
"""Bytes of a file's name; another ending may be tried, and 255 is what most systems take."""


class Definition(NamedTuple):
    """What a definition says. regions: the value of each. labelled: number, file of labels, picture, of each frame."""

    regions: tuple[int, ...]
    frames: int
    labelled: tuple[tuple[int, str, str], ...]


def read(path: Path) -> Definition:
    """Read a file. Raises InputError where it cannot be read, or lacks what is wanted."""
    try:
        lines = [line.strip() for line in path.read_text(encoding="latin-1").splitlines() if line.strip()]
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    regions = [_whole(value, path) for name, value in _said(lines) if name.startswith("scale of region")]
    numbers, files, pictures = (
        [value for name, value in _said(lines) if name == wanted]
        for wanted in ("frame number", "file name", "input file name")
    )
    frames = [_whole(value, path) for name, value in _said(lines) if name.startswith("total number of frames")]
    if len(regions) < 2 or len(frames) != 1:
        raise InputError(f"{path} is no definition of a clip; wanted two regions or more, and the number of frames")
    if not len(numbers) == len(files) == len(pictures) or not numbers:
        raise InputError(
            f"{path} names {len(numbers)} labelled frames, {len(files)} files and {len(pictures)} pictures; "
            "wanted as many of each, and at least one"
        )
    rows = [(_whole(n, path), _file(f, path), _file(p, path)) for n, f, p in zip(numbers, files, pictures, strict=True)]
    return Definition(tuple(regions), frames[0], tuple(rows))


def _said(lines: list[str]) -> list[tuple[str, str]]:
    """The lines that end with a colon, in small letters without it, and the line after each."""
    return [
        (name[:-1].strip().lower(), value)
        for name, value in pairwise(lines)
        if name.endswith(":") and not value.endswith(":")
    ]


def _whole(text: str, path: Path) -> int:
    if not text.isdecimal() or len(text) > 9:
        raise InputError(f"{path}: '{text[:40]}' will not do; wanted a whole number")
    return int(text)


def _file(text: str, path: Path) -> str:
    """The name of a file beside the definition, without folders that somebody else's machine had."""
    name = re.split(r"[\\/]", text)[-1]
    if name in ("", ".", "..") or "\0" in name or len(name.encode()) > _LONGEST:
        raise InputError(f"{path}: '{text[:40]}' is no name of a file")
    return name
