"""Places of landmarks that come during a live run: JSON lines, CSV rows, or reports of ground vehicles."""

import csv
import json
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import isfinite, nan
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import AerialLocator, to_local
from torchvision_dddas.io.mavlink_link import is_mavlink, take_systems
from torchvision_dddas.io.telemetry import is_clock, kind_of_report, message_parts
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.cot_input import CotInput
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.report_inputs import ReportInput, is_live_input, open_input
from torchvision_dddas.types import Landmarks

_KEPT = 100  # reports of a landmark
_WAIT_S, _SETTLING_S, _POLL_S = 10.0, 1.0, 0.05
_PLACE = 33  # GLOBAL_POSITION_INT
_DEGREES, _METRES = ("longitude_deg", "latitude_deg"), ("east_m", "north_m")


def open_landmarks(path: Path | Landmarks | None, source: LiveSource, health: Health) -> "LiveLandmarks | None":
    """Open --landmarks if it names a live input. `mavlink:...?ugv1=11` and `cot:...?ugv1=UID` name vehicles.

    Raise errors of open_input.
    """
    if not isinstance(path, Path) or not is_live_input(str(path)):
        return None
    if not source.is_stream:
        raise InputError(f"--landmarks {path} is for a camera or a stream; for a recording give a table")
    if str(path).startswith("cot:"):
        events = CotInput(str(path), lambda words: health.event("landmarks", words))
        return LiveLandmarks(str(path), events, dict(enumerate(events.names.values())), health)
    text, systems = take_systems(str(path), "--landmarks") if is_mavlink(str(path)) else (str(path), {})
    if is_mavlink(text) and not systems:
        raise InputError(f"--landmarks {path} names no vehicle; give their systems, such as {text}?ugv1=11&ugv2=12")
    found = open_input(text, lambda words: health.event("landmarks", words))
    return LiveLandmarks(str(path), found, {number: name for name, number in systems.items()}, health)


class LiveLandmarks:
    """A thread that reads where landmarks are. Each has the latest reports and its first one.

    systems: names of landmarks by MAVLink system, or by any number for other inputs; empty: every sender is a landmark.
    """

    def __init__(self, name: str, source: ReportInput, systems: Mapping[int, str], health: Health) -> None:
        self.name, self._source, self._systems, self._health = name, source, systems, health
        self._reports = dict[str, deque[tuple[float, float, float, float]]]()  # time, place and sigma, by name
        self._first = dict[str, tuple[float, float, float, float]]()
        self._names: tuple[str, ...] | None = None  # once the run began, no landmark is added
        self._columns: list[str] = []
        self._geographic, self._count, self._placed = True, 0, 0
        self._told, self._closing, self._lock = set[str](), threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._run, name="landmarks", daemon=True)
        self._thread.start()

    def wait(self, waiting: Callable[[], object] | None) -> None:
        """Wait for the first reports, a second longer for those of further landmarks. Raise InputError without any."""
        began_s = time.monotonic()
        wanted = max(len(self._systems), 1)
        while len(self._first) < wanted:
            if waiting is not None:
                waiting()
            elif time.monotonic() - began_s > _WAIT_S:
                missing = sorted(set(self._systems.values()) - set(self._first)) or ["any landmark"]
                raise InputError(f"--landmarks {self.name}: no place of {', '.join(missing)} comes for {_WAIT_S:g} s")
            time.sleep(_POLL_S)
        time.sleep(0.0 if self._systems else _SETTLING_S)
        self._names = tuple(self._first)

    def record(self, start_utc_s: float, rate_hz: float) -> Landmarks:
        """Return the reports as a table of frames. start_utc_s: when frame 1 was taken."""
        names = self._names or tuple(self._first)
        with self._lock:
            rows = [
                (*report, k)
                for k, name in enumerate(names)
                for report in dict.fromkeys((self._first[name], *self._reports[name]))
            ]
        time_s, east, north, sigma, landmark = np.array(sorted(rows)).reshape(-1, 5).T
        count, frame = len(rows), 1 + (time_s - start_utc_s) * rate_hz
        none, unseen = np.zeros(count, np.int64), np.full((count, 2), nan)
        columns = frame, landmark.astype(np.int64), unseen, np.c_[east, north], sigma, none.astype(bool), none
        return Landmarks(names, *columns, self._geographic, self.name)

    def place(self, locator: AerialLocator | None, start_utc_s: float, rate_hz: float) -> None:
        """Give a locator the reports that came since the last call. start_utc_s: as for `record`, NaN if unknown."""
        if locator is None or self._count == self._placed or not isfinite(start_utc_s):
            return
        self._placed, marks, origin = self._count, self.record(start_utc_s, rate_hz), locator.site.origin_deg
        locator.set_site(replace(locator.site, landmarks=marks if origin is None else to_local(marks, origin)))

    def close(self) -> None:
        """End the thread and close the input."""
        self._closing.set()
        self._thread.join(timeout=2.0)
        self._source.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            for came_s, content in self._source.receive():
                try:
                    fault = self._add(came_s, content)
                except Exception:  # no damaged report ends the thread
                    fault = f"{content[:40]!r} gives no place of a landmark"
                if fault and fault not in self._told and len(self._told) < _KEPT:
                    self._told.add(fault)
                    self._health.event("landmarks", f"{self.name}: {fault}: such reports are left out")

    def _add(self, came_s: float, content: bytes) -> str:
        """Add a report. Return "", or why it is left out. Raise any exception for a damaged one."""
        kind = kind_of_report(content)
        if kind == "mavlink":
            number, system, payload = message_parts(content)
            name = self._systems.get(system, "")
            if number != _PLACE or not name:
                return ""
            latitude, longitude = struct.unpack("<ii", payload.ljust(12, b"\0")[4:12])
            row = {"landmark": name, **dict(zip(_DEGREES, (longitude / 1e7, latitude / 1e7), strict=True))}
        elif kind == "csv":
            cells = next(csv.reader([content.decode()]))
            if not self._columns or cells == self._columns:
                self._columns = cells
                return ""
            row = dict(zip(self._columns, cells, strict=True))
        else:
            row = json.loads(content)
        name, kinds = str(row["landmark"]), _DEGREES if _DEGREES[0] in row else _METRES
        east, north = (float(row[column]) for column in kinds)
        if not isfinite(east + north) or (kinds is _DEGREES and not (abs(east) <= 180 and abs(north) <= 90)):
            return f"the place of {name} is unknown or off the globe"
        if self._names is not None and (name not in self._names or self._geographic != (kinds is _DEGREES)):
            return f"{name} was not there at the start, or its places are in other units"
        told_s = float(row.get("time_s") or nan)
        when_s = told_s if is_clock(told_s) else came_s
        with self._lock:
            self._geographic = kinds is _DEGREES
            report = when_s, east, north, float(row.get("sigma_m") or nan)
            self._first.setdefault(name, report)
            self._reports.setdefault(name, deque(maxlen=_KEPT)).append(report)
            self._count += 1
        return ""
