"""Positions as they were written, and one line for each mistake."""

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.position_tables import read_positions

HEADER = "frame,target,east_m,north_m,var_east_m2,cov_east_north_m2,var_north_m2,score"
PLACES = "frame,target,east_m,north_m,longitude_deg,latitude_deg"


@pytest.fixture
def table(tmp_path):
    def write(text):
        path = tmp_path / "positions.csv"
        path.write_text(text)
        return path

    return write


def test_rows_are_sorted_by_frame_and_unknown_covariances_are_nan(table):
    found = read_positions(table(HEADER + "\n2,7,1.5,-2,0.1,0.02,0.3,0.5\n\n1,8,3,4,,,,1\n"))
    assert found.frame.tolist() == [1, 2] and found.target.tolist() == [8, 7]
    assert found.east_north_m.tolist() == [[3, 4], [1.5, -2]]
    assert np.isnan(found.covariance_m2[0]).all()
    assert found.covariance_m2[1].tolist() == [[0.1, 0.02], [0.02, 0.3]]
    assert found.score.tolist() == [1, 0.5] and found.lonlat_deg is None


def test_the_places_alone_are_enough(table):
    found = read_positions(table(PLACES + "\n1,1,0,0,10,50\n"))
    assert np.isnan(found.covariance_m2).all() and found.score.tolist() == [1]
    assert found.lonlat_deg is not None and found.lonlat_deg.tolist() == [[10, 50]]


def test_degrees_that_no_row_has_are_none(table):
    assert read_positions(table(PLACES + "\n1,1,0,0,,\n")).lonlat_deg is None


def test_a_covariance_of_a_line_survives_its_rounding(table):
    # Written with four decimals, as `dddas locate` does, 9.9999 * 0.0001 is a little less than 0.0317 squared.
    assert len(read_positions(table(HEADER + "\n1,1,0,0,9.9999,0.0317,0.0001,1\n"))) == 1


def test_a_table_without_rows_is_valid(table):
    assert len(read_positions(table(HEADER + "\n"))) == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame,target,east_m\n", "lacks north_m; its columns are frame, target, east_m"),
        (HEADER + "\n1,1,x,0,1,0,1,1\n", "line 2: east_m is 'x'; wanted a number from"),
        (HEADER + "\n1,1.5,0,0,1,0,1,1\n", "line 2: target is '1.5'; wanted a whole number from 1"),
        (HEADER + "\n2,1,0,0,1,0,1,1\n1,1,0,0,-1,0,1,1\n", "line 3: -1, 0, 1 are no variances"),
        (HEADER + "\n1,1,0,0,1,5,1,1\n", "line 2: 1, 5, 1 are no variances"),
        (PLACES + "\n1,1,0,0,10,95\n", "line 2: latitude_deg is '95'; wanted a number from -90 to 90"),
        (PLACES + "\n2,1,0,0,10,50\n1,1,0,0,,\n", "line 3: no longitude_deg or latitude_deg, which other rows"),
    ],
)
def test_a_mistake_is_named(table, text, words):
    with pytest.raises(InputError, match=words):
        read_positions(table(text))
