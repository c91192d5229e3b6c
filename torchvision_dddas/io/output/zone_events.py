"""Events of targets at zones and of crowds: events.csv, .jsonl, .geojson and .cot.xml, and counts."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.io.atomic_files import OutputPart, write_whole
from torchvision_dddas.io.maps.formats import MARK_STALE_S, event_uid, mark
from torchvision_dddas.io.maps.ground_tracks import iso_utc
from torchvision_dddas.io.output.run_report import Table
from torchvision_dddas.io.tables import DEGREES, EAST_NORTH, FRAME, Column, Rows, Schema, TableFiles, TextFiles
from torchvision_dddas.types import FrameResult, Zone, ZoneEvent

CSV, JSONL, GEOJSON, COT = "events.csv", "events.jsonl", "events.geojson", "events.cot.xml"
_PIXEL = (Column("u_px", ".2f"), Column("v_px", ".2f"))
EVENTS = Schema(
    "events",
    *(FRAME, Column("time_s", ".3f"), Column("utc"), Column("event"), Column("zone"), Column("target", "d")),
    *(Column("class"), Column("class_id", ".0f"), Column("direction"), Column("inside_s", ".3f")),
    *(Column("speed_m_s", ".3f"), Column("speed_px_s", ".2f"), *EAST_NORTH, *DEGREES, *_PIXEL, Column("others")),
)
"""The columns of events.csv, with the meanings in ZoneEvent. A line of events.jsonl has the same names."""
COUNTED = ("enter", "leave", "present", "dwell", "to_right", "to_left")


def event_fields(event: ZoneEvent, start_utc_s: float = math.nan) -> dict[str, Any]:
    """Return the columns of an event. Unknown values are None, and numbers are rounded as in events.csv."""
    names = [column.name for column in (*EAST_NORTH, *DEGREES, *_PIXEL)]
    places = [*event.east_north_m.tolist(), *event.lonlat_deg.tolist(), *event.image_px.tolist()]
    utc_s = start_utc_s + event.time_s
    fields = {
        "frame": event.frame,
        "time_s": event.time_s,
        "utc": iso_utc(np.array([utc_s]))[0] if math.isfinite(utc_s) else None,
        "event": event.kind,
        "zone": event.zone or None,
        "target": event.target,
        "class": event.label or None,
        "class_id": None if event.class_id < 0 else event.class_id,
        "direction": event.direction or None,
        "inside_s": event.inside_s,
        "speed_m_s": event.speed_m_s,
        "speed_px_s": event.speed_px_s,
        **dict(zip(names, places, strict=True)),
        "others": ";".join(map(str, event.others)) or None,
    }
    form = {column.name: column.format for column in EVENTS.columns}
    for name, value in fields.items():
        if isinstance(value, float):
            fields[name] = float(format(value, form[name])) if math.isfinite(value) else None
    return fields


class ZoneCounts:
    """Counts events. rows: for each zone the numbers of targets, of targets by class, and of events by kind.

    crowds: number of crowd events by kind.
    """

    def __init__(self, zones: Sequence[Zone]) -> None:
        self.rows: dict[str, dict[str, Any]] = {
            zone.name: {"targets": 0, "classes": {}, **dict.fromkeys(COUNTED[4:] if zone.is_line else COUNTED[:4], 0)}
            for zone in zones
        }
        self.crowds: dict[str, int] = {}

    def add(self, events: Sequence[ZoneEvent]) -> None:
        """Count the events of a frame."""
        for event in events:
            if not event.zone:
                self.crowds[event.kind] = self.crowds.get(event.kind, 0) + 1
                continue
            row = self.rows[event.zone]
            row[event.direction or event.kind] += 1
            if event.is_first:
                row["targets"] += 1
                label = event.label or (f"class {event.class_id}" if event.class_id >= 0 else "unknown")
                row["classes"][label] = row["classes"].get(label, 0) + 1


def zone_table(counts: dict[str, dict[str, Any]]) -> Table:
    """Return the counts as a table for a report."""
    rows = [
        (name, row["targets"], row["classes"], {kind: row[kind] for kind in COUNTED if row.get(kind)})
        for name, row in counts.items()
    ]
    return "Events by place", ("zone", "targets", "by class", "events"), rows, ""


class EventFiles(OutputPart[FrameResult]):
    """Writes the files of events. events.geojson needs longitudes and latitudes, and also holds the zones in degrees.

    events.cot.xml holds marks as Cursor-on-Target. It also needs a clock.
    """

    files = (CSV, JSONL, GEOJSON, COT)

    def __init__(self, folder: Path, zones: Sequence[Zone], start_utc_s: float, has_degrees: bool) -> None:
        self._folder, self._zones, self._start_utc_s, self._has_degrees = folder, zones, start_utc_s, has_degrees
        self._marks: list[str] = []
        self._features: list[dict[str, Any]] = []
        self._table = TableFiles[FrameResult]({folder / CSV: (EVENTS, self._rows)})
        self._lines = TextFiles({folder / JSONL: ""})

    def _rows(self, result: FrameResult) -> Rows:
        fields = [event_fields(event, self._start_utc_s) for event in result.events]
        return {name: [one[name] for one in fields] for name in EVENTS.names}

    def write(self, item: FrameResult) -> None:
        """Add the events of a frame. Raise OSError if a file cannot be written."""
        self._table.write(item)
        fields = [event_fields(event, self._start_utc_s) for event in item.events]
        self._lines.write("".join(json.dumps(one) + "\n" for one in fields))
        for event, one in zip(item.events, fields, strict=True):
            place = one.pop("longitude_deg"), one.pop("latitude_deg")
            if not self._has_degrees or None in place:
                continue
            self._features.append(_feature("Point", place, one))
            if math.isfinite(self._start_utc_s):
                uid = f"{event_uid('dddas', self._start_utc_s, event.target)}-{len(self._marks) + 1}"
                until = iso_utc(np.array([self._start_utc_s + event.time_s + MARK_STALE_S]))[0]
                self._marks.append(mark(uid, event.describe(), (one["utc"], until), place))

    def close(self, complete: bool) -> None:
        """Move the files to their places. Raise OSError if they cannot be written."""
        self._table.close()
        self._lines.close()
        if self._has_degrees:
            shown = [_zone_feature(zone) for zone in self._zones if zone.unit == "deg"]
            content = {"type": "FeatureCollection", "features": [*shown, *self._features]}
            write_whole(self._folder / GEOJSON, (json.dumps(content, separators=(",", ":")) + "\n").encode())
            if math.isfinite(self._start_utc_s):
                lines = "".join(self._marks)
                text = f'<?xml version="1.0" encoding="UTF-8"?>\n<events>\n{lines}</events>\n'
                write_whole(self._folder / COT, text.encode())

    def discard(self) -> None:
        """Remove the unfinished files."""
        self._table.discard()
        self._lines.discard()


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def _zone_feature(zone: Zone) -> dict[str, Any]:
    rings = [ring.tolist() if zone.is_line else [*ring.tolist(), ring[0].tolist()] for ring in zone.rings]
    return _feature("MultiLineString" if zone.is_line else "Polygon", rings, {"name": zone.name})
