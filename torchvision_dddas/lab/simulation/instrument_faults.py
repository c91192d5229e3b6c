"""Faults of a served vehicle's instruments: off, stuck, wrong and slow, for a part of the run."""

import math
import re
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Flight

SLOW_S, WRONG_DEG, WRONG_PLACE_DEG = 2.0, 30.0, 0.001
"""Age of slow data; error of a wrong heading; error of a wrong latitude, about 110 m. A wrong camera is upside down."""

_PARTS = {
    "gps": ("place", "above_sea_m", "altitude_m", "speed_m_s"),
    "attitude": ("heading_rad", "pitch_rad", "roll_rad", "vehicle_heading_rad"),
}
_FORM = re.compile(r"(camera|gps|attitude)=(off|stuck|wrong|slow)@(\d+(?:\.\d+)?)\.\.(\d+(?:\.\d+)?)")


class InstrumentFault(NamedTuple):
    """A fault of an instrument between two times of the simulated world, in seconds."""

    instrument: str
    verb: str
    from_s: float
    to_s: float


def parse_fault(text: str) -> InstrumentFault:
    """Parse `gps=stuck@10..20`. Raise InputError for anything else."""
    found = _FORM.fullmatch(text)
    if found is None or float(found[3]) >= float(found[4]):
        raise InputError(
            f"--fault {text}: wanted INSTRUMENT=VERB@FROM..TO in seconds, such as gps=stuck@10..20; instruments are "
            "camera, gps, attitude, verbs off, stuck, wrong, slow"
        )
    return InstrumentFault(found[1], found[2], float(found[3]), float(found[4]))


class Instruments:
    """The data of the instruments with their faults. Call `show` for each frame in order."""

    def __init__(self, faults: Sequence[InstrumentFault]) -> None:
        self._faults, self._seen = faults, {name: deque[tuple[float, Any]]() for name in ("camera", *_PARTS)}

    def show(
        self, time_s: float, image: np.ndarray | None, flight: Flight | None
    ) -> tuple[np.ndarray | None, Flight | None]:
        """Return the picture and the report that leave the vehicle; None for no picture or no report."""
        shown: Any = self._pass_on("camera", image, time_s)
        for instrument, names in _PARTS.items():
            values = None if flight is None else {name: getattr(flight, name) for name in names}
            values = self._pass_on(instrument, values, time_s)
            if flight is not None and values is None:
                values = {name: (math.nan, math.nan) if name == "place" else math.nan for name in names}
            flight = None if flight is None else replace(flight, **values)
        return shown, flight

    def _pass_on(self, instrument: str, value: Any, time_s: float) -> Any:
        fault = next((f for f in self._faults if f.instrument == instrument and f.from_s <= time_s < f.to_s), None)
        verb, seen = "" if fault is None else fault.verb, self._seen[instrument]
        if value is None or verb == "off":
            return None
        if verb == "stuck" and seen:
            return seen[-1][1]
        seen.append((time_s, value))
        while len(seen) > 1 and seen[1][0] <= time_s - SLOW_S:
            seen.popleft()
        if verb == "slow":
            return seen[0][1]
        return _spoil(instrument, value) if verb == "wrong" else value


def _spoil(instrument: str, value: Any) -> Any:
    if instrument == "camera":
        return value[::-1, ::-1]
    if instrument == "gps":
        return value | {"place": (value["place"][0], value["place"][1] + WRONG_PLACE_DEG)}
    return value | {"heading_rad": (value["heading_rad"] + math.radians(WRONG_DEG)) % (2 * math.pi)}
