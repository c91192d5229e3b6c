"""Tracks and error ellipses for other tools: GeoJSON (RFC 7946), KML 2.2, Cursor-on-Target."""

import json
import math
from collections.abc import Sequence
from html import escape
from itertools import pairwise
from typing import Any

import numpy as np

from torchvision_dddas.geometry import circular_error_90, error_category
from torchvision_dddas.io.maps.ground_tracks import (
    GroundTracks,
    Place,
    cut_line,
    ellipse_rows,
    iso_utc,
    map_ellipses,
    semi_axes,
)
from torchvision_dddas.io.overlay import identity_colour

# --------------------------------------------------------------------------------------------------------------------
# GeoJSON.


def geojson(
    tracks: GroundTracks, landmarks: GroundTracks | None = None, names: Sequence[str] = (), name: str = "tracks"
) -> dict[str, Any]:
    """Return a FeatureCollection with one feature per target: a line, or a point if the target has a single place.

    `frames` holds the frame of each place, `times` its time. Without a clock, `seconds` holds seconds since the clip's
    first frame, if known. `sigma_m` is the root of the trace of each covariance, null if unknown. A line that crosses
    longitude 180 is cut there, and the cut adds points that belong to no frame. `bbox` goes from west to east, across
    longitude 180 if the places do. landmarks: added under their names. name: name of the layer.
    Raise ValueError without a geographic origin.
    """
    features = [_geojson_track(tracks, rows, {"target": target}) for target, rows in tracks.of.items()]
    if landmarks is not None and landmarks.lonlat_deg is not None:
        features += [_geojson_track(landmarks, rows, {"landmark": names[k]}) for k, rows in landmarks.of.items()]
    return _collection(name, features)


def ellipses_geojson(tracks: GroundTracks) -> dict[str, Any]:
    """Return a FeatureCollection of the 95 % ellipses of the rows that `ellipse_rows` selects.

    The ellipses need a separate file, because GDAL and QGIS read a file as one layer with one type of shape.
    Raise ValueError without a geographic origin.
    """
    features = []
    for ellipse in map_ellipses(tracks, ellipse_rows(tracks)):
        row = ellipse.row
        properties: dict[str, Any] = {
            "target": int(tracks.target[row]),
            "probability": 0.95,
            "frame": int(tracks.frame[row]),
            "semi_major_m": round(ellipse.major_m, 3),
            "semi_minor_m": round(ellipse.minor_m, 3),
            "circular_error90_m": round(float(tracks.circular_error90_m[row]), 2),
            "error_category": str(error_category(tracks.circular_error90_m[row])),
            "bearing_deg": round(math.degrees(ellipse.bearing_rad), 1) % 180,
        }
        if tracks.times_utc is not None:
            properties["time"] = tracks.times_utc[row]
        features.append(_feature("Polygon", [[ring] for ring in ellipse.rings], properties))
    return _collection("ellipses", features)


def encode_geojson(collection: dict[str, Any]) -> bytes:
    """Return a collection as the bytes of a file."""
    return (json.dumps(collection, separators=(",", ":")) + "\n").encode()


def _collection(name: str, features: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a FeatureCollection. GDAL uses the name as the name of the layer."""
    places = [place for feature in features for place in _places(feature["geometry"]["coordinates"])]
    box = {"bbox": _box(places)} if places else {}
    return {"type": "FeatureCollection", "name": name, **box, "features": features}


def _geojson_track(tracks: GroundTracks, rows: slice, name: dict[str, Any]) -> dict[str, Any]:
    places, sigma_m = tracks.places(rows), np.round(tracks.sigma_m[rows], 3).tolist()
    properties = {
        **name,
        "frames": tracks.frame[rows].tolist(),
        "sigma_m": [sigma if math.isfinite(sigma) else None for sigma in sigma_m],
    }
    for key, heights in (
        ("above_sea_m", tracks.above_sea_m[rows]),
        ("above_ellipsoid_m", tracks.above_ellipsoid_m[rows]),
    ):
        if np.isfinite(heights).any():
            properties[key] = [round(up, 2) if math.isfinite(up) else None for up in heights.tolist()]
    if tracks.times_utc is not None:
        properties["times"] = tracks.times_utc[rows]
    elif np.isfinite(tracks.time_s[rows]).all():
        properties["seconds"] = np.round(tracks.time_s[rows], 4).tolist()
    return (
        _feature("Point", places, properties)
        if len(places) == 1
        else _feature("LineString", cut_line(places), properties)
    )


def _feature(kind: str, parts: Sequence[Any], properties: dict[str, Any]) -> dict[str, Any]:
    shape = (
        {"type": kind, "coordinates": parts[0]} if len(parts) == 1 else {"type": f"Multi{kind}", "coordinates": parts}
    )
    return {"type": "Feature", "geometry": shape, "properties": properties}


def _places(coordinates: list[Any]) -> list[Place]:
    """Return all places of a shape from its nested lists."""
    if isinstance(coordinates[0], float):
        return [coordinates]
    return [place for part in coordinates for place in _places(part)]


def _box(places: list[Place]) -> list[float]:
    longitude, latitude = np.array(places).T
    west, east = longitude.min(), longitude.max()
    if east - west > 180:
        # The places lie on both sides of longitude 180, so the western edge is the larger number.
        east = longitude[longitude < 0].max(initial=-180.0)
        west = longitude[longitude >= 0].min(initial=180.0)
    return [float(west), float(latitude.min()), float(east), float(latitude.max())]


# --------------------------------------------------------------------------------------------------------------------
# KML.

_KML = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document>
<name>{name}</name>
{styles}{folders}</Document>
</kml>
"""


def kml(
    tracks: GroundTracks, name: str = "tracks", landmarks: GroundTracks | None = None, names: Sequence[str] = ()
) -> str:
    """Return a KML document with folders of tracks, 95 % ellipses and landmarks.

    With a clock, tracks are gx:Track elements and each ellipse has the time of its place. Without a clock, tracks are
    lines, and only the last place of each target has an ellipse. Tracks are cut where they cross longitude 180.
    Raise ValueError without a geographic origin.
    """
    styles = {f"target-{target}": identity_colour(target) for target in tracks.of}
    folders = {
        "tracks": [_kml_track(tracks, rows, f"target {t}", f"target-{t}") for t, rows in tracks.of.items()],
        "95 % ellipses": _kml_ellipses(tracks),
    }
    if landmarks is not None and landmarks.lonlat_deg is not None:
        styles["landmark"] = (255, 255, 255)
        marks = [_kml_track(landmarks, rows, names[k], "landmark") for k, rows in landmarks.of.items()]
        folders["landmarks"] = marks
    return _KML.format(
        name=xml_text(name),
        styles="".join(_kml_style(name, colour) for name, colour in styles.items()),
        folders="".join(
            f"<Folder>\n<name>{name}</name>\n{''.join(marks)}</Folder>\n" for name, marks in folders.items() if marks
        ),
    )


def xml_text(text: str) -> str:
    """Escape a text for XML, and remove the control characters that XML cannot represent."""
    kept = "".join(c for c in text if c in "\t\n\r" or (c >= " " and not "\ud800" <= c <= "\udfff" and c < "\ufffe"))
    return escape(kept, quote=False).replace('"', "&quot;")


def _kml_style(name: str, colour: tuple[int, int, int]) -> str:
    tint = "{:02x}{:02x}{:02x}".format(*colour)  # KML's order is opacity, blue, green, red
    return (
        f'<Style id="{name}"><IconStyle><color>ff{tint}</color><scale>0.6</scale></IconStyle>'
        f"<LineStyle><color>ff{tint}</color><width>3</width></LineStyle>"
        f"<PolyStyle><color>40{tint}</color></PolyStyle></Style>\n"
    )


def _kml_track(tracks: GroundTracks, rows: slice, name: str, style: str) -> str:
    places = tracks.places(rows)
    if tracks.times_utc is None:
        lines = [
            f"<LineString><tessellate>1</tessellate>{_coordinates(line)}</LineString>" for line in cut_line(places)
        ]
        shape = f"<Point>{_coordinates(places)}</Point>" if len(places) == 1 else _one_or("MultiGeometry", lines)
    else:
        when = tracks.times_utc[rows]
        cuts = [k for k, (a, b) in enumerate(pairwise(places), 1) if abs(a[0] - b[0]) > 180]
        pieces = [
            "<gx:Track><altitudeMode>clampToGround</altitudeMode>\n"
            + "".join(f"<when>{time}</when>\n" for time in when[a:b])
            + "".join(f"<gx:coord>{place[0]!r} {place[1]!r} 0</gx:coord>\n" for place in places[a:b])
            + "</gx:Track>"
            for a, b in pairwise([0, *cuts, len(places)])
        ]
        shape = _one_or("gx:MultiTrack", pieces)
    return f"<Placemark><name>{xml_text(name)}</name><styleUrl>#{style}</styleUrl>{shape}</Placemark>\n"


def _kml_ellipses(tracks: GroundTracks) -> list[str]:
    rows = ellipse_rows(tracks)
    if tracks.times_utc is None:
        rows = rows[np.isin(rows, [of.stop - 1 for of in tracks.of.values()])]
    placemarks = []
    for ellipse in map_ellipses(tracks, rows):
        rings = [
            f"<Polygon><tessellate>1</tessellate><outerBoundaryIs><LinearRing>{_coordinates(ring)}"
            "</LinearRing></outerBoundaryIs></Polygon>"
            for ring in ellipse.rings
        ]
        target, times = tracks.target[ellipse.row], tracks.times_utc
        placemarks.append(
            f"<Placemark><name>target {target}, frame {tracks.frame[ellipse.row]}</name>"
            f"<description>95 % ellipse, semi-axes {ellipse.major_m:.2f} m and {ellipse.minor_m:.2f} m</description>"
            + (f"<TimeStamp><when>{times[ellipse.row]}</when></TimeStamp>" if times else "")
            + f"<styleUrl>#target-{target}</styleUrl>{_one_or('MultiGeometry', rings)}</Placemark>\n"
        )
    return placemarks


def _one_or(several: str, shapes: Sequence[str]) -> str:
    """Return a single shape as it is, or several shapes inside an element of this name."""
    return shapes[0] if len(shapes) == 1 else f"<{several}>{''.join(shapes)}</{several}>"


def _coordinates(places: list[Place]) -> str:
    return f"<coordinates>{' '.join(f'{p[0]!r},{p[1]!r},0' for p in places)}</coordinates>"


# --------------------------------------------------------------------------------------------------------------------
# Cursor-on-Target, the XML that situational-awareness tools exchange.

UNKNOWN = "9999999.0"
"""The value of an unknown height or error."""
STALE_S, MARK_STALE_S = 10.0, 600.0
"""Seconds for which the events of a target and of a mark are valid."""
_KIND = "a-u-G"  # an atom on the ground of unknown affiliation
_MARK = "b-m-p-s-m"  # a spot on the map
_OWN = "a-f-A-M-F-Q"  # a friendly unmanned aircraft


def cot(tracks: GroundTracks, source: str = "dddas") -> str:
    """Return `<events>` in the order of time, one event per line, and at most one event per target and second.

    ce is one standard deviation along the longer axis of the ellipse. The remarks name the category of the 90 % error.
    how="m-f" means "fused from several machine sources". A uid consists of the source, the start of the clip, and the
    target. Raise ValueError without a geographic origin or a clock.
    Source: MITRE, Event-PUBLIC.xsd, version 2.0.
    """
    if tracks.times_utc is None:
        raise ValueError("these positions have no clock")
    rows = np.array([row for of in tracks.of.values() for row in tracks.spaced(1.0, of)], int)
    rows = rows[np.lexsort((tracks.target[rows], tracks.time_s[rows]))]
    axes, _ = semi_axes(tracks.covariance_m2[rows], chi2=1.0)
    stale = iso_utc(tracks.start_utc_s + tracks.time_s[rows] + STALE_S)
    lines = []
    for row, sigma_m, until in zip(rows.tolist(), axes, stale, strict=True):
        longitude, latitude = tracks.degrees[row].tolist()
        uid = event_uid(source, tracks.start_utc_s, tracks.target[row])
        when = tracks.times_utc[row], until
        place = longitude, latitude, float(tracks.above_ellipsoid_m[row])
        lines.append(event(uid, tracks.target[row], when, place, sigma_m, tracks.velocity_m_s[row]))
    return '<?xml version="1.0" encoding="UTF-8"?>\n<events>\n' + "".join(lines) + "</events>\n"


def event_uid(source: str, start_utc_s: float, target: int | str) -> str:
    """Return the uid of a target in a run, or of its camera."""
    return f"{xml_text(source)}-{start_utc_s:.0f}-{target}"


def event(
    uid: str,
    target: int,
    when: tuple[str, str],
    place: tuple[float, float, float],
    sigma_m: np.ndarray,
    velocity_m_s: np.ndarray,
    velocity_covariance: np.ndarray | None = None,
    source: str = "",
) -> str:
    """Return the line of a target's event. when: its time, and the time until which it is valid.

    place: longitude, latitude, and metres above the ellipsoid, NaN if unknown. sigma_m: (2,) standard deviations along
    the axes of the ellipse, the longer first. The first becomes ce. The remark names the category of the 90 % error.
    velocity_covariance: (2, 2) in m²/s². source: the name of the camera, which begins the callsign.
    """
    within_m = circular_error_90(sigma_m)
    category = error_category(within_m)[0]
    remark = f"<remarks>{category}, 90 % within {within_m[0]:.1f} m</remarks>" if category else ""
    track = _track(velocity_m_s, velocity_covariance)
    name = f"{source} target {target}".lstrip()
    return _event(uid, _KIND, name, when, place, float(sigma_m[0]), track + remark)


def own_event(
    uid: str,
    name: str,
    when: tuple[str, str],
    place: tuple[float, float, float],
    sigma_m: tuple[float, float],
    angles_rad: tuple[float, float, float],
    view_rad: tuple[float, float],
    range_m: float,
    velocity_m_s: np.ndarray,
) -> str:
    """Return the event of the camera in the air: its place, and a `sensor` detail with its view.

    when, place: as for `event`. sigma_m: horizontal and vertical. angles_rad: heading, pitch below the horizon and
    roll. view_rad: horizontal and vertical field of view. range_m: to the ground along the optical axis, NaN if it does
    not meet the ground. Source: MITRE, CoT_sensor.xsd.
    """
    heading, pitch, roll = (round(math.degrees(angle), 1) for angle in angles_rad)
    fov, vfov = (math.degrees(angle) for angle in view_rad)
    seen = f' range="{range_m:.0f}"' if math.isfinite(range_m) else ""
    sensor = (
        f'<sensor azimuth="{heading % 360:.1f}" elevation="{-pitch:.1f}" roll="{roll:.1f}" fov="{fov:.1f}" '
        f'vfov="{vfov:.1f}"{seen} type="r-e" model="{xml_text(name)}"/>'
    )
    return _event(uid, _OWN, name, when, place, sigma_m[0], _track(velocity_m_s) + sensor, sigma_m[1])


def _track(velocity_m_s: np.ndarray, covariance: np.ndarray | None = None) -> str:
    """Return the element of course and speed with their standard deviations; empty if the velocity is unknown.

    Source: MITRE, CoT_track.xsd.
    """
    east, north = velocity_m_s.tolist()
    if not (math.isfinite(east) and math.isfinite(north)):
        return ""
    speed, errors = math.hypot(east, north), ""
    if covariance is not None and np.isfinite(covariance).all() and speed > 0:
        along, across = velocity_m_s / speed, np.array([north, -east]) / speed
        speed_sigma, across_sigma = (math.sqrt(max(float(d @ covariance @ d), 0.0)) for d in (along, across))
        course_sigma = min(math.degrees(across_sigma / speed), 180.0)
        errors = f' eCourse="{course_sigma:.1f}" eSpeed="{speed_sigma:.2f}"'
    course = round(math.degrees(math.atan2(east, north)), 1) % 360
    return f'<track course="{course:.1f}" speed="{speed:.2f}"{errors}/>'


def mark(uid: str, name: str, when: tuple[str, str], place: tuple[float, float]) -> str:
    """Return an event that marks a spot on the map. when: as for `event`. place: longitude, latitude."""
    return _event(uid, _MARK, name, when, (*place, math.nan), math.nan)


def _event(
    uid: str,
    kind: str,
    name: str,
    when: tuple[str, str],
    place: tuple[float, float, float],
    sigma_m: float,
    detail: str = "",
    height_sigma_m: float = math.nan,
) -> str:
    longitude, latitude, above_ellipsoid_m = place
    time, stale = when
    known = (f"{v:.2f}" if math.isfinite(v) else UNKNOWN for v in (sigma_m, above_ellipsoid_m, height_sigma_m))
    error, hae, height_error = known
    return (
        f'<event version="2.0" uid="{uid}" type="{kind}" how="m-f" time="{time}" start="{time}" stale="{stale}">'
        f'<point lat="{latitude:.8f}" lon="{longitude:.8f}" hae="{hae}" ce="{error}" le="{height_error}"/>'
        f'<detail><contact callsign="{xml_text(name)}"/>{detail}</detail></event>\n'
    )
