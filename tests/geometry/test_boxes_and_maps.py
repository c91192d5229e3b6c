"""What boxes share, where a sparse mask is set, and homographies on points."""

import numpy as np
import pytest

from torchvision_dddas.geometry import background_flow, chain, corner_error, occupied, shared_px, transfer


def test_boxes_share_the_area_that_lies_in_both_and_none_where_they_touch_or_lie_apart() -> None:
    box = np.array([0.0, 0, 10, 10])
    other = np.array([[5.0, 8, 10, 10], [10, 0, 5, 5], [20, 20, 3, 3], [2, 3, 4, 5]])
    assert shared_px(box, other).tolist() == [10, 0, 0, 20]


def test_every_box_is_held_against_every_other() -> None:
    a = np.random.default_rng(0).uniform(1, 30, (3, 4))
    b = np.random.default_rng(1).uniform(1, 30, (5, 4))
    table = shared_px(a[:, None], b)
    assert table.shape == (3, 5)
    assert table[2, 4] == shared_px(a[2], b[4]) == shared_px(b[4], a[2])


def scattered(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    mask = np.zeros(tuple(rng.integers(5, 300, 2)), np.uint8)
    mask[rng.integers(0, mask.shape[0], 6), rng.integers(0, mask.shape[1], 6)] = 255
    return mask


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("apart", [2, 30, 50])
def test_boxes_hold_every_pixel_once_and_far_enough_from_their_border(seed: int, apart: int) -> None:
    mask = scattered(seed)
    owner = np.zeros(mask.shape, int)
    for x, y, width, height in occupied(mask, apart):
        owner[y : y + height, x : x + width] += 1
        row, column = np.nonzero(mask[y : y + height, x : x + width])
        assert len(row)
        sides = (
            (column, x),
            (width - 1 - column, mask.shape[1] - x - width),
            (row, y),
            (height - 1 - row, mask.shape[0] - y - height),
        )
        assert all(away.min() >= apart / 2 or rest == 0 for away, rest in sides)
    assert owner.max(initial=0) <= 1 and (owner[mask > 0] == 1).all()


SHIFT = np.array([[1, 0, 3], [0, 1, -4], [0, 0, 1.0]])
TILT = np.array([[1.02, 0.01, 5], [-0.02, 0.99, 2], [1e-4, -2e-4, 1]])


def test_transfer_by_hand():
    np.testing.assert_allclose(
        transfer(np.array([[2, 0, 1], [0, 1, 0], [0, 0.1, 1]]), np.array([[3, 10]])), np.array([[3.5, 5]])
    )


def test_a_point_on_the_horizon_goes_to_infinity_without_a_warning():
    assert not np.isfinite(transfer(np.array([[1, 0, 0], [0, 1, 0], [1, 0, 0.0]]), np.array([[0, 5]]))).all()


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
