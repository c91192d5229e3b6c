"""Read zones from GeoJSON (RFC 7946) and KML 2.2: polygons are areas, lines are lines to cross.

The property `name` is the name, and `dwell_s` is the time in seconds after which a target dwells. In KML both belong to
the placemark, `dwell_s` as <Data> or <SimpleData> of its <ExtendedData>. Coordinates are WGS84, unless a GeoJSON has
the top-level member "unit": "px" for u, v in the picture of a fixed camera, "m" for the run's local metres.
"""

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchvision_dddas.errors import InputError, readable
from torchvision_dddas.geometry import area_of, crosses_itself, east_north
from torchvision_dddas.types import Zone

UNITS = ("deg", "m", "px")
MOST_POINTS, MOST_ZONES = 2000, 1000
_KINDS = {"Polygon": 1, "MultiPolygon": 2, "LineString": 0, "MultiLineString": 1}
"""Supported geometries, and the nesting depth of their lines."""


def read_zones(path: str | Path) -> tuple[list[Zone], list[str]]:
    """Return the zones of a file, and notes on what was left out.

    Raise InputError as `make_zone` does, and for an unreadable file, another format, or a file without polygon or line.
    """
    try:
        content = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"zones {path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if content.startswith(b"PK"):
        raise InputError(f"zones {path} is an archive, such as KMZ; unpack it and give the .kml file in it")
    try:
        is_json = content.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")
        given = json.loads(content.decode("utf-8-sig")) if is_json else ElementTree.fromstring(content)
    except (ValueError, RecursionError, ElementTree.ParseError) as error:
        raise InputError(f"zones {path} is neither GeoJSON nor KML: {error}") from None
    unit = given.get("unit", "deg") if isinstance(given, dict) else "deg"
    crs = given.get("crs") if isinstance(given, dict) else None
    if crs and not re.search(r"(CRS84|\b4326)\b", str(crs)):
        raise InputError(f"zones {path} has coordinates in {str(crs)[:80]}; save it in WGS84, EPSG:4326")
    zones: list[Zone] = []
    notes: list[str] = []
    other = 0
    for name, kind, lines, dwell_s in _features(given) if isinstance(given, dict) else _placemarks(given):
        if kind not in _KINDS:
            other += 1
            continue
        is_line = "Line" in kind
        name = " ".join(readable(name).split())[:80] or f"{'line' if is_line else 'zone'} {len(zones) + 1}"
        used = {zone.name for zone in zones}
        if name in used:
            other_name = next(f"{name} #{k}" for k in range(2, MOST_ZONES + 3) if f"{name} #{k}" not in used)
            notes.append(f"zones {path}: {name} occurs more than once or has several areas; one is named {other_name}")
            name = other_name
        try:
            zones.append(make_zone(name, lines, is_line, unit, 10.0 if dwell_s is None else dwell_s))
        except InputError as error:
            raise InputError(f"zones {path}: {error}") from None
    if not zones or len(zones) > MOST_ZONES:
        raise InputError(f"zones {path} has {len(zones) or 'no'} polygons and lines; wanted 1 to {MOST_ZONES}")
    if other:
        notes.append(f"zones {path}: features that are neither polygon nor line are left out: {other}")
    return zones, notes


def make_zone(name: str, lines: Any, is_line: bool, unit: str = "deg", dwell_s: Any = 10.0) -> Zone:
    """Make a zone from lists of places. Raise InputError for wrong types, numbers or ranges, and crossing outlines."""
    if unit not in UNITS:
        raise InputError(f"the unit of zones must be one of {', '.join(UNITS)}, got {str(unit)[:40]!r}")
    try:
        rings = tuple(np.array([place[:2] for place in line], float).reshape(len(line), 2) for line in lines)
        seconds = float(dwell_s)
    except (TypeError, ValueError, OverflowError, IndexError, KeyError):
        raise InputError(f"{name} must be a list of places with two numbers each, and its dwell_s a number") from None
    rings = tuple(ring[np.r_[True, (ring[1:] != ring[:-1]).any(axis=1)][: len(ring)]] for ring in rings)
    if not is_line:
        rings = tuple(ring[:-1] if len(ring) and (ring[0] == ring[-1]).all() else ring for ring in rings)
    least = 2 if is_line else 3
    count = sum(map(len, rings))
    if not rings or min(map(len, rings)) < least or count > MOST_POINTS:
        raise InputError(
            f"{name} has {count} points; wanted {least} or more in each part, none repeated, {MOST_POINTS} at most"
        )
    if not all(np.isfinite(ring).all() for ring in rings) or not 0 < seconds < math.inf:
        raise InputError(f"{name} holds a number that is not finite, or a dwell_s that is not positive")
    if (
        unit == "deg"
        and (far := next((p for ring in rings for p in ring if (abs(p) > (180, 90)).any()), None)) is not None
    ):
        fits = all((abs(ring) <= (90, 180)).all() for ring in rings)
        raise InputError(
            f"{name} has a place at {far[0]:g}, {far[1]:g}; wanted longitude, latitude in degrees"
            f"{' (are they swapped? write the longitude first)' if fits else ''}. For other coordinates, set the "
            'member "unit" of the GeoJSON to "px" or "m"'
        )
    if not is_line and any(map(crosses_itself, rings)):
        raise InputError(f"{name} crosses itself, so its inside is undefined; draw its outline without crossings")
    if not is_line and any(area_of(ring) == 0 for ring in rings):
        raise InputError(f"{name} has no inside: its points lie on one line")
    return Zone(name, rings, is_line, unit, seconds)


def zone_rings(zone: Zone, origin_deg: tuple[float, float] | None) -> list[np.ndarray]:
    """Return the rings in local metres. Pixels become u and -v, so that left and right are those of the viewer."""
    if zone.unit == "px":
        return [ring * (1, -1) for ring in zone.rings]
    return [east_north(r, origin_deg) if zone.unit == "deg" and origin_deg else r for r in zone.rings]


Found = tuple[str, str, Any, Any]
"""Name, kind, lines and dwell_s of a feature."""


def _features(given: Any, name: str = "", dwell_s: Any = None) -> Iterator[Found]:
    """Yield the geometries of a GeoJSON object."""
    if not isinstance(given, dict):
        return
    properties = given.get("properties")
    if isinstance(properties, dict):
        name, dwell_s = str(properties.get("name") or ""), properties.get("dwell_s")
    inner = [*_list(given.get("features")), *_list(given.get("geometries"))]
    for one in [*inner, given["geometry"]] if isinstance(given.get("geometry"), dict) else inner:
        yield from _features(one, name, dwell_s)
    if "coordinates" in given:
        kind, lines = str(given.get("type")), given["coordinates"]
        if kind == "MultiPolygon":  # several areas are several zones
            yield from ((name, "Polygon", part, dwell_s) for part in _list(lines))
            return
        for _ in range(_KINDS.get(kind, 1) - 1):
            lines = [line for part in _list(lines) for line in _list(part)]
        yield name, kind, [lines] if kind == "LineString" else lines, dwell_s


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _placemarks(root: ElementTree.Element) -> Iterator[Found]:
    """Yield the geometries of a KML. All lines of a placemark form one geometry."""
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""
    for mark in root.iter("Placemark"):
        name, plain = (mark.findtext("name") or "").strip(), mark.findtext(".//SimpleData[@name='dwell_s']")
        dwell_s = mark.findtext(".//Data[@name='dwell_s']/value", plain)
        found = False
        areas = [("Polygon", area.findall(".//coordinates")) for area in mark.iter("Polygon")]
        for kind, elements in [*areas, ("LineString", mark.findall(".//LineString/coordinates"))]:
            if texts := [element.text or "" for element in elements]:
                found = True
                yield name, kind, [[p.split(",") for p in text.split()] for text in texts], dwell_s
        if not found or mark.find(".//Point") is not None:
            yield name, "", (), None
