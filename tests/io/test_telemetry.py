"""Telemetry: our own tables read by column name, interpolated in time, never invented."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.types import Telemetry

HEADER = "time_s,altitude_m,speed_m_s\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "telemetry.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_columns_are_found_by_name_whatever_their_order_and_company(tmp_path: Path) -> None:
    text = "\ufeffspeed_m_s, battery, time_s, altitude_m\n5,99,0,20\n\n6,98,0.5,25\n"
    read = read_telemetry(write(tmp_path, text))
    np.testing.assert_array_equal(read.time_s, [0, 0.5])
    np.testing.assert_array_equal(read.altitude_m, [20, 25])
    np.testing.assert_array_equal(read.speed_m_s, [5, 6])


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", ["lacks time_s, altitude_m, speed_m_s", "none"]),
        ("time_s,height,speed_m_s\n0,1,2\n", ["lacks altitude_m", "time_s, height, speed_m_s"]),
        ("time_s;altitude_m;speed_m_s\n0;1;2\n", ["lacks", "time_s;altitude_m;speed_m_s"]),
        (HEADER, ["no rows"]),
        (HEADER + "0,20,5\n1,high,5\n", ["line 3", "altitude_m is 'high'"]),
        (HEADER + "0,20,nan\n", ["line 2", "speed_m_s is 'nan'"]),
        (HEADER + "0,inf,5\n", ["line 2", "altitude_m is 'inf'"]),
        (HEADER + "0,20,-5\n", ["line 2", "speed_m_s is '-5'", "0 or more"]),
        (HEADER + "0,20\n", ["line 2", "speed_m_s is missing"]),
        (HEADER + "0,20,5\n2,20,5\n1,20,5\n", ["line 4", "runs back from 2 to 1"]),
        (HEADER + "0,20,5\n,20,5\n", ["line 3", "time_s is ''"]),
        (HEADER + "0,,\n1,,\n", ["holds a place, an altitude"]),
        (HEADER + "0,20,5\n1e30,20,5\n", ["line 3", "time_s is '1e30'"]),
        ("time_s,speed_m_s\n0,1\n", ["lacks altitude_m"]),
        ("time_s,altitude_m,latitude_deg\n0,20,50\n", ["lacks longitude_deg"]),
        ("time_s,altitude_m,east_m\n0,20,50\n", ["lacks north_m"]),
        (
            "time_s,altitude_m,longitude_deg,latitude_deg,east_m,north_m\n0,20,7,50,0,0\n",
            ["in degrees and in metres", "one kind"],
        ),
        ("time_s,altitude_m,longitude_deg,latitude_deg\n0,20,50,110\n", ["line 2", "latitude_deg is 110", "swapped?"]),
        ("time_s,altitude_m,longitude_deg,latitude_deg\n0,20,190,50\n", ["line 2", "longitude_deg is 190"]),
        ("time_s,altitude_m,pitch_deg\n0,20,195\n", ["line 2", "pitch_deg is '195'", "-180 to 180"]),
        ("time_s,altitude_m,hfov_deg\n0,20,200\n", ["line 2", "hfov_deg is '200'"]),
    ],
)
def test_a_mistake_gets_one_line_with_file_and_place(tmp_path: Path, text: str, wanted: list[str]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as error:
        read_telemetry(path)
    assert "\n" not in str(error.value)
    for part in [str(path), *wanted]:
        assert part in str(error.value)


def _told(flown: Telemetry, time_s: float) -> tuple[float, float]:
    flight = flown.at(time_s)
    assert flight is not None
    return flight.altitude_m, flight.speed_m_s


def test_between_samples_it_is_linear_and_far_outside_nothing_is_known() -> None:
    flown = Telemetry(np.array([1.0, 3.0]), np.array([20.0, 40.0]), np.array([4.0, 8.0]))
    assert _told(flown, 1.5) == (25, 5)
    assert _told(flown, 3) == (40, 8)
    assert _told(flown, 0.5) == (20, 4)
    assert _told(flown, 3.9) == (40, 8)
    assert flown.at(4.1) is None
    assert flown.at(-0.1) is None
    assert flown.at(0.5, tolerance_s=0.1) is None


def test_every_column_of_ours_comes_back_in_the_records_units(tmp_path: Path) -> None:
    header = (
        "time_s,altitude_m,speed_m_s,longitude_deg,latitude_deg,above_sea_m,heading_deg,pitch_deg,roll_deg,hfov_deg,"
        "vehicle_heading_deg\n"
    )
    read = read_telemetry(write(tmp_path, header + "0,50,4,11.5,48.1,560,-90,60,-3,70,270\n"), clock_offset_s=2.5)
    assert read.time_s.tolist() == [2.5] and read.geographic
    assert read.place.tolist() == [[11.5, 48.1]]
    assert (read.altitude_m[0], read.speed_m_s[0], read.above_sea_m[0]) == (50, 4, 560)
    angles = [read.heading_rad, read.pitch_rad, read.roll_rad, read.hfov_rad, read.vehicle_heading_rad]
    np.testing.assert_allclose(np.degrees(np.ravel(angles)), [270, 60, -3, 70, 270])


def test_local_metres_are_told_from_degrees(tmp_path: Path) -> None:
    read = read_telemetry(write(tmp_path, "time_s,altitude_m,east_m,north_m\n0,50,250,-120\n"))
    assert not read.geographic and read.place.tolist() == [[250, -120]]


def test_the_height_above_the_sea_may_stand_for_that_above_ground(tmp_path: Path) -> None:
    read = read_telemetry(write(tmp_path, "time_s,above_sea_m\n0,560\n1,561\n"))
    assert np.isnan(read.altitude_m).all() and read.above_sea_m.tolist() == [560, 561]
    assert any("no altitude above ground" in note for note in read.notes)


def test_an_empty_cell_is_unknown_and_so_is_what_lies_beside_it(tmp_path: Path) -> None:
    rows = "".join(f"{i},{'' if i == 3 else 20 + i},5\n" for i in range(8))
    read = read_telemetry(write(tmp_path, HEADER + rows))
    assert np.isnan(read.altitude_m).tolist() == [i == 3 for i in range(8)]
    assert [math.isnan(_told(read, t)[0]) for t in (2.0, 2.5, 3.0, 3.5, 4.0)] == [False, True, True, True, False]
    assert _told(read, 3.0)[1] == 5


def test_a_column_that_is_told_more_rarely_goes_on_between_its_samples(tmp_path: Path) -> None:
    rows = "".join(f"{i / 10},{20 + i / 10 if i % 5 == 0 else ''},5\n" for i in range(21))
    read = read_telemetry(write(tmp_path, HEADER + rows))
    np.testing.assert_allclose(read.altitude_m, 20 + np.arange(21) / 10)


def test_rows_without_anything_still_end_what_was_known(tmp_path: Path) -> None:
    rows = "".join(f"{i},20,5\n" for i in range(4)) + "4,,\n5,,\n6,20,5\n"
    assert all(math.isnan(value) for value in _told(read_telemetry(write(tmp_path, HEADER + rows)), 4.5))


def test_a_long_silence_is_a_gap_that_is_noted_and_not_bridged(tmp_path: Path) -> None:
    times = [*range(10), *range(60, 70)]
    read = read_telemetry(write(tmp_path, HEADER + "".join(f"{t},20,5\n" for t in times)))
    assert math.isnan(_told(read, 30)[0]) and _told(read, 9) == (20, 5) and _told(read, 60) == (20, 5)
    (note,) = read.notes
    assert "gap" in note and "9.0 s" in note and "51.0 s" in note


def test_the_speed_left_out_is_that_of_the_places_and_that_is_said(tmp_path: Path) -> None:
    rows = "".join(f"{i / 10:.1f},50,{3 * i / 10 + 1000:.2f},{-4 * i / 10:.2f}\n" for i in range(60))
    read = read_telemetry(write(tmp_path, "time_s,altitude_m,east_m,north_m\n" + rows))
    np.testing.assert_allclose(read.speed_m_s, 5, rtol=1e-3)
    assert any("speed is that of the places" in note for note in read.notes)
    degrees = "".join(f"{i / 10:.1f},50,{179.9999 + i * 1e-5 - 360 * (i > 10):.7f},0.5\n" for i in range(60))
    read = read_telemetry(write(tmp_path, "time_s,altitude_m,longitude_deg,latitude_deg\n" + degrees))
    np.testing.assert_allclose(read.speed_m_s, 1e-4 * 111_320, rtol=2e-3)  # over the date line, too


def test_places_that_stand_still_too_shortly_tell_no_speed(tmp_path: Path) -> None:
    rows = "".join(f"{i / 30:.3f},50,11.500000,48.100000\n" for i in range(4))
    read = read_telemetry(write(tmp_path, "time_s,altitude_m,longitude_deg,latitude_deg\n" + rows))
    assert np.isnan(read.speed_m_s).all() and not read.notes


def test_a_place_of_zero_zero_is_no_fix(tmp_path: Path) -> None:
    rows = "0,50,5,0,0\n1,50,5,0,0\n2,50,5,11.5,48.1\n3,50,5,11.5,48.1\n"
    read = read_telemetry(write(tmp_path, "time_s,altitude_m,speed_m_s,longitude_deg,latitude_deg\n" + rows))
    assert np.isnan(read.place[:2]).all() and np.isfinite(read.place[2:]).all()
    assert any("2 of 4 places are 0, 0" in note for note in read.notes)


def test_an_altitude_below_ground_is_noted_with_its_line(tmp_path: Path) -> None:
    read = read_telemetry(write(tmp_path, HEADER + "0,20,5\n1,-12,5\n2,-1,5\n"))
    assert any("line 3" in note and "-12 m" in note and "below the ground" in note for note in read.notes)
    assert read.altitude_m.tolist() == [20, -12, -1]


def _turning(first_deg: float, last_deg: float) -> Telemetry:
    angle = np.radians([first_deg, last_deg])
    return replace(
        Telemetry(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2)),
        heading_rad=angle,
        vehicle_heading_rad=angle,
        roll_rad=(angle + np.pi) % (2 * np.pi) - np.pi,
        place=np.array([[179.9, 10.0], [-179.9, 11.0]]),
    )


@pytest.mark.parametrize(("first", "last", "middle"), [(350, 20, 5), (20, 350, 5), (170, 200, 185), (0, 90, 45)])
def test_angles_and_longitudes_go_the_short_way_round(first: float, last: float, middle: float) -> None:
    flight = _turning(first, last).at(0.5)
    assert flight is not None
    assert math.degrees(flight.heading_rad) == pytest.approx(middle)
    assert math.degrees(flight.vehicle_heading_rad) == pytest.approx(middle)
    assert math.degrees(flight.roll_rad) % 360 == pytest.approx(middle) and abs(flight.roll_rad) <= math.pi
    assert abs(flight.place[0]) == pytest.approx(180) and flight.place[1] == pytest.approx(10.5)


def test_local_metres_are_not_taken_for_longitudes() -> None:
    flown = replace(_turning(0, 0), place=np.array([[900.0, 0.0], [1100.0, 10.0]]), geographic=False)
    flight = flown.at(0.25)
    assert flight is not None and flight.place == (950, 2.5)


def test_what_is_not_said_stays_unknown() -> None:
    flight = Telemetry(np.array([1.0, 3.0]), np.array([20.0, 40.0]), np.array([4.0, 8.0])).at(2.0)
    assert flight is not None
    unknown = [*flight.place, flight.above_sea_m, flight.heading_rad, flight.pitch_rad, flight.roll_rad]
    assert np.isnan([*unknown, flight.hfov_rad, flight.vehicle_heading_rad]).all()


@pytest.mark.parametrize(("from_s", "to_s", "good"), [(50, 60, False), (-60, -50, False), (14, 20, True), (5, 6, True)])
def test_whether_telemetry_covers_a_clip_is_told_with_both_spans(from_s: float, to_s: float, good: bool) -> None:
    flown = Telemetry(np.array([from_s, to_s], float), np.zeros(2), np.zeros(2))
    if good:
        flown.check_overlap(15.0)
    else:
        with pytest.raises(InputError, match=rf"covers {from_s:.1f} to {to_s:.1f} s, the clip 0.0 to 15.0 s"):
            flown.check_overlap(15.0)


def test_no_samples_cover_no_clip() -> None:
    with pytest.raises(InputError, match="no samples"):
        Telemetry(np.zeros(0), np.zeros(0), np.zeros(0)).check_overlap(15.0)


# -- tables of other programs ------------------------------------------------------------------------------------------


def test_a_flight_log_of_dated_rows_is_read_by_its_columns_names(tmp_path: Path) -> None:
    text = (
        "frame,timestamp,fnum,focal_len,latitude,longitude,rel_alt,abs_alt\n"
        "0,2022-10-07 17:52:13.500,2.8,24.0,37.38892,126.66295,146.0,94.465\n"
        "1,2022-10-07 17:52:14.000,2.8,24.0,37.38893,126.66295,147.0,95.465\n"
    )
    read = read_telemetry(write(tmp_path, text))
    np.testing.assert_allclose(read.time_s, [0, 0.5])
    assert read.altitude_m.tolist() == [146, 147] and read.above_sea_m.tolist() == [94.465, 95.465]
    assert read.place[0].tolist() == [126.66295, 37.38892]
    assert math.degrees(read.hfov_rad[0]) == pytest.approx(73.74, abs=0.01)
    assert math.isnan(read.start_utc_s)  # the zone is not told


def test_units_in_the_names_of_columns_are_converted(tmp_path: Path) -> None:
    text = (
        "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),speed(mph),"
        "compass_heading(degrees),gimbal_heading(degrees),gimbal_pitch(degrees),altitude(feet),altitude_above_seaLevel(feet)\n"
        "100,2021-05-01 10:00:00,48.1,11.5,164.042,10,90,350,-60,9,1640.42\n"
        "600,2021-05-01 10:00:00,48.1,11.5,164.042,10,90,350,-60,9,1640.42\n"
    )
    read = read_telemetry(write(tmp_path, text))
    np.testing.assert_allclose(read.time_s, [0, 0.5])
    np.testing.assert_allclose([read.altitude_m[0], read.above_sea_m[0]], [50, 500], atol=1e-3)
    np.testing.assert_allclose(read.speed_m_s[0], 4.4704)
    degrees = np.degrees([read.vehicle_heading_rad[0], read.heading_rad[0], read.pitch_rad[0]])
    np.testing.assert_allclose(degrees, [90, 350, 60])


def test_columns_with_their_groups_before_the_names_are_read(tmp_path: Path) -> None:
    text = (
        "OSD.flyTime [s],OSD.latitude,OSD.longitude,OSD.height [ft],OSD.hSpeed [MPH],OSD.yaw [360],GIMBAL.pitch,"
        "GIMBAL.yaw [360]\n0.0,48.1,11.5,164.042,10,90,-60,80\n0.5,48.1,11.5,164.042,10,90,-60,80\n"
    )
    read = read_telemetry(write(tmp_path, text))
    assert read.time_s.tolist() == [0, 0.5] and read.altitude_m[0] == pytest.approx(50, abs=1e-3)
    degrees = np.degrees([read.vehicle_heading_rad[0], read.heading_rad[0], read.pitch_rad[0]])
    np.testing.assert_allclose(degrees, [90, 80, 60])


def test_a_table_of_other_columns_in_utc_tells_the_clock(tmp_path: Path) -> None:
    text = "timestamp,lat,lon,alt\n2021-05-01T10:00:00Z,48.1,11.5,500\n2021-05-01T10:00:01Z,48.1,11.5,500\n"
    read = read_telemetry(write(tmp_path, text), clock_offset_s=-3.0)
    assert read.start_utc_s == pytest.approx(1_619_863_200 + 3) and read.time_s.tolist() == [-3, -2]


def test_a_table_that_counts_frames_needs_its_clip(tmp_path: Path) -> None:
    path = write(tmp_path, "frame,latitude,longitude,rel_alt\n1,48.1,11.5,50\n6,48.1,11.5,55\n")
    with pytest.raises(InputError, match=r"has frames.*give its clip"):
        read_telemetry(path)
    clip = tmp_path / "pictures"
    clip.mkdir()
    for number in range(3):
        cv2.imwrite(str(clip / f"{number}.png"), np.zeros((32, 32), np.uint8))
    np.testing.assert_allclose(read_telemetry(path, clip=clip).time_s, [0, 0.5])  # 10 images a second
