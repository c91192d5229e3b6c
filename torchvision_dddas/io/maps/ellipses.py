"""How well a place is known, as an ellipse that holds the true place with a probability of 95 %."""

import numpy as np

from torchvision_dddas.io.maps.ground_tracks import GroundTracks

CHI2_95 = 5.991464547107979
"""What a chi-squared variable of two degrees of freedom stays below in 95 % of all cases: -2 ln 0.05."""

MOST = 2_000
"""A map shows about one ellipse a second of each target, but fewer where there would be more than so many."""


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


def shown(tracks: GroundTracks, every_s: float = 1.0, most: int = MOST) -> np.ndarray:
    """(K,) rows whose ellipses a map shows: of each target the last, and about one each every_s before it.

    The times between are lengthened where there would be more than `most`, but each target's last is shown always.
    """
    known = np.isfinite(tracks.covariance_m2).all(axis=(1, 2))
    span = sum(
        float(t[-1] - t[0]) for t in (tracks.time_s[rows] for rows in tracks.of.values()) if np.isfinite(t).all()
    )
    apart = max(every_s, span / most)
    rows = [row for of in tracks.of.values() for row in tracks.spaced(apart, of)]
    return np.array([row for row in rows if known[row]], int)
