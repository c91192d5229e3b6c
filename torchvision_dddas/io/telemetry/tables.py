"""Read telemetry from CSV: own tables, `time_s,altitude_m,...`, and tables of other programs, by their column names."""

import math
import re
from datetime import tzinfo
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import DEGREE_M
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.io.tables import PLACES, Column, CsvText, Schema, parse_numbers, read_csv, read_table
from torchvision_dddas.io.telemetry.clocks import read_times, settle_times
from torchvision_dddas.io.telemetry.fields import (
    FIELDS,
    UNITS,
    Known,
    Names,
    field_of_view,
    looks_alike,
    names_of_table,
    parse_angle,
)
from torchvision_dddas.io.telemetry.record import JUMP_M, KINDS, OWN, Log, build_record
from torchvision_dddas.types import Telemetry

_PLACE = PLACES[0]
_KNOWN = {field.quantity: Known(field, math.pi / 180 if field.kind == "angle" else 1.0) for field in FIELDS}
# Columns of own tables; their pitch is positive down.
_OWN = {"altitude_m": "above_ground_m", "heading_deg": "heading_rad", "pitch_deg": "pitch_rad", "roll_deg": "roll_rad"}
_OWN |= {"hfov_deg": "hfov_rad", "vehicle_heading_deg": "vehicle_heading_rad"}
_OWN |= {name: name for name in ("speed_m_s", *_PLACE, *PLACES[1], "above_sea_m", "above_takeoff_m")}
_OWN |= {"above_ellipsoid_m": "above_ellipsoid_m", "accuracy_m": "accuracy_m"}
SCHEMA = Schema(
    "telemetry",
    Column("time_s", "g", -1e10, 1e10, wanted="seconds since the clip's first frame"),
    *(
        # A later check reports swapped longitudes and latitudes.
        Column(name, "g", *((-math.inf, math.inf) if name in _PLACE else field[2:4]), may_be_empty=True)
        for name, field in ((name, _KNOWN[quantity].field) for name, quantity in _OWN.items())
    ),
)
# A quantity is not read if a better one of these is known.
_BETTER = {"above_ground_m": {"above_takeoff_m"}, "bare_height_m": {"above_takeoff_m", "above_ground_m"}}
_BETTER |= {"bare_altitude_m": {"above_sea_m"}, "geoid_m": {"above_sea_m"}}
# The names of columns are searched for in this many rows and cells: lines about the flight may come before them.
_PREAMBLE, _CELLS = 60, 1000
# Largest numbers of columns that are tried for one quantity, read as times, and listed in a note.
_TRIED, _CLOCKS, _LISTED = 4, 8, 12
_UNKNOWN = {"nan", "na", "n/a", "null", "none", "no data", "inf", "-inf", "-", "--", "---"}
_ON = {"1", "1.0", "true", "yes", "y", "rec", "on", "video", "recording", "started"}
_GROUPED = re.compile(r"[-+]?\d{1,3},\d{3}")


def read_telemetry_table(
    path: Path,
    clock_offset_s: float,
    clip: Path | None,
    zone: tzinfo | None = None,
    order: str = "auto",
    rate_hz: float | None = None,
) -> Telemetry:
    """Read an own table, whose columns are all in SCHEMA, or a table of another program, as `read_telemetry` does.

    Raise InputError as `read_telemetry`, and for an own table as `read_table`, for half a place, and for falling times.
    """
    _, lines, rows = read_csv(path, "telemetry", has_header=False)
    names = Names()
    known = (sum(names.find(_bare(title)) is not None for title in row[:_CELLS]) for row in rows[:_PREAMBLE])
    place = next((place for place, count in enumerate(known) if count > 1), 0)
    header = [_bare(title) for title in rows[place]] if rows else []
    text = CsvText(header, lines[place + 1 :], rows[place + 1 :])
    if rows and rows[place] in text.rows:  # the line of names may be repeated
        kept = [k for k, row in enumerate(text.rows) if row != rows[place]]
        text = CsvText(header, [text.line[k] for k in kept], [text.rows[k] for k in kept])
    # Ignore an empty name, as after a comma at the end of the line, and the row numbers of pandas.
    if {name for name in header if name not in ("", "Unnamed: 0")} <= set(SCHEMA.names):
        return _read_own(path, text, clock_offset_s)
    return _Table(path, text).read(clock_offset_s, clip, zone, order, rate_hz)


def _bare(title: str) -> str:
    return title.lstrip("#%/ ")


def _no_log(path: Path) -> InputError:
    return InputError(
        f"telemetry {path} is not a log: its first line names none of {', '.join(SCHEMA.names)}; wanted {KINDS}. A CSV "
        "needs time_s and altitude_m, or a place"
    )


def _read_own(path: Path, text: CsvText, clock_offset_s: float) -> Telemetry:
    if not text.header:
        raise _no_log(path)
    pairs = [pair for pair in PLACES if set(pair) & set(text.header)]
    if len(pairs) > 1:
        raise InputError(f"telemetry {path} has places in degrees and in metres; wanted one kind: leave the other out")
    # The camera's file may give the height of the take-off point.
    has_height = any(name.startswith("above_") for name in text.header)
    wanted = pairs[0] if pairs else () if has_height else ("altitude_m",)
    table = read_table(path, SCHEMA, ("time_s", *wanted), is_ragged=True, text=text)
    table.require_rows()
    time_s = table["time_s"]
    if (is_back := np.diff(time_s) < 0).any():
        row = int(np.argmax(is_back)) + 1
        raise table.error(f"time_s runs back from {time_s[row - 1]:g} to {time_s[row]:g}; sort it by time", row)
    log = Log(path, OWN, moments=np.column_stack([time_s, time_s, table.line]))
    values = {known: table[name] * _KNOWN[known].scale for name, known in _OWN.items() if name in table}
    log.add_all(time_s, table.line, values, known=True)
    return build_record(log, clock_offset_s)


# --------------------------------------------------------------------------------------------------------------------
# Tables of other programs.


class _Table:
    """A table. columns: quantity -> place and meaning of its columns, best first. used: places of columns in use."""

    def __init__(self, path: Path, text: CsvText) -> None:
        self.header, self.lines, self.rows = text
        places = [k for k, name in enumerate(self.header) if re.match(r"\W*lat|\W*lon|\W*lng", name, re.IGNORECASE)]
        if any(k < len(row) and _GROUPED.fullmatch(row[k]) for row in self.rows[:2] for k in places):
            # A comma in a latitude is decimal, even with three digits behind it.
            self.rows = [[c.replace(",", ".") if _GROUPED.fullmatch(c) else c for c in row] for row in self.rows]
        self.names = names_of_table(self.header)
        self.log = Log(path, f"table of {self.names.program or 'another program'}")
        units = self.units = self._take_units()
        self.columns: dict[str, list[tuple[int, Known]]] = {}
        for place, title in enumerate(self.header):
            if (known := self.names.find(title)) is not None:
                known = known.in_unit(units[place]) or known if place < len(units) else known
                self.columns.setdefault(known.field.quantity, []).append((place, known))
        for columns in self.columns.values():
            columns.sort(key=lambda column: column[1].rank)
        self.used: set[int] = set()

    def _take_units(self) -> list[str]:
        """Remove a line of units below the names, and return the units; [] if there is no such line."""
        first = [cell.strip("()[]").lower() for cell in self.rows[0]] if self.rows else []
        is_unit = any(cell in units and not cell.isdigit() for cell in first for units in UNITS.values())
        if not is_unit or np.isfinite(parse_numbers(first)).any():
            return []
        del self.rows[0], self.lines[0]
        return first

    def cells(self, place: int) -> list[str]:
        """Return a column as text, "" for a row that ends before it."""
        self.used.add(place)
        return [row[place] if place < len(row) else "" for row in self.rows]

    def texts(self, quantity: str) -> list[str]:
        """Return the first column of a quantity that is not empty; empty cells if there is no such column."""
        tried = (self.cells(place) for place, _ in self.columns.get(quantity, ())[:_TRIED])
        return next((cells for cells in tried if any(cells)), [""] * len(self.rows))

    def numbers(self, quantity: str) -> np.ndarray | None:
        """Return a quantity in the record's unit and sign, (N,), NaN if unknown; None if no cell has a number."""
        columns = self.columns.get(quantity, [])[:_TRIED]
        for place, known in columns:
            cells = self.cells(place)
            values = parse_numbers(cells)
            rows = [row for row in np.flatnonzero(np.isinf(values)).tolist() if cells[row].lower() not in _UNKNOWN]
            if known.field.kind == "degrees":
                values[rows] = [parse_angle(cells[row])[0] for row in rows]
                rows = [row for row in rows if math.isnan(values[row])]
            values[np.isinf(values)] = np.nan
            is_fixed = known.field.kind != "degrees" or (values != 0).any() or place == columns[-1][0]
            if np.isfinite(values).any() and is_fixed:  # without a fix, a receiver says 0
                if rows:
                    what = f"{self.header[place]} is '{cells[rows[0]][:40]}', which is not a number"
                    self.log.note(f"line {self.lines[rows[0]]}: {what}; {len(rows)} left out")
                if known.field.kind in ("angle", "degrees"):
                    self._note_radians(place, values, known)
                return values * known.scale
            self.used.discard(place)
        return None

    def _note_radians(self, place: int, values: np.ndarray, known: Known) -> None:
        """Note angles that are read as degrees because their unit is unknown, although all could be radians."""
        title, finite, quantity = self.header[place], values[np.isfinite(values)], known.field.quantity
        turn = 1 / 4 if quantity in ("pitch_rad", "latitude_deg") else 1 / 2 if quantity == "longitude_deg" else 1
        is_told = bool(re.search(r"deg|°", title.lower()) or self.units)
        is_degrees = abs(known.scale) == (1.0 if known.field.kind == "degrees" else math.pi / 180)
        if (
            is_degrees
            and not is_told
            and np.abs(finite).max() < 6.284 * turn
            and not np.allclose(finite, finite.round(1))
        ):
            span = f"'{title}' is {finite.min():g} to {finite.max():g}, which may be radians: degrees are assumed"
            self.log.note(f"{span}; wanted a name with the unit, as gimbal_yaw_rad or latitude_rad")

    def read(
        self, clock_offset_s: float, clip: Path | None, zone: tzinfo | None, order: str, rate_hz: float | None
    ) -> Telemetry:
        """Return the record of the table."""
        log = self.log
        if not self.columns:
            raise _no_log(log.path)
        if not self.columns.keys() & {"time", "frame"}:
            titles = ", ".join(filter(None, self.header[:20]))
            raise InputError(f"telemetry {log.path} lacks a time; its columns are {titles}, wanted seconds or dates")
        if not self.rows:
            raise InputError(f"telemetry {log.path} has a header but no rows")
        if "time_s" in self.header and len(others := set(self.header) - set(SCHEMA.names)) < len(self.header) - 1:
            log.note(f"own tables have no columns {', '.join(sorted(others)[:_LISTED])}: read as another program's")
        values = self._quantities(order)
        if "time" in self.columns:
            time_s, start_utc_s = self._times(values, zone)
        else:
            time_s, start_utc_s = self._frames(clip, rate_hz), math.nan
        where, is_known = np.array(self.lines, float), np.isfinite(time_s)
        if not is_known.all():
            (place, _), *_ = self.columns.get("time") or self.columns["frame"]
            row = int((~is_known).argmax())
            text = f"'{self.cells(place)[row][:40]}' is not a time"
            if 2 * is_known.sum() <= len(time_s):
                raise log.refuse(f"{text}; wanted a date with a time, or seconds", where[row])
            log.note(f"line {where[row]:.0f}: {text}; {(~is_known).sum()} rows without a time are left out")
        log.moments = np.column_stack([time_s, time_s, where])[is_known]
        values = {quantity: column[is_known] for quantity, column in values.items()}
        log.add_all(time_s[is_known], where[is_known], values, known=True)
        if "filming" in self.columns and not clock_offset_s:
            self._note_film(time_s)
        # List unused columns that may hold quantities of a record, columns of unknown meaning first.
        unused = [title for place, title in enumerate(self.header) if place not in self.used]
        more_known = [title for title in unused if self.names.find(title) is not None]
        if listed := [t for t in unused if self.names.find(t) is None and looks_alike(t)] + more_known:
            more = f" and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
            log.note(f"columns that are not used: {', '.join(listed[:_LISTED])}{more}")
        return build_record(log, clock_offset_s, start_utc_s)

    def _quantities(self, order: str) -> dict[str, np.ndarray]:
        """Return the columns of the record, (N,) each, NaN if unknown."""
        values = dict[str, np.ndarray]()
        for quantity, kind, *_ in FIELDS:
            is_wanted = kind not in ("text", "number", "time") and not _BETTER.get(quantity, set()) & values.keys()
            if is_wanted and (column := self.numbers(quantity)) is not None:
                values[quantity] = column
        if "place" in self.columns and not values.keys() >= set(_PLACE):
            values |= self._pairs(order)
        if values.keys() >= set(_PLACE):
            for name, negative in zip(_PLACE, "WS", strict=True):
                sides = self.texts(name.replace("_deg", "_side"))
                is_negative = [side[:1].upper() == negative for side in sides]
                values[name] = np.where(is_negative, -np.abs(values[name]), values[name])
            self._scale_places(values)
            if (fix := self.numbers("fix")) is not None:
                fixed = {*_PLACE, "above_sea_m"} & values.keys()
                values |= {name: np.where(fix < 2, np.nan, values[name]) for name in fixed}
        if "focal_mm" in self.columns and "hfov_rad" not in values:
            values["hfov_rad"], notes = field_of_view(*map(self.texts, ("focal_mm", "f_number", "zoom")))
            self.log.is_nominal = True
            self.log.notes += notes
        return values

    def _scale_places(self, values: dict[str, np.ndarray]) -> None:
        """Convert whole numbers to degrees, from ten-millionths, as autopilots write them, or from millionths."""
        known = {name: column[np.isfinite(column)] for name, column in values.items()}
        both = np.concatenate([known[name] for name in _PLACE])
        if not len(both) or np.abs(both).max() <= 1000 or (both != np.round(both)).any():
            return
        is_e7 = self.names.program or any(
            (np.abs(known[k]) > m).any() for k, m in zip(_PLACE, (18e7, 9e7), strict=True)
        )
        values |= {name: values[name] * (1e-7 if is_e7 else 1e-6) for name in _PLACE}
        if not is_e7:
            self.log.note(
                "whole numbers as places are read as millionths of degrees; a name such as lat_e7 sets another unit"
            )
        tall = [
            name for name in values if name.startswith(("above", "bare")) and np.abs(known[name]).max(initial=0) > 1000
        ]
        if tall and not self.names.program:
            self.log.note(f"{', '.join(tall)} beside whole numbers as places may be in millimetres: metres are assumed")

    def _pairs(self, order: str) -> dict[str, np.ndarray]:
        """Return the longitudes and latitudes of a column that contains both."""
        signs = (";", "/", ", ", None, ",")
        parts = [
            [two for sign in signs if len(two := cell.strip("()[]").split(sign)) in (2, 3)]
            for cell in self.texts("place")
        ]
        if any(two and len(two[0]) == 3 for two in parts):
            self.log.note("the third number in a cell is not used")
        angles = [[parse_angle(part) for part in (two[0][:2] if two else ("", ""))] for two in parts]
        pairs = np.array([[value for value, _ in two] for two in angles])
        sides = {side for (_, side), _ in angles if side}
        first = re.search(r"lat|lon|lng", self.header[self.columns["place"][0][0]].lower())
        told = self.names.order or (("lat-lon" if first[0] == "lat" else "lon-lat") if first else "")
        is_first = sides <= {"N", "S"} if sides else self.log.latitude_first(pairs, told, order, "a cell")
        return dict(zip(_PLACE[::-1] if is_first else _PLACE, pairs.T, strict=True))

    @np.errstate(over="ignore", invalid="ignore")  # cells may hold any numbers
    def _times(self, values: dict[str, np.ndarray], zone: tzinfo | None) -> tuple[np.ndarray, float]:
        """Return the seconds since the first row, (N,), and the time of the first row, s since 1970."""
        columns = self.columns["time"][:_CLOCKS]
        read = [read_times(self.header[place], self.cells(place), known) for place, known in columns]
        step_m, is_far = math.nan, np.zeros(len(self.rows), bool)
        if values.keys() >= set(_PLACE):
            east, north = (np.diff(values[name]) * DEGREE_M for name in _PLACE)
            steps_m = np.hypot(east * np.cos(np.radians(values["latitude_deg"][1:])), north)
            is_far[1:] = steps_m > JUMP_M
            step_m = float(np.median(steps_m[np.isfinite(steps_m)])) if np.isfinite(steps_m).any() else math.nan
        time_s, start_utc_s, titles = settle_times(self.log, read, step_m, is_far, zone)
        self.used -= {place for place, _ in columns if self.header[place] not in titles}
        return time_s, start_utc_s

    def _frames(self, clip: Path | None, rate_hz: float | None) -> np.ndarray:
        """Return the seconds since the first frame, (N,), from frame numbers, which count from 0 or from 1."""
        if clip is None and rate_hz is None:
            raise InputError(
                f"telemetry {self.log.path} has frames and no times; give its clip, --rate, or a column time_s"
            )
        if (count := self.numbers("frame")) is None:
            return np.full(len(self.rows), np.nan)
        rate_hz = rate_hz or open_source(str(clip)).rate_hz
        return (count - min(float(count[np.isfinite(count)][0]), 1.0)) / rate_hz

    def _note_film(self, time_s: np.ndarray) -> None:
        """Note when the camera begins to record."""
        is_on = np.array([cell.lower() in _ON for cell in self.texts("filming")])
        begins = time_s[is_on & ~np.append(False, is_on[:-1])]
        if (begins > 0).any():
            more = f" and again at {', '.join(f'{begin:.1f}' for begin in begins[1:6])} s" if len(begins) > 1 else ""
            self.log.note(
                f"the log says that the camera began to film {begins[0]:.1f} s after its first row{more}, and times "
                f"count from that row: aerial.clock_offset_s={-begins[0]:.1f} counts them from the start of the film"
            )
