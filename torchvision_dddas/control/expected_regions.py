"""Where in a picture from the ground the people of located targets can show: only there is it searched."""

import math

import numpy as np

from torchvision_dddas.config import GroundParameters
from torchvision_dddas.types import Camera

# People are as tall as within so many standard deviations, and the camera looks where it says within as many.
_SIGMAS = 2.0
# Targets are within one of where they are said to be: most of it is that of the middle within the outline, and the
# whole outline is searched, with so much about it.
_MARGIN_M = 0.5
# The ground between rises or falls as steeply, and the camera nods as far.
_SLOPE_RAD = math.radians(5)
# Half the width of a body's box over its height: a region holds whole boxes.
_HALF_WIDE = 0.17


def expected_regions(
    place_m: np.ndarray,
    covariance_m2: np.ndarray,
    radius_m: np.ndarray,
    camera: Camera,
    camera_m: np.ndarray,
    heading_rad: float,
    parameters: GroundParameters,
) -> tuple[np.ndarray, np.ndarray]:
    """(R, 4) boxes in the picture within which bodies of the targets in view lie, and (R, 2) heights of these, in px.

    place_m (N, 2), covariance_m2 (N, 2, 2), radius_m (N,): of the targets. camera_m (2,): where the camera stands, by
    the same origin. As targets.scan.within wants them; a target that a picture cannot show has no region.
    """
    regions: list[list[float]] = []
    heights: list[tuple[float, float]] = []
    width, (focal_u, focal_v), (middle_u, middle_v) = camera.size_px[0], camera.focal_px, camera.centre_px
    unsure = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2)[:, -1], 0) + camera.position_sigma_m**2)
    tall = parameters.body_height_m + _SIGMAS * parameters.body_height_sigma_m * np.array([-1.0, 1.0])
    eye = camera.height_m if math.isfinite(camera.height_m) else float(tall[1])
    nearest_m = focal_v * tall[0] / camera.size_px[1]  # nobody is whole in the picture from nearer
    for apart, reach in zip(place_m - camera_m, radius_m + unsure + _MARGIN_M, strict=True):
        away = float(np.hypot(*apart))
        if away < nearest_m:
            continue
        off = (math.atan2(apart[0], apart[1]) - heading_rad + math.pi) % (2 * math.pi) - math.pi
        half = math.asin(min(reach / max(away, 1e-9), 1.0)) + _SIGMAS * camera.heading_sigma_rad
        low, high = (min(max(off + side * half, -1.4), 1.4) for side in (-1, 1))
        left, right = (middle_u + focal_u * math.tan(angle) for angle in (low, high))
        if right < 0 or left > width or abs(off) - half > math.pi / 2:
            continue
        # Along the axis, over the part of the target that is in view.
        far = (away + reach) * math.cos(min(max(0.0, low), high))
        near = max((away - reach) * math.cos(max(abs(low), abs(high))), nearest_m)
        if far <= near:
            continue
        horizon = middle_v - focal_v * math.tan(camera.pitch_rad)
        # A head above the eye's height is highest when near, one below it when far.
        top = horizon - focal_v * (_SLOPE_RAD + max((tall[1] - eye) / near, 0.0))
        bottom = horizon + focal_v * (_SLOPE_RAD + eye / near)
        heights.append((focal_v * tall[0] / far, focal_v * tall[1] / near))
        beside = _HALF_WIDE * heights[-1][1]
        regions.append([left - beside, top, right - left + 2 * beside, bottom - top])
    return np.array(regions, float).reshape(-1, 4), np.array(heights, float).reshape(-1, 2)
