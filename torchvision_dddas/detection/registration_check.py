"""Whether a registration may be trusted: the same judgement for every back end."""

import numpy as np

from torchvision_dddas.config import RegistrationParameters
from torchvision_dddas.geometry import background_flow, transfer
from torchvision_dddas.types import Registration

_NEXT = [1, 2, 3, 0]


def judged(
    later_from_earlier: np.ndarray,
    tracked: int,
    inliers: int,
    error_px: float,
    size: tuple[int, int],
    parameters: RegistrationParameters,
) -> Registration:
    """The record of a registration, flagged with a cause in words when nothing may be concluded from it.

    size: (width, height). A homography that folds the picture or changes its area by more than half is no camera motion
    between successive frames.
    """
    cause = ""
    if tracked < parameters.min_inliers:
        cause = f"only {tracked} keypoints could be followed, {parameters.min_inliers} wanted"
    elif inliers < parameters.min_inliers or inliers < parameters.min_inlier_share * tracked:
        cause = f"only {inliers} of {tracked} keypoints agree on one background motion"
    elif not plausible(later_from_earlier, size):
        cause = "the background motion found is not one of a camera"
    flow = background_flow(later_from_earlier, size) if not cause else float("nan")
    return Registration(later_from_earlier, tracked, inliers, error_px, flow, not cause, cause)


def plausible(later_from_earlier: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether the picture's outline stays convex, upright and of similar area."""
    width, height = size
    corners = transfer(later_from_earlier, np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
    if not np.isfinite(corners).all():
        return False
    following = corners[_NEXT]
    edges = following - corners
    after = edges[_NEXT]
    turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    area = 0.5 * (corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum()
    return bool((turns > 0).all() and 0.5 < area / (width * height) < 2.0)
