"""The camera in the air: its axes, where it shows a point, the ray back, and the ground that rays meet."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.airborne import CAMERA
from torchvision_dddas.geo.pose_estimation import move_pose
from torchvision_dddas.geometry import turn_of, turned
from torchvision_dddas.geometry.projection import (
    axes_of,
    distort_pixels,
    ground_height,
    ground_with_slopes,
    project,
    project_with_slopes,
    rays,
    undistort_pixels,
)
from torchvision_dddas.types import CameraPose, Elevation

BENT = replace(CAMERA, k1=-0.2, k2=0.05, p1=1e-3, p2=-2e-3, k3=0.01, focal_px=(1400.0, 1380.0))
FOLDING = replace(CAMERA, k1=-0.3, k2=0.02)
POINTS = np.array([[5.0, 8.0, 0.0], [-7.0, 3.0, 1.5], [1.0, -6.0, 0.0], [12.0, 9.0, -2.0]])
ABOVE = CameraPose(np.array([2.0, -3.0, 50.0]), axes_of(0.7, 1.3, 0.1), 1.02)


def slopes_of(function, size, step):
    """Central differences of a function of a step (size,), by the last axis."""
    return np.stack([(function(d) - function(-d)) / (2 * step) for d in step * np.eye(size)], axis=-1)


def test_a_level_camera_that_looks_north_has_east_on_its_right_and_the_ground_below():
    assert np.allclose(axes_of(0, 0, 0), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T)


@given(st.floats(0, 6.2), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_angles_come_back_from_axes_and_a_turn_from_its_rotation(heading, pitch, roll):
    axes = axes_of(heading, pitch, roll)
    assert np.allclose(axes_of(*CameraPose(np.zeros(3), axes).angles_rad), axes, atol=1e-8)
    vector = np.array([heading - 3.1, pitch, roll]) / 2
    assert np.allclose(turn_of(turned(vector)), vector, atol=1e-7)


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_the_ray_through_where_a_point_is_shown_meets_the_point(camera):
    way, apart = rays(project(POINTS, ABOVE, camera), ABOVE, camera), POINTS - ABOVE.place_m
    assert np.allclose(np.cross(way, apart), 0, atol=1e-6) and ((way * apart).sum(axis=1) > 0).all()


def test_points_show_where_opencv_shows_them():
    inner = np.array([[1400 * 1.02, 0, 959.5], [0, 1380 * 1.02, 539.5], [0, 0, 1]])
    turn, offset = cv2.Rodrigues(ABOVE.axes.T)[0], -ABOVE.axes.T @ ABOVE.place_m
    theirs = cv2.projectPoints(POINTS, turn, offset, inner, np.array(BENT.distortion))[0][:, 0]
    assert np.allclose(project(POINTS, ABOVE, BENT), theirs, atol=1e-6)


def test_a_point_beyond_the_bend_of_the_lens_is_shown_nowhere():
    wide = np.array([[30.0, 0.0, 0.0], [150.0, 0.0, 0.0], [400.0, 0.0, 0.0]])
    for camera, shown in ((CAMERA, [True] * 3), (BENT, [True] * 3), (FOLDING, [True, False, False])):
        assert np.isfinite(project(wide, ABOVE, camera)).all(axis=1).tolist() == shown


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_slopes_of_the_projection_are_its_differences(camera):
    _, by_pose, by_point = project_with_slopes(POINTS, ABOVE, camera)
    pose = slopes_of(lambda step: project(POINTS, move_pose(ABOVE, step), camera), 7, 1e-6)
    point = slopes_of(lambda step: project(POINTS + step, ABOVE, camera), 3, 1e-6)
    assert np.allclose(pose, by_pose, rtol=1e-5, atol=1e-4) and np.allclose(point, by_point, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("surface", [None, lambda there: 0.2 * there[:, 0] - 0.1 * there[:, 1]])
def test_slopes_of_the_ground_are_its_differences(surface):
    pixels = np.array([[200.0, 100.0], [1500.0, 900.0]])
    _, by_pose, by_pixel = ground_with_slopes(ABOVE, BENT, pixels, 0.5, surface)
    pixel = slopes_of(lambda step: ground_with_slopes(ABOVE, BENT, pixels + step, 0.5, surface)[0], 2, 1e-4)
    pose = slopes_of(lambda step: ground_with_slopes(move_pose(ABOVE, step), BENT, pixels, 0.5, surface)[0], 7, 1e-5)
    assert np.allclose(pixel, by_pixel, rtol=1e-3, atol=1e-6) and np.allclose(pose, by_pose, rtol=1e-3, atol=1e-3)


def test_a_straight_lens_shows_points_at_unbent_pixels_and_bent_ones_are_the_lens_again():
    pose = replace(ABOVE, focal=1.0)
    seen, straight = (
        project(POINTS, pose, BENT),
        project(POINTS, pose, replace(BENT, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)),
    )
    assert np.allclose(undistort_pixels(seen, BENT), straight, atol=1e-6)
    assert np.allclose(distort_pixels(straight, BENT), seen, atol=1e-6)
    assert np.abs(straight - seen).max() > 1


GRID = Elevation(np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]]), (100.0, 50.0), 2.0)
HOLED = replace(GRID, up_m=np.array([[0.0, 1.0, np.nan], [10.0, 11.0, 12.0]]))


def test_between_four_heights_the_ground_is_bilinear_and_outside_or_beside_a_hole_nothing_is_known():
    places = np.array([[100, 50], [104, 50], [100, 52], [104, 52], [101, 51], [103.5, 50.5]], float)
    assert ground_height(GRID, places) == pytest.approx([0, 2, 10, 12, 5.5, 4.25])
    beyond = np.array([[99.9, 51], [104.1, 51], [102, 49.9], [102, 52.1], [np.nan, 51]])
    assert np.isnan(ground_height(GRID, beyond)).all()
    assert np.isnan(ground_height(HOLED, places)).tolist() == [False, True, False, True, False, True]
