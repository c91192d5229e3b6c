import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.io.ground import positions, tracks
from torchvision_dddas import geometry
from torchvision_dddas.io.maps.ellipses import (
    CHI2_95,
    cut_line,
    degrees_per_metre,
    ring_about,
    ring_m,
    semi_axes,
)
from torchvision_dddas.io.maps.ground_tracks import ellipse_rows


def test_an_ellipse_lies_along_its_larger_variance_clockwise_from_north():
    axes, bearing = semi_axes(np.array([[[4, 0], [0, 1.0]], [[1, 0], [0, 4]], [[2.5, 1.5], [1.5, 2.5]]]), chi2=1)
    assert np.allclose(axes, [2, 1])
    assert np.allclose(np.degrees(bearing), [90, 0, 45])


@given(st.floats(0.1, 9), st.floats(0.1, 9), st.floats(-0.95, 0.95))
def test_every_point_of_the_ring_is_as_unlikely(east, north, correlation):
    both = correlation * np.sqrt(east * north)
    covariance = np.array([[east, both], [both, north]])
    ring = ring_m(*semi_axes(covariance[None]))[0]
    assert np.allclose(np.einsum("ki,ij,kj->k", ring, np.linalg.inv(covariance), ring), CHI2_95)


def test_95_of_100_errors_lie_in_the_ellipse():
    covariance = np.array([[3.0, 1.2], [1.2, 1.0]])
    error = np.random.default_rng(4).multivariate_normal((0, 0), covariance, 20_000)
    inside = (error @ np.linalg.inv(covariance) * error).sum(axis=1) <= CHI2_95
    assert abs(inside.mean() - 0.95) < 0.006


def test_a_covariance_that_is_a_line_or_unknown_gives_no_wrong_number():
    axes, bearing = semi_axes(np.array([[[1, 1], [1, 1.0]], [[np.nan] * 2] * 2]))
    assert axes[0, 1] == pytest.approx(0, abs=1e-7) and np.degrees(bearing[0]) == pytest.approx(45)
    assert np.isnan(axes[1]).all()


@pytest.mark.parametrize("origin", [(10.0, 0.0), (-110.95, 32.23), (20.0, -70.0)])
def test_rings_in_degrees_are_those_of_the_ellipsoid(origin):
    ring = ring_m(np.array([[60.0, 30.0]]), np.array([0.7]))[0]
    (found,) = ring_about(np.array(origin), ring)
    assert found[0] == found[-1] and len(found) == len(ring) + 1
    back = geometry.east_north(np.array(found[:-1]), origin)
    assert np.abs(back - ring).max() < 0.002


@pytest.mark.parametrize("latitude", [0.0, 45.0, -80.0])
def test_degrees_per_metre_are_those_of_the_ellipsoid(latitude):
    found = geometry.lonlat(np.array([[1.0, 0], [0, 1]]), (0.0, latitude))
    assert np.allclose(np.diag(found - (0, latitude)), degrees_per_metre(latitude), rtol=1e-6)


@pytest.mark.parametrize("longitude", [180.0, 179.9999, -179.9999, -180.0])
def test_a_ring_over_180_degrees_is_cut_into_two_closed_anticlockwise_ones(longitude):
    ring = ring_m(np.array([[60.0, 30.0]]), np.array([0.7]))[0]
    rings = ring_about(np.array([longitude, -17.0]), ring)
    assert len(rings) == 2
    areas = [_area(np.array(r)) for r in rings]
    (whole,) = ring_about(np.array([10.0, -17.0]), ring)
    assert min(areas) > 0 and sum(areas) == pytest.approx(_area(np.array(whole)), rel=1e-3)
    for part in rings:
        assert part[0] == part[-1]
        longitudes = np.array(part)[:, 0]
        assert np.abs(longitudes).max() == 180 and np.ptp(longitudes) < 0.01


def _area(ring):
    x, y = (ring - ring[0]).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2)


def test_a_ring_around_a_pole_is_left_out():
    ring = ring_m(np.array([[60.0, 30.0]]), np.array([0.7]))[0]
    for latitude in (90.0, -90.0, 89.9995):
        assert ring_about(np.array([12.0, latitude]), ring) == []
    assert ring_about(np.array([np.nan, np.nan]), ring) == []


def test_a_line_is_cut_each_time_it_goes_over_180_degrees():
    lines = cut_line([[179.0, 0.0], [-179.0, 2.0], [179.0, 4.0]])
    assert lines == [
        [[179.0, 0.0], [180.0, 1.0]],
        [[-180.0, 1.0], [-179.0, 2.0], [-180.0, 3.0]],
        [[180.0, 3.0], [179.0, 4.0]],
    ]


def test_ellipses_are_shown_once_a_second_and_at_the_last_place():
    found = tracks([positions(frame, [[0, 0]]) for frame in range(1, 36)])
    assert found.frame[ellipse_rows(found)].tolist() == [1, 11, 21, 31, 35]
    assert found.frame[ellipse_rows(found, most=2)].tolist() == [1, 18, 35]


def test_without_times_or_with_unknown_errors_only_what_is_known_is_ellipse_rows():
    untimed = tracks([positions(frame, [[0, 0]]) for frame in (1, 2, 3)], timed=False)
    assert untimed.frame[ellipse_rows(untimed)].tolist() == [3]
    unknown = tracks([positions(1, [[0, 0]], np.full((2, 2), np.nan))])
    assert len(ellipse_rows(unknown)) == 0
