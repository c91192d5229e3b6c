"""The circle that contains the true position with a probability of 90 %, and the category of its radius.

Categories of target location error by the 90 % circular error: CAT I 0 to 20 ft (6 m), II 21 to 50 ft (15 m), III 51 to
100 ft (30 m), IV 101 to 300 ft (91 m), V 301 to 1000 ft (305 m), VI beyond. Source: JP 3-09.3, Close Air Support,
table "Target Location Error Categories".
"""

import numpy as np

from torchvision_dddas.types import Float

_FOOT_M = 0.3048
_LIMITS_M = np.array([20, 50, 100, 300, 1000]) * _FOOT_M
_NAMES = np.array(["CAT I", "CAT II", "CAT III", "CAT IV", "CAT V", "CAT VI"], dtype=object)
_TURNS = np.pi * (np.arange(64) + 0.5) / 64


def circular_error_90(sigma_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    """Return the radius in metres of the circle that contains the true position with 90 %; NaN where sigma is NaN.

    sigma_m: standard deviations along the axes of the error ellipse, the longer axis first, as from `semi_axes`. For
    this normal distribution, the probability beyond r is the mean over all angles t of exp(-r² / 2 (a² cos² t +
    b² sin² t)). The relative error of the radius is at most 1e-4.

    >>> circular_error_90(np.array([[1.0, 1.0], [1.0, 0.0]])).round(3)
    array([2.146, 1.645])
    """
    longer, shorter = np.asarray(sigma_m, float).reshape(-1, 2).T
    spread = longer[:, None] ** 2 * np.cos(_TURNS) ** 2 + shorter[:, None] ** 2 * np.sin(_TURNS) ** 2
    low, high = 1.6 * longer, 2.2 * longer
    for _ in range(16):
        radius = (low + high) / 2
        beyond = np.exp(-(radius[:, None] ** 2) / np.maximum(2 * spread, 1e-300)).mean(axis=1) > 0.1
        low, high = np.where(beyond, radius, low), np.where(beyond, high, radius)
    return (low + high) / 2


def error_category(circular_error_90_m: Float[np.ndarray, " N"]) -> np.ndarray:
    """Return the category of each 90 % circular error in metres, (N,) text; "" where the error is NaN."""
    error = np.asarray(circular_error_90_m, float)
    known: np.ndarray = np.where(np.isnan(error), "", _NAMES[np.searchsorted(_LIMITS_M, np.nan_to_num(error))])
    return known
