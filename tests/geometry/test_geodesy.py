"""Degrees to metres and back."""

import numpy as np
import pymap3d
import pytest

from torchvision_dddas.geometry import east_north, lonlat, plain_east_north, plain_lonlat

TUCSON = (-110.95, 32.23)


def test_many_points_are_converted_there_and_back_as_one_after_the_other_and_as_pymap3d_does():
    metres = np.random.default_rng(1).uniform(-5000, 5000, (40_001, 2))
    degrees = lonlat(metres, TUCSON)
    latitude, longitude, _ = pymap3d.enu2geodetic(metres[:, 0], metres[:, 1], 0, TUCSON[1], TUCSON[0], 0)
    assert np.abs(degrees - np.stack([longitude, latitude], 1)).max() < 1e-12
    back = east_north(degrees, TUCSON)
    near = np.linalg.norm(metres, axis=1) < 1500
    assert np.abs(back - metres)[near].max() < 1e-3
    for row in (0, 16_383, 16_384, 40_000):
        assert np.abs(lonlat(metres[row : row + 1], TUCSON)[0] - degrees[row]).max() < 1e-12
        assert np.abs(east_north(degrees[row : row + 1], TUCSON)[0] - back[row]).max() < 1e-6


@pytest.mark.parametrize("there_and_back", [(lonlat, east_north), (plain_lonlat, plain_east_north)])
@pytest.mark.parametrize("origin", [(179.9999, -17.0), (-179.9999, 89.0)])
def test_places_on_both_sides_of_180_degrees_are_neighbours(there_and_back, origin):
    to_degrees, to_metres = there_and_back
    metres = np.array([[-50.0, 3.0], [50.0, -3.0]])
    degrees = to_degrees(metres, origin)
    assert (np.abs(degrees[:, 0]) <= 180).all() and np.sign(degrees[:, 0]).sum() == 0
    assert np.allclose(to_metres(degrees, origin), metres, atol=1e-3)


def test_the_plain_conversion_is_as_printed_and_some_decimetres_off_in_150_m():
    metres = np.array([[0.0, 150.0], [150.0, 0.0]])
    there = plain_lonlat(metres, np.array(TUCSON))
    step = 150 / 111_320
    assert np.allclose(there - TUCSON, [[0, step], [step / np.cos(np.radians(32.23)), 0]], atol=1e-12)
    assert 0.1 < np.linalg.norm(east_north(there[:1], TUCSON) - (0, 150)) < 0.6
    assert np.allclose(plain_east_north(there, TUCSON), metres)
