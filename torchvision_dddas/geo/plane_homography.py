"""Fit the plane homography from ground to picture by landmarks alone, and locate pixels on the ground.

The homography (appendix A, IV-B, eq. 6 to 11) has eight unknowns; each landmark is weighted by its accuracy.
`paper` solves as the source does, by normal equations of raw degrees. Eq. (11) prints 1 in place of the last element of
the inverse; here that element is used. If the camera's pose is known, pixels are mapped to the ground by rays instead.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from torchvision_dddas.geometry import Surface, ground_with_slopes, inverse_2x2, lonlat, transfer, undistort_pixels
from torchvision_dddas.runtime import SHIPPED, opened, wants_torch
from torchvision_dddas.types import Camera, Fix, Float, LandmarkObservations

# Number of landmarks that a plane homography needs.
LEAST = 4
# Refuse a homography if the relative standard deviation of its depth at a landmark exceeds this.
_VAGUE = 0.3

Solution = tuple[np.ndarray, np.ndarray]
"""image_from_ground (B, 3, 3), with h33 = 1 and the identity where invalid, and whether each is valid (B,)."""


class PlaneSolver:
    """Batched float64 solver of plane homographies: the shipped ONNX graphs or torch, which agree to 1e-6 px."""

    def __init__(self, fit: Callable[..., Solution], fit_raw: Callable[..., Solution]) -> None:
        """fit, fit_raw: the functions of `functional.plane_maps`, on arrays."""
        self._fit, self._fit_raw = fit, fit_raw

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> Solution:
        """Solve by weighted least squares with Hartley normalisation; ground and image are (B, n, 2).

        weight: (B, n), 0 for a padding row, whose values are ignored.
        """
        # Padding may hold NaN, which a weight of zero does not remove: 0 x NaN is NaN.
        ground, image = (np.where(weight[..., None] > 0, points, 0.0) for points in (ground, image))
        return self._solve(self._fit, ground, image, weight)

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> Solution:
        """Solve as the source does: by normal equations of the given coordinates, such as degrees.

        On an ill-conditioned system the errors of the two engines differ.
        """
        return self._solve(self._fit_raw, ground, image)

    @staticmethod
    def _solve(fit: Callable[..., Solution], *arrays: np.ndarray) -> Solution:
        count, n = arrays[0].shape[:2]
        if n < LEAST or not count:
            return np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)
        return fit(*(np.ascontiguousarray(array, np.float64) for array in arrays))


def load_solver(backend: str) -> PlaneSolver:
    """Return the solver of a back end: auto, onboard or torch. Raise InputError for other names or missing packages."""
    if not wants_torch(backend, auto_with_gpu=False):
        fit, fit_raw = open_graph("homography"), open_graph("homography_raw")
        return PlaneSolver(
            lambda ground, image, weight: fit.run(None, {"ground": ground, "image": image, "weight": weight}),
            lambda ground, image: fit_raw.run(None, {"ground": ground, "image": image}),
        )
    import torch

    import torchvision_dddas.functional as F

    def on_arrays(function: Callable[..., Any]) -> Callable[..., Solution]:
        return lambda *arrays: tuple(result.numpy() for result in function(*map(torch.from_numpy, arrays)))

    return PlaneSolver(on_arrays(F.find_homography), on_arrays(F.find_homography_raw))


@cache
def open_graph(name: str) -> Any:
    """Open an ONNX Runtime session of a shipped graph, once: opening takes longer than thousands of solutions."""
    return opened(SHIPPED, f"{name}.onnx")


def fix_by_homography(
    frame: int,
    marks: LandmarkObservations,
    solver: PlaneSolver,
    least_spread: float = 0.02,
    degrees: tuple[np.ndarray, tuple[float, float]] | None = None,
    paper: bool = False,
) -> Fix:
    """Fit the homography of the landmarks; by = "" and a cause if they are too few or stand on one line.

    marks: every landmark needs a pixel and a place. degrees, for `paper`: longitudes and latitudes (n, 2), and the
    origin of the local metres; without degrees, `paper` solves the local metres.
    """
    n = len(marks)
    cause = describe_too_few(frame, n) if n < LEAST else describe_one_line(frame, marks, least_spread)
    if cause:
        return no_fix(frame, marks, cause)
    degenerate = (
        f"the {n} landmarks of frame {frame} allow no homography: three of four stand on one line, or two are swapped"
    )
    middle = marks.east_north_m.mean(axis=0)
    if paper:
        given = marks.east_north_m if degrees is None else np.asarray(degrees[0], float)
        matrix, valid = solver.solve_raw(given[None], marks.image_px[None])
        if not valid[0] or not np.isfinite(matrix[0]).all():
            return no_fix(frame, marks, degenerate)
        ours = matrix[0]
        if degrees is not None:
            corner = lonlat(middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), degrees[1])
            degrees_from_metres = np.eye(3)
            degrees_from_metres[:2, :2] = (corner[1:] - corner[0]).T
            degrees_from_metres[:2, 2] = corner[0] - degrees_from_metres[:2, :2] @ middle
            ours = ours @ degrees_from_metres
        # The errors of this fix are unknown.
        return Fix(frame, "paper", image_from_ground=ours / ours[2, 2], landmark=marks.landmark, state=("used",) * n)
    # Centre the ground: h33 = 1 fails if the origin is far away or on the line that has no image.
    ground, image = marks.east_north_m - middle, marks.image_px
    variance = marks.pixel_sigma**2
    grown = np.linalg.norm(image - image.mean(axis=0)) / np.linalg.norm(ground)
    weight = 1 / (variance + (grown * marks.sigma_m) ** 2)
    for again in (True, False):
        matrix, valid = solver.solve(ground[None], image[None], weight[None])
        if not valid[0] or not np.isfinite(matrix[0]).all():
            return no_fix(frame, marks, degenerate)
        depth, by_ground, by_matrix = _slopes(ground, matrix[0])
        seen = np.eye(2) * variance[:, None, None]
        seen += by_ground @ by_ground.swapaxes(1, 2) * (marks.sigma_m**2)[:, None, None]
        applied = weight * depth**2
        if again:
            # The solver's residuals are in pixels times this depth. It is now known, so each row gets its right weight.
            weight = 2 / (depth**2 * np.trace(seen, axis1=1, axis2=2))
            weight = weight / weight.max()
    if (depth <= 0).any() and (depth >= 0).any():
        return no_fix(frame, marks, degenerate)
    information = np.einsum("n,nki,nkj->ij", applied, by_matrix, by_matrix)
    spread_out = np.einsum("n,nki,nkl,nlj->ij", applied**2, by_matrix, seen, by_matrix)
    inverse = np.linalg.pinv(information, rcond=1e-15, hermitian=True)
    covariance = inverse @ spread_out @ inverse
    vague = np.sqrt(np.einsum("ni,ij,nj->n", ground, covariance[6:, 6:], ground)) / np.abs(depth)
    if vague.max() > _VAGUE:
        cause = (
            f"the {n} landmarks of frame {frame} lie too near one line, three of them or all, for their accuracy: "
            "the homography would be a guess; add a landmark off the line, or telemetry"
        )
        return no_fix(frame, marks, cause)
    far = _about(matrix[0], -middle)
    return Fix(
        frame,
        "homography",
        image_from_ground=far / far[2, 2],
        matrix_covariance=covariance,
        about_m=(float(middle[0]), float(middle[1])),
        landmark=marks.landmark,
        state=("used",) * n,
    )


def no_fix(frame: int, marks: LandmarkObservations, cause: str) -> Fix:
    """Return a fix without a result, with its cause in words."""
    return Fix(frame, "", landmark=marks.landmark, state=("excluded",) * len(marks), cause=cause)


def describe_too_few(frame: int, n: int, without: str = "") -> str:
    """Return a message on how many landmarks are missing in which frame."""
    has = f"{n} landmark{'s' * (n != 1)}" if n else "no landmark"
    return f"frame {frame} has {has}{without}, {LEAST - n} missing of the {LEAST} that are needed"


def describe_one_line(frame: int, marks: LandmarkObservations, least_spread: float) -> str:
    """Return why landmarks allow no fix: they lie on one line or in one spot. Empty if they are spread out."""
    if len(marks) and np.linalg.norm(marks.image_px - marks.image_px.mean(axis=0)) <= np.linalg.norm(marks.pixel_sigma):
        return f"the {len(marks)} landmarks of frame {frame} show in one spot of the picture"
    wide = relative_width(marks)
    if wide >= least_spread:
        return ""
    return (
        f"the {len(marks)} landmarks of frame {frame} stand on one line: width over length is {wide:.3f}, below "
        f"aerial.least_spread = {least_spread:g}; a homography needs them spread, a pose needs telemetry"
    )


def relative_width(marks: LandmarkObservations) -> float:
    """Return the width of the landmarks as a share of their length, the smaller share of ground and picture.

    Receiver errors make a row on the ground look wider than it is; in the picture they do not matter.
    """
    shares = []
    for points in (marks.east_north_m, marks.image_px):
        length, width = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[:2]
        shares.append(float(width / length) if length > 0 else 0.0)
    return min(shares)


def locate_pixels(
    fix: Fix,
    camera: Camera,
    pixels: Float[np.ndarray, "N 2"],
    sigma_px: float,
    up_m: float | Float[np.ndarray, "N"] = 0.0,
    surface: Surface | None = None,
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2 2"]]:
    """Return east and north of pixels, and the covariance relative to the landmarks' team; NaN without ground.

    sigma_px: standard deviation of u and of v each. up_m: height of the points above the ground, which is the plane
    up = 0 or the surface. A homography uses neither up_m nor the surface.
    """
    pixels = np.asarray(pixels, float).reshape(-1, 2)
    if fix.pose is not None and fix.covariance is not None:
        ground, by_pose, by_pixel = ground_with_slopes(fix.pose, camera, pixels, up_m, surface)
        covariance = by_pose @ fix.covariance @ by_pose.swapaxes(1, 2)
        return ground, covariance + sigma_px**2 * by_pixel @ by_pixel.swapaxes(1, 2)
    unknown = np.full((len(pixels), 2, 2), np.nan)
    if fix.image_from_ground is None:
        return unknown[:, 0], unknown
    if fix.by != "paper":
        pixels = undistort_pixels(pixels, camera)
    middle = np.array(fix.about_m)
    matrix = _about(fix.image_from_ground, middle)
    matrix = matrix / matrix[2, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        try:
            ground = transfer(np.linalg.inv(matrix), pixels)
        except np.linalg.LinAlgError:
            ground = unknown[:, 0]
        depth, by_ground, by_matrix = _slopes(ground, matrix)
        # A point that a picture from above would show mirrored lies beyond the horizon.
        ground = np.where((depth * np.linalg.det(matrix) < 0)[:, None], ground, np.nan)
        if fix.matrix_covariance is None:
            return ground + middle, unknown
        by_pixel = inverse_2x2(by_ground)
        seen = by_matrix @ fix.matrix_covariance @ by_matrix.swapaxes(1, 2) + sigma_px**2 * np.eye(2)
        covariance = by_pixel @ seen @ by_pixel.swapaxes(1, 2)
        covariance = (covariance + covariance.swapaxes(1, 2)) / 2
    return ground + middle, np.where(np.isfinite(ground).all(axis=1)[:, None, None], covariance, np.nan)


def _slopes(ground: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth (n,) of eq. (6), and derivatives of the pixels by ground (n, 2, 2) and matrix (n, 2, 8)."""
    n = len(ground)
    rows = np.c_[ground, np.ones(n)]
    mapped = rows @ matrix.T
    depth = mapped[:, 2]
    pixels = mapped[:, :2] / depth[:, None]
    by_ground = (matrix[None, :2, :2] - pixels[:, :, None] * matrix[None, 2:, :2]) / depth[:, None, None]
    by_matrix = np.zeros((n, 2, 8))
    by_matrix[:, 0, :3] = by_matrix[:, 1, 3:6] = rows
    by_matrix[:, :, 6:] = -pixels[:, :, None] * ground[:, None, :]
    return depth, by_ground, by_matrix / depth[:, None, None]


def _about(matrix: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return a homography on ground coordinates that are counted from a middle."""
    shift = np.eye(3)
    shift[:2, 2] = middle
    return matrix @ shift
