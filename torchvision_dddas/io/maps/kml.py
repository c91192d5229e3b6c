"""Tracks and error ellipses as KML 2.2, with times where a clock is known."""

from html import escape
from itertools import pairwise

import numpy as np

from torchvision_dddas.io.maps.ellipses import Place, cut_line, ring_about, ring_m, rounded, semi_axes
from torchvision_dddas.io.maps.ground_tracks import GroundTracks, ellipse_rows
from torchvision_dddas.io.overlay import identity_colour

_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document>
<name>{name}</name>
"""


def kml(
    tracks: GroundTracks, name: str = "tracks", landmarks: GroundTracks | None = None, names: tuple[str, ...] = ()
) -> str:
    """The document: folders of tracks, of ellipses that hold the true place with 95 %, and of landmarks.

    With a clock a track is a gx:Track, several where it goes over 180 degrees of longitude, and an ellipse has the time
    of its place; else a track is a line, cut there, and there are the ellipses of the last places only.
    Raises ValueError where there is no geographic origin.
    """
    if tracks.lonlat_deg is None:
        raise ValueError("these positions have no longitude and latitude")
    parts = [_HEAD.format(name=xml_text(name)), *(_style(f"target-{t}", identity_colour(t)) for t in tracks.of)]
    parts.append(_folder("tracks", [_track(tracks, of, f"target {t}", f"target-{t}") for t, of in tracks.of.items()]))
    parts.append(_folder("95 % ellipses", _ellipses(tracks)))
    if landmarks is not None and landmarks.lonlat_deg is not None:
        parts.append(_style("landmark", (255, 255, 255)))
        marks = [_track(landmarks, of, names[k], "landmark") for k, of in landmarks.of.items()]
        parts.append(_folder("landmarks", marks))
    # Styles go before the folders that use them.
    parts[1:] = sorted(parts[1:], key=lambda part: not part.startswith("<Style"))
    return "".join([*parts, "</Document>\n</kml>\n"])


def xml_text(text: str) -> str:
    """A text as XML holds it: escaped, without the control characters that XML has no way to write."""
    kept = "".join(c for c in text if c in "\t\n\r" or (c >= " " and not "\ud800" <= c <= "\udfff" and c < "\ufffe"))
    return escape(kept, quote=False).replace('"', "&quot;")


def _style(name: str, colour: tuple[int, int, int]) -> str:
    tint = "{:02x}{:02x}{:02x}".format(*colour)  # KML has blue before red as OpenCV has, and opacity before both
    return (
        f'<Style id="{name}"><IconStyle><color>ff{tint}</color><scale>0.6</scale></IconStyle>'
        f"<LineStyle><color>ff{tint}</color><width>3</width></LineStyle>"
        f"<PolyStyle><color>40{tint}</color></PolyStyle></Style>\n"
    )


def _folder(name: str, placemarks: list[str]) -> str:
    return f"<Folder>\n<name>{name}</name>\n{''.join(placemarks)}</Folder>\n" if placemarks else ""


def _track(tracks: GroundTracks, rows: slice, name: str, style: str) -> str:
    assert tracks.lonlat_deg is not None
    places = rounded(tracks.lonlat_deg[rows])
    if tracks.times_utc is None:
        lines = [_coordinates(line) for line in cut_line(places)]
        shapes = [f"<LineString><tessellate>1</tessellate>{line}</LineString>" for line in lines]
        if len(places) == 1:
            shapes = [f"<Point>{_coordinates(places)}</Point>"]
        shape = shapes[0] if len(shapes) == 1 else f"<MultiGeometry>{''.join(shapes)}</MultiGeometry>"
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
        shape = pieces[0] if len(pieces) == 1 else f"<gx:MultiTrack>{''.join(pieces)}</gx:MultiTrack>"
    return f"<Placemark><name>{xml_text(name)}</name><styleUrl>#{style}</styleUrl>{shape}</Placemark>\n"


def _ellipses(tracks: GroundTracks) -> list[str]:
    assert tracks.lonlat_deg is not None
    rows = ellipse_rows(tracks)
    if tracks.times_utc is None:
        rows = rows[np.isin(rows, [of.stop - 1 for of in tracks.of.values()])]
    axes, bearing = semi_axes(tracks.covariance_m2[rows])
    placemarks = []
    for row, ring, (major, minor) in zip(rows.tolist(), ring_m(axes, bearing), axes, strict=True):
        rings = [
            f"<Polygon><tessellate>1</tessellate><outerBoundaryIs><LinearRing>{_coordinates(ring)}"
            "</LinearRing></outerBoundaryIs></Polygon>"
            for ring in ring_about(tracks.lonlat_deg[row], ring)
        ]
        if not rings:
            continue
        target = tracks.target[row]
        placemarks.append(
            f"<Placemark><name>target {target}, frame {tracks.frame[row]}</name>"
            f"<description>95 % ellipse, semi-axes {major:.2f} m and {minor:.2f} m</description>"
            + (f"<TimeStamp><when>{tracks.times_utc[row]}</when></TimeStamp>" if tracks.times_utc else "")
            + f"<styleUrl>#target-{target}</styleUrl>"
            + (rings[0] if len(rings) == 1 else f"<MultiGeometry>{''.join(rings)}</MultiGeometry>")
            + "</Placemark>\n"
        )
    return placemarks


def _coordinates(places: list[Place]) -> str:
    return f"<coordinates>{' '.join(f'{p[0]!r},{p[1]!r},0' for p in places)}</coordinates>"
