"""The data of the interactive map in report.html, in local metres."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.io.maps.ground_tracks import GroundTracks, semi_axes
from torchvision_dddas.io.maps.map_picture import (
    EVENTS,
    FINE,
    FUSED,
    INK,
    MARK,
    CameraPath,
    MapFrame,
    Signs,
    extent,
    frame_around,
    ground_photo,
)
from torchvision_dddas.io.overlay import Colour, identity_colour
from torchvision_dddas.io.report import data_url
from torchvision_dddas.types import Ortho

MOST_PLACES = 10_000
"""Approximate largest number of places of all targets together, and of all landmarks; longer runs are thinned."""
_NOTE = f"The run is long: this map has about {MOST_PLACES} of its places, evenly spread; the tables have all of them."
_MOST_STEPS = 2_000  # steps of the slider
_PHOTO_PX = 1600  # longer side of the photo


def map_data(
    tracks: GroundTracks,
    landmarks: GroundTracks,
    names: Sequence[str],
    camera: CameraPath,
    way: GroundTracks,
    photo: Ortho | None,
    signs: Signs,
    to_degrees: Callable[[np.ndarray], np.ndarray] | None,
    fused: GroundTracks | None = None,
) -> dict[str, Any] | None:
    """Return the data that map.js draws; None if no place of a target is known. Unknown values are NaN.

    way: the camera's places, as target 0. fused: targets located by all platforms together.
    Boxes are [west, south, east, north]: the map opens with `box`, and `whole` contains all places. `degrees` holds the
    corners of `box`; the page interpolates between them, with an error of up to 2 m in a box of 10 km. A row of a mover
    is [time or frame, east, north, semi-axes of the 95 % ellipse, its bearing, frame].
    """
    shown = extent(tracks, landmarks, camera, signs)
    layers = {"target": tracks, "landmark": landmarks, "camera": way}
    if fused is not None and len(fused):
        layers["fused"] = fused
    if not len(tracks) and "fused" not in layers:
        return None
    places = np.concatenate([shown, *(one.east_north_m for one in layers.values())])
    places = np.concatenate([places, *(ring for _, rings, _ in signs.zones for ring in rings)])
    places = places[np.isfinite(places).all(axis=1)]
    frames = np.concatenate([one.frame for one in layers.values()])
    if not len(frames) or not len(places):
        return None
    is_timed = all(np.isfinite(one.time_s).all() for one in layers.values())
    at = np.concatenate([one.time_s if is_timed else one.frame for one in layers.values()])
    room_m = 0.15 * max(float(np.ptp(places, axis=0).max()), 20.0)
    whole = [*(places.min(axis=0) - room_m), *(places.max(axis=0) + room_m)]
    west, south, east, north = box = frame_around(shown).box_m
    corners = np.array([[west, south], [east, south], [west, north], [east, north]])
    return {
        "unit": "s" if is_timed else "frame",
        "span": [at.min(), at.max()],
        "steps": min(len(np.unique(frames)), _MOST_STEPS),
        "utc": tracks.start_utc_s if is_timed else None,
        "box": box,
        "whole": whole,
        # Unwrapped longitudes may exceed 180 degrees.
        "degrees": None if to_degrees is None else np.unwrap(to_degrees(corners), period=360, axis=0).tolist(),
        "photo": None if photo is None else _photo(photo, whole),
        "movers": [
            *_movers(way, is_timed, "camera", lambda _: ("camera", INK)),
            *_movers(landmarks, is_timed, "landmark", lambda k: (names[k], MARK)),
            *_movers(tracks, is_timed, "target", lambda k: (f"{k}", identity_colour(k))),
            *(_movers(fused, is_timed, "fused", lambda k: (f"fused {k}", FUSED)) if fused is not None else ()),
        ],
        "views": [[time_s if is_timed else frame, _rounded(view)] for frame, time_s, view in camera.views],
        "zones": [[name, [_rounded(ring) for ring in rings], is_line] for name, rings, is_line in signs.zones],
        "signs": [[*EVENTS[kind][:2], _hex(EVENTS[kind][2]), _rounded(at)] for kind, at in signs.events],
        "looks": [[_rounded(from_m), _rounded(at_m)] for from_m, at_m in signs.looks],
        "note": _NOTE if any(len(one) > MOST_PLACES for one in layers.values()) else "",
    }


def _movers(
    tracks: GroundTracks, is_timed: bool, kind: str, named: Callable[[int], tuple[str, Colour]]
) -> list[dict[str, Any]]:
    """Return the tracks of one kind, split into parts without gaps."""
    at = tracks.time_s if is_timed else tracks.frame.astype(float)
    spans = sum(float(np.ptp(at[rows])) for rows in tracks.of.values())
    apart = spans / MOST_PLACES if len(tracks) > MOST_PLACES else 0.0
    axes, bearing = semi_axes(tracks.covariance_m2)
    table = np.column_stack(
        [at.round(3), tracks.east_north_m.round(2), axes.round(2), np.degrees(bearing).round(), tracks.frame]
    )
    is_known = np.isfinite(tracks.east_north_m).all(axis=1)
    found = []
    for target, rows in tracks.of.items():
        kept = np.arange(rows.start, rows.stop)
        if apart:
            _, first = np.unique((at[rows] - at[rows.start]) // apart, return_index=True)
            kept = np.union1d(rows.start + first, [rows.stop - 1])
        kept = kept[is_known[kept]]
        parts = [table[kept[(kept >= part.start) & (kept < part.stop)]].tolist() for part in tracks.pieces(rows)]
        name, colour = named(target)
        found.append({"name": name, "kind": kind, "colour": _hex(colour), "parts": [part for part in parts if part]})
    return found


def _photo(photo: Ortho, whole: Sequence[float]) -> dict[str, Any] | None:
    """Return the part of the photo inside a box as JPEG, and the box of this part; None if they do not overlap."""
    height, width = photo.image.shape[:2]
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]) @ photo.east_north_from_pixel.T
    low, high = np.maximum(corners.min(axis=0), whole[:2]), np.minimum(corners.max(axis=0), whole[2:])
    if not (high > low).all():
        return None
    pixel_m = math.sqrt(abs(np.linalg.det(photo.east_north_from_pixel[:, :2])))
    metres = FINE * max(float((high - low).max()) / _PHOTO_PX, pixel_m)
    size = np.ceil((high - low) / metres).astype(int)
    frame = MapFrame(float(low[0]), float(low[1]), metres, int(size[0]), int(size[1]))
    jpeg = cv2.imencode(".jpg", ground_photo(frame, photo), [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    return {"url": data_url(jpeg), "box": frame.box_m}


def _rounded(places_m: np.ndarray) -> Any:
    return np.round(np.asarray(places_m, float), 2).tolist()


def _hex(colour: Colour) -> str:
    return "#{2:02x}{1:02x}{0:02x}".format(*colour)
