"""Landmarks and positions from CSV: what a table means, and one line for each mistake."""

import numpy as np
import pytest

from torchvision_dddas.geo.site import looks_swapped
from torchvision_dddas.io.ground_tables import read_landmarks, read_positions

HEADER = "frame,landmark,longitude_deg,latitude_deg\n"
METRES = "frame,landmark,east_m,north_m"
BOTH = HEADER[:-1] + ",east_m,north_m\n"


@pytest.fixture
def table(tmp_path):
    def write(text):
        path = tmp_path / "landmarks.csv"
        path.write_text(text)
        return path

    return write


def test_rows_are_sorted_by_frame_and_names_are_as_they_first_appear(table):
    found = read_landmarks(table(HEADER + "2,rover,-110.95,32.23\n1,7,-110.951,32.23\n1,rover,-110.95,32.231\n"))
    assert (found.names, found.geographic, len(found)) == (("rover", "7"), True, 3)
    assert (found.frame.tolist(), found.landmark.tolist(), found.line.tolist()) == ([1, 1, 2], [1, 0, 0], [3, 4, 2])
    assert found.place[1].tolist() == [-110.95, 32.231]
    assert np.isnan(found.image_px).all() and np.isnan(found.sigma_m).all() and not found.planned.any()


def test_metres_pictures_sigmas_and_plans_are_read_and_further_columns_are_not(table):
    rows = "1,a,3,4,10.5,20,0.5,0,9\n5,a,6,8,,,,1,x\n5,a,nan,,,,,,\n"
    found = read_landmarks(table(f"{METRES},u_px,v_px,sigma_m,planned,battery\n{rows}"))
    assert not found.geographic and found.place[:2].tolist() == [[3, 4], [6, 8]]
    assert np.isnan(found.place[2]).all()  # a dropout
    assert found.image_px[0].tolist() == [10.5, 20] and np.isnan(found.image_px[1:]).all()
    assert found.sigma_m[0] == 0.5 and np.isnan(found.sigma_m[1]) and found.planned.tolist() == [False, True, False]


def test_times_become_frames_whole_ones_where_the_picture_shows_it(table):
    text = "time_s,landmark,east_m,north_m,u_px,v_px\n-2,a,0,0,,\n0,a,0,0,,\n0.5,a,0,0,,\n0.51,a,0,0,,\n"
    assert read_landmarks(table(text), rate_hz=25.0, clock_offset_s=2.0).frame.tolist() == pytest.approx(
        [1, 51, 63.5, 63.75]
    )
    seen = "time_s,landmark,east_m,north_m,u_px,v_px\n0.033,a,0,0,1,1\n0.067,a,0,0,,\n"
    assert read_landmarks(table(seen), rate_hz=30.0).frame.tolist() == pytest.approx([2, 3.01])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "lacks frame or time_s, landmark, longitude_deg,latitude_deg (or east_m,north_m); its columns are none"),
        ("frame,longitude_deg,latitude_deg\n", "lacks landmark; its columns are frame, longitude_deg, latitude_deg"),
        (f"{METRES},u_px\n", "lacks v_px; its columns"),
        (HEADER, "has a header but no rows"),
        (f"time_s,{METRES}\n", "has both frame and time_s"),
        ("time_s,landmark,east_m,north_m\n0,a,0,0\n", "has times (time_s); pass --rate"),
        (HEADER + "1,a,1,1\n1,b,x,1\n", "line 3: longitude_deg is 'x'; wanted a number"),
        (HEADER + "1.5,a,1,1\n", "line 2: frame is '1.5'; wanted a whole number from 1; between two pictures, give"),
        (HEADER + "1,,1,1\n", "line 2: landmark is empty; give its name or number"),
        (HEADER + "1,a,32.23,-110.95\n", "line 2: latitude_deg is '-110.95'; wanted -90 to 90; longitude and latitude"),
        (HEADER + "1,a,500123,3566000\n", "wanted -90 to 90; if these are metres, name the columns east_m,north_m"),
        (HEADER + "1,a,1,\n", "line 2: longitude_deg alone; wanted longitude_deg and latitude_deg, or neither"),
        (HEADER + "1,a,1,1\n1,a,1,1\n", "line 3: a is in frame 1 already, by line 2; give each landmark once"),
        (HEADER + "1,a,1,1\n2,a,1,1\n3,a,1,2\n", "line 4: 1, 2 lies 111 km from most others"),
        (HEADER + "1,a,1,1\n2,a,1,1\n3,a,0,0\n", "a receiver without a fix reports 0, 0: leave it empty"),
        (BOTH + "1,a,1,1,,\n2,a,,,1,1\n", "line 2 has its place in degrees, line 3 in metres; give one kind"),
        (BOTH + "1,a,,,,\n2,a,1,1,1,1\n", "line 3: the row has a place in degrees and in metres"),
        (f"{METRES},sigma_m\n1,a,0,0,-1\n", "line 2: sigma_m is '-1'; wanted a number from 0 to 100000"),
        (f"{METRES},planned\n1,a,0,0,0.5\n", "line 2: planned is '0.5'; wanted 0 or 1"),
        (f"{METRES},planned\n1,a,,,1\n", "line 2: planned is 1 but there is no place"),
        (f"{METRES},planned,u_px,v_px\n1,a,0,0,1,5,5\n", "line 2: planned is 1 and there is a u_px"),
    ],
)
def test_a_mistake_in_landmarks_is_one_clear_line(refused, text, words):
    line = refused(read_landmarks, text)
    assert words in line and line.startswith("landmarks ")


def test_a_waypoint_beside_a_report_and_places_about_180_degrees_are_no_mistakes(table):
    found = read_landmarks(table(f"{METRES},planned\n1,a,0,0,0\n1,a,1,1,1\n"))
    assert found.planned.tolist() == [False, True]
    about = "1,a,179.9999,1\n1,b,-179.9999,1\n1,c,179.9998,1\n1,d,-179.9998,1\n"
    assert len(read_landmarks(table(HEADER + about))) == 4


@pytest.mark.parametrize("near", [(12.5, 47.3), (-0.1, 51.5), (45.0, 45.1)])
def test_swapped_longitude_and_latitude_are_seen_by_a_place_that_is_near(table, near):
    longitude, latitude = near
    rows = "1,a,{0:.4f},{1:.4f}\n1,b,{2:.4f},{1:.4f}\n"
    right = read_landmarks(table(HEADER + rows.format(longitude, latitude, longitude + 1e-3)))
    wrong = read_landmarks(table(HEADER + rows.format(latitude, longitude, latitude + 1e-3)))
    assert looks_swapped(wrong, near) and not looks_swapped(right, near)
    assert not looks_swapped(wrong, (float("nan"), float("nan")))
    assert not looks_swapped(wrong, (-60.0, -30.0))  # far from either: no word on swapping


LOCATED = "frame,target,east_m,north_m,var_east_m2,cov_east_north_m2,var_north_m2,score"
PLACES = "frame,target,east_m,north_m,longitude_deg,latitude_deg"


def test_positions_are_sorted_by_frame_and_what_is_not_there_is_unknown(table):
    found = read_positions(table(LOCATED + "\n2,7,1.5,-2,0.1,0.02,0.3,0.5\n\n1,8,3,4,,,,1\n"))
    assert found.frame.tolist() == [1, 2] and found.target.tolist() == [8, 7]
    assert found.east_north_m.tolist() == [[3, 4], [1.5, -2]] and found.score.tolist() == [1, 0.5]
    assert np.isnan(found.covariance_m2[0]).all() and found.lonlat_deg is None
    assert found.covariance_m2[1].tolist() == [[0.1, 0.02], [0.02, 0.3]]
    places = read_positions(table(PLACES + "\n1,1,0,0,10,50\n"))
    assert np.isnan(places.covariance_m2).all() and places.score.tolist() == [1]
    assert places.lonlat_deg is not None and places.lonlat_deg.tolist() == [[10, 50]]
    assert read_positions(table(PLACES + "\n1,1,0,0,,\n")).lonlat_deg is None
    # Written with four decimals, as `dddas locate` does, 9.9999 * 0.0001 is a little less than 0.0317 squared.
    assert len(read_positions(table(LOCATED + "\n1,1,0,0,9.9999,0.0317,0.0001,1\n"))) == 1
    assert len(read_positions(table(LOCATED + "\n"))) == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (LOCATED + "\n2,1,0,0,1,0,1,1\n1,1,0,0,-1,0,1,1\n", "line 3: -1, 0, 1 are not the variances"),
        (LOCATED + "\n1,1,0,0,1,5,1,1\n", "line 2: 1, 5, 1 are not the variances"),
        (PLACES + "\n1,1,0,0,10,95\n", "line 2: latitude_deg is '95'; wanted a number from -90 to 90"),
        (PLACES + "\n2,1,0,0,10,50\n1,1,0,0,,\n", "line 3: no longitude_deg or latitude_deg, which other rows"),
    ],
)
def test_a_mistake_in_positions_is_one_clear_line(refused, text, words):
    assert words in refused(read_positions, text)
