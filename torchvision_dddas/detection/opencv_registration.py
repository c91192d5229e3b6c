"""The registration of one frame pair on OpenCV: grid keypoints, Lucas-Kanade, RANSAC, refits on the inliers.

With `registration.redetect_frames` above 1 the inliers of one step are the start points of the next, and its homography
predicts where they go: a short search is then enough.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.config import RegistrationParameters
from torchvision_dddas.detection.engine import View
from torchvision_dddas.detection.registration import cell_side, judge_points, match_exposure
from torchvision_dddas.geometry import transfer
from torchvision_dddas.types import Registration

# The short search around a prediction: pyramid levels above the full resolution, and steps a level.
_SHORT_LEVELS, _SHORT_STEPS = 1, 5
# The window of the deep search from a cold start is at least this wide.
_DEEP_WINDOW_PX = 21
# Below this share of inliers a short step is done again, deep and from new keypoints.
_LEAST_SHARE = 0.4
# Keypoints are detected anew below this share of those detected, or of the coarse cells that they covered.
_LEAST_LEFT, _LEAST_COVER, _COARSE = 0.6, 0.8, 4
_STRIP_ROWS = 64
# Inliers of the refits, in RANSAC's tolerance. On half pictures 0.08 px at the corners with or without the rest.
_TOLERANCES, _TOLERANCES_HALVED = (1.5, 1.0, 0.5, 0.5), (1.0, 0.5)
LAST_TOLERANCE = _TOLERANCES[-1]


@dataclass(frozen=True)
class _Carried:
    """What a step leaves to the next one.

    points: (N, 2) float32, its inliers. step: (3, 3) its homography. age: steps since detection. count, cover: points
    and coarse cells that the detection gave.
    """

    points: np.ndarray
    step: np.ndarray
    age: int
    count: int
    cover: int


def register(earlier: View, later: View, parameters: RegistrationParameters) -> Registration:
    """The background's motion from `earlier` to `later`; what the next step needs is left in `later.kept`."""
    carrying = parameters.redetect_frames > 1
    carried: _Carried | None = earlier.kept.pop("carried", None) if carrying else None
    if carried is not None and _is_worn(carried, earlier.size, parameters):
        points = detect_keypoints(earlier.grey, parameters, halved=not parameters.halved)
        carried = _Carried(points, carried.step, 0, len(points), _cover(points, earlier.size))
    if carried is not None:
        found, inliers = _register_points(earlier, later, carried.points, parameters, carried.step)
        if found.inliers < _LEAST_SHARE * len(carried.points) or not found.reliable:
            carried = None
    if carried is None:
        points = detect_keypoints(earlier.grey, parameters, halved=carrying and not parameters.halved)
        carried = _Carried(points, np.eye(3), 0, len(points), _cover(points, earlier.size))
        found, inliers = _register_points(earlier, later, points, parameters, None)
    if carrying and found.reliable:
        step = found.later_from_earlier
        later.kept["carried"] = _Carried(inliers, step, carried.age + 1, carried.count, carried.cover)
    return found


def detect_keypoints(grey: np.ndarray, parameters: RegistrationParameters, halved: bool = False) -> np.ndarray:
    """(N, 2) float32: the best pixel of every grid cell, by the smaller eigenvalue of the structure tensor.

    halved: search at half the resolution, at a quarter of the cost; the points then lie on even pixels.
    """
    height, width = grey.shape
    cell = cell_side(width, height, parameters)
    if halved and min(width, height) > 1:
        # Half a pixel to the left and top of where the corner stands: a search window does not mind.
        grey = cv2.resize(grey, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        points = _best_of_cells(grey, max(cell // 2, 1), parameters)
        return 2 * points
    return _best_of_cells(grey, cell, parameters)


def _best_of_cells(grey: np.ndarray, cell: int, parameters: RegistrationParameters) -> np.ndarray:
    rows, columns = grey.shape[0] // cell, grey.shape[1] // cell
    if not rows or not columns:
        return np.zeros((0, 2), np.float32)
    corner = _corners(grey, parameters.block_px)
    cells = corner[: rows * cell, : columns * cell].reshape(rows, cell, columns * cell)
    # Down the columns first: that runs along whole rows of memory.
    best = cells.max(axis=1).reshape(rows, columns, cell)
    column = best.argmax(axis=2) + cell * np.arange(columns)
    value = best.max(axis=2)
    at_best = cells[np.arange(rows)[:, None], :, column] == value[..., None]
    row = at_best.argmax(axis=2) + cell * np.arange(rows)[:, None]
    good = value > max(parameters.quality * float(corner.max()), 1e-7)
    return np.stack([column[good], row[good]], axis=1).astype(np.float32)


def _corners(grey: np.ndarray, block: int) -> np.ndarray:
    """(H, W) float32: `cv2.cornerMinEigenVal`, in strips, because it holds six float pictures of what it is given."""
    corner = np.empty(grey.shape, np.float32)
    reach = 1 + block // 2
    for top in range(0, len(grey), _STRIP_ROWS):
        above, bottom = min(top, reach), top + _STRIP_ROWS
        strip = cv2.cornerMinEigenVal(grey[top - above : bottom + reach], block, ksize=3)
        corner[top:bottom] = strip[above : above + _STRIP_ROWS]
    return corner


def _is_worn(carried: _Carried, size: tuple[int, int], parameters: RegistrationParameters) -> bool:
    """Whether the points carried on are too old, too few or too much in one place."""
    return (
        carried.age >= parameters.redetect_frames
        or len(carried.points) < _LEAST_LEFT * carried.count
        or _cover(carried.points, size) < _LEAST_COVER * carried.cover
    )


def _cover(points: np.ndarray, size: tuple[int, int]) -> int:
    """In how many cells of a coarse grid over the picture there are points."""
    cells = np.clip(points * (_COARSE / np.array(size)), 0, _COARSE - 1).astype(int)
    return len(np.unique(cells @ (1, _COARSE)))


def _register_points(
    earlier: View, later: View, start: np.ndarray, parameters: RegistrationParameters, predicted: np.ndarray | None
) -> tuple[Registration, np.ndarray]:
    """The registration and its inliers' places in the later frame."""
    end, tracked = start, np.zeros(len(start), bool)
    if len(start) >= 4:
        end, found, missed_px = track_both_ways(*match_exposure(earlier, later), start, parameters, predicted)
        tracked = found & (missed_px <= parameters.forward_backward_px)
    start, end = start[tracked], end[tracked]
    later_from_earlier = fit_motion(start, end, parameters) if len(start) >= 4 else np.eye(3)
    registration, inliers = judge_points(later_from_earlier, start, end, earlier.size, parameters)
    return registration, end[inliers]


def track_both_ways(
    earlier: np.ndarray,
    later: np.ndarray,
    start: np.ndarray,
    parameters: RegistrationParameters,
    predicted: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the points went, (N, 2) float32, which were found there and on the way back, and by how much that missed.

    missed_px: (N,) of the start; 0 where the way back is left out. predicted: (3, 3), where to look first.
    """
    levels, steps, side, flags = parameters.levels, parameters.iterations, parameters.window_px, 0
    guess: Any = None  # OpenCV's stubs know no None here
    if predicted is not None:
        levels, steps, flags = min(levels, _SHORT_LEVELS), min(steps, _SHORT_STEPS), cv2.OPTFLOW_USE_INITIAL_FLOW
        guess = transfer(predicted, start).astype(np.float32)
    elif parameters.redetect_frames > 1:
        side = max(side, _DEEP_WINDOW_PX)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, steps, parameters.epsilon_px)
    search: dict[str, Any] = {"winSize": (side, side), "maxLevel": levels, "criteria": criteria, "flags": flags}
    end, found, _ = cv2.calcOpticalFlowPyrLK(earlier, later, start, guess, **search)
    tracked, missed_px = found.ravel() == 1, np.zeros(len(start))
    if parameters.forward_backward_px > 0:
        # The way back is searched from where it should end, at full resolution: a true match stays there. From nothing
        # it costs three times as much and moves the homography by 0.03 px at most.
        search |= {"maxLevel": 0, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        back, found, _ = cv2.calcOpticalFlowPyrLK(later, earlier, end, start.copy(), **search)
        tracked &= found.ravel() == 1
        missed_px = np.linalg.norm(back - start, axis=1)
    height, width = later.shape
    return end, tracked & ((end >= 0) & (end <= (width - 1, height - 1))).all(axis=1), missed_px


def fit_motion(start: np.ndarray, end: np.ndarray, parameters: RegistrationParameters) -> np.ndarray:
    """RANSAC, then least squares on the inliers of a tightening tolerance: the refits matter most for accuracy."""
    affine, model, refit = parameters.model == "affine", None, None
    if affine:
        found: np.ndarray | None = cv2.estimateAffine2D(start, end, None, cv2.RANSAC, parameters.ransac_px)[0]
        model = None if found is None else np.vstack([found, [0, 0, 1]])
    else:
        model, _ = cv2.findHomography(start, end, cv2.USAC_MAGSAC, parameters.ransac_px, None, 2000, 0.999)
    if model is None:
        return np.eye(3)
    fitted = np.zeros(0, bool)
    for share in _TOLERANCES_HALVED if parameters.halved else _TOLERANCES:
        tolerance = share * parameters.ransac_px
        near = np.linalg.norm(transfer(model, start) - end, axis=1) < tolerance
        if near.sum() < 12:
            break
        if np.array_equal(near, fitted):  # the same points again give the same model
            continue
        fitted = near
        if affine:
            rows = np.c_[start[near], np.ones(near.sum())].astype(np.float64)
            refit = np.vstack([np.linalg.lstsq(rows, end[near].astype(np.float64), rcond=None)[0].T, [0, 0, 1]])
        else:
            refit = cv2.findHomography(start[near], end[near], 0)[0]
        if refit is None:
            break
        model = refit
    return model
