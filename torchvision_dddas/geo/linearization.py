"""What a picture says of errors, near the pose that explains it best: linear, so that others can be held against it."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.geo.pose_estimation import Solution
from torchvision_dddas.geo.projection import project_with_slopes
from torchvision_dddas.geometry import slope_of_turn
from torchvision_dddas.types import Camera, LandmarkObservations


@dataclass(frozen=True)
class Glimpse:
    """The pixels of k of n landmarks as a linear function of the errors of telemetry and reports: truth less report.

    shown_px: (2k,) slopes times the errors, plus noise of variance_px2 (2k,). slopes: (2k, 7 + 2n). used: (n,) bool.
    """

    shown_px: np.ndarray
    slopes: np.ndarray
    variance_px2: np.ndarray
    used: np.ndarray


def glimpse_of(marks: LandmarkObservations, camera: Camera, used: np.ndarray, solution: Solution) -> Glimpse:
    """The picture of one frame. The telemetry must tell all seven: a correction is then of what it says."""
    points = np.column_stack([solution.places, marks.up_m])[used]
    seen, by_pose, by_point = project_with_slopes(points, solution.pose, camera)
    k = len(points)
    slopes = np.zeros((k, 2, 7 + 2 * len(used)))
    slopes[:, :, :7] = by_pose
    slopes[:, :, :3] = by_pose[:, :, :3] @ np.linalg.inv(slope_of_turn(solution.correction[:3]))
    for row, landmark in enumerate(np.flatnonzero(used).tolist()):
        slopes[row, :, 7 + 2 * landmark : 9 + 2 * landmark] = by_point[row, :, :2]
    flat = slopes.reshape(2 * k, -1)
    missing = (marks.image_px[used] - seen).ravel()
    return Glimpse(missing + flat @ solution.correction, flat, np.repeat(marks.pixel_sigma[used], 2) ** 2, used)
