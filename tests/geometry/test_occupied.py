"""Where a sparse mask is set."""

import numpy as np
import pytest

from torchvision_dddas.geometry import occupied


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


def test_an_empty_mask_has_no_box() -> None:
    assert occupied(np.zeros((50, 70), np.uint8), 10) == []


def test_a_single_pixel_of_a_block_is_seen() -> None:
    mask = np.zeros((64, 64), np.uint8)
    mask[33, 47] = 255
    assert len(occupied(mask, 2)) == 1
