"""NMEA 0183: sentences of a receiver, one a line."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry.log import Log, assemble
from torchvision_dddas.types import Telemetry

_KNOT = 1852 / 3600
_DAY_S = 86_400.0
_KINDS = {"GGA", "RMC", "GLL", "VTG", "HDT", "THS"}


def read_nmea(path: Path, text: str, clock_offset_s: float) -> Telemetry:
    """GGA, RMC and GLL for places, RMC and VTG for the speed, HDT and THS for the vehicle's heading.

    A receiver's height is above the sea: above ground nothing is known. Times since the first sentence that has one.
    Raises InputError where no sentence is whole or none has a time.
    """
    try:
        import pynmea2
    except ImportError:
        raise InputError(
            f"telemetry {path} is NMEA 0183, which needs pynmea2: pip install 'torchvision-dddas[telemetry]'"
        ) from None
    log = Log(path, "NMEA 0183", bridge_s=1.0)
    checked = "*" in text
    bad: list[int] = []
    clock = _Clock()
    for number, line in enumerate(text.splitlines(), 1):
        place = line.find("$")
        if place < 0 or line[place + 3 : place + 6] not in _KINDS:
            continue
        try:
            sentence = pynmea2.parse(line[place:].strip(), check=checked)
            if clock.tells(sentence):
                _say(log, sentence, clock.now_s, number)
        except (pynmea2.ParseError, ValueError, TypeError, AttributeError):
            bad.append(number)
    if bad:
        log.note(f"line {bad[0]}: not a whole sentence or its checksum is wrong; {len(bad)} lines are left out")
    if not log.samples:
        raise log.refuse("no NMEA sentence tells a place or a heading together with a time")
    return assemble(log, clock_offset_s, clock.utc_s)


class _Clock:
    """Time of day counted on over midnight, from the first; and the date where it is told."""

    def __init__(self) -> None:
        self.first_s = self.last_s = self.utc_s = math.nan
        self.days = 0

    @property
    def now_s(self) -> float:
        return self.last_s + self.days * _DAY_S - self.first_s

    def tells(self, sentence: Any) -> bool:
        """Take a sentence's time, if it has one; whether any is known by now."""
        told = getattr(sentence, "timestamp", None)
        if told is not None and not isinstance(told, str):
            second = told.hour * 3600 + told.minute * 60 + told.second + told.microsecond / 1e6
            if second < self.last_s - _DAY_S / 2:
                self.days += 1
            self.first_s = second if math.isnan(self.first_s) else self.first_s
            self.last_s = second
            date = getattr(sentence, "datestamp", None)
            if date is not None and math.isnan(self.utc_s):
                midnight = datetime(date.year, date.month, date.day, tzinfo=UTC).timestamp()
                self.utc_s = midnight + second - self.now_s
        return not math.isnan(self.first_s)


def _say(log: Log, sentence: Any, time_s: float, line: int) -> None:
    kind = sentence.sentence_type
    if kind in ("GGA", "RMC", "GLL"):
        fixed = int(sentence.gps_qual or 0) > 0 if kind == "GGA" else sentence.status == "A"
        fixed = fixed and bool(sentence.lat) and bool(sentence.lon)
        log.add("longitude_deg", time_s, sentence.longitude if fixed else math.nan, line)
        log.add("latitude_deg", time_s, sentence.latitude if fixed else math.nan, line)
        if kind == "GGA":
            known = fixed and sentence.altitude is not None
            log.add("above_sea_m", time_s, float(sentence.altitude) if known else math.nan, line)
        if kind == "RMC" and sentence.spd_over_grnd is not None:
            log.add("speed_m_s", time_s, float(sentence.spd_over_grnd) * _KNOT if fixed else math.nan, line)
    elif kind == "VTG" and sentence.spd_over_grnd_kmph is not None:
        log.add("speed_m_s", time_s, float(sentence.spd_over_grnd_kmph) / 3.6, line)
    elif kind in ("HDT", "THS") and sentence.heading:
        log.add("vehicle_heading_rad", time_s, math.radians(float(sentence.heading)), line)
