"""The speed over ground from places, where a log does not say it."""

import numpy as np

# Metres a degree of latitude; the ellipsoid's differ by half a per cent, a smoothed speed by more.
_DEGREE_M = 111_320.0
# Half the while over which a line is laid through the places, at least and at most.
_LEAST_S, _MOST_S = 1.0, 10.0
# Places are rounded to some digits: the line is laid over so long that this is the speed of one last digit.
_QUANTUM_M_S = 0.5


def speed_from_places(time_s: np.ndarray, place: np.ndarray, geographic: bool) -> tuple[np.ndarray, float]:
    """The slope of a line laid through the places around each moment, m/s, and the while it is laid over, s.

    time_s: (N,) rising. place: (N, 2) degrees or metres, NaN where unknown: there and where fewer than three places
    are near, the speed is NaN.
    """
    known = np.isfinite(place).all(axis=1)
    speed = np.full(len(time_s), np.nan)
    times = time_s[known] - time_s[known][0]
    metres = place[known] - place[known][0]
    if geographic:
        metres[:, 0] = (metres[:, 0] + 180) % 360 - 180
        metres *= _DEGREE_M * np.array([np.cos(np.radians(place[known][0, 1])), 1.0])
    half_s = float(np.clip(_quantum_m(metres) / _QUANTUM_M_S / 2, _LEAST_S, _MOST_S))
    low = np.searchsorted(times, times - half_s - 1e-9)
    high = np.searchsorted(times, times + half_s + 1e-9)
    count = high - low
    # Sums over each while are differences of running sums; times are centred on each moment to keep digits.
    running = np.cumsum(
        np.vstack([np.zeros((1, 6)), np.column_stack([times, times**2, metres, metres * times[:, None]])]), axis=0
    )
    total, squares, east, north, t_east, t_north = (running[high] - running[low]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = squares - total**2 / count
        slope = np.stack([t_east - total * east / count, t_north - total * north / count]) / spread
    speed[known] = np.where((count > 2) & (spread > 1e-6), np.hypot(*slope), np.nan)
    return speed, 2 * half_s


def _quantum_m(metres: np.ndarray) -> float:
    """The smallest step between places that differ."""
    steps = np.abs(np.diff(metres, axis=0))
    steps = steps[steps > 1e-6]
    return float(np.percentile(steps, 1)) if len(steps) else 0.0
