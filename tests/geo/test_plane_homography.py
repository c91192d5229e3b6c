"""Plane homographies: both solvers against NumPy and OpenCV; picture to ground and back, with errors, and refusals."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.airborne import CAMERA, GPS_M, look, ring
from torchvision_dddas.geo.plane_homography import PlaneSolver, fix_by_homography, load_solver, locate_pixels
from torchvision_dddas.geometry import lonlat, transfer
from torchvision_dddas.geometry.projection import axes_of, ground_with_slopes, project
from torchvision_dddas.types import CameraPose, Fix

SOLVER = load_solver("onboard")
FAR, UTM, TUCSON = np.array([4000.0, -3000.0]), np.array([500_000.0, 3_500_000.0]), (-110.9, 31.9)


@pytest.fixture(scope="module", params=["onboard", "torch"])
def solver(request) -> PlaneSolver:
    if request.param == "torch":
        pytest.importorskip("torch")
    return load_solver(request.param)


def shown(ground: np.ndarray, altitude_m: float, tilt_deg: float, middle_m: tuple[float, float] = (0, 0)) -> np.ndarray:
    """Pixels of ground (N, 2) in a camera that looks at a point from so high."""
    axes = axes_of(0.5, np.pi / 2 - np.radians(tilt_deg), 0.0)
    pose = CameraPose(np.array([*middle_m, 0]) + axes[:, 2] * altitude_m / axes[2, 2], axes)
    return project(np.c_[ground, np.zeros(len(ground))], pose, CAMERA)


def around(count: int, middle_m: tuple[float, float] = (0, 0), radius_m: float = 12.5, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False) + rng.uniform(-0.3, 0.3, count)
    return np.asarray(middle_m + radius_m * np.stack([np.sin(turn), np.cos(turn)], 1) * rng.uniform(0.7, 1))


def by_svd(ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The same least squares by NumPy: h33 = 1 at the weighted mean of the ground."""
    share = weight / weight.sum()

    def scaling(points: np.ndarray) -> np.ndarray:
        mean = share @ points
        scale = np.sqrt(2 / (share @ ((points - mean) ** 2).sum(1)))
        return np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]])

    into, out = scaling(ground), scaling(image)
    (x, y), (u, v) = transfer(into, ground).T, transfer(out, image).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows_u = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], 1)
    rows_v = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], 1)
    root = np.sqrt(np.tile(share, 2))
    found = np.linalg.lstsq(np.concatenate([rows_u, rows_v]) * root[:, None], np.concatenate([u, v]) * root)[0]
    return np.asarray(np.linalg.inv(out) @ np.append(found, 1).reshape(3, 3) @ into)


@pytest.mark.parametrize("away_m", [0, 3000])
@pytest.mark.parametrize(("altitude", "tilt"), [(50, 0), (200, 0), (50, 65)])
def test_four_landmarks_are_met_to_a_millionth_of_a_pixel_also_far_from_the_origin(solver, altitude, tilt, away_m):
    middle, rng = (away_m, -away_m), np.random.default_rng(1)
    ground = np.stack([around(4, middle, seed=k) for k in range(10)])
    image = np.stack([shown(one, altitude, tilt, middle) for one in ground]) + rng.normal(0, 1, (10, 4, 2))
    matrix, valid = solver.solve(ground, image, rng.uniform(0.01, 1, (10, 4)))
    assert valid.all()
    for k in range(10):
        corners = (ground[k] - middle).astype(np.float32), image[k].astype(np.float32)
        wanted = transfer(cv2.getPerspectiveTransform(*corners, cv2.DECOMP_SVD), ground[k] - middle)
        met = transfer(matrix[k], ground[k])
        assert np.abs(met - image[k]).max() < 1e-6 and np.abs(wanted - met).max() < 0.01  # float32


@pytest.mark.parametrize("count", [4, 5, 16])
def test_the_least_squares_are_those_of_numpy(solver, count):
    rng = np.random.default_rng(count)
    for k, (altitude, tilt) in enumerate([(50, 0), (200, 20), (70, 50)]):
        ground = around(count, (800.0, 250.0), seed=k)
        image = shown(ground, altitude, tilt, (800, 250)) + rng.normal(0, 2, (count, 2))
        weight = rng.uniform(0.05, 1, count)
        (matrix,), valid = solver.solve(ground[None], image[None], weight[None])
        places = np.concatenate([ground, around(8, (800.0, 250.0), 25)])
        wanted = transfer(by_svd(ground, image, weight), places)
        assert valid and np.abs(transfer(matrix, places) - wanted).max() < 1e-6


def test_landmarks_of_weight_zero_are_as_if_absent_whatever_they_hold(solver):
    ground = around(6)
    image = shown(ground, 60, 30) + np.random.default_rng(0).normal(0, 1, (6, 2))
    (wanted,), _ = solver.solve(ground[None], image[None], np.ones((1, 6)))
    for nonsense in (np.nan, np.inf, 0.0, 1e9):
        more = [np.concatenate([held, np.full((2, 2), nonsense)])[None] for held in (ground, image)]
        (found,), valid = solver.solve(*more, np.array([[1.0] * 6 + [0.0] * 2]))
        assert valid
        np.testing.assert_allclose(transfer(found, ground), transfer(wanted, ground), atol=1e-9)


LINES = {
    "on one line": [[0.0, 0], [5, 5], [10, 10], [20, 20]],
    "on a line eastwards": [[0.0, 7], [5, 7], [10, 7], [20, 7]],
    "three on one line": [[0.0, 0], [10, 10], [20, 20], [0, 20]],
    "two at one place": [[0.0, 0], [0, 0], [20, 20], [0, 20]],
    "all at one place": [[5.0, 5]] * 4,
    "five on one line": [[0.0, 0], [5, 5], [10, 10], [20, 20], [1, 1], [-9, 12]],
}


@pytest.mark.parametrize("away_m", [0, 2000])
@pytest.mark.parametrize("ground", LINES.values(), ids=LINES)
def test_landmarks_that_fix_no_homography_are_marked_and_the_matrix_is_the_identity(solver, ground, away_m):
    place = np.array(ground) + away_m
    matrix, valid = solver.solve(place[None], shown(place, 60, 30, (away_m, away_m))[None], np.ones((1, len(place))))
    assert not valid.any() and np.array_equal(matrix, np.eye(3)[None])


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_four_landmarks_are_marked_by_number_and_by_weight(solver, count):
    ground = around(6)[None]
    few = ground[:, :count], ground[:, :count]
    matrix, valid = solver.solve(*few, np.ones((1, count)))
    assert matrix.shape == (1, 3, 3) and not valid.any() and not solver.solve_raw(*few)[1].any()
    assert not solver.solve(ground, ground * 3 + 7, np.array([[1.0] * count + [0.0] * (6 - count)]))[1].any()


def posed(look_):
    return Fix(1, "pose", look_.pose, 1e-8 * np.eye(7))


@pytest.mark.parametrize("far", [np.zeros(2), FAR, UTM])
@pytest.mark.parametrize(("n", "tilt_deg", "sigma_m"), [(4, 0.0, GPS_M), (6, 45.0, GPS_M), (4, 50.0, 0.01)])
def test_exact_landmarks_give_exact_ground_wherever_the_origin_is_and_the_same_errors(n, tilt_deg, sigma_m, far):
    seen = look(1, n=n, errors=0, tilt_deg=tilt_deg, sigma_m=sigma_m)
    near = locate_pixels(fix_by_homography(1, seen.marks, SOLVER), CAMERA, seen.targets_px, 1.0)[1]
    fix = fix_by_homography(1, replace(seen.marks, east_north_m=seen.marks.east_north_m + far), SOLVER)
    ground, covariance = locate_pixels(fix, CAMERA, seen.targets_px, 1.0)
    assert fix.by == "homography" and fix.state == ("used",) * n
    assert np.allclose(ground, seen.targets + far, atol=1e-6)
    assert np.allclose(covariance, near, atol=1e-5 * near.max())


def test_beyond_the_horizon_there_is_no_ground():
    seen = look(1, errors=0, tilt_deg=75.0, places=ring(4) * 0.4)
    sky = np.array([[960.0, -400.0], [960.0, 600.0]])
    for fix in (fix_by_homography(1, replace(seen.marks, sigma_m=np.zeros(4)), SOLVER), posed(seen)):
        ground, covariance = locate_pixels(fix, CAMERA, sky, 1.0)
        assert np.isfinite(ground).all(axis=1).tolist() == [False, True]
        assert np.isfinite(covariance).all(axis=(1, 2)).tolist() == [False, True]


def test_raw_degrees_lose_what_local_metres_keep():
    seen = look(4, n=6, errors=0)
    degrees = (lonlat(seen.marks.east_north_m, TUCSON), TUCSON)
    fix = fix_by_homography(1, seen.marks, SOLVER, degrees=degrees, paper=True)
    ground, covariance = locate_pixels(fix, CAMERA, seen.targets_px, 1.0)
    off = np.linalg.norm(ground - seen.targets, axis=1)
    assert fix.by == "paper" and 1e-3 < np.median(off) < 10 and np.isnan(covariance).all()


def test_the_covariance_of_rays_is_that_of_the_pose_and_of_the_pixel():
    seen = look(6, errors=0, tilt_deg=30.0)
    fix = Fix(1, "pose", seen.pose, np.diag([0.01, 0.02, 0.05, 1.0, 0.5, 2.0, 0.01]) ** 2)
    place, by_pose, by_pixel = ground_with_slopes(seen.pose, CAMERA, seen.targets_px)
    ground, covariance = locate_pixels(fix, CAMERA, seen.targets_px, 2.0)
    expected = by_pose @ fix.covariance @ by_pose.swapaxes(1, 2) + 4 * by_pixel @ by_pixel.swapaxes(1, 2)
    assert np.allclose(ground, seen.targets) and np.allclose(place, ground)
    assert np.allclose(covariance, expected, rtol=1e-9)


def test_rays_meet_a_slope_where_it_is_and_no_ground_where_no_height_is_known():
    seen, there = look(7, errors=0, tilt_deg=45.0), np.array([[3.0, 4.0], [-9.0, 2.0]])
    pixels = project(np.c_[there, there @ [0.2, -0.1]], seen.pose, CAMERA)
    for surface, wanted in ((lambda p: p @ [0.2, -0.1], there), (lambda p: np.full(len(p), np.nan), np.nan * there)):
        found, _ = locate_pixels(posed(seen), CAMERA, pixels, 1.0, surface=surface)
        assert np.allclose(found, wanted, atol=0.02, equal_nan=True)


@pytest.mark.parametrize("paper", [False, True])
def test_landmarks_on_one_line_or_in_one_spot_are_refused_in_words(paper):
    marks = look(1, n=5).marks
    row = replace(marks, east_north_m=np.outer(np.arange(5), [3.0, 4.0]))
    spot = replace(marks, image_px=np.tile(marks.image_px[:1], (5, 1)))
    for wrong, words in ((row, "stand on one line"), (spot, "show in one spot of the picture")):
        fix = fix_by_homography(7, wrong, SOLVER, paper=paper)
        assert fix.by == "" and f"the 5 landmarks of frame 7 {words}" in fix.cause


def test_landmarks_too_few_or_nearer_to_a_line_than_their_places_are_known_are_refused():
    def fix(places, **known):
        return fix_by_homography(17, look(1, places=np.array(places, float), errors=0, **known).marks, SOLVER)

    row, corner = [[-25, 0], [-8, 1], [8, 0], [25, 1]], [[-20, 0], [0, 0], [20, 0], [0, 20]]
    assert "for their accuracy" in fix(row).cause and fix(corner).by == ""
    assert fix(row, sigma_m=0.0, pixel_sigma=0.1).by == "homography"
    few = fix(ring(3))
    assert few.by == "" and few.cause == "frame 17 has 3 landmarks, 1 missing of the 4 that are needed"
    assert np.isnan(locate_pixels(few, CAMERA, np.zeros((2, 2)), 1.0)[0]).all()
