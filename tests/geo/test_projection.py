"""The camera in the air: its axes, where it shows a point, and the ray back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.airborne import CAMERA
from torchvision_dddas.geo.pose_estimation import move_pose
from torchvision_dddas.geo.projection import (
    axes_of,
    distort_pixels,
    ground_with_slopes,
    project,
    project_with_slopes,
    rays,
    undistort_pixels,
)
from torchvision_dddas.geometry import turn_of, turned
from torchvision_dddas.types import CameraPose

BENT = replace(CAMERA, k1=-0.2, k2=0.05, focal_px=(1400.0, 1380.0))
POINTS = np.array([[5.0, 8.0, 0.0], [-7.0, 3.0, 1.5], [1.0, -6.0, 0.0], [12.0, 9.0, -2.0]])
ABOVE = CameraPose(np.array([2.0, -3.0, 50.0]), axes_of(0.7, 1.3, 0.1), 1.02)


def test_a_level_camera_that_looks_north_has_east_on_its_right_and_the_ground_below():
    assert np.allclose(axes_of(0, 0, 0), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T)


@given(st.floats(0, 6.2), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_angles_come_back_from_axes(heading, pitch, roll):
    axes = axes_of(heading, pitch, roll)
    assert np.allclose(axes_of(*CameraPose(np.zeros(3), axes).angles_rad), axes, atol=1e-8)


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_the_ray_through_where_a_point_is_shown_meets_the_point(camera):
    way = rays(project(POINTS, ABOVE, camera), ABOVE, camera)
    apart = POINTS - ABOVE.place_m
    assert np.allclose(np.cross(way, apart), 0, atol=1e-6)
    assert ((way * apart).sum(axis=1) > 0).all()


def test_a_point_beyond_the_bend_of_the_lens_is_shown_nowhere():
    wide = np.array([[30.0, 0.0, 0.0], [150.0, 0.0, 0.0], [400.0, 0.0, 0.0]])
    assert np.isfinite(project(wide, ABOVE, CAMERA)).all()
    assert np.isfinite(project(wide, ABOVE, BENT)).all()
    folding = replace(CAMERA, k1=-0.3, k2=0.02)
    assert np.isfinite(project(wide, ABOVE, folding))[:, 0].tolist() == [True, False, False]


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_slopes_of_the_projection_are_its_differences(camera):
    _, by_pose, by_point = project_with_slopes(POINTS, ABOVE, camera)
    for axis, step in enumerate(1e-6 * np.eye(7)):
        there, back = (project(POINTS, move_pose(ABOVE, sign * step), camera) for sign in (1, -1))
        assert np.allclose((there - back) / 2e-6, by_pose[:, :, axis], rtol=1e-5, atol=1e-4)
    for axis, step in enumerate(1e-6 * np.eye(3)):
        there, back = (project(POINTS + sign * step, ABOVE, camera) for sign in (1, -1))
        assert np.allclose((there - back) / 2e-6, by_point[:, :, axis], rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("surface", [None, lambda there: 0.2 * there[:, 0] - 0.1 * there[:, 1]])
def test_slopes_of_the_ground_are_its_differences(surface):
    pixels = np.array([[200.0, 100.0], [1500.0, 900.0]])

    def ground(pose, at):
        return ground_with_slopes(pose, BENT, at, 0.5, surface)[0]

    _, by_pose, by_pixel = ground_with_slopes(ABOVE, BENT, pixels, 0.5, surface)
    for axis, step in enumerate(1e-4 * np.eye(2)):
        apart = ground(ABOVE, pixels + step) - ground(ABOVE, pixels - step)
        assert np.allclose(apart / 2e-4, by_pixel[:, :, axis], rtol=1e-3, atol=1e-6)
    for axis, step in enumerate(1e-5 * np.eye(7)):
        apart = ground(move_pose(ABOVE, step), pixels) - ground(move_pose(ABOVE, -step), pixels)
        assert np.allclose(apart / 2e-5, by_pose[:, :, axis], rtol=1e-3, atol=1e-3)


@given(st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3))
def test_a_turn_comes_back_from_its_rotation(vector):
    assert np.allclose(turn_of(turned(np.array(vector))), vector, atol=1e-7)


def test_a_straight_lens_shows_points_at_unbent_pixels_and_bent_ones_are_the_lens_again():
    seen = project(POINTS, ABOVE, BENT)
    straight = project(POINTS, replace(ABOVE, focal=1.0), replace(BENT, k1=0.0, k2=0.0))
    found = undistort_pixels(project(POINTS, replace(ABOVE, focal=1.0), BENT), BENT)
    assert np.allclose(found, straight, atol=1e-6)
    assert np.allclose(distort_pixels(undistort_pixels(seen, BENT), BENT), seen, atol=1e-6)
    assert np.abs(undistort_pixels(seen, BENT) - seen).max() > 1
