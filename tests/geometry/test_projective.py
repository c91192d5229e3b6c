"""Homographies on points."""

import numpy as np
import pytest

from torchvision_dddas.geometry import background_flow, chain, corner_error, transfer

SHIFT = np.array([[1, 0, 3], [0, 1, -4], [0, 0, 1.0]])
TILT = np.array([[1.02, 0.01, 5], [-0.02, 0.99, 2], [1e-4, -2e-4, 1]])


def test_transfer_by_hand():
    np.testing.assert_allclose(
        transfer(np.array([[2, 0, 1], [0, 1, 0], [0, 0.1, 1]]), np.array([[3, 10]])), np.array([[3.5, 5]])
    )


def test_there_and_back_is_the_identity():
    points = np.random.default_rng(0).uniform(0, 500, (50, 2))
    np.testing.assert_allclose(transfer(np.linalg.inv(TILT), transfer(TILT, points)), points, atol=1e-9)


def test_a_point_on_the_horizon_goes_to_infinity_without_a_warning():
    assert not np.isfinite(transfer(np.array([[1, 0, 0], [0, 1, 0], [1, 0, 0.0]]), np.array([[0, 5]]))).all()


def test_no_points_give_no_points():
    assert transfer(TILT, np.zeros((0, 2))).shape == (0, 2)


def test_a_chain_is_one_step_after_the_other():
    points = np.array([[10.0, 20], [300, 200]])
    np.testing.assert_allclose(transfer(chain([TILT, SHIFT]), points), transfer(SHIFT, transfer(TILT, points)))
    np.testing.assert_array_equal(chain([]), np.eye(3))
    assert chain([TILT] * 40)[2, 2] == pytest.approx(1)


def test_background_flow_of_a_shift_is_its_length():
    assert background_flow(SHIFT, (101, 67)) == pytest.approx(5)
    assert background_flow(np.eye(3), (101, 67)) == 0


def test_corner_error_is_the_largest_at_the_corners():
    assert corner_error(SHIFT, np.eye(3), (101, 67)) == pytest.approx(5)
    grown = np.diag([1.1, 1, 1])
    assert corner_error(grown, np.eye(3), (101, 67)) == pytest.approx(10)
