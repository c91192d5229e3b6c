"""The places of all targets over time, with error ellipses. Maps are made from them at the end of a run."""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.types import Positions

CHI2_95 = 5.991464547107979
"""The 95 % quantile of chi-squared with two degrees of freedom, -2 ln 0.05."""
MOST_ELLIPSES = 2_000
"""Approximate largest number of ellipses on a map."""

Place = list[float]
"""Longitude and latitude in degrees, rounded to 1e-8 (about 1 mm)."""

_ROW = np.dtype(
    [
        *(("frame", "i8"), ("target", "i8"), ("time_s", "f8"), ("east_north_m", "f8", 2)),
        *(("covariance_m2", "f8", (2, 2)), ("lonlat_deg", "f8", 2), ("velocity_m_s", "f8", 2)),
        *(("above_sea_m", "f8"), ("above_ellipsoid_m", "f8")),
    ]
)


@dataclass(frozen=True)
class GroundTracks:
    """All places of all targets, one row per place, sorted by target and then by time. Unknown values are NaN.

    target, frame: (N,) int64. time_s: (N,) seconds since the clip's first frame. east_north_m: (N, 2).
    covariance_m2: (N, 2, 2). velocity_m_s: (N, 2). lonlat_deg: (N, 2); None without a geographic origin.
    above_sea_m, above_ellipsoid_m: (N,) heights of the ground. start_utc_s: seconds since 1970 at time_s = 0; NaN
    without a clock.
    """

    target: np.ndarray
    frame: np.ndarray
    time_s: np.ndarray
    east_north_m: np.ndarray
    covariance_m2: np.ndarray
    lonlat_deg: np.ndarray | None
    velocity_m_s: np.ndarray
    above_sea_m: np.ndarray
    above_ellipsoid_m: np.ndarray
    start_utc_s: float = math.nan

    def __len__(self) -> int:
        return len(self.target)

    @cached_property
    def of(self) -> dict[int, slice]:
        """The rows of each target."""
        targets, first = np.unique(self.target, return_index=True)
        edges = pairwise([*first.tolist(), len(self)])
        return {target: slice(*edge) for target, edge in zip(targets.tolist(), edges, strict=True)}

    @cached_property
    def sigma_m(self) -> np.ndarray:
        """(N,) root of the trace of each place's covariance, NaN if unknown."""
        return np.sqrt(self.covariance_m2[:, 0, 0] + self.covariance_m2[:, 1, 1])

    @cached_property
    def circular_error90_m(self) -> np.ndarray:
        """(N,) radius of the circle that contains the true place with a probability of 90 %; NaN if unknown."""
        return geometry.circular_error_90(semi_axes(self.covariance_m2, 1.0)[0])

    @cached_property
    def times_utc(self) -> list[str] | None:
        """The time of each place, ISO 8601 to the millisecond; None without a clock or if a time is unknown."""
        if not (math.isfinite(self.start_utc_s) and np.isfinite(self.time_s).all()):
            return None
        return iso_utc(self.start_utc_s + self.time_s)

    @property
    def degrees(self) -> np.ndarray:
        """(N, 2) longitudes and latitudes. Raise ValueError without a geographic origin."""
        if self.lonlat_deg is None:
            raise ValueError("these positions have no longitude and latitude")
        return self.lonlat_deg

    def places(self, rows: slice) -> list[Place]:
        """Return the longitudes and latitudes of some rows."""
        return [*np.round(self.degrees[rows], 8).tolist()]

    def pieces(self, rows: slice) -> list[slice]:
        """Split a target's rows at gaps longer than four times the median step between its frames."""
        steps = np.diff(self.frame[rows])
        longest = 4 * max(float(np.median(steps)), 1.0) if len(steps) else 0.0
        cuts = rows.start + 1 + np.flatnonzero(steps > longest)
        return [slice(*edge) for edge in pairwise([rows.start, *cuts.tolist(), rows.stop])]

    def spaced(self, seconds: float, rows: slice) -> list[int]:
        """Select rows of a target with known times that are at least this number of seconds apart."""
        due = -math.inf
        chosen: list[int] = []
        for row, at in enumerate(self.time_s[rows].tolist(), rows.start):
            # Rounded time stamps must not skip a row.
            if at >= due - 1e-6:
                chosen.append(row)
                due = at + seconds
        return chosen


def iso_utc(utc_s: np.ndarray) -> list[str]:
    """Format seconds since 1970 as ISO 8601 to the millisecond, such as 2026-03-01T12:00:00.250Z."""
    stamps = np.round(np.asarray(utc_s, float) * 1000).astype("i8").astype("M8[ms]")
    return [f"{stamp}Z" for stamp in np.datetime_as_string(stamps).tolist()]


class Gathered:
    """Collects rows of GroundTracks. A row takes 120 bytes, and up to three times as much while the array grows."""

    def __init__(self) -> None:
        self._rows = np.zeros(256, _ROW)
        self._count = 0

    def add(self, positions: Positions, time_s: float = math.nan, velocity_m_s: np.ndarray | None = None) -> None:
        """Keep the places of a frame."""
        count = self._count + len(positions)
        if count > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros(max(count, len(self._rows)), _ROW)])
        rows = self._rows[self._count : count]
        rows["frame"], rows["target"], rows["time_s"] = positions.frame, positions.target, time_s
        rows["east_north_m"], rows["covariance_m2"] = positions.east_north_m, positions.covariance_m2
        rows["lonlat_deg"] = np.nan if positions.lonlat_deg is None else positions.lonlat_deg
        rows["velocity_m_s"] = np.nan if velocity_m_s is None else velocity_m_s
        rows["above_sea_m"], rows["above_ellipsoid_m"] = positions.above_sea_m, positions.above_ellipsoid_m
        self._count = count

    def tracks(self, geographic: bool, start_utc_s: float = math.nan) -> GroundTracks:
        """Return the places sorted by target. geographic: whether they have longitudes and latitudes."""
        rows = self._rows[: self._count]
        rows = rows[np.argsort(rows["target"], kind="stable")]
        columns: dict[str, Any] = {name: rows[name] for name in _ROW.names or ()}
        if not geographic:
            columns["lonlat_deg"] = None
        return GroundTracks(**columns, start_utc_s=start_utc_s)


# --------------------------------------------------------------------------------------------------------------------
# Error ellipses.


def semi_axes(covariance_m2: np.ndarray, chi2: float = CHI2_95) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 2) semi-axes in metres, the longer first, and (N,) its bearing in [0, pi), clockwise from north.

    covariance_m2: (N, 2, 2) of east and north; NaN gives NaN. chi2 = 1: one standard deviation along each axis.
    """
    east, both, north = covariance_m2[:, 0, 0], covariance_m2[:, 0, 1], covariance_m2[:, 1, 1]
    mean, apart = (east + north) / 2, np.hypot((east - north) / 2, both)
    # Rounding may leave the smaller eigenvalue of a line a little below 0.
    variances = np.maximum(np.stack([mean + apart, mean - apart], axis=1), 0.0)
    bearing = (np.pi / 2 - np.arctan2(2 * both, east - north) / 2) % np.pi
    return np.sqrt(chi2 * variances), bearing


def ring_m(axes_m: np.ndarray, bearing_rad: np.ndarray, points: int = 24) -> np.ndarray:
    """Return (N, points, 2) metres east and north of each centre, anticlockwise, without repeating the first point."""
    turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
    along = np.stack([np.sin(bearing_rad), np.cos(bearing_rad)], axis=1)[:, None]
    across = np.stack([-along[..., 1], along[..., 0]], axis=2)
    return axes_m[:, None, :1] * np.cos(turn)[:, None] * along + axes_m[:, None, 1:] * np.sin(turn)[:, None] * across


def ellipse_rows(tracks: GroundTracks, most: int = MOST_ELLIPSES) -> np.ndarray:
    """Return the (K,) rows whose ellipses a map shows: the last row of each target, and about one row per second.

    The intervals grow if there would be more than about `most` ellipses. Rows without a covariance are left out.
    """
    times = [tracks.time_s[rows] for rows in tracks.of.values()]
    apart_s = max(1.0, sum(float(t[-1] - t[0]) for t in times if np.isfinite(t).all()) / most)
    chosen = {row for rows in tracks.of.values() for row in (*tracks.spaced(apart_s, rows), rows.stop - 1)}
    return np.array([row for row in sorted(chosen) if np.isfinite(tracks.covariance_m2[row]).all()], int)


@dataclass(frozen=True)
class MapEllipse:
    """The 95 % ellipse of a row of GroundTracks. rings: closed rings of places in degrees."""

    row: int
    rings: list[list[Place]]
    major_m: float
    minor_m: float
    bearing_rad: float


def map_ellipses(tracks: GroundTracks, rows: np.ndarray) -> list[MapEllipse]:
    """Return the ellipses of some rows, without ellipses too near a pole."""
    axes, bearing = semi_axes(tracks.covariance_m2[rows])
    found = []
    for row, ring, (major, minor), turn in zip(rows.tolist(), ring_m(axes, bearing), axes, bearing, strict=True):
        if rings := ring_about(tracks.degrees[row], ring):
            found.append(MapEllipse(row, rings, float(major), float(minor), float(turn)))
    return found


def ring_about(lonlat_deg: np.ndarray, ring_m: np.ndarray) -> list[list[Place]]:
    """Convert a small ring around a place to closed rings in degrees: two rings if it crosses longitude 180.

    ring_m: (K, 2) metres east and north, convex and anticlockwise. The rings are anticlockwise, too. The scale at the
    place is used for the whole ring, which causes an error of 1 mm at 100 m. Return no ring too near a pole.
    """
    longitude, latitude = (float(v) for v in lonlat_deg)
    to_pole_m = (90 - abs(latitude)) * 111_000
    # Within a tenth of the distance to the pole, the length of a degree of longitude changes by about a tenth.
    if not np.hypot(*ring_m.T).max() <= to_pole_m / 10:
        return []
    degrees_per_metre = np.diag(geometry.lonlat(np.eye(2), (0.0, latitude)) - (0.0, latitude))
    parts = [(longitude, latitude) + ring_m * degrees_per_metre]
    if np.abs(parts[0][:, 0]).max() > 180:
        edges = (-540.0, -180.0, 180.0)
        parts = [_clip(_clip(parts[0], west, 1.0), west + 360, -1.0) - (west + 180, 0.0) for west in edges]
    rings = [np.round(part, 8).tolist() for part in parts if len(part) >= 3]
    return [[*ring, ring[0]] for ring in rings]


def _clip(ring: np.ndarray, edge: float, side: float) -> np.ndarray:
    """Return the part of a convex ring east (side 1) or west (side -1) of a longitude."""
    inside = (ring[:, 0] - edge) * side >= 0
    if inside.all() or not inside.any():
        return ring[inside]
    kept = []
    for k, (before, after) in enumerate(zip(np.roll(ring, 1, axis=0), ring, strict=True)):
        if inside[k] != inside[k - 1]:
            share = (edge - before[0]) / (after[0] - before[0])
            kept.append([edge, before[1] + share * (after[1] - before[1])])
        if inside[k]:
            kept.append(after)
    return np.array(kept)


def cut_line(places: list[Place]) -> list[list[Place]]:
    """Cut a line where it crosses longitude 180. The cut ends lie on that meridian."""
    lines = [places[:1]]
    for before, after in pairwise(places):
        if abs(after[0] - before[0]) > 180:
            edge = math.copysign(180.0, before[0])
            # Degrees of longitude before and behind the meridian.
            ahead, behind = abs(edge - before[0]), abs(-edge - after[0])
            share = ahead / (ahead + behind) if ahead + behind > 0 else 0.0
            latitude = round(before[1] + share * (after[1] - before[1]), 8)
            lines[-1].append([edge, latitude])
            lines.append([[-edge, latitude]])
        lines[-1].append(after)
    return lines
