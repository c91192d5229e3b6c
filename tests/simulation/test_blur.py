"""What moves while the shutter is open is drawn out as far as it moves, and keeps its light and its middle."""

import numpy as np
import pytest

from torchvision_dddas.simulation.cameras import motion_blur


def dot() -> np.ndarray:
    picture = np.zeros((81, 121, 3), np.uint8)
    picture[38:43, 58:63] = 250
    return picture


def spread(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle (u, v) and variances of the light."""
    light = picture[..., 0].astype(float) / picture[..., 0].sum()
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    middle = np.array([(light * u).sum(), (light * v).sum()])
    return middle, np.array([(light * (u - middle[0]) ** 2).sum(), (light * (v - middle[1]) ** 2).sum()])


@pytest.mark.parametrize("way", [(12.0, 0.0), (0.0, -7.5), (9.0, 5.0)])
def test_a_way_common_to_all_draws_out_by_its_length_and_moves_nothing(way):
    blurred = motion_blur(dot(), np.broadcast_to(np.float32(way), (3, 3, 2)))
    (before, own), (after, now) = spread(dot()), spread(blurred)
    assert np.abs(after - before).max() < 0.1
    assert now - own == pytest.approx(np.square(way) / 12, abs=0.6)


def test_where_ways_differ_each_part_is_drawn_out_by_its_own():
    way = np.zeros((3, 3, 2), np.float32)
    way[..., 0] = [0.0, 10.0, 20.0]
    blurred = motion_blur(dot(), way)
    (before, own), (after, now) = spread(dot()), spread(blurred)
    assert np.abs(after - before).max() < 0.6
    assert (now - own)[0] == pytest.approx(100 / 12, rel=0.15)
    assert (now - own)[1] < 0.1
