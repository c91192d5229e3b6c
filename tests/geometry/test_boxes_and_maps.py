"""What boxes share, where a sparse mask is set, and homographies on points."""

import numpy as np
import pytest

from torchvision_dddas.geometry import background_flow, chain, corner_error, occupied, shared_px, transfer


def test_boxes_share_the_area_that_lies_in_both_and_every_box_is_compared_with_every_other() -> None:
    box, other = np.array([0.0, 0, 10, 10]), np.array([[5.0, 8, 10, 10], [10, 0, 5, 5], [20, 20, 3, 3], [2, 3, 4, 5]])
    assert shared_px(box, other).tolist() == [10, 0, 0, 20]
    each = [[shared_px(one, two) for two in other] for one in other]
    assert np.array_equal(shared_px(other[:, None], other), each)


@pytest.mark.parametrize("apart", [2, 30, 50])
def test_boxes_hold_every_pixel_once_and_far_enough_from_their_border(apart: int) -> None:
    rng = np.random.default_rng(apart)
    for _ in range(12):
        mask = np.zeros(tuple(rng.integers(5, 300, 2)), np.uint8)
        mask[rng.integers(0, mask.shape[0], 6), rng.integers(0, mask.shape[1], 6)] = 255
        owner = np.zeros(mask.shape, int)
        for x, y, width, height in occupied(mask, apart):
            owner[y : y + height, x : x + width] += 1
            held = np.nonzero(mask[y : y + height, x : x + width])
            for at, start, size, whole in zip(held, (y, x), (height, width), mask.shape, strict=True):
                assert at.min() >= apart / 2 or start == 0
                assert size - 1 - at.max() >= apart / 2 or start + size == whole
        assert owner.max(initial=0) <= 1 and (owner[mask > 0] == 1).all()


SHIFT = np.array([[1, 0, 3], [0, 1, -4], [0, 0, 1.0]])
TILT = np.array([[1.02, 0.01, 5], [-0.02, 0.99, 2], [1e-4, -2e-4, 1]])


def test_transfer_is_by_hand_and_a_point_on_the_horizon_goes_to_infinity_without_a_warning():
    tilted = np.array([[2, 0, 1], [0, 1, 0], [0, 0.1, 1]])
    np.testing.assert_allclose(transfer(tilted, np.array([[3, 10]])), np.array([[3.5, 5]]))
    assert not np.isfinite(transfer(np.array([[1, 0, 0], [0, 1, 0], [1, 0, 0.0]]), np.array([[0, 5]]))).all()


def test_a_chain_is_one_step_after_the_other():
    points = np.array([[10.0, 20], [300, 200]])
    np.testing.assert_allclose(transfer(chain([TILT, SHIFT]), points), transfer(SHIFT, transfer(TILT, points)))
    np.testing.assert_array_equal(chain([]), np.eye(3))
    assert chain([TILT] * 40)[2, 2] == pytest.approx(1)


def test_background_flow_and_corner_error_of_a_shift_are_its_length():
    assert background_flow(SHIFT, (101, 67)) == corner_error(SHIFT, np.eye(3), (101, 67)) == pytest.approx(5)
    assert background_flow(np.eye(3), (101, 67)) == 0
    assert corner_error(np.diag([1.1, 1, 1]), np.eye(3), (101, 67)) == pytest.approx(10)
