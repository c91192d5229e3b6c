"""Solvers of plane homographies: both back ends, and what NumPy, OpenCV and the cameras themselves say."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from torchvision_dddas.geo.plane_homography import PlaneSolver, load_solver


@pytest.fixture(scope="module", params=["onboard", "torch"])
def solver(request) -> PlaneSolver:
    if request.param == "torch":
        pytest.importorskip("torch")
    return load_solver(request.param)


def view(altitude_m: float, tilt_deg: float, heading_deg: float, middle_m: tuple[float, float]) -> np.ndarray:
    """image_from_ground of a camera of 1080p and 70 degrees that looks at a point from so high."""
    tilt, heading = np.radians([tilt_deg, heading_deg])
    forward = np.array([np.sin(tilt) * np.sin(heading), np.sin(tilt) * np.cos(heading), -np.cos(tilt)])
    right = np.array([np.cos(heading), -np.sin(heading), 0])
    axes = np.stack([right, np.cross(forward, right), forward])
    place = np.array([*middle_m, 0]) - forward * altitude_m / np.cos(tilt)
    pixels = np.array([[1371.0, 0, 959.5], [0, 1371, 539.5], [0, 0, 1]])
    return np.asarray(pixels @ np.column_stack([axes[:, :2], -axes @ place]))


def seen(matrix: np.ndarray, ground: np.ndarray) -> np.ndarray:
    found = np.concatenate([ground, np.ones_like(ground[..., :1])], -1) @ matrix.swapaxes(-1, -2)
    return np.asarray(found[..., :2] / found[..., 2:])


def ring(count: int, middle_m: tuple[float, float] = (0, 0), radius_m: float = 12.5, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    around = np.linspace(0, 2 * np.pi, count, endpoint=False) + rng.uniform(-0.3, 0.3, count)
    return np.asarray(middle_m + radius_m * np.stack([np.sin(around), np.cos(around)], 1) * rng.uniform(0.7, 1))


def by_svd(ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The same least squares by NumPy: h33 = 1 at the weighted mean of the ground."""
    share = weight / weight.sum()
    into, out = (_scaling(points, share) for points in (ground, image))
    (x, y), (u, v) = seen(into, ground).T, seen(out, image).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], 1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], 1),
        ]
    )
    root = np.sqrt(np.tile(share, 2))
    found = np.linalg.lstsq(rows * root[:, None], np.concatenate([u, v]) * root)[0]
    matrix = np.linalg.inv(out) @ np.append(found, 1).reshape(3, 3) @ into
    return np.asarray(matrix / matrix[2, 2])


def _scaling(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    mean = share @ points
    scale = np.sqrt(2 / (share @ ((points - mean) ** 2).sum(1)))
    return np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]])


@pytest.mark.parametrize("away_m", [0, 3000])
@pytest.mark.parametrize(("altitude", "tilt"), [(50, 0), (200, 0), (60, 45), (50, 65)])
def test_four_landmarks_are_met_to_a_millionth_of_a_pixel_also_kilometres_from_the_origin(
    solver, altitude, tilt, away_m
):
    middle = (away_m, -away_m)
    rng = np.random.default_rng(1)
    ground = np.stack([ring(4, middle, seed=k) for k in range(40)])
    image = seen(view(altitude, tilt, 30, middle), ground) + rng.normal(0, 1, (40, 4, 2))
    matrix, valid = solver.solve(ground, image, rng.uniform(0.01, 1, (40, 4)))
    assert valid.all()
    assert np.abs(seen(matrix, ground) - image).max() < 1e-6
    for k in range(40):
        wanted = cv2.getPerspectiveTransform(
            (ground[k] - middle).astype(np.float32), image[k].astype(np.float32), cv2.DECOMP_SVD
        )
        assert np.abs(seen(wanted, ground[k] - middle) - seen(matrix[k], ground[k])).max() < 0.01  # float32


@pytest.mark.parametrize("count", [4, 5, 6, 9, 16])
def test_the_least_squares_are_those_of_numpy(solver, count):
    rng = np.random.default_rng(count)
    for k, (altitude, tilt) in enumerate([(50, 0), (200, 20), (70, 50)]):
        ground = ring(count, (800.0, 250.0), seed=k)
        image = seen(view(altitude, tilt, 200, (800, 250)), ground) + rng.normal(0, 2, (count, 2))
        weight = rng.uniform(0.05, 1, count)
        matrix, valid = solver.solve(ground[None], image[None], weight[None])
        assert valid
        places = np.concatenate([ground, ring(8, (800.0, 250.0), 25)])
        assert np.abs(seen(matrix[0], places) - seen(by_svd(ground, image, weight), places)).max() < 1e-6


def test_landmarks_of_weight_zero_are_as_if_absent_whatever_they_hold(solver):
    ground, matrix = ring(6), view(60, 30, 0, (0, 0))
    image = seen(matrix, ground) + np.random.default_rng(0).normal(0, 1, (6, 2))
    wanted, _ = solver.solve(ground[None], image[None], np.ones((1, 6)))
    for nonsense in (np.nan, np.inf, 0.0, 1e9):
        more = [np.concatenate([held, np.full((2, 2), nonsense)])[None] for held in (ground, image)]
        found, valid = solver.solve(*more, np.array([[1.0] * 6 + [0.0] * 2]))
        assert valid
        np.testing.assert_allclose(seen(found[0], ground), seen(wanted[0], ground), atol=1e-9)


LINES = {
    "on one line": [[0.0, 0], [5, 5], [10, 10], [20, 20]],
    "on a line eastwards": [[0.0, 7], [5, 7], [10, 7], [20, 7]],
    "three on one line": [[0.0, 0], [10, 10], [20, 20], [0, 20]],
    "two at one place": [[0.0, 0], [0, 0], [20, 20], [0, 20]],
    "all at one place": [[5.0, 5]] * 4,
    "six on one line": [[0.0, 0], [5, 5], [10, 10], [20, 20], [1, 1], [-9, -9]],
    "five on one line": [[0.0, 0], [5, 5], [10, 10], [20, 20], [1, 1], [-9, 12]],
}


@pytest.mark.parametrize("away_m", [0, 2000])
@pytest.mark.parametrize("ground", LINES.values(), ids=LINES)
def test_landmarks_that_fix_no_homography_are_marked_and_the_matrix_is_the_identity(solver, ground, away_m):
    place = np.array([ground]) + away_m
    matrix, valid = solver.solve(place, seen(view(60, 30, 10, (away_m, away_m)), place), np.ones(place.shape[:2]))
    assert not valid.any()
    assert np.array_equal(matrix, np.eye(3)[None])


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_four_landmarks_are_marked_by_number_and_by_weight(solver, count):
    matrix, valid = solver.solve(ring(6)[None, :count], ring(6)[None, :count], np.ones((1, count)))
    assert matrix.shape == (1, 3, 3) and valid.tolist() == [False]
    weight = np.array([[1.0] * count + [0.0] * (6 - count)])
    assert not solver.solve(ring(6)[None], ring(6)[None] * 3 + 7, weight)[1].any()
    assert not solver.solve_raw(ring(6)[None, :count], ring(6)[None, :count])[1].any()


def test_the_onboard_solver_needs_no_torch():
    load = "from torchvision_dddas.geo.plane_homography import load_solver; load_solver('auto')"
    script = f"import sys; {load}; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "False"
