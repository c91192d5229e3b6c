"""The back end for one stream on a small CPU: OpenCV on 8-bit pictures, no torch."""

from collections.abc import Sequence

import cv2
import numpy as np

from torchvision_dddas.settings import Settings
from torchvision_dddas.targets.projective import transfer
from torchvision_dddas.types import Registration
from torchvision_dddas.vision.judgement import judged
from torchvision_dddas.vision.protocol import EVIDENCE_CAP, EVIDENCE_SCALE, Foreground, View, Window


class OnboardVision:
    """Implements `Vision` one pair and one window at a time."""

    name = "onboard"

    def __init__(self, settings: Settings) -> None:
        self.knobs = settings

    def prepare(self, image: np.ndarray) -> View:
        """The frame and its grey picture."""
        return View(image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """Keypoints, pyramidal Lucas–Kanade, RANSAC, refits on the inliers."""
        return [self._register(earlier, later) for earlier, later in pairs]

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """Differences to the warped neighbours, threshold, morphology."""
        return [_foreground(window, self.knobs) for window in windows]

    def _register(self, earlier: View, later: View) -> Registration:
        knobs = self.knobs.registration
        start = _keypoints(earlier, knobs)
        if len(start) < 4:
            return judged(np.eye(3), 0, 0, np.inf, earlier.size, knobs)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, knobs.iterations, knobs.epsilon_px)
        window = {"winSize": (knobs.window_px,) * 2, "maxLevel": knobs.levels, "criteria": criteria}
        end, found, _ = cv2.calcOpticalFlowPyrLK(earlier.grey, later.grey, start, None, **window)
        tracked = found.ravel() == 1
        if knobs.forward_backward_px > 0:
            back, found, _ = cv2.calcOpticalFlowPyrLK(later.grey, earlier.grey, end, None, **window)
            tracked &= (found.ravel() == 1) & (np.linalg.norm(back - start, axis=1) <= knobs.forward_backward_px)
        width, height = later.size
        tracked &= ((end >= 0) & (end <= (width - 1, height - 1))).all(axis=1)
        start, end = start[tracked], end[tracked]
        if len(start) < 4:
            return judged(np.eye(3), len(start), 0, np.inf, earlier.size, knobs)
        later_from_earlier = _fit(start, end, knobs)
        miss = np.linalg.norm(transfer(later_from_earlier, start) - end, axis=1)
        inliers = miss < knobs.ransac_px
        if knobs.redetect_frames > 1:
            _carry(earlier, later, end[inliers])
        error = float(np.median(miss[inliers])) if inliers.any() else np.inf
        return judged(later_from_earlier, len(start), int(inliers.sum()), error, earlier.size, knobs)


def _keypoints(view: View, knobs) -> np.ndarray:
    """(N, 2) float32: carried on from the last step, or the best pixel of every grid cell."""
    if "keypoints" in view.kept:
        return view.kept["keypoints"]
    width, height = view.size
    cell = cell_side(width, height, knobs)
    corner = cv2.cornerMinEigenVal(view.grey, knobs.block_px, ksize=3)
    rows, columns = height // cell, width // cell
    if not rows or not columns:
        return np.zeros((0, 2), np.float32)
    cells = corner[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    cells = cells.transpose(0, 2, 1, 3).reshape(rows * columns, -1)
    best = cells.argmax(axis=1)
    cell_row, cell_column = np.divmod(np.arange(rows * columns), columns)
    points = np.c_[cell_column * cell + best % cell, cell_row * cell + best // cell].astype(np.float32)
    return points[cells.max(axis=1) > max(knobs.quality * float(corner.max()), 1e-7)]


def cell_side(width: int, height: int, knobs) -> int:
    """Side of the grid cells, in pixels, that keeps the number of keypoints within the budget."""
    return max(knobs.cell_px, int(np.ceil(np.sqrt(width * height / knobs.keypoints))))


def _fit(start: np.ndarray, end: np.ndarray, knobs) -> np.ndarray:
    """RANSAC, then least squares on the inliers of a tightening tolerance: the refits matter most for accuracy."""
    affine = knobs.model == "affine"
    if affine:
        found, _ = cv2.estimateAffine2D(start, end, method=cv2.RANSAC, ransacReprojThreshold=knobs.ransac_px)
        model = None if found is None else np.vstack([found, [0, 0, 1]])
    else:
        model, _ = cv2.findHomography(start, end, cv2.USAC_MAGSAC, knobs.ransac_px, maxIters=2000, confidence=0.999)
    if model is None:
        return np.eye(3)
    for tolerance in (1.5 * knobs.ransac_px, knobs.ransac_px, 0.5 * knobs.ransac_px, 0.5 * knobs.ransac_px):
        near = np.linalg.norm(transfer(model, start) - end, axis=1) < tolerance
        if near.sum() < 12:
            break
        if affine:
            rows = np.c_[start[near], np.ones(near.sum())].astype(np.float64)
            refit = np.vstack([np.linalg.lstsq(rows, end[near].astype(np.float64), rcond=None)[0].T, [0, 0, 1]])
        else:
            refit, _ = cv2.findHomography(start[near], end[near], 0)
        if refit is None:
            break
        model = refit
    return model


def _carry(earlier: View, later: View, points: np.ndarray) -> None:
    pass


# --------------------------------------------------------------------------------------------------------------------


def _foreground(window: Window, settings: Settings) -> Foreground:
    knobs, grey = settings.difference, window.reference.grey
    warped, inside = [], []
    for view, neighbour_from_reference in zip(window.neighbours, window.neighbour_from_reference, strict=True):
        warped.append(_warp(view.grey, neighbour_from_reference, grey.shape))
        inside.append(_inside(neighbour_from_reference, window.reference.size, knobs.border_px))
    texture = _texture(grey)
    if knobs.kind == "normalized":
        for i, picture in enumerate(warped):
            warped[i] = _exposed(grey, picture, inside[i])
        noise = cv2.multiply(texture, texture, scale=(knobs.gradient_share / 4) ** 2, dtype=cv2.CV_32F)
        weight = EVIDENCE_SCALE / np.sqrt(noise + knobs.noise_levels**2)

        def evidence(pair: tuple[int, int]) -> np.ndarray:
            a, b = pair
            both = inside[a] & inside[b]
            least = cv2.min(cv2.absdiff(grey, warped[a]), cv2.absdiff(grey, warped[b])) & both
            z = cv2.multiply(least, weight, dtype=cv2.CV_8U)
            z = cv2.GaussianBlur(cv2.min(z, EVIDENCE_CAP), (knobs.blur_px,) * 2, 0)
            textured = z[(texture > 16) & (both > 0)]
            unit = max(1.0, float(np.median(textured)) / EVIDENCE_SCALE) if len(textured) > 500 else 1.0
            return z if unit == 1.0 else cv2.convertScaleAbs(z, alpha=1 / unit)

        scale = EVIDENCE_SCALE
    else:

        def evidence(pair: tuple[int, int]) -> np.ndarray:
            a, b = pair
            if knobs.kind == "between_later":
                least = cv2.absdiff(warped[a], warped[b])
            else:
                least = cv2.min(cv2.absdiff(grey, warped[a]), cv2.absdiff(grey, warped[b]))
            return cv2.GaussianBlur(least, (knobs.blur_px,) * 2, 0) & inside[a] & inside[b]

        scale = 1.0
    near = evidence(window.near[0])
    for pair in window.near[1:]:
        near = cv2.max(near, evidence(pair))
    wide = near if window.wide is None else evidence(window.wide)
    core = cv2.threshold(near, int(knobs.threshold * scale), 255, cv2.THRESH_BINARY)[1]
    core = cv2.erode(core, _ellipse(settings.morphology.erode_px))
    core = cv2.morphologyEx(core, cv2.MORPH_CLOSE, _ellipse(settings.morphology.close_px))
    small = None
    if window.small is not None:
        a, b = window.small
        least = cv2.min(cv2.absdiff(grey, warped[a]), cv2.absdiff(grey, warped[b]))
        least = cv2.GaussianBlur(least, (5, 5), 0) & inside[a] & inside[b]
        small = cv2.threshold(least, int(settings.small.threshold), 255, cv2.THRESH_BINARY)[1]
        small = cv2.morphologyEx(cv2.erode(small, _ellipse(3)), cv2.MORPH_CLOSE, _ellipse(5))
    a, b = window.near[-1]
    offsets = (window.offsets[a], window.offsets[b])
    return Foreground(core, near, wide, texture, small, (warped[a], warped[b]), offsets)


def _ellipse(side: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def _warp(picture: np.ndarray, picture_from_reference: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = shape[1], shape[0]
    return cv2.warpPerspective(picture, picture_from_reference, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _inside(picture_from_reference: np.ndarray, size: tuple[int, int], border: int) -> np.ndarray:
    """255 where the reference's pixels see the picture, a strip inside its border left out."""
    width, height = size
    inset = np.full((height, width), 0, np.uint8)
    inset[border : height - border, border : width - border] = 255
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(inset, picture_from_reference, size, flags=flags)


def _texture(grey: np.ndarray) -> np.ndarray:
    """Mean gradient magnitude over 5x5 px, 4 x grey levels a pixel, uint8."""
    across = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.5)
    down = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.5)
    return cv2.blur(cv2.convertScaleAbs(cv2.magnitude(across, down)), (5, 5))


def _exposed(reference: np.ndarray, warped: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The warped picture in the reference's exposure: gain and offset by trimmed least squares on every 4th pixel."""
    seen = inside[::4, ::4] > 0
    x, y = warped[::4, ::4][seen].astype(np.float32), reference[::4, ::4][seen].astype(np.float32)
    if len(x) < 100:
        return warped
    gain, offset = 1.0, float(np.median(y - x))
    for _ in range(4):
        miss = np.abs(gain * x + offset - y)
        kept = miss <= max(3.0, 3.7 * float(np.median(miss)))
        mean_x, mean_y = float(x[kept].mean()), float(y[kept].mean())
        spread = float(((x[kept] - mean_x) ** 2).mean())
        gain = float(((x[kept] - mean_x) * (y[kept] - mean_y)).mean()) / spread if spread > 1e-3 else 1.0
        offset = mean_y - gain * mean_x
    table = np.clip(np.round(gain * np.arange(256) + offset), 0, 255).astype(np.uint8)
    return cv2.LUT(warped, table)
