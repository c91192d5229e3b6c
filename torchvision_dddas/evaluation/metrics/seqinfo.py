"""MOTChallenge's seqinfo.ini: how long a sequence is, how fast, and where its pictures lie."""

import configparser
import math
from pathlib import Path
from typing import NamedTuple

from torchvision_dddas.errors import InputError

MOST_FRAMES = 10_000_000
"""No clip is longer."""


class SeqInfo(NamedTuple):
    """What it says. length: frames, 0 where it does not. rate_hz: None where it does not. pictures: their folder."""

    length: int = 0
    rate_hz: float | None = None
    pictures: str = "img1"


def read_seqinfo(path: Path) -> SeqInfo:
    """Read the file. Raises InputError: no such format, no usable seqLength or imDir under [Sequence]."""
    ini = configparser.ConfigParser(interpolation=None)
    try:
        ini.read(path, encoding="utf-8")
        length = ini.getint("Sequence", "seqLength")
    except (configparser.Error, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path} does not tell seqLength under [Sequence]: {error}") from error
    if not 0 <= length <= MOST_FRAMES:
        raise InputError(f"{path}: seqLength is {length}; wanted 0 to {MOST_FRAMES}")
    try:
        rate_hz = ini.getfloat("Sequence", "frameRate", fallback=math.nan)
    except ValueError:
        rate_hz = math.nan
    pictures = Path(ini.get("Sequence", "imDir", fallback="") or "img1").name
    if len(pictures.encode()) > 255:  # no folder's name is longer
        raise InputError(f"{path}: imDir = {pictures} is no folder's name")
    return SeqInfo(length, rate_hz if 0 < rate_hz <= 1000 else None, pictures)
