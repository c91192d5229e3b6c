"""The plane homography."""

from functools import cache
from typing import Any, Protocol

import numpy as np

from torchvision_dddas.geo.projection import Surface, ground_from_rays, inverse_2x2, undistort_pixels
from torchvision_dddas.geometry import lonlat, transfer
from torchvision_dddas.runtime import SHIPPED, opened, wants_torch
from torchvision_dddas.types import Camera, Fix, Float, LandmarkObservations

LEAST_POINTS = 4


class PlaneSolver(Protocol):
    """Batched solver of plane homographies in float64."""

    name: str

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """image_from_ground (B, 3, 3), h33 = 1, and whether each is valid (B,), from ground and image (B, n, 2).

        Weighted least squares, Hartley-normalised. weight: (B, n), 0 for a row that is padding.
        """
        ...

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same as the source solves it: normal equations of the given coordinates, such as degrees."""
        ...


def load_solver(backend: str) -> PlaneSolver:
    """The solver of a back end: auto, onboard or torch. Raises InputError for another name or missing packages."""
    return TorchPlaneSolver() if wants_torch(backend) else OnnxPlaneSolver()


class OnnxPlaneSolver:
    """PlaneSolver that runs the shipped ONNX graphs. They agree with the torch solver to 1e-6 px."""

    name = "onboard"

    def __init__(self) -> None:
        self.fit, self.fit_raw = open_graph("homography"), open_graph("homography_raw")

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See PlaneSolver. The graph is that of `functional.homography.fit`."""
        ground, image, weight = (np.asarray(array, np.float64) for array in (ground, image, weight))
        if weight.shape[1] < LEAST_POINTS or not len(weight):
            return _invalid(len(weight))
        if np.count_nonzero(weight) < weight.size:
            # Padding may hold NaN, and zero times NaN is not zero.
            ground, image = (np.where(weight[..., None] > 0, points, 0.0) for points in (ground, image))
        matrix, valid = self.fit.run(None, {"ground": ground, "image": image, "weight": weight})
        return matrix, valid

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See PlaneSolver. On an ill-conditioned system it and the torch solver err differently."""
        ground, image = np.asarray(ground, np.float64), np.asarray(image, np.float64)
        if ground.shape[1] < LEAST_POINTS or not len(ground):
            return _invalid(len(ground))
        matrix, valid = self.fit_raw.run(None, {"ground": ground, "image": image})
        return matrix, valid


@cache
def open_graph(name: str) -> Any:
    """An ONNX Runtime session of a shipped graph. Opening one takes longer than thousands of solutions."""
    return opened(SHIPPED, f"{name}.onnx")


def _invalid(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)


class TorchPlaneSolver:
    """PlaneSolver by `functional.homography`."""

    name = "torch"

    def __init__(self) -> None:
        import torch

        from torchvision_dddas.functional import homography

        self._tensor, self._homography = torch.from_numpy, homography

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See PlaneSolver."""
        matrix, valid = self._homography.fit(*map(self._double, (ground, image, weight)))
        return matrix.numpy(), valid.numpy()

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See PlaneSolver."""
        matrix, valid = self._homography.fit_raw(*map(self._double, (ground, image)))
        return matrix.numpy(), valid.numpy()

    def _double(self, array: np.ndarray) -> Any:
        return self._tensor(np.ascontiguousarray(array, np.float64))


# Landmarks that a plane homography takes.
LEAST = 4


# A homography is none whose depth at a landmark is no better known than this, as a share of it.
VAGUE = 0.3


def fix_by_homography(
    frame: int,
    marks: LandmarkObservations,
    solver: PlaneSolver,
    least_spread: float = 0.02,
    degrees: tuple[np.ndarray, tuple[float, float]] | None = None,
    paper: bool = False,
) -> Fix:
    """The homography of the landmarks; by = "" and a cause where there are too few or they stand on one line.

    marks: none may lack its pixel or its place. degrees, for `paper`: their longitudes and latitudes (n, 2), and the
    origin of the local metres; without them `paper` solves the local metres.
    """
    n = len(marks)
    cause = describe_too_few(frame, n) if n < LEAST else describe_one_line(frame, marks, least_spread)
    if cause:
        return no_fix(frame, marks, cause)
    if paper:
        return _fix_as_printed(frame, marks, solver, degrees)
    # Centred: with the origin far away, or on the line that the picture shows nowhere, h33 = 1 would not do.
    middle = marks.east_north_m.mean(axis=0)
    ground, image = marks.east_north_m - middle, marks.image_px
    variance = marks.pixel_sigma**2
    grown = np.linalg.norm(image - image.mean(axis=0)) / np.linalg.norm(ground)
    weight = 1 / (variance + (grown * marks.sigma_m) ** 2)
    for again in (True, False):
        matrix, valid = solver.solve(ground[None], image[None], weight[None])
        if not valid[0] or not np.isfinite(matrix[0]).all():
            return no_fix(frame, marks, _no_homography(frame, n))
        depth, by_ground, by_matrix = _slopes(ground, matrix[0])
        seen = np.eye(2) * variance[:, None, None]
        seen += by_ground @ by_ground.swapaxes(1, 2) * (marks.sigma_m**2)[:, None, None]
        ours = weight * depth**2
        if again:
            # The solver's residuals are in pixels times this depth: now that it is known, each row weighs as it should.
            weight = 2 / (depth**2 * np.trace(seen, axis1=1, axis2=2))
            weight = weight / weight.max()
    if (depth <= 0).any() and (depth >= 0).any():
        return no_fix(frame, marks, _no_homography(frame, n))
    information = np.einsum("n,nki,nkj->ij", ours, by_matrix, by_matrix)
    spread_out = np.einsum("n,nki,nkl,nlj->ij", ours**2, by_matrix, seen, by_matrix)
    inverse = np.linalg.pinv(information, rcond=1e-15, hermitian=True)
    covariance = inverse @ spread_out @ inverse
    vague = np.sqrt(np.einsum("ni,ij,nj->n", ground, covariance[6:, 6:], ground)) / np.abs(depth)
    if vague.max() > VAGUE:
        cause = (
            f"the {n} landmarks of frame {frame} lie too near one line, three of them or all, for how well they are "
            "known: their homography would be no more than a guess; add a landmark off the line, or telemetry"
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
    """A fix that concludes nothing, with its cause in words."""
    return Fix(frame, "", landmark=marks.landmark, state=("excluded",) * len(marks), cause=cause)


def describe_too_few(frame: int, n: int, without: str = "") -> str:
    """How many landmarks are missing in which frame, in words."""
    has = f"{n} landmark{'s' * (n != 1)}" if n else "no landmark"
    return f"frame {frame} has {has}{without}, {LEAST - n} missing of the {LEAST} that are needed"


def describe_one_line(frame: int, marks: LandmarkObservations, least_spread: float) -> str:
    """Why landmarks on one line, or shown in one spot, allow no fix, in words; empty where they are spread out."""
    if len(marks) and np.linalg.norm(marks.image_px - marks.image_px.mean(axis=0)) <= np.linalg.norm(marks.pixel_sigma):
        return f"the {len(marks)} landmarks of frame {frame} show in one spot of the picture"
    wide = relative_width(marks)
    if wide >= least_spread:
        return ""
    return (
        f"the {len(marks)} landmarks of frame {frame} stand on one line: {wide:.3f} wide of 1 long, below "
        f"aerial.least_spread = {least_spread:g}; a homography needs them spread, a pose needs telemetry"
    )


def relative_width(marks: LandmarkObservations) -> float:
    """Width of the landmarks as a share of their length, on the ground or in the picture, whichever is less.

    Receiver errors make a row on the ground wider than it is; in the picture it is a row whatever the errors.
    """
    return min(spread(marks.east_north_m), spread(marks.image_px))


def spread(points: Float[np.ndarray, "n 2"]) -> float:
    """Width of a set of points as a share of its length."""
    apart = points - points.mean(axis=0)
    length, width = np.linalg.svd(apart, compute_uv=False)[:2]
    return float(width / length) if length > 0 else 0.0


def locate_pixels(
    fix: Fix,
    camera: Camera,
    pixels: Float[np.ndarray, "N 2"],
    sigma_px: float,
    up_m: float | Float[np.ndarray, "N"] = 0.0,
    surface: Surface | None = None,
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2 2"]]:
    """East and north of what pixels show, and the covariance relative to the landmarks' team; NaN where there is none.

    sigma_px: standard deviation of u and of v each. up_m: height of what is seen above the ground: the plane up = 0 or
    the surface. Where all that is known is a homography both are left aside. A ray that meets no ground gives NaN.
    """
    pixels = np.asarray(pixels, float).reshape(-1, 2)
    if fix.pose is not None and fix.covariance is not None:
        return ground_from_rays(fix.pose, fix.covariance, camera, pixels, sigma_px, up_m, surface)
    if fix.image_from_ground is None:
        return np.full((len(pixels), 2), np.nan), np.full((len(pixels), 2, 2), np.nan)
    if fix.by != "paper":
        pixels = undistort_pixels(pixels, camera)
    middle = np.array(fix.about_m)
    matrix = _about(fix.image_from_ground, middle)
    ground, covariance = _by_inverse(matrix / matrix[2, 2], fix.matrix_covariance, pixels, sigma_px)
    return ground + middle, covariance


def absolute_covariance(relative_m2: Float[np.ndarray, "N 2 2"], common_sigma_m: float) -> Float[np.ndarray, "N 2 2"]:
    """The covariance of absolute places: with the error that all receivers of the team share."""
    return relative_m2 + common_sigma_m**2 * np.eye(2)


def _slopes(ground: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (n,) of eq. (6), and derivatives of the pixels by the ground (n, 2, 2) and by the matrix (n, 2, 8)."""
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
    """A homography on ground coordinates that are counted from a middle."""
    shift = np.eye(3)
    shift[:2, 2] = middle
    return matrix @ shift


def _no_homography(frame: int, n: int) -> str:
    return (
        f"the {n} landmarks of frame {frame} allow no homography: three of four stand on one line, or two are swapped"
    )


def _fix_as_printed(
    frame: int, marks: LandmarkObservations, solver: PlaneSolver, degrees: tuple[np.ndarray, tuple[float, float]] | None
) -> Fix:
    """The source's solution, of raw degrees if given, in local metres; its errors are unknown."""
    n = len(marks)
    given = marks.east_north_m if degrees is None else np.asarray(degrees[0], float)
    matrix, valid = solver.solve_raw(given[None], marks.image_px[None])
    if not valid[0] or not np.isfinite(matrix[0]).all():
        return no_fix(frame, marks, _no_homography(frame, n))
    ours = matrix[0]
    if degrees is not None:
        middle = marks.east_north_m.mean(axis=0)
        corner = lonlat(middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), degrees[1])
        degrees_from_metres = np.eye(3)
        degrees_from_metres[:2, :2] = (corner[1:] - corner[0]).T
        degrees_from_metres[:2, 2] = corner[0] - degrees_from_metres[:2, :2] @ middle
        ours = ours @ degrees_from_metres
    return Fix(frame, "paper", image_from_ground=ours / ours[2, 2], landmark=marks.landmark, state=("used",) * n)


def _by_inverse(
    matrix: np.ndarray, covariance: np.ndarray | None, pixels: np.ndarray, sigma_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Eq. (11). A point that a picture from above would show mirrored lies beyond the horizon: NaN."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        try:
            found = transfer(np.linalg.inv(matrix), pixels)
        except np.linalg.LinAlgError:
            found = np.full((len(pixels), 2), np.nan)
        depth, by_ground, by_matrix = _slopes(found, matrix)
        found = np.where((depth * np.linalg.det(matrix) < 0)[:, None], found, np.nan)
        by_pixel = inverse_2x2(by_ground)
        if covariance is None:
            return found, np.full((len(pixels), 2, 2), np.nan)
        seen = by_matrix @ covariance @ by_matrix.swapaxes(1, 2) + sigma_px**2 * np.eye(2)
        spread_m2 = by_pixel @ seen @ by_pixel.swapaxes(1, 2)
        spread_m2 = (spread_m2 + spread_m2.swapaxes(1, 2)) / 2
    return found, np.where(np.isfinite(found).all(axis=1)[:, None, None], spread_m2, np.nan)
