"""Read the newest reports of a live link by the readers of logs: keep a window of them, and parse it as a file."""

import csv
import io
import json
import math
import os
import re
import struct
import tempfile
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry.clocks import parse_time_zone
from torchvision_dddas.io.telemetry.mavlink import HEARTBEAT, SYSTEM_TIME, message_end, message_parts, read_tlog
from torchvision_dddas.io.telemetry.misb import KEY, local_sets, read_misb, stamp_s
from torchvision_dddas.io.telemetry.nmea import read_nmea
from torchvision_dddas.io.telemetry.record import PAUSES, is_clock
from torchvision_dddas.io.telemetry.tables import read_telemetry_table
from torchvision_dddas.types import Telemetry

_WINDOW_S, _MOST, _LEAST = 8.0, 600, 12
_SWAPPED_S = 5.0  # reports that come in another order than they were made differ by this time at most
_AHEAD_S, _SET_AFTER = 60.0, 3  # how far a time may jump ahead; so many odd times in a row are those of a set clock
_RECENT = 25  # packets that give the delay of pictures
_NAMES_MOST = 500  # columns that are read of JSON
# gpsd's TPV reports, whose names are ambiguous elsewhere; its estimates of errors have no stated probability.
_GPSD = {"time": "time", "lat": "latitude_deg", "lon": "longitude_deg", "speed": "speed_m_s", "altMSL": "above_sea_m"}
_GPSD |= {"altHAE": "above_ellipsoid_m"}
_CSV = re.compile(rb"[^\0-\x08\x0e-\x1f]*[,;\t|][^\0-\x08\x0e-\x1f]*")
_NO_AUTOPILOT = b"\x08"  # MAV_AUTOPILOT_INVALID, of ground stations, cameras and onboard computers
_NAMES = {"csv": "CSV", "json": "JSON lines", "nmea": "NMEA 0183", "mavlink": "MAVLink", "klv": "KLV"}


def kind_of_report(content: bytes) -> str:
    """Return csv, json, nmea, mavlink or klv for a line, a datagram or a packet; "" for anything else."""
    start = content.lstrip()
    if start.startswith(b"{"):
        return "json"
    if re.match(rb"[$!][A-Z]{5,},", start):
        return "nmea"
    if KEY in content[:32]:  # a header of the stream may precede the packet
        return "klv"
    if content[:1] in (b"\xfd", b"\xfe") and len(content) > 8:
        return "mavlink"
    return "csv" if _CSV.fullmatch(content) else ""


def split_reports(content: bytes) -> Iterator[bytes]:
    """Yield the reports of a datagram: lines of text, or MAVLink messages."""
    kind = kind_of_report(content)
    while kind == "mavlink" and content:
        end = message_end(content)
        yield content[:end]
        content = content[end:]
    yield from [content] if kind == "klv" else (line for line in content.splitlines() if line.strip())


class ReportWindow:
    """The newest reports of one link, all of one kind, which the first usable report decides.

    name: of the link, for messages. time_zone, order: as for `read_telemetry`. system: the vehicle whose MAVLink
    messages are taken; 0: the first autopilot whose heartbeat comes. delay_s: from the stamps of KLV packets to the
    times of their pictures, by this machine's clock; NaN for other reports.
    """

    def __init__(self, name: str, time_zone: str = "", order: str = "auto", system: int = 0) -> None:
        self.name, self.kind, self.system, self.delay_s = name, "", system, math.nan
        self._zone, self._order = parse_time_zone(time_zone), order
        self._header = b""  # of a CSV
        self._reports: deque[tuple[float, bytes]] = deque(maxlen=_MOST)
        self._newest = math.nan, math.nan  # the latest time that a row tells, and when that row came
        self._odd = 0  # rows with odd times since the last usual one
        memory = "/dev/shm"  # the disk of a board does not last if it is written ten times a second
        self._folder = tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None)

    def add(self, came_s: float, content: bytes) -> str:
        """Add a report that came at came_s, seconds since 1970. Return "", or why it is left out."""
        kind = kind_of_report(content)
        if not kind or (self.kind and kind != self.kind):
            said = f"{_NAMES[kind]} comes beside {_NAMES[self.kind]}" if kind else f"{content[:30]!r} is no report"
            return f"{said}: such reports are left out"
        row = _row(content) if kind == "json" else content
        if row is None:
            return "a line is no JSON object: such lines are left out"
        self.kind = kind
        if kind == "mavlink" and (why := self._other_system(content)) is not None:
            return why
        if kind == "csv" and not self._header:
            self._header = row
        elif row and row != self._header:
            if why := self._odd_time(came_s, row):
                return why
            self._reports.append((came_s, row))
            while len(self._reports) > _LEAST and self._reports[0][0] < came_s - _WINDOW_S:
                self._reports.popleft()
        return ""

    def _other_system(self, message: bytes) -> str | None:
        """Return None for a message of the vehicle's system; else why it is left out, "" if that is no fault."""
        number, system, payload = message_parts(message)
        if number == HEARTBEAT and not self.system and payload[5:6] != _NO_AUTOPILOT:
            self.system = system
        if self.system == system and number != SYSTEM_TIME:  # times of reception count, so its clock does not matter
            return None
        is_usual = number in (HEARTBEAT, SYSTEM_TIME) or not self.system
        return "" if is_usual else f"MAVLink system {system} is left out: system {self.system} is taken; see ?system=N"

    def _odd_time(self, came_s: float, row: bytes) -> str:
        """Return why a row of an own table is left out for its time, which would make the others unusable; else ""."""
        try:
            if self.kind == "csv":
                time_s = float(row.split(b",")[self._header.split(b",").index(b"time_s")])
            else:
                time_s = float(json.loads(row)["time_s"]) if self.kind == "json" else math.nan
        except (KeyError, TypeError, ValueError, IndexError, OverflowError):  # the reader of the window reports it
            return ""
        newest_s, newest_came_s = self._newest
        ahead_s = time_s - newest_s
        if ahead_s > came_s - newest_came_s + _AHEAD_S or ahead_s < -_SWAPPED_S:
            self._odd += 1
            if self._odd < _SET_AFTER:
                apart = f"{ahead_s:g} s ahead of" if ahead_s > 0 else f"{-ahead_s:g} s behind"
                return f"the time_s of a row is {apart} the others: such rows are left out"
            self._reports.clear()  # the sender has set its clock
            newest_s = math.nan
        if math.isfinite(time_s):
            self._odd, self._newest = 0, (time_s if math.isnan(newest_s) else max(time_s, newest_s), came_s)
        return ""

    @property
    def came_s(self) -> float:
        """When the newest report came, seconds since 1970; NaN before the first."""
        return self._reports[-1][0] if self._reports else math.nan

    def read(self) -> Telemetry | None:
        """Return the reports, counted from 1970 by their own clock, else by their reception; None without any.

        Raise InputError or any other error if they cannot be used; the older half of them is then forgotten, so that
        damage passes.
        """
        if not self._reports:
            return None
        path = Path(self._folder.name, f"reports.{self.kind}")
        try:
            path.write_bytes(self._content())
            log = self._parse(path)
        except Exception as error:
            for _ in range(-(-len(self._reports) // 2)):
                self._reports.popleft()
            if not isinstance(error, InputError):
                raise
            raise InputError(str(error).replace(str(path), self.name)) from None
        notes = tuple(note for note in log.notes if not any(words in note for words in PAUSES))  # usual on a link
        return replace(log, origin=f"{self.name} ({_NAMES[self.kind]})", notes=notes, **self._clock(log))

    def close(self) -> None:
        """Remove the window's file."""
        self._folder.cleanup()

    def _content(self) -> bytes:
        contents = [content for _, content in self._reports]
        if self.kind == "mavlink":
            return b"".join(struct.pack(">Q", round(came_s * 1e6)) + content for came_s, content in self._reports)
        if self.kind == "json":
            rows = _in_order([json.loads(content) for content in contents])
            text, names = io.StringIO(), dict.fromkeys(name for row in rows for name in row)
            table = csv.DictWriter(text, list(names)[:_NAMES_MOST], restval="", extrasaction="ignore")
            table.writeheader()
            table.writerows(rows)
            return text.getvalue().encode()
        return b"".join(contents) if self.kind == "klv" else b"\n".join([self._header, *contents])

    def _parse(self, path: Path) -> Telemetry:
        if self.kind == "mavlink":
            return read_tlog(path, 0.0)
        if self.kind == "klv":
            return read_misb(path, None, 0.0)
        if self.kind == "nmea":
            return read_nmea(path, path.read_text("utf-8", errors="replace"), 0.0, self._reports[0][0])
        return read_telemetry_table(path, 0.0, None, self._zone, self._order)

    def _clock(self, log: Telemetry) -> dict[str, Any]:
        start_utc_s = log.start_utc_s
        unknown = {"start_utc_s": 0.0, "start_local_s": math.nan, "latest_utc_s": math.nan}
        if self.kind == "klv":
            return {"time_s": self._picture_times(log.time_s + start_utc_s), **unknown}
        if math.isnan(start_utc_s):  # times of an own table may count from 1970
            start_utc_s = 0.0 if is_clock(log.time_s[-1]) else self.came_s - float(log.time_s[-1])
        return {"time_s": log.time_s + start_utc_s, **unknown}

    def _picture_times(self, utc_s: np.ndarray) -> np.ndarray:
        """Return the times of the pictures with which KLV came that has the stamps utc_s. Measure delay_s."""
        found = ((came_s, one) for came_s, packet in self._reports for one in local_sets(packet))
        pairs = np.array([(stamp_s(one.tags.get(2)), came_s) for came_s, one in found])
        stamps, came = pairs[np.isfinite(pairs[:, 0])].T
        # The reader changes stamps that count other units than the standard's.
        stamps = stamps * 1000.0 ** round(math.log(np.median(utc_s) / np.median(stamps), 1000))
        self.delay_s = float(np.median((came - stamps)[-_RECENT:]))
        order = np.argsort(stamps, kind="stable")
        return np.interp(utc_s, stamps[order], np.maximum.accumulate(came[order]))


def _in_order(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows by their times if some were swapped on the way. Times of different clocks are left as they came."""
    try:
        times = [float(row["time_s"]) for row in rows]
    except (KeyError, TypeError, ValueError, OverflowError):
        return rows
    if not 0 < max((a - b for a, b in pairwise(times)), default=0.0) <= _SWAPPED_S:
        return rows
    return [rows[k] for k in np.argsort(times, kind="stable")]


def _row(content: bytes) -> bytes | None:
    """Return an object of JSON as a flat one, names of inner objects without those of the outer ones; None if damaged.

    gpsd's reports get our names; those of its classes without a place become empty.
    """
    try:
        given = json.loads(content)
    except ValueError:
        return None
    if not isinstance(given, dict):
        return None
    if isinstance(given.get("class"), str):
        if given["class"] != "TPV":
            return b""
        if not given.get("time") or given.get("mode", 0) < 2:  # without a fix
            return b""
        return json.dumps({ours: given.get(name) for name, ours in _GPSD.items()}).encode()
    flat = dict[str, Any]()
    for name, value in given.items():
        flat |= {name: value} if not isinstance(value, dict) else {k: v for k, v in value.items() if k not in given}
    return json.dumps({name: v for name, v in flat.items() if not isinstance(v, dict | list)}).encode()
