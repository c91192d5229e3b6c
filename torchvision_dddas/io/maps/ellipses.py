"""Error ellipses of places, and lines and rings on the ellipsoid for maps that end at 180 degrees of longitude."""

import math
from itertools import pairwise

import numpy as np

_AXIS_M, _SQUARED_ECCENTRICITY = 6_378_137.0, 6.694379990141316e-3  # WGS84

CHI2_95 = 5.991464547107979
"""The 95 % quantile of chi-squared with two degrees of freedom, -2 ln 0.05."""

Place = list[float]
"""Longitude and latitude in degrees."""


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


def rounded(lonlat_deg: np.ndarray) -> list[Place]:
    """Places rounded to 1e-8 degrees, a millimetre."""
    return [*np.round(lonlat_deg, 8).tolist()]


def cut_line(places: list[Place]) -> list[list[Place]]:
    """Cut a line where it crosses 180 degrees of longitude; the cut ends lie on that meridian."""
    # Most lines are long and do not come near.
    if len(places) < 2 or np.abs(np.diff([place[0] for place in places])).max() <= 180:
        return [places]
    lines = [places[:1]]
    for before, after in pairwise(places):
        if abs(after[0] - before[0]) > 180:
            edge = math.copysign(180.0, before[0])
            # Degrees to the edge, and from it on the other side.
            here, there = abs(edge - before[0]), abs(-edge - after[0])
            share = here / (here + there) if here + there > 0 else 0.0
            latitude = round(before[1] + share * (after[1] - before[1]), 8)
            lines[-1].append([edge, latitude])
            lines.append([[-edge, latitude]])
        lines[-1].append(after)
    return lines


def ring_about(lonlat_deg: np.ndarray, ring_m: np.ndarray) -> list[list[Place]]:
    """A small ring of metres about a place as closed rings in degrees, two where it lies on both sides of 180 degrees.

    ring_m: (K, 2) metres east and north, convex and anticlockwise, as the rings will be. Degrees a metre are those at
    the place: on the ellipsoid 100 m off are 1 mm out. None where the ring comes too near a pole to be a ring there.
    """
    longitude, latitude = (float(v) for v in lonlat_deg)
    reach = float(np.hypot(*ring_m.T).max())
    to_pole_m = (90 - abs(latitude)) * 111_000
    # Within a tenth of the way to the pole a degree of longitude changes its length by as much.
    if not reach <= to_pole_m / 10:
        return []
    degrees = (longitude, latitude) + ring_m * degrees_per_metre(latitude)
    if np.abs(degrees[:, 0]).max() <= 180:
        parts = [degrees]
    else:
        edges = (-540.0, -180.0, 180.0)
        parts = [_clip(_clip(degrees, west, 1.0), west + 360, -1.0) - (west + 180, 0.0) for west in edges]
    rings = [rounded(part) for part in parts if len(part) >= 3]
    return [[*ring, ring[0]] for ring in rings]


def degrees_per_metre(latitude_deg: float) -> np.ndarray:
    """(2,) degrees of longitude and of latitude that a metre east, or north, is on the WGS84 ellipsoid."""
    latitude = math.radians(latitude_deg)
    root = math.sqrt(1 - _SQUARED_ECCENTRICITY * math.sin(latitude) ** 2)
    along_parallel = _AXIS_M / root * math.cos(latitude)
    along_meridian = _AXIS_M * (1 - _SQUARED_ECCENTRICITY) / root**3
    return np.degrees([1 / along_parallel, 1 / along_meridian])


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
