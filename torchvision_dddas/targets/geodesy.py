"""Longitude and latitude to local metres and back: on the WGS84 ellipsoid, and as the source does (appendix A, IV-C).

All in float64: longitude in float32 is 0.7 m coarse. Local metres are those of the plane that touches the ellipsoid at
the origin: a kilometre from it they are 5 cm above the ground, and less than a millimetre off.
"""

from collections.abc import Callable

import numpy as np

from torchvision_dddas.shapes import Float

Degrees = Float[np.ndarray, "*n 2"] | tuple[float, float]
"""Longitude and latitude."""

DEGREE_M = 111_320.0
"""Length of a degree of latitude to the source, everywhere. On the ellipsoid it is 110 574 m to 111 694 m."""


# So many points at once: the intermediate results stay in the cache, which halves the time of a million points.
_PART = 1 << 14


def east_north(lonlat_deg: Float[np.ndarray, "N 2"], origin_deg: tuple[float, float]) -> Float[np.ndarray, "N 2"]:
    """Metres east and north of an origin, both as (longitude, latitude)."""
    import pymap3d  # here, as most runs have places in metres, or none

    def of_part(lonlat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        east, north, _ = pymap3d.geodetic2enu(lonlat[:, 1], lonlat[:, 0], 0.0, origin_deg[1], origin_deg[0], 0.0)
        return east, north

    return _by_parts(of_part, lonlat_deg)


def lonlat(east_north_m: Float[np.ndarray, "N 2"], origin_deg: tuple[float, float]) -> Float[np.ndarray, "N 2"]:
    """(longitude, latitude) of local metres."""
    import pymap3d

    def of_part(metres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        latitude, longitude, _ = pymap3d.enu2geodetic(
            metres[:, 0], metres[:, 1], 0.0, origin_deg[1], origin_deg[0], 0.0
        )
        return longitude, latitude

    return _by_parts(of_part, east_north_m)


def _by_parts(of_part: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], pairs: np.ndarray) -> np.ndarray:
    """(N, 2) of what a function makes of (n, 2) at a time."""
    given = np.asarray(pairs, float).reshape(-1, 2)
    found = np.empty_like(given)
    for begin in range(0, len(given), _PART):
        part = slice(begin, begin + _PART)
        found[part, 0], found[part, 1] = of_part(given[part])
    return found


def plain_lonlat(east_north_m: Float[np.ndarray, "N 2"], origin_deg: Degrees) -> np.ndarray:
    """(longitude, latitude) as the source has them, eq. (14): K = 111 320 m a degree, K cos(latitude) of longitude.

    0.3 m off in 150 m. Longitudes go on over 180 degrees at -180.
    """
    origin = np.asarray(origin_deg, float)
    found = origin + np.asarray(east_north_m, float) / _degree_m(origin)
    beyond = np.abs(found[..., 0]) > 180
    found[..., 0] = np.where(beyond, (found[..., 0] + 180) % 360 - 180, found[..., 0])
    return found


def plain_east_north(lonlat_deg: Float[np.ndarray, "N 2"], origin_deg: Degrees) -> np.ndarray:
    """Metres east and north, the other way round."""
    origin = np.asarray(origin_deg, float)
    apart = np.asarray(lonlat_deg, float) - origin
    far = np.abs(apart[..., 0]) > 180
    apart[..., 0] = np.where(far, (apart[..., 0] + 180) % 360 - 180, apart[..., 0])
    return apart * _degree_m(origin)


def _degree_m(origin_deg: np.ndarray) -> np.ndarray:
    """(..., 2) metres a degree of longitude and of latitude."""
    latitude = origin_deg[..., 1]
    return np.stack([DEGREE_M * np.cos(np.radians(latitude)), np.full_like(latitude, DEGREE_M)], axis=-1)
