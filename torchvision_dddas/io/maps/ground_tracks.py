"""The places of all targets over time, from which maps are made at the end of a run, and their error ellipses."""

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
"""Ellipses of a map, about."""

Place = list[float]
"""Longitude and latitude in degrees, rounded to 1e-8, a millimetre."""

_ROW = np.dtype(
    [
        *(("frame", "i8"), ("target", "i8"), ("time_s", "f8"), ("east_north_m", "f8", 2)),
        *(("covariance_m2", "f8", (2, 2)), ("lonlat_deg", "f8", 2), ("velocity_m_s", "f8", 2)),
        *(("above_sea_m", "f8"), ("above_ellipsoid_m", "f8")),
    ]
)


@dataclass(frozen=True)
class GroundTracks:
    """All places of all targets, one row a place, by target and then by time.

    target, frame: (N,) int64. time_s: (N,) since the clip's first frame, NaN where unknown. east_north_m: (N, 2).
    covariance_m2: (N, 2, 2), velocity_m_s: (N, 2), NaN where unknown. lonlat_deg: (N, 2); None where there is no
    geographic origin. above_sea_m, above_ellipsoid_m: (N,) heights of the ground, NaN where unknown.
    start_utc_s: seconds since 1970 at time_s = 0; NaN where no clock is known.
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
        """(N,) how well each place is known: the root of the covariance's trace, NaN where it is not."""
        return np.sqrt(self.covariance_m2[:, 0, 0] + self.covariance_m2[:, 1, 1])

    @cached_property
    def circular_error90_m(self) -> np.ndarray:
        """(N,) radius of the circle about each place that holds the true one with 90 %; NaN where it is not known."""
        return geometry.circular_error_90(semi_axes(self.covariance_m2, 1.0)[0])

    @cached_property
    def times_utc(self) -> list[str] | None:
        """When each place was taken, ISO 8601 to the millisecond; None where no clock is known."""
        if not (math.isfinite(self.start_utc_s) and np.isfinite(self.time_s).all()):
            return None
        return iso_utc(self.start_utc_s + self.time_s)

    @property
    def degrees(self) -> np.ndarray:
        """(N, 2) longitudes and latitudes. Raises ValueError without a geographic origin."""
        if self.lonlat_deg is None:
            raise ValueError("these positions have no longitude and latitude")
        return self.lonlat_deg

    def places(self, rows: slice) -> list[Place]:
        """The longitudes and latitudes of some rows."""
        return [*np.round(self.degrees[rows], 8).tolist()]

    def pieces(self, rows: slice) -> list[slice]:
        """Split a target's rows where it was not located for more than four times its usual step of frames."""
        steps = np.diff(self.frame[rows])
        longest = 4 * max(float(np.median(steps)), 1.0) if len(steps) else 0.0
        cuts = rows.start + 1 + np.flatnonzero(steps > longest)
        return [slice(*edge) for edge in pairwise([rows.start, *cuts.tolist(), rows.stop])]

    def spaced(self, seconds: float, rows: slice) -> list[int]:
        """The first of a target's rows with a known time, and those that follow at least so long after another."""
        due = -math.inf
        chosen: list[int] = []
        for row, at in enumerate(self.time_s[rows].tolist(), rows.start):
            # Rounded time stamps must not skip a row.
            if at >= due - 1e-6:
                chosen.append(row)
                due = at + seconds
        return chosen


def iso_utc(utc_s: np.ndarray) -> list[str]:
    """Seconds since 1970 as ISO 8601 to the millisecond, as in 2026-03-01T12:00:00.250Z."""
    stamps = np.round(np.asarray(utc_s, float) * 1000).astype("i8").astype("M8[ms]")
    return [f"{stamp}Z" for stamp in np.datetime_as_string(stamps).tolist()]


class Gathered:
    """Collects rows of GroundTracks, 120 bytes each, and up to three times that while the array grows."""

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
        """The places by target. geographic: whether they have longitudes and latitudes."""
        rows = self._rows[: self._count]
        rows = rows[np.argsort(rows["target"], kind="stable")]
        columns: dict[str, Any] = {name: rows[name] for name in _ROW.names or ()}
        if not geographic:
            columns["lonlat_deg"] = None
        return GroundTracks(**columns, start_utc_s=start_utc_s)


# --------------------------------------------------------------------------------------------------------------------
# Error ellipses.


def semi_axes(covariance_m2: np.ndarray, chi2: float = CHI2_95) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) metres, the longer first, and (N,) the longer one's bearing in [0, pi), clockwise from north.

    covariance_m2: (N, 2, 2) along east and north. NaN where it is. chi2 = 1: one standard deviation along each axis.
    """
    east, both, north = covariance_m2[:, 0, 0], covariance_m2[:, 0, 1], covariance_m2[:, 1, 1]
    mean, apart = (east + north) / 2, np.hypot((east - north) / 2, both)
    # Rounding may leave the smaller eigenvalue of a line a little below 0.
    variances = np.maximum(np.stack([mean + apart, mean - apart], axis=1), 0.0)
    bearing = (np.pi / 2 - np.arctan2(2 * both, east - north) / 2) % np.pi
    return np.sqrt(chi2 * variances), bearing


def ring_m(axes_m: np.ndarray, bearing_rad: np.ndarray, points: int = 24) -> np.ndarray:
    """(N, points, 2) metres east and north of each centre, anticlockwise; the first point is not given again."""
    turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
    along = np.stack([np.sin(bearing_rad), np.cos(bearing_rad)], axis=1)[:, None]
    across = np.stack([-along[..., 1], along[..., 0]], axis=2)
    return axes_m[:, None, :1] * np.cos(turn)[:, None] * along + axes_m[:, None, 1:] * np.sin(turn)[:, None] * across


def ellipse_rows(tracks: GroundTracks, most: int = MOST_ELLIPSES) -> np.ndarray:
    """(K,) rows whose ellipses a map shows: the last of each target, and about one each second before it.

    The intervals grow where there would be more than `most`; each target's last with a known covariance is among them.
    """
    times = [tracks.time_s[rows] for rows in tracks.of.values()]
    apart_s = max(1.0, sum(float(t[-1] - t[0]) for t in times if np.isfinite(t).all()) / most)
    chosen = {row for rows in tracks.of.values() for row in (*tracks.spaced(apart_s, rows), rows.stop - 1)}
    return np.array([row for row in sorted(chosen) if np.isfinite(tracks.covariance_m2[row]).all()], int)


@dataclass(frozen=True)
class MapEllipse:
    """The ellipse that holds the true place of a row of GroundTracks with 95 %. rings: closed, in degrees."""

    row: int
    rings: list[list[Place]]
    major_m: float
    minor_m: float
    bearing_rad: float


def map_ellipses(tracks: GroundTracks, rows: np.ndarray) -> list[MapEllipse]:
    """The ellipses of some rows, except those too near a pole."""
    axes, bearing = semi_axes(tracks.covariance_m2[rows])
    found = []
    for row, ring, (major, minor), turn in zip(rows.tolist(), ring_m(axes, bearing), axes, bearing, strict=True):
        if rings := ring_about(tracks.degrees[row], ring):
            found.append(MapEllipse(row, rings, float(major), float(minor), float(turn)))
    return found


def ring_about(lonlat_deg: np.ndarray, ring_m: np.ndarray) -> list[list[Place]]:
    """A small ring of metres about a place as closed rings in degrees, two where it lies on both sides of 180 degrees.

    ring_m: (K, 2) metres east and north, convex and anticlockwise, as the rings will be. Degrees a metre are those at
    the place: on the ellipsoid 100 m off are 1 mm out. None where the ring comes too near a pole to be a ring there.
    """
    longitude, latitude = (float(v) for v in lonlat_deg)
    to_pole_m = (90 - abs(latitude)) * 111_000
    # Within a tenth of the way to the pole a degree of longitude changes its length by as much.
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
    """The part of a convex ring east (side 1) or west (-1) of a longitude."""
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
    """Cut a line where it crosses 180 degrees of longitude; the cut ends lie on that meridian."""
    lines = [places[:1]]
    for before, after in pairwise(places):
        if abs(after[0] - before[0]) > 180:
            edge = math.copysign(180.0, before[0])
            # Degrees to the edge, and from it on the other side.
            ahead, behind = abs(edge - before[0]), abs(-edge - after[0])
            share = ahead / (ahead + behind) if ahead + behind > 0 else 0.0
            latitude = round(before[1] + share * (after[1] - before[1]), 8)
            lines[-1].append([edge, latitude])
            lines.append([[-edge, latitude]])
        lines[-1].append(after)
    return lines
