"""What boxes share."""

import numpy as np

from torchvision_dddas.geometry import shared_px


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
