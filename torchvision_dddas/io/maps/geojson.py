"""Tracks and error ellipses as GeoJSON (RFC 7946)."""

import json
import math
from typing import Any

import numpy as np

from torchvision_dddas.io.maps.ellipses import Place, cut_line, ring_about, ring_m, rounded, semi_axes
from torchvision_dddas.io.maps.ground_tracks import GroundTracks, ellipse_rows


def geojson(
    tracks: GroundTracks, ellipses: bool = False, landmarks: GroundTracks | None = None, names: tuple[str, ...] = ()
) -> dict[str, Any]:
    """A FeatureCollection, a feature a target: a line, or a point where it was located once.

    `frames` has the frame of each place and `times` its time where a clock is known, else `seconds` since the clip's
    first frame where that is; `sigma_m` how well it is known: the root of the covariance's trace, null where it is not.
    A line over 180 degrees of longitude is cut there, into lines whose ends on it are no places of frames.
    ellipses: with those that hold the true place with 95 %, as in `ellipse_rows`. landmarks: they too, by their
    names. `bbox` goes from west to east, over 180 degrees where the places do.
    Raises ValueError where there is no geographic origin.
    """
    if tracks.lonlat_deg is None:
        raise ValueError("these positions have no longitude and latitude")
    features = [_track(tracks, rows, {"target": target}) for target, rows in tracks.of.items()]
    if ellipses:
        features += _ellipses(tracks)
    if landmarks is not None and landmarks.lonlat_deg is not None:
        features += [_track(landmarks, rows, {"landmark": names[k]}) for k, rows in landmarks.of.items()]
    box = {"bbox": _box([place for feature in features for place in _corners(feature)])} if features else {}
    return {"type": "FeatureCollection", **box, "features": features}


def encode_geojson(collection: dict[str, Any]) -> bytes:
    """The bytes of the file."""
    return (json.dumps(collection, separators=(",", ":")) + "\n").encode()


def _track(tracks: GroundTracks, rows: slice, properties: dict[str, Any]) -> dict[str, Any]:
    assert tracks.lonlat_deg is not None
    places = rounded(tracks.lonlat_deg[rows])
    lines = cut_line(places)
    if len(places) == 1:
        shape: dict[str, Any] = {"type": "Point", "coordinates": places[0]}
    elif len(lines) == 1:
        shape = {"type": "LineString", "coordinates": lines[0]}
    else:
        shape = {"type": "MultiLineString", "coordinates": lines}
    properties |= {
        "frames": tracks.frame[rows].tolist(),
        "sigma_m": [s if math.isfinite(s) else None for s in np.round(tracks.sigma_m[rows], 3).tolist()],
    }
    if tracks.times_utc is not None:
        properties["times"] = tracks.times_utc[rows]
    elif np.isfinite(tracks.time_s[rows]).all():
        properties["seconds"] = np.round(tracks.time_s[rows], 4).tolist()
    return {"type": "Feature", "geometry": shape, "properties": properties}


def _ellipses(tracks: GroundTracks) -> list[dict[str, Any]]:
    assert tracks.lonlat_deg is not None
    rows = ellipse_rows(tracks)
    axes, bearing = semi_axes(tracks.covariance_m2[rows])
    features = []
    for row, ring, (major, minor), turned in zip(rows.tolist(), ring_m(axes, bearing), axes, bearing, strict=True):
        rings = ring_about(tracks.lonlat_deg[row], ring)
        if not rings:
            continue
        polygons = [[ring] for ring in rings]
        shape: dict[str, Any] = {"type": "MultiPolygon", "coordinates": polygons}
        if len(polygons) == 1:
            shape = {"type": "Polygon", "coordinates": polygons[0]}
        properties: dict[str, Any] = {
            "ellipse_of": int(tracks.target[row]),
            "probability": 0.95,
            "frame": int(tracks.frame[row]),
            "semi_major_m": round(float(major), 3),
            "semi_minor_m": round(float(minor), 3),
            "bearing_deg": round(math.degrees(turned), 1) % 180,
        }
        if tracks.times_utc is not None:
            properties["time"] = tracks.times_utc[row]
        features.append({"type": "Feature", "geometry": shape, "properties": properties})
    return features


def _corners(feature: dict[str, Any]) -> list[Place]:
    """All places of a feature, however deep they lie."""
    found = feature["geometry"]["coordinates"]
    if feature["geometry"]["type"] == "Point":
        return [found]
    while not isinstance(found[0][0], float):
        found = [place for part in found for place in part]
    return list(found)


def _box(places: list[Place]) -> list[float]:
    longitude, latitude = np.array(places).T
    if np.ptp(longitude) > 180:
        # They lie on both sides of 180 degrees: so west is the larger number.
        east = longitude[longitude < 0].max(initial=-180.0)
        west = longitude[longitude >= 0].min(initial=180.0)
    else:
        west, east = longitude.min(), longitude.max()
    return [float(west), float(latitude.min()), float(east), float(latitude.max())]
