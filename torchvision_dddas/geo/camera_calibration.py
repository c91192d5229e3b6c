"""Calibration of a camera on the ground by people: its height and pitch, and its focal length.

With the camera h above the ground, the slope of the ray to a head is 1 - H / h of that to the feet (see `ranging`). So
each body's feet and the camera's pitch say where its head is to be, and the pitch and height that fit all heads are
the camera's. People of different heights average out; the scale is that of the typical person, H.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.ranging import level
from torchvision_dddas.types import Camera, Float

# Fewest boxes for a calibration.
FEWEST = 20
# The rows of the feet, without a tenth on either side, must span this many body heights at least.
_NARROW = 0.3
# Jackknife: this many stretches of time are left out in turn, for the standard deviations.
_BLOCKS = 10
# Starts of the search: pitches, each with all heights, in heights of the typical person.
_PITCHES, _HEIGHTS = np.radians([0.0, 5.0, 15.0, 30.0, 50.0]), (0.5, 1.2, 2.5, 8.0)
# A fit is refused whose median residual exceeds this many body heights, or whose height has a larger relative
# standard deviation.
_POOR, _UNSURE = 0.5, 0.2
# A measurement is an outlier so many robust standard deviations from the median, or _SURE of it where that is more.
_OUTLIER = 3.5
# Shares of the focal length. A box is never read more surely than _SURE; no calibration of people is finer than
# _FINEST, for all their boxes may be too tall or too low together.
_SURE, _FINEST = 0.03, 0.01


@dataclass(frozen=True)
class MountedPose:
    """height_m: of the camera. pitch_rad: down. Each with its standard deviation. miss: a body's typical residual."""

    height_m: float
    pitch_rad: float
    height_sigma_m: float
    pitch_sigma_rad: float
    miss: float


@dataclass(frozen=True)
class FocalLength:
    """focal_px: the focal length. sigma_px: its standard deviation. outlier: (N,) the measurements that were not used.

    spread_px: standard deviation of one measurement; NaN where there is but one.
    """

    focal_px: float
    sigma_px: float
    spread_px: float
    outlier: np.ndarray


def calibrate_pose(
    box_px: Float[np.ndarray, "N 4"], camera: Camera, body_height_m: float, height_sigma: float
) -> MountedPose:
    """The camera's height and pitch, from boxes of upright people that the picture's border does not cut.

    box_px: in the order of time. height_sigma: standard deviation of a box's height, in heights; boxes that miss by
    much more hardly count. miss: the median residual, in box heights.
    Raises InputError where there are fewer than FEWEST boxes that the lens can show, or they do not tell, as when all
    feet are in one row, or no pose fits them.
    """
    box = np.asarray(box_px, float).reshape(-1, 4)
    u = box[:, 0] + box[:, 2] / 2 - 0.5
    feet, head = (level(u, v - 0.5, camera)[1] for v in (box[:, 1] + box[:, 3], box[:, 1]))
    seen = np.isfinite(feet) & np.isfinite(head) & (feet > head)
    box, feet, head = box[seen], feet[seen], head[seen]
    if len(box) < FEWEST:
        lost = f" (and {(~seen).sum()} where the lens shows nothing: check k1 and k2)" if not seen.all() else ""
        raise InputError(
            f"{len(box)} whole boxes of people{lost}; wanted {FEWEST} at least to tell how the camera stands"
        )
    low, high = np.percentile(box[:, 1] + box[:, 3], [10, 90])
    if high - low < _NARROW * np.median(box[:, 3]):
        raise InputError(
            f"most feet lie within {high - low:.0f} rows of the picture, which does not tell how the camera stands; "
            "give people near and far"
        )

    from scipy.optimize import least_squares  # here, as it takes half a second and 45 MB

    def residual(guess: np.ndarray, rows: np.ndarray) -> np.ndarray:
        pitch, height = guess[0], np.exp(guess[1])
        slope = np.tan(pitch + np.arctan(feet[rows])) * (1 - 1 / height)
        return (head[rows] - np.tan(np.arctan(slope) - pitch)) / (feet[rows] - head[rows])

    # Beyond the horizon the tangent turns round; the bounds keep feet of most people below it.
    bounds = [-0.3, np.log(0.05)], [1.5, np.log(1000)]
    fit = partial(least_squares, residual, bounds=bounds, loss="soft_l1", f_scale=max(height_sigma, 1e-3))
    everyone = np.ones(len(box), bool)
    starts = [np.array([pitch, np.log(height)]) for pitch in _PITCHES for height in _HEIGHTS]
    best = min((fit(start, args=(everyone,)) for start in starts), key=lambda found: found.cost).x
    block = np.arange(len(box)) * _BLOCKS // len(box)
    without = [fit(best, args=(block != n,)).x for n in range(_BLOCKS)]
    sigma = np.sqrt((_BLOCKS - 1) * np.array(without).var(axis=0))
    height = float(np.exp(best[1])) * body_height_m
    if not sigma[1] < _UNSURE:
        raise InputError(
            f"these people do not tell how the camera stands: its height would be {height:.2f} m, unsure by "
            f"{min(sigma[1], 99):.0%}. Give more of them, near and far"
        )
    miss = float(np.median(np.abs(residual(best, everyone))))
    if not miss < _POOR:
        raise InputError(
            f"no height and pitch fit these boxes: half of them miss by more than {min(miss, 99):.0%} of their height; "
            "check that they are upright people, and the camera's focal length and size"
        )
    return MountedPose(height, float(best[0]), float(sigma[1]) * height, float(sigma[0]), miss)


def calibrate_focal_length(
    distance_m: Float[np.ndarray, "N"], height_px: Float[np.ndarray, "N"], body_height_m: float
) -> FocalLength:
    """F = D h / H of each measurement, and of all: least squares of relative errors, which are alike at every distance.

    distance_m: along the optical axis of a level camera. height_px: the body's, in the picture.
    Raises InputError where there is no measurement, or one is not positive and finite.
    """
    distance, height = np.asarray(distance_m, float), np.asarray(height_px, float)
    if len(height) == 0:
        raise InputError("no measurement to calibrate by; wanted one or more heights in pixels, each with its distance")
    for name, values in (("distance", distance), ("height in pixels", height), ("body height", [body_height_m])):
        for value in values:
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"a {name} of {value:g} will not do to calibrate by; wanted a number above 0")
    with np.errstate(over="ignore"):
        each = distance * height / body_height_m
    if not np.isfinite(each).all():
        raise InputError("a distance times a height in pixels is beyond all numbers; wanted metres and pixels")
    middle = float(np.median(each))
    spread = 1.4826 * float(np.median(np.abs(each - middle)))
    outlier = np.abs(each - middle) > _OUTLIER * max(spread, _SURE * middle)
    used = each[~outlier]
    focal = float(used.mean())
    deviation = float(used.std(ddof=1)) if len(used) > 1 else np.nan
    single = np.fmax(deviation, _SURE * focal)
    return FocalLength(focal, float(max(single / np.sqrt(len(used)), _FINEST * focal)), deviation, outlier)
