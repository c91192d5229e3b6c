"""The engine for one stream on a small CPU: OpenCV on 8-bit pictures, without torch.

Two frames are registered by grid keypoints, Lucas-Kanade tracking, RANSAC, and refits on the inliers. With
`registration.redetect_frames` above 1, the inliers of one step are the start points of the next step, and the
homography of the step predicts their motion, so that a short search is enough.

The engine can work at half the resolution, for a quarter of the cost. A pixel of the half picture is the mean of 2 x 2
pixels, so that coordinate p in the half picture is 2 p + 1/2 in the whole picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.chain import (
    DetectionChain,
    OpenCVOperations,
    View,
    Window,
    halve_side,
    match_exposure,
    no_texture,
)
from torchvision_dddas.config import RegistrationParameters, Settings
from torchvision_dddas.detection.engine import Engine, Foreground, grey_of, judge_points
from torchvision_dddas.geometry import transfer
from torchvision_dddas.types import Registration

_WHOLE_FROM_HALF = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]])
_HALF_FROM_WHOLE = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])

# Most pyramid levels above the full resolution when the motion is predicted. The number of iterations is not reduced
# as well: a limit of five iterations gave false targets on distant objects with parallax.
_SHORT_LEVELS = 1
# The Lucas-Kanade window is at least this wide when no earlier step predicts the motion.
_DEEP_WINDOW_PX = 21
# If a step with predicted motion has a smaller share of inliers, it is repeated with new keypoints and all levels.
_LEAST_SHARE = 0.4
# New keypoints are detected when fewer than _LEAST_LEFT of the detected keypoints are left, or when they cover fewer
# than _LEAST_COVER of the cells, in a grid of _COARSE x _COARSE cells, that all detected keypoints covered.
_LEAST_LEFT, _LEAST_COVER, _COARSE = 0.6, 0.8, 4
_STRIP_ROWS = 64
# Inlier tolerances of the successive refits, as factors of RANSAC's tolerance. On half pictures two refits suffice: the
# error at the corners is 0.08 px with two and with four.
_TOLERANCES, _TOLERANCES_HALVED = (1.5, 1.0, 0.5, 0.5), (1.0, 0.5)


@dataclass(frozen=True)
class Carried:
    """The keypoints and the homography that one registration step passes to the next.

    points: (N, 2) float32, the inliers of the step. step: (3, 3) its homography, None before the first step. age: steps
    since the keypoints were detected. count, cover: number of keypoints and coarse cells at detection.
    """

    points: np.ndarray
    step: np.ndarray | None
    age: int
    count: int
    cover: int


@dataclass
class OpenCVView(View):
    """A frame with cached data. carried: keypoints of the step that ends at this frame, for the next step."""

    carried: Carried | None = None

    @cached_property
    def half(self) -> "OpenCVView":
        """The grey view at half its resolution, without an odd last row or column."""
        width, height = (max(side // 2, 1) for side in self.size)
        grey = cv2.resize(self.grey[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        if self.ignored is None:
            return OpenCVView(grey, grey)
        share = cv2.resize(self.ignored[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        return OpenCVView(grey, grey, ignored=cv2.threshold(share, 0, 255, cv2.THRESH_BINARY)[1])


class OpenCVEngine(Engine[OpenCVView]):
    """Implements `Engine` for one pair and one window at a time."""

    name = "onboard"

    def __init__(self, settings: Settings) -> None:
        self.parameters = settings

    def prepare(self, image: np.ndarray) -> OpenCVView:
        """See `Engine.prepare`."""
        return OpenCVView(image, grey_of(image))

    def register(self, pairs: Sequence[tuple[OpenCVView, OpenCVView]]) -> list[Registration]:
        """See `Engine.register`."""
        parameters = self.parameters.registration
        if not parameters.halved:
            return [_register(earlier, later, parameters) for earlier, later in pairs]
        # Search windows keep their size in pixels, so that they cover twice the distance in the scene.
        lengths = {"cell_px": max(parameters.cell_px // 2, 4), "ransac_px": parameters.ransac_px / 2}
        lengths["min_distance_px"] = max(parameters.min_distance_px // 2, 1)
        lengths["forward_backward_px"] = parameters.forward_backward_px / 2
        small = parameters.model_copy(update=lengths)
        steps = [_register(earlier.half, later.half, small) for earlier, later in pairs]
        matrices = [_WHOLE_FROM_HALF @ step.later_from_earlier @ _HALF_FROM_WHOLE for step in steps]
        return [
            replace(step, later_from_earlier=m / m[2, 2], error_px=2 * step.error_px, flow_px=2 * step.flow_px)
            for step, m in zip(steps, matrices, strict=True)
        ]

    def foreground(self, windows: Sequence[Window[OpenCVView]]) -> list[Foreground]:
        """See `Engine.foreground`."""
        given, settings = [window.settings or self.parameters for window in windows], self.parameters
        if not settings.difference.halved:
            return [find_foreground(window, own) for window, own in zip(windows, given, strict=True)]
        halves = [(halve_window(window), halve_settings(own)) for window, own in zip(windows, given, strict=True)]
        found = [find_foreground(*half) for half in halves]
        outlines = settings.refine.on
        if not (
            outlines or settings.history.on or settings.small.on
        ):  # finding blobs does not need the whole resolution
            return [replace(half, scale=2) for half in found]
        return [double_maps(half, window.reference.size, outlines) for half, window in zip(found, windows, strict=True)]


def find_foreground(window: Window[OpenCVView], settings: Settings) -> Foreground:
    """Compute the chain's maps of a window. For a picture of a single row or column, all maps are 0."""
    grey = window.reference.grey
    if min(grey.shape) < 2:  # OpenCV treats a single column as a scalar
        zero = np.zeros_like(grey)
        return Foreground(zero, zero, zero, zero, zero, (grey, grey), (zero,), zero, (-1, 1))
    chain: DetectionChain[OpenCVView, np.ndarray, np.ndarray] = DetectionChain(settings, OpenCVOperations())
    maps, (a, b) = chain.find_foreground(window), window.near[-1]
    return Foreground(**vars(maps) | {"offsets": (window.offsets[a], window.offsets[b])})


# -- half pictures -----------------------------------------------------------------------------------------------------


def halve_window(window: Window[OpenCVView]) -> Window[OpenCVView]:
    """Return the same window on half pictures."""
    return replace(
        window,
        reference=window.reference.half,
        neighbours=tuple(neighbour.half for neighbour in window.neighbours),
        neighbour_from_reference=_HALF_FROM_WHOLE @ window.neighbour_from_reference @ _WHOLE_FROM_HALF,
        close_px=halve_side(window.close_px) if window.close_px else 0,
        ignored=window.reference.half.ignored,
    )


def halve_settings(settings: Settings) -> Settings:
    """Return settings for half pictures: halve the lengths in pixels, and the gradient share, as slopes are doubled."""
    difference, morphology, small = settings.difference, settings.morphology, settings.small
    border_px, gradient_share = -(-difference.border_px // 2), difference.gradient_share / 2
    sides = {"blur_px": halve_side(difference.blur_px), "border_px": border_px, "gradient_share": gradient_share}
    cleaning = {name: halve_side(getattr(morphology, name)) for name in ("erode_px", "dilate_px", "close_px")}
    return settings.model_copy(
        update={
            "difference": difference.model_copy(update=sides),
            "morphology": morphology.model_copy(update=cleaning),
            "small": small.model_copy(update={"close_px": halve_side(small.close_px)}),
        }
    )


def double_maps(half: Foreground, size: tuple[int, int], outlines: bool) -> Foreground:
    """Enlarge the maps of half pictures to size (width, height). outlines: whether the warped pictures are needed."""
    is_needed = half.texture.strides != (0, 0)
    texture = double(cv2.convertScaleAbs(half.texture, alpha=0.5), size) if is_needed else no_texture(size[::-1])
    evidence = double(half.evidence, size)
    one, other = half.warped
    return Foreground(
        double(half.core, size),
        evidence,
        evidence if half.wide is half.evidence else double(half.wide, size),
        texture,
        None if half.small is None else double(half.small, size),
        (double(one, size, smooth=True), double(other, size, smooth=True)) if outlines else half.warped,
        tuple(double(pair, size) for pair in half.pairs),
        None if half.levels is None else double(half.levels, size),
        half.offsets,
    )


def double(picture: np.ndarray, size: tuple[int, int], smooth: bool = False) -> np.ndarray:
    """Enlarge a picture twofold to size (width, height); an odd last row or column is repeated."""
    twice = picture.shape[1] * 2, picture.shape[0] * 2
    large = cv2.resize(picture, twice, interpolation=cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)
    if twice == size:
        return large
    more = max(size[1] - twice[1], 0), max(size[0] - twice[0], 0)
    return cv2.copyMakeBorder(large, 0, more[0], 0, more[1], cv2.BORDER_REPLICATE)[: size[1], : size[0]]


# -- registration ------------------------------------------------------------------------------------------------------


def _register(earlier: OpenCVView, later: OpenCVView, parameters: RegistrationParameters) -> Registration:
    """Register the background of `later` to `earlier`, and store the keypoints for the next step in `later.carried`."""
    carrying = parameters.redetect_frames > 1

    def detect(step: np.ndarray | None) -> Carried:
        points = detect_keypoints(earlier.grey, parameters, halved=parameters.halved_corners and not parameters.halved)
        points = points[_counts(points, earlier)]
        return Carried(points, step, 0, len(points), _cover(points, earlier.size))

    carried, earlier.carried = earlier.carried if carrying else None, None
    if carried is not None:
        # Detect new keypoints if the carried points are too old, too few, too clustered, or more than settings allow.
        if (
            carried.age >= parameters.redetect_frames
            or len(carried.points) > parameters.keypoints
            or len(carried.points) < _LEAST_LEFT * carried.count
            or _cover(carried.points, earlier.size) < _LEAST_COVER * carried.cover
        ):
            carried = detect(carried.step)
        found, inliers = _register_points(earlier, later, carried, parameters)
        if found.inliers < _LEAST_SHARE * len(carried.points) or not found.reliable:
            carried = None
    if carried is None:
        carried = detect(None)
        found, inliers = _register_points(earlier, later, carried, parameters)
    if carrying and found.reliable:
        step, inliers = found.later_from_earlier, inliers[_counts(inliers, later)]
        later.carried = replace(carried, points=inliers, step=step, age=carried.age + 1)
    return found


def _counts(points: np.ndarray, view: OpenCVView) -> np.ndarray:
    """Return (N,) bool: whether points (N, 2) are outside the ignored area. Points are first clipped to the picture."""
    if view.ignored is None:
        return np.ones(len(points), bool)
    u, v = np.clip(points.round().astype(int), 0, np.array(view.size) - 1).T
    return view.ignored[v, u] == 0


def detect_keypoints(grey: np.ndarray, parameters: RegistrationParameters, halved: bool = False) -> np.ndarray:
    """Detect (N, 2) float32 corners above the quality threshold: the strongest of each grid cell, or of the frame.

    halved: search at half the resolution, for a quarter of the cost; the points then lie on even pixels.
    """
    height, width = grey.shape
    cell, factor, apart_px = parameters.cell_side(width, height), 1, parameters.min_distance_px
    if halved and min(width, height) > 1:
        # The points lie half a pixel to the left and top of the corners, which does not matter for a search window.
        grey = grey[: height // 2 * 2, : width // 2 * 2]  # resizing an odd side would stretch it and move the corners
        grey, factor = cv2.resize(grey, (width // 2, height // 2), interpolation=cv2.INTER_AREA), 2
        cell, apart_px = max(cell // 2, 1), max(apart_px // 2, 1)
    if parameters.corners == "frame":
        found: np.ndarray | None = cv2.goodFeaturesToTrack(
            grey, parameters.keypoints, parameters.quality, apart_px, blockSize=parameters.block_px
        )
        return np.zeros((0, 2), np.float32) if found is None else factor * found.reshape(-1, 2)
    rows, columns = grey.shape[0] // cell, grey.shape[1] // cell
    if not rows or not columns:
        return np.zeros((0, 2), np.float32)
    corner = measure_corners(grey, parameters.block_px)
    cells = corner[: rows * cell, : columns * cell].reshape(rows, cell, columns * cell)
    # Take the maximum down the columns first, because that reads whole rows of memory.
    best = cells.max(axis=1).reshape(rows, columns, cell)
    column = best.argmax(axis=2) + cell * np.arange(columns)
    value = best.max(axis=2)
    at_best = cells[np.arange(rows)[:, None], :, column] == value[..., None]
    row = at_best.argmax(axis=2) + cell * np.arange(rows)[:, None]
    good = value > max(parameters.quality * float(corner.max()), 1e-7)
    return factor * np.stack([column[good], row[good]], axis=1).astype(np.float32)


def measure_corners(grey: np.ndarray, block: int) -> np.ndarray:
    """Compute `cv2.cornerMinEigenVal`, (H, W) float32, in strips: OpenCV allocates six float pictures of its input."""
    corner = np.empty(grey.shape, np.float32)
    reach = 1 + block // 2
    for top in range(0, len(grey), _STRIP_ROWS):
        above, bottom = min(top, reach), top + _STRIP_ROWS
        strip = cv2.cornerMinEigenVal(grey[top - above : bottom + reach], block, ksize=3)
        corner[top:bottom] = strip[above : above + _STRIP_ROWS]
    return corner


def _cover(points: np.ndarray, size: tuple[int, int]) -> int:
    """Return the number of cells, in a coarse grid over the picture, that contain points."""
    cells = np.clip(points * (_COARSE / np.array(size)), 0, _COARSE - 1).astype(int)
    return len(np.unique(cells @ (1, _COARSE)))


def _register_points(
    earlier: OpenCVView, later: OpenCVView, carried: Carried, parameters: RegistrationParameters
) -> tuple[Registration, np.ndarray]:
    """Register two frames by the carried points, and return the record and the inliers' positions in `later`."""
    start = end = carried.points if len(carried.points) >= 4 else carried.points[:0]
    if len(start):
        end, found, missed_px = track_both_ways(*match_exposure(earlier, later), start, parameters, carried.step)
        tracked = found & (missed_px <= parameters.forward_backward_px)
        start, end = start[tracked], end[tracked]
    later_from_earlier = fit_motion(start, end, parameters)
    registration, inliers = judge_points(later_from_earlier, start, end, earlier.size, parameters)
    return registration, end[inliers]


def track_both_ways(
    earlier: np.ndarray,
    later: np.ndarray,
    start: np.ndarray,
    parameters: RegistrationParameters,
    predicted: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Track points forward and backward. predicted: (3, 3) homography that gives the start of the search.

    Return the positions in `later`, (N, 2) float32; whether each point was found in both directions, (N,) bool; and its
    distance from the start after tracking back, (N,) px, 0 if backward tracking is off.
    """
    levels, side, flags = parameters.levels, parameters.window_px, 0
    guess: Any = None  # OpenCV's type stubs do not allow None here
    if predicted is not None:
        levels, flags = min(levels, _SHORT_LEVELS), cv2.OPTFLOW_USE_INITIAL_FLOW
        guess = transfer(predicted, start).astype(np.float32)
    elif parameters.redetect_frames > 1:
        side = max(side, _DEEP_WINDOW_PX)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, parameters.iterations, parameters.epsilon_px)
    search: dict[str, Any] = {"winSize": (side, side), "maxLevel": levels, "criteria": criteria, "flags": flags}
    end, found, _ = cv2.calcOpticalFlowPyrLK(earlier, later, start, guess, **search)
    tracked, missed_px = found.ravel() == 1, np.zeros(len(start))
    if parameters.forward_backward_px > 0:
        # Start backward tracking at the known start points, at full resolution only: a true match stays there. A search
        # without this start costs three times as much and changes the homography by 0.03 px at most.
        search |= {"maxLevel": 0, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        back, found, _ = cv2.calcOpticalFlowPyrLK(later, earlier, end, start.copy(), **search)
        tracked &= found.ravel() == 1
        missed_px = np.linalg.norm(back - start, axis=1)
    height, width = later.shape
    return end, tracked & ((end >= 0) & (end <= (width - 1, height - 1))).all(axis=1), missed_px


def fit_motion(start: np.ndarray, end: np.ndarray, parameters: RegistrationParameters) -> np.ndarray:
    """Fit a (3, 3) motion by RANSAC, then refit it by least squares on the inliers of a shrinking tolerance.

    The refits matter most for accuracy. Return the identity for fewer than four points, and if RANSAC finds no model.
    """
    if len(start) < 4:
        return np.eye(3)
    is_affine, model = parameters.model == "affine", None
    if is_affine:
        found: np.ndarray | None = cv2.estimateAffine2D(start, end, None, cv2.RANSAC, parameters.ransac_px)[0]
        model = None if found is None else np.vstack([found, [0, 0, 1]])
    else:
        model, _ = cv2.findHomography(start, end, cv2.USAC_MAGSAC, parameters.ransac_px, None, 2000, 0.999)
    if model is None:
        return np.eye(3)
    fitted = np.zeros(0, bool)
    for share in _TOLERANCES_HALVED if parameters.halved else _TOLERANCES:
        near = np.linalg.norm(transfer(model, start) - end, axis=1) < share * parameters.ransac_px
        if near.sum() < 12:
            break
        if np.array_equal(near, fitted):  # the same points again give the same model
            continue
        fitted = near
        if is_affine:
            rows = np.c_[start[near], np.ones(near.sum())].astype(np.float64)
            refit = np.vstack([np.linalg.lstsq(rows, end[near].astype(np.float64), rcond=None)[0].T, [0, 0, 1]])
        else:
            refit = cv2.findHomography(start[near], end[near], 0)[0]
            if refit is None:
                break
        model = refit
    return model
