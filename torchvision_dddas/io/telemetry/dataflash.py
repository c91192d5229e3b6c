"""Read ArduPilot's DataFlash logs, binary or as text. The log itself describes the columns of its messages."""

import re
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchvision_dddas.io.telemetry.autopilots import NAMES, Topic, Topics, add_topic, build_flight, column, start_clock
from torchvision_dddas.io.telemetry.record import Log
from torchvision_dddas.types import Telemetry

MAGIC = b"\xa3\x95\x80\x80"
"""The first bytes of a binary log: the beginning of a message that describes messages."""
IN_TEXT = re.compile(r"^FMT, ?\d+, ?\d+, ?\w+, ?\w+", re.MULTILINE)
"""A description in a text log."""
_HEAD, _FMT = MAGIC[:2], MAGIC[2]
# NumPy's type for each format letter, and the divisors of letters for scaled integers.
_TYPES = {"M": "b", "g": "e", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "n": "S4", "N": "S16"}
_TYPES |= dict.fromkeys("aZ", "S64") | {letter: letter for letter in "bBhHiIfdqQ"}
_PER_UNIT = dict.fromkeys("cCeE", 1e2) | {"L": 1e7}
# UTC is 14 s behind GPS time, and one second more since each of these weeks.
_WEEK_S, _GPS_EPOCH_S, _LEAP_WEEKS = 604_800, 315_964_800, (1512, 1695, 1851, 1930)


@np.errstate(invalid="ignore", over="ignore")  # a damaged log may hold any bits
def read_dataflash(path: Path, text: str | None, clock_offset_s: float) -> Telemetry:
    """Read positions, heights and attitudes of an ArduPilot log; times count from the first. text: None if binary.

    Raise InputError if the log has none of them.
    """
    log = Log(path, "ArduPilot DataFlash log", "byte" if text is None else "line", bridge_s=1.0)
    topics: Topics = {}
    for name, topic in _binary(log, path.read_bytes()) if text is None else _written(log, text):
        # In old GPS messages TimeMS counts the milliseconds of the week, and T those of the autopilot.
        for clock, per_second in (("TimeUS", 1e6), ("T", 1e3), ("TimeMS", 1e3)):
            if clock in topic:
                add_topic(topics, name, "", topic | {"time_s": topic[clock] / per_second})
                break
    if not topics:
        raise log.refuse("the DataFlash log has no position, height or attitude")
    receivers = [topic for name in ("GPS", "GPS2") for topic in topics.get(name, {}).values()]
    return build_flight(log, topics, clock_offset_s, start_clock(map(_clock, receivers)))


def _clock(receiver: Topic) -> tuple[np.ndarray, np.ndarray]:
    """Return seconds since 1970 in UTC, 0 without a fix, and the autopilot's times."""
    week, week_ms = (column(receiver, a if a in receiver else b) for a, b in (("GWk", "Week"), ("GMS", "TimeMS")))
    utc_s = _GPS_EPOCH_S + week * _WEEK_S + week_ms / 1e3 - 14 - np.searchsorted(_LEAP_WEEKS, week, side="right")
    return np.where((column(receiver, "Status") >= 2) & (week > 0), utc_s, 0), receiver["time_s"]


def _binary(log: Log, content: bytes) -> Iterator[tuple[str, Topic]]:
    """Yield the messages to read, by name. A message is whole if another message, or the end, follows."""
    formats: dict[int, tuple[str, int, str, list[str]]] = {_FMT: ("FMT", 89, "", [])}
    places: dict[int, list[int]] = {}
    place = lost = first = 0
    while place + 3 <= len(content):
        name, size, *_ = formats.get(content[place + 2], ("", 0)) if content.startswith(_HEAD, place) else ("", 0)
        end = place + size
        if size < 3 or not (content.startswith(_HEAD, end) or end == len(content)):
            end = following if (following := content.find(_HEAD, place + 1)) > 0 else len(content)
            lost, first = lost + end - place, first or place
        elif name == "FMT":
            number, length, *texts = struct.unpack_from("<BB4s16s64s", content, place + 3)
            name, letters, fields = (one.split(b"\0")[0].decode("latin-1") for one in texts)
            formats[number] = name, length, letters, fields.split(",")
        elif name in NAMES:
            places.setdefault(content[place + 2], []).append(place)
        place = end
    if lost:
        log.note(f"byte {first}: {lost} bytes are not whole messages and are left out")
    for number, where in places.items():
        name, size, letters, fields = formats[number]
        row = np.dtype([(f"{i}", "<" + _TYPES.get(letter, "S1")) for i, letter in enumerate(letters)])
        if row.itemsize == size - 3 and len(fields) == len(letters):
            rows = np.frombuffer(b"".join(content[place + 3 : place + size] for place in where), row)
            numbers = [(i, letter) for i, letter in enumerate(letters) if row[i].kind != "S"]
            topic = {fields[i]: rows[f"{i}"] / _PER_UNIT.get(letter, 1) for i, letter in numbers}
            yield name, topic | {"where": np.array(where)}


def _written(log: Log, text: str) -> Iterator[tuple[str, Topic]]:
    """Yield the messages to read of a text log, by name. The numbers are in the units of their columns."""
    columns: dict[str, tuple[str, ...]] = {}
    rows: dict[tuple[str, tuple[str, ...]], list[list[float]]] = {}  # by name and columns, which damage may change
    bad: list[int] = []
    for number, line in enumerate(text.splitlines(), 1):
        name, _, rest = line.partition(",")
        cells = [cell.strip() for cell in rest.split(",")] if name == "FMT" or name in columns else []
        if name == "FMT" and len(cells) > 4 and cells[2] in NAMES:
            columns[cells[2]] = tuple(cells[4:])
        elif name in columns:
            try:
                values = [value for _, value in zip(columns[name], map(float, cells), strict=True)]
                rows.setdefault((name, columns[name]), []).append([*values, number])
            except ValueError:
                bad.append(number)
    if bad:
        log.note(f"line {bad[0]}: {len(bad)} messages are cut off or garbled and are left out")
    # If a message has several sets of columns, the set with most rows comes last, and is kept.
    for (name, names), found in sorted(rows.items(), key=lambda item: len(item[1])):
        yield name, dict(zip((*names, "where"), np.array(found).T, strict=True))
