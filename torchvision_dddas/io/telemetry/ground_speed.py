"""The speed over ground from places, where a log does not say it."""

import numpy as np

# Metres a degree of latitude; the ellipsoid's differ by half a per cent, a smoothed speed by more.
_DEGREE_M = 111_320.0
# Half the while over which a line is laid through the places, at least and at most.
_LEAST_S, _MOST_S = 1.0, 10.0
# Places are rounded: the line is laid over so long that a step of the last digit is no more than this.
_STEP_M_S = 0.5
# A receiver's places wander by this even where more digits are written.
_WANDER_M = 0.1


def speed_from_places(time_s: np.ndarray, place: np.ndarray, geographic: bool) -> tuple[np.ndarray, float]:
    """The slope of a line laid through the places around each moment, m/s, and the while it is laid over, s.

    time_s: (N,) rising. place: (N, 2) degrees or metres, NaN where unknown: there the speed is NaN, and where the
    places around span too short a while to tell it.
    """
    known = np.isfinite(place).all(axis=1)
    speed = np.full(len(time_s), np.nan)
    times = time_s[known] - time_s[known][0]
    metres = place[known] - place[known][0]
    if geographic:
        metres[:, 0] = (metres[:, 0] + 180) % 360 - 180
        metres *= _DEGREE_M * np.array([np.cos(np.radians(place[known][0, 1])), 1.0])
    wanted_s = min(_step_m(place[known], geographic) / _STEP_M_S, _MOST_S)
    half_s = max(wanted_s, _LEAST_S, 2.0 * float(np.median(np.diff(times))))
    low = np.searchsorted(times, times - half_s - 1e-6)
    high = np.searchsorted(times, times + half_s + 1e-6)
    count, span_s = high - low, times[high - 1] - times[low]
    # Sums over each while are differences of running sums.
    terms = np.column_stack([times, times**2, metres, metres * times[:, None]])
    running = np.vstack([np.zeros((1, 6)), np.cumsum(terms, axis=0)])
    total, squares, east, north, t_east, t_north = (running[high] - running[low]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = squares - total**2 / count
        slope = np.stack([t_east - total * east / count, t_north - total * north / count]) / spread
    speed[known] = np.where((count > 2) & (span_s >= 0.9 * wanted_s) & (spread > 1e-6), np.hypot(*slope), np.nan)
    return speed, 2 * half_s


def _step_m(place: np.ndarray, geographic: bool) -> float:
    """The step of the last digit that the places have, along the coarser of the two ways."""
    metres, least = (_DEGREE_M, _WANDER_M) if geographic else (1.0, 0.0)
    for digits in range(8):
        shifted = place * 10.0**digits
        if np.allclose(shifted, np.round(shifted), rtol=0, atol=1e-4):
            return max(metres * 10.0**-digits, least)
    return least
