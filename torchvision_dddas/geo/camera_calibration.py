"""Calibrate a camera on the ground by the people it sees: its height and pitch, and its focal length.

With the camera at height h and people of height H, the slope of the ray to a head is 1 - H / h times that of the ray to
the feet (see `ranging`). Given a pitch and a height, the feet predict the position of the head; the fit chooses the
pitch and height that predict all heads best. People of different heights average out; H, the height of a typical
person, sets the scale.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.ranging import level
from torchvision_dddas.types import Camera, Float

# Fewest boxes for a calibration.
FEWEST = 20
# The foot rows, without the lowest and highest tenth, must span at least this many body heights.
_NARROW = 0.3
# Jackknife: leave out this many time blocks in turn to obtain the standard deviations.
_BLOCKS = 10
# Starts of the search: every pitch with every height, in heights of the typical person.
_PITCHES, _HEIGHTS = np.radians([0.0, 5.0, 15.0, 30.0, 50.0]), (0.5, 1.2, 2.5, 8.0)
# Refuse a fit if the median residual exceeds _POOR body heights, or if the relative standard deviation of the height
# exceeds _UNSURE.
_POOR, _UNSURE = 0.5, 0.2
# A measurement is an outlier if it is this many robust standard deviations, at least _SURE each, from the median.
_OUTLIER = 3.5
# Shares of the focal length. _SURE is the smallest standard deviation of one measurement. _FINEST is the smallest of a
# calibration, because all boxes of people may be too tall or too low together.
_SURE, _FINEST = 0.03, 0.01


@dataclass(frozen=True)
class MountedPose:
    """The height and the pitch (downwards) of a camera, with standard deviations. miss: median residual."""

    height_m: float
    pitch_rad: float
    height_sigma_m: float
    pitch_sigma_rad: float
    miss: float


@dataclass(frozen=True)
class FocalLength:
    """focal_px: the focal length. sigma_px: its standard deviation. outlier: (N,) the measurements that were not used.

    spread_px: standard deviation of one measurement; NaN for a single measurement.
    """

    focal_px: float
    sigma_px: float
    spread_px: float
    outlier: np.ndarray


def calibrate_pose(
    box_px: Float[np.ndarray, "N 4"], camera: Camera, body_height_m: float, height_sigma: float
) -> MountedPose:
    """Estimate the camera's height and pitch from boxes of upright people that the picture's border does not cut.

    box_px: boxes in the order of time. height_sigma: standard deviation of a box's height, in heights; boxes with much
    larger residuals get little weight. miss: the median residual, in box heights. Raise InputError if fewer than FEWEST
    boxes lie where the lens can show them, if they do not determine the pose (all feet in one row), or if no pose fits
    them.
    """
    box = np.asarray(box_px, float).reshape(-1, 4)
    u = box[:, 0] + box[:, 2] / 2 - 0.5
    feet, head = (level(u, v - 0.5, camera)[1] for v in (box[:, 1] + box[:, 3], box[:, 1]))
    seen = np.isfinite(feet) & np.isfinite(head) & (feet > head)
    box, feet, head = box[seen], feet[seen], head[seen]
    if len(box) < FEWEST:
        lost = f" (and {(~seen).sum()} where the lens shows nothing: check k1, k2 and k3)" if not seen.all() else ""
        raise InputError(
            f"at least {FEWEST} whole boxes of people are needed to find the camera's pose, got {len(box)}{lost}"
        )
    low, high = np.percentile(box[:, 1] + box[:, 3], [10, 90])
    if high - low < _NARROW * np.median(box[:, 3]):
        raise InputError(
            f"most feet lie within {high - low:.0f} rows of the picture, too few to find the camera's pose; "
            "give people near and far"
        )

    from scipy.optimize import least_squares  # imported here because it takes half a second and 45 MB

    def residual(guess: np.ndarray, rows: np.ndarray) -> np.ndarray:
        pitch, height = guess[0], np.exp(guess[1])
        slope = np.tan(pitch + np.arctan(feet[rows])) * (1 - 1 / height)
        return (head[rows] - np.tan(np.arctan(slope) - pitch)) / (feet[rows] - head[rows])

    # Beyond the horizon the tangent changes sign; the bounds keep the feet of most people below the horizon.
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
            f"these people do not determine the camera's pose: its height would be {height:.2f} m, with an error of "
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
    """Return F = D h / H of each measurement, and their mean: relative errors are equal at every distance.

    distance_m: along the optical axis of a level camera. height_px: height of the body in the picture.
    Raise InputError if there is no measurement, or if one is not positive and finite.
    """
    distance, height = np.asarray(distance_m, float), np.asarray(height_px, float)
    if len(height) == 0:
        raise InputError("calibration needs one or more heights in pixels, each with its distance; got none")
    for name, values in (("distance", distance), ("height in pixels", height), ("body height", [body_height_m])):
        for value in values:
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"a {name} must be a number above 0, got {value:g}")
    with np.errstate(over="ignore"):
        each = distance * height / body_height_m
    if not np.isfinite(each).all():
        raise InputError("the product of a distance and a height in pixels is not finite; give metres and pixels")
    middle = float(np.median(each))
    spread = 1.4826 * float(np.median(np.abs(each - middle)))
    outlier = np.abs(each - middle) > _OUTLIER * max(spread, _SURE * middle)
    used = each[~outlier]
    focal = float(used.mean())
    deviation = float(used.std(ddof=1)) if len(used) > 1 else np.nan
    single = np.fmax(deviation, _SURE * focal)
    return FocalLength(focal, float(max(single / np.sqrt(len(used)), _FINEST * focal)), deviation, outlier)
