"""Looking up the height of the ground."""

import numpy as np
import pytest

from torchvision_dddas.geo.terrain import ground_height
from torchvision_dddas.types import Elevation

GRID = Elevation(np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]]), (100.0, 50.0), 2.0)


def test_between_four_heights_it_is_bilinear():
    places = [[100, 50], [104, 50], [100, 52], [104, 52], [101, 51], [103.5, 50.5]]
    assert ground_height(GRID, np.array(places, float)) == pytest.approx([0, 2, 10, 12, 5.5, 4.25])


def test_outside_the_grid_nothing_is_known():
    places = np.array([[99.9, 51], [104.1, 51], [102, 49.9], [102, 52.1], [np.nan, 51]])
    assert np.isnan(ground_height(GRID, places)).all()


def test_beside_a_hole_nothing_is_known():
    holed = Elevation(np.array([[0.0, 1.0, np.nan], [10.0, 11.0, 12.0]]), (0.0, 0.0), 1.0)
    assert np.isfinite(ground_height(holed, np.array([[0.5, 0.5]]))).all()
    assert np.isnan(ground_height(holed, np.array([[1.5, 0.5]]))).all()
