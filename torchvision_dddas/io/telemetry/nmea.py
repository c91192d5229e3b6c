"""Read NMEA 0183 sentences of a receiver as telemetry, alone on their lines or within other text."""

import functools
import math
import operator
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from torchvision_dddas.geometry import DEGREE_M
from torchvision_dddas.io.telemetry.clocks import midnight_s
from torchvision_dddas.io.telemetry.record import Log, build_record, is_clock
from torchvision_dddas.types import Telemetry

_KNOT = 1852 / 3600
_DAY_S = 86_400.0
_APART_M = 30.0  # places further apart at the same time are of two receivers
# The numbers of the fields in each kind of sentence. A place takes four fields: latitude, N or S, longitude, E or W.
# With a status of 0, V or only N, the values are unknown. A sentence that ends before the field `least` is too short.
_FIELDS: dict[str, dict[str, int]] = {
    "GGA": {"time": 1, "place": 2, "status": 6, "above_sea": 9, "separation": 11, "least": 9},
    "GNS": {"time": 1, "place": 2, "status": 6, "above_sea": 9, "separation": 10, "least": 9},
    "RMC": {"time": 1, "status": 2, "place": 3, "knots": 7, "date": 9, "least": 9},
    "GLL": {"place": 1, "time": 5, "status": 6, "least": 4},
    "VTG": {"km_h": 7, "status": 9, "least": 7},
    "HDT": {"heading": 1, "least": 1},
    "THS": {"heading": 1, "status": 2, "least": 2},
    "ZDA": {"time": 1, "date": 2, "least": 4},  # its date takes three fields: day, month, year
}
SENTENCE = re.compile(rf"(?<![A-Za-z])\$?([A-Z]{{2}}(?:{'|'.join(_FIELDS)}),[^$*\r\n\"'<>\\]*)(\*[0-9A-Fa-f]{{0,2}})?")
"""A sentence of these kinds in any text: the part that its checksum covers, and the checksum with its star."""


def read_nmea(path: Path, text: str, clock_offset_s: float, came_s: float = math.nan) -> Telemetry:
    """Read the sentences of `_FIELDS`. Times count from the first sentence with a time.

    came_s: when the first sentence came, seconds since 1970; it gives the date if no sentence does.

    Heights are above the sea, and also above the ellipsoid if the sentence has the geoid's height. No sentence has a
    height above ground. Raise InputError if no whole sentence gives a place or a heading together with a time.
    """
    log = Log(path, "NMEA 0183", bridge_s=1.0)
    first_s = last_s = math.nan  # times of day of the first and the latest sentence
    days = 0
    clocks: list[float] = []  # the clock at the first sentence, by each date
    faults: list[tuple[int, str]] = []
    seen, elsewhere = (math.nan, (math.nan, math.nan)), list[int]()  # time and place of the latest sentence
    separations: set[float] = set()
    for number, body in _whole_sentences(log, text, faults):
        try:
            values = _values(body.replace(" ", "").split(","))
        except (ValueError, LookupError) as error:
            faults.append((number, "too short" if isinstance(error, IndexError) else "with a garbled field"))
            continue
        now_s, date_s, separation = (values.pop(name) for name in ("time", "date", "separation"))
        if math.isfinite(now_s):
            days += now_s < last_s - _DAY_S / 2  # a step back is midnight
            first_s, last_s = now_s if math.isnan(first_s) else first_s, now_s
            clocks += [date_s + first_s - days * _DAY_S] if math.isfinite(date_s) else []
        if math.isfinite(first_s):
            separations.add(separation)
            place = values.get("latitude_deg", math.nan), values.get("longitude_deg", math.nan)
            if now_s != seen[0] or math.isnan(seen[1][0]):
                seen = now_s, place
            elif math.dist(place, seen[1]) * DEGREE_M > _APART_M:
                elsewhere.append(number)
                continue
            for name, value in values.items():
                log.add(name, last_s + days * _DAY_S - first_s, value, number)
    if not clocks and math.isfinite(came_s + first_s):
        clocks.append(first_s + _DAY_S * round((came_s - first_s) / _DAY_S))
    said = ", ".join(f"{count} {fault}" for fault, count in Counter(fault for _, fault in faults).items())
    if faults:
        log.note(f"line {min(faults)[0]}: sentences are left out: {said}")
    if not log.samples:
        found = f"; found are sentences {said}" if faults else ""
        hint = "; remove the checksums (*hh) to read them unchecked" if "wrong checksum" in said else ""
        raise log.refuse(f"no NMEA sentence gives a place or a heading together with a time{found}{hint}")
    if elsewhere:
        what = f"line {elsewhere[0]}: the log has two receivers over {_APART_M:g} m from each other"
        log.note(f"{what}: the first place of each time counts, and {len(elsewhere)} sentences are left out")
    if {apart for apart in separations if math.isfinite(apart)} == {0.0}:
        log.note("the receiver gives the geoid as 0 throughout: its heights above the sea may be above the ellipsoid")
    return build_record(log, clock_offset_s, next((s for s in clocks if is_clock(s)), [*clocks, math.nan][0]))


def _whole_sentences(log: Log, text: str, faults: list[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Yield the line and body of each trusted sentence. Append the line and fault of other sentences to `faults`."""
    found = [
        (number, body, checksum, functools.reduce(operator.xor, body.encode()))
        for number, line in enumerate(text.splitlines(), 1)
        for body, checksum in SENTENCE.findall(line)
    ]
    # Some programs get every checksum wrong in the same way: by a constant difference, or with a constant checksum.
    sums = [(int(checksum[1:], 16), right) for _, _, checksum, right in found if len(checksum) == 3]
    (apart, alike), (given, same) = (
        max(Counter(values).items(), key=lambda item: item[1], default=(0, 0))
        for values in ([one ^ right for one, right in sums], [one for one, _ in sums])
    )
    apart = apart if alike > max(2, 0.9 * len(sums)) else 0
    given = given if same > max(2, 0.9 * len(sums)) else -1
    bare = Counter(body[:5] for _, body, checksum, _ in found if not checksum)
    names = Counter(body[:5] for _, body, *_ in found)
    odd = Counter[str]()
    for number, body, checksum, right in found:
        digits = checksum[1:].upper()
        if len(digits) == 2 and int(digits, 16) not in (right, right ^ apart, given):
            faults.append((number, "with a wrong checksum"))
        # A line that was cut off lacks its checksum. Some receivers never write checksums.
        elif not checksum and bare[body[:5]] <= names[body[:5]] / 2:
            faults.append((number, "without a checksum"))
        elif checksum and len(digits) < 2 and digits not in ("", f"{right:X}", f"{right:02X}"[0]):
            faults.append((number, "with a wrong, short checksum"))
        else:
            odd["no checksum"] += not checksum
            odd["a short checksum"] += 0 < len(checksum) < 3
            odd["a checksum that is wrong in the same way throughout"] += len(digits) == 2 and int(digits, 16) != right
            yield number, body
    for fault, count in (+odd).items():
        log.note(f"{count} of {len(found)} sentences have {fault}: they are read, and damage in them goes unnoticed")


def _values(cells: list[str]) -> dict[str, float]:
    """Return a sentence's quantities, `time` of day, `date` and `separation` of the geoid; NaN if unknown.

    Raise IndexError if the sentence is too short, and KeyError or ValueError if a field is garbled.
    """
    fields = _FIELDS[cells[0][2:]]
    if len(cells) <= fields["least"]:
        raise IndexError
    cells += [""] * 12  # a missing field, at -1 or behind the end, is empty
    knots, km_h, heading, height, separation = (
        float(text) if (text := cells[fields.get(name, -1)]) else math.nan
        for name in ("knots", "km_h", "heading", "above_sea", "separation")
    )
    values: dict[str, float] = {}
    if "place" in fields:
        latitude, north, longitude, east = cells[fields["place"] :][:4]
        values |= {"latitude_deg": _degrees(latitude, north), "longitude_deg": _degrees(longitude, east)}
    if "above_sea" in fields:
        values |= {"above_sea_m": height, "above_ellipsoid_m": height + separation}
    speed_m_s = knots * _KNOT if "knots" in fields else km_h / 3.6
    values |= {} if math.isnan(speed_m_s) else {"speed_m_s": speed_m_s}
    values |= {} if math.isnan(heading) else {"vehicle_heading_rad": math.radians(heading)}
    if cells[fields.get("status", -1)] in ("0", "V", "N", "NN", "NNN", "NNNN"):
        values = dict.fromkeys(values, math.nan)
    clock = cells[fields.get("time", -1)]
    time_s = int(clock[:2]) * 3600 + int(clock[2:4]) * 60 + float(clock[4:]) if clock else math.nan
    if clock and not 0 <= time_s <= _DAY_S + 1:
        raise ValueError(clock)
    date_s = _midnight_s(*cells[fields["date"] :][:3]) if "date" in fields else math.nan
    return {**values, "time": time_s, "date": date_s, "separation": separation}


def _degrees(text: str, letter: str) -> float:
    """Return the degrees of 4807.038 (48 degrees, 7.038 minutes) with N, S, E or W; NaN without a place."""
    if not text or not letter:
        return math.nan
    whole, minutes = divmod(float(text), 100)
    degrees, most = whole + minutes / 60, {"N": 90, "S": 90, "E": 180, "W": 180}[letter]
    if not (minutes < 60 and 0 <= degrees <= most):
        raise ValueError(text)
    return -degrees if letter in "SW" else degrees


def _midnight_s(day: str, month: str, year: str) -> float:
    """Return the seconds from 1970 to a date; NaN if invalid. RMC has the whole date in the first text: 230394."""
    if len(day) == 6:
        day, month, year = day[:2], day[2:4], f"{'19' if day[4] >= '8' else '20'}{day[4:]}"
    return midnight_s(year, month, day)
