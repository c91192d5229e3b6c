"""Picture to ground and back: the bare homography with its errors, the source's raw degrees, rays on the ground."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import CAMERA, GPS_M, look, ring
from torchvision_dddas.geo.plane_homography import fix_by_homography, load_solver, locate_pixels
from torchvision_dddas.geo.pose_estimation import move_pose
from torchvision_dddas.geo.projection import project
from torchvision_dddas.geometry import lonlat, transfer
from torchvision_dddas.types import Fix

SOLVER = load_solver("onboard")
FAR = np.array([4000.0, -3000.0])
UTM = np.array([500_000.0, 3_500_000.0])
TUCSON = (-110.9, 31.9)


def posed(seen, sigma=1e-4):
    return Fix(1, "pose", seen.pose, sigma**2 * np.eye(7))


@pytest.mark.parametrize("n", [4, 6])
@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
def test_exact_landmarks_give_exact_ground(n, tilt_deg):
    seen = look(1, n=n, errors=0, tilt_deg=tilt_deg)
    fix = fix_by_homography(1, seen.marks, SOLVER)
    ground, _ = locate_pixels(fix, CAMERA, seen.targets_px, 1.0)
    assert fix.by == "homography" and fix.state == ("used",) * n
    assert np.allclose(ground, seen.targets, atol=1e-6)
    assert fix.image_from_ground is not None
    assert np.allclose(transfer(fix.image_from_ground, seen.targets), seen.targets_px, atol=1e-6)


@pytest.mark.parametrize("far", [FAR, UTM])
@pytest.mark.parametrize(("tilt_deg", "sigma_m"), [(0.0, GPS_M), (0.0, 0.01), (50.0, 0.01)])
def test_landmarks_far_from_the_origin_do_as_well_and_their_errors_are_the_same(far, tilt_deg, sigma_m):
    seen = look(1, errors=0, tilt_deg=tilt_deg, sigma_m=sigma_m)
    moved_away = replace(seen.marks, east_north_m=seen.marks.east_north_m + far)
    ground, covariance = locate_pixels(fix_by_homography(1, moved_away, SOLVER), CAMERA, seen.targets_px, 1.0)
    near = locate_pixels(fix_by_homography(1, seen.marks, SOLVER), CAMERA, seen.targets_px, 1.0)[1]
    assert np.allclose(ground, seen.targets + far, atol=1e-6)
    assert np.allclose(covariance, near, rtol=1e-5)


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
    assert fix.by == "paper" and 1e-3 < np.median(off) < 10
    assert np.isnan(covariance).all()


def test_the_covariance_of_rays_is_that_of_the_pose_and_of_the_pixel():
    seen = look(6, errors=0, tilt_deg=30.0)
    fix = Fix(1, "pose", seen.pose, np.diag([0.01, 0.02, 0.05, 1.0, 0.5, 2.0, 0.01]) ** 2)
    _, covariance = locate_pixels(fix, CAMERA, seen.targets_px, 2.0)
    columns = []
    for step in 1e-5 * np.eye(7):
        there, back = (
            locate_pixels(replace(fix, pose=move_pose(seen.pose, sign * step)), CAMERA, seen.targets_px, 2.0)[0]
            for sign in (1, -1)
        )
        columns.append((there - back) / 2e-5)
    by_pose = np.stack(columns, axis=2)
    columns = [
        (locate_pixels(fix, CAMERA, seen.targets_px + step, 2.0)[0] - seen.targets) / 1e-3 for step in 1e-3 * np.eye(2)
    ]
    by_pixel = np.stack(columns, axis=2)
    expected = by_pose @ fix.covariance @ by_pose.swapaxes(1, 2) + 4 * by_pixel @ by_pixel.swapaxes(1, 2)
    assert np.allclose(covariance, expected, rtol=1e-3, atol=1e-6)


def test_rays_meet_a_slope_where_it_is():
    seen = look(7, errors=0, tilt_deg=45.0)

    def slope(east_north_m):
        return 0.2 * east_north_m[:, 0] - 0.1 * east_north_m[:, 1]

    there = np.array([[3.0, 4.0], [-9.0, 2.0]])
    pixels = project(np.c_[there, slope(there)], seen.pose, CAMERA)
    ground, _ = locate_pixels(posed(seen), CAMERA, pixels, 1.0, surface=slope)
    assert np.allclose(ground, there, atol=0.02)
    nowhere, _ = locate_pixels(posed(seen), CAMERA, pixels, 1.0, surface=lambda p: np.full(len(p), np.nan))
    assert np.isnan(nowhere).all()


@pytest.mark.parametrize("paper", [False, True])
def test_landmarks_on_one_line_or_in_one_spot_are_refused_in_words(paper):
    seen = look(1, n=5)
    row = replace(seen.marks, east_north_m=np.outer(np.arange(5), [3.0, 4.0]))
    spot = replace(seen.marks, image_px=np.tile(seen.marks.image_px[:1], (5, 1)))
    for marks, words in ((row, "stand on one line"), (spot, "show in one spot of the picture")):
        fix = fix_by_homography(7, marks, SOLVER, paper=paper)
        assert fix.by == "" and f"the 5 landmarks of frame 7 {words}" in fix.cause


def test_landmarks_nearer_to_a_line_than_their_places_are_known_are_refused():
    row = np.array([[-25.0, 0.0], [-8.0, 1.0], [8.0, 0.0], [25.0, 1.0]])
    assert "for how well they are known" in fix_by_homography(1, look(1, places=row, errors=0).marks, SOLVER).cause
    assert fix_by_homography(1, look(1, places=row, errors=0, sigma_m=0.0, pixel_sigma=0.1).marks, SOLVER).by


def test_three_of_four_on_a_line_are_refused():
    corner = np.array([[-20.0, 0.0], [0.0, 0.0], [20.0, 0.0], [0.0, 20.0]])
    assert fix_by_homography(1, look(1, places=corner, errors=0).marks, SOLVER).by == ""


def test_too_few_landmarks_are_refused_with_how_many_are_missing_and_where():
    fix = fix_by_homography(17, look(1, n=3).marks, SOLVER)
    assert fix.by == "" and fix.cause == "frame 17 has 3 landmarks, 1 missing of the 4 that are needed"
    assert np.isnan(locate_pixels(fix, CAMERA, np.zeros((2, 2)), 1.0)[0]).all()
