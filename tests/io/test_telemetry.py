"""Telemetry tables, own ones and those of other programs, read by column name; values in between, never invented."""

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
PLACED = "time_s,altitude_m,longitude_deg,latitude_deg\n"


def rows(count, row):
    return "".join(f"{row(i)}\n" for i in range(count))


def degrees(flown, *names):
    return [math.degrees(getattr(flown, f"{name}_rad")[0]) for name in names]


def known_at(flown, time_s):
    flight = flown.at(time_s)
    assert flight is not None
    return flight.altitude_m, flight.speed_m_s


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["is not a log", "names none of time_s, altitude_m", "A CSV needs time_s and altitude_m"]),
        (
            "# Surveillance, from the air\n",
            ["is not a log", "a CSV, DJI .SRT,", "altitude_m, or a place"],
        ),
        ("altitude_m,speed_m_s\n5,1\n", ["lacks time_s;", "its columns are altitude_m, speed_m_s"]),
        ("time_s,speed_m_s\n0,1\n", ["lacks altitude_m", "its columns are time_s, speed_m_s"]),
        (HEADER, ["no rows"]),
        (HEADER + "0,20,5\n1,high,5\n", ["line 3", "altitude_m is 'high'"]),
        (HEADER + "0,20,nan\n", ["line 2", "speed_m_s is 'nan'"]),
        (HEADER + "0,20,-5\n", ["line 2", "speed_m_s is '-5'", "0 to 300"]),
        (HEADER + "0,20\n", ["line 2", "speed_m_s is missing"]),
        (HEADER + "0,20,5\n2,20,5\n1,20,5\n", ["line 4", "runs back from 2 to 1"]),
        (HEADER + "0,20,5\n,20,5\n", ["line 3", "time_s is ''"]),
        (HEADER + "0,,\n1,,\n", ["holds a place, an altitude"]),
        ("time_s,altitude_m,latitude_deg\n0,20,50\n", ["lacks longitude_deg"]),
        ("time_s,altitude_m,longitude_deg,latitude_deg,east_m,north_m\n0,20,7,50,0,0\n", ["in degrees and in metres"]),
        (PLACED + "0,20,50,110\n", ["line 2", "latitude_deg is 110", "swapped?"]),
        ("time_s,altitude_m,hfov_deg\n0,20,180\n", ["line 2", "hfov_deg is '180'", "0.05 to 179"]),
        ("time_s,altitude_m,pitch_deg\n0,20,195\n", ["line 2", "pitch_deg is '195'", "-100 to 100"]),
        ("frame,latitude,longitude,rel_alt\n1,48.1,11.5,50\n", ["has frames", "give its clip"]),
        ("date,latitude,longitude\nsoon,48.1,11.5\n", ["line 2: 'soon' is not a time"]),
    ],
)
def test_a_mistake_gets_one_line_with_file_and_place(refused, text, words):
    line = refused(read_telemetry, text)
    assert all(part in line for part in words)


def test_every_column_comes_back_in_the_records_units(fly):
    header = PLACED[:-1] + ",speed_m_s,above_sea_m,heading_deg,pitch_deg,roll_deg,hfov_deg,vehicle_heading_deg\n"
    flown = fly(header + "0,50,11.5,48.1,4,560,-90,60,-3,70,270\n", clock_offset_s=2.5)
    assert flown.time_s.tolist() == [2.5] and flown.geographic and flown.place.tolist() == [[11.5, 48.1]]
    assert (flown.altitude_m[0], flown.speed_m_s[0], flown.above_sea_m[0]) == (50, 4, 560)
    angles = degrees(flown, "heading", "pitch", "roll", "hfov", "vehicle_heading")
    np.testing.assert_allclose(angles, [270, 60, -3, 70, 270])


def test_places_may_be_in_metres_and_heights_above_the_sea(fly):
    flown = fly("time_s,above_sea_m,east_m,north_m\n0,560,250,-120\n")
    assert not flown.geographic and flown.place.tolist() == [[250, -120]]
    assert np.isnan(flown.altitude_m).all() and flown.above_sea_m.tolist() == [560]
    assert any("no altitude above ground" in note for note in flown.notes)


def test_an_empty_cell_is_unknown_and_so_is_what_lies_beside_it(fly):
    flown = fly(HEADER + rows(8, lambda i: f"{i},{'' if i == 3 else 20 + i},5"))
    assert np.isnan(flown.altitude_m).tolist() == [i == 3 for i in range(8)]
    unknown = [math.isnan(known_at(flown, t)[0]) for t in (2.0, 2.5, 3.0, 3.5, 4.0)]
    assert unknown == [False, True, True, True, False] and known_at(flown, 3.0)[1] == 5


def test_a_column_sampled_more_rarely_goes_on_between_its_samples(fly):
    flown = fly(HEADER + rows(21, lambda i: f"{i / 10},{20 + i / 10 if i % 5 == 0 else ''},5"))
    np.testing.assert_allclose(flown.altitude_m, 20 + np.arange(21) / 10)


def test_empty_rows_and_long_pauses_are_not_bridged(fly):
    flown = fly(HEADER + rows(4, lambda i: f"{i},20,5") + "4,,\n5,,\n6,20,5\n")
    assert all(math.isnan(value) for value in known_at(flown, 4.5))
    flown = fly(HEADER + rows(20, lambda i: f"{i + 50 * (i > 9)},20,5"))
    assert math.isnan(known_at(flown, 30)[0]) and known_at(flown, 9) == known_at(flown, 60) == (20, 5)
    (note,) = flown.notes
    assert "gap" in note and "9.0 s" in note and "51.0 s" in note


def test_a_speed_left_out_is_that_of_the_places(fly):
    flown = fly(
        "time_s,altitude_m,east_m,north_m\n" + rows(60, lambda i: f"{i / 10},50,{0.3 * i + 1000:.2f},{-0.4 * i:.2f}")
    )
    np.testing.assert_allclose(flown.speed_m_s, 5, rtol=1e-3)
    assert any("speed is computed from the places" in note for note in flown.notes)
    over_date_line = rows(60, lambda i: f"{i / 10},50,{179.9999 + i * 1e-5 - 360 * (i > 10):.7f},0.5")
    np.testing.assert_allclose(fly(PLACED + over_date_line).speed_m_s, 1e-4 * 111_320, rtol=2e-3)
    too_short = fly(PLACED + rows(4, lambda i: f"{i / 30:.3f},50,11.500000,48.100000"))
    assert np.isnan(too_short.speed_m_s).all() and not too_short.notes


def test_a_place_of_zero_zero_and_an_altitude_below_ground_are_noted(fly):
    flown = fly(PLACED + "0,50,0,0\n1,-12,0,0\n2,-1,11.5,48.1\n3,50,11.5,48.1\n")
    assert np.isnan(flown.place[:2]).all() and np.isfinite(flown.place[2:]).all()
    assert any("2 of 4 places are 0, 0" in note for note in flown.notes)
    assert any("line 3" in note and "-12 m" in note and "below the ground" in note for note in flown.notes)
    assert flown.altitude_m.tolist() == [50, -12, -1, 50]


# -- The record --------------------------------------------------------------------------------------------------------


def test_between_samples_it_is_linear_and_far_outside_nothing_is_known():
    flown = Telemetry(np.array([1.0, 3.0]), np.array([20.0, 40.0]), np.array([4.0, 8.0]))
    assert [known_at(flown, t) for t in (1.5, 3, 0.5, 3.9)] == [(25, 5), (40, 8), (20, 4), (40, 8)]
    assert flown.at(4.1) is flown.at(-0.1) is flown.at(0.5, tolerance_s=0.1) is None
    flight = flown.at(2.0)
    assert flight is not None
    unknown = [*flight.place, flight.above_sea_m, flight.heading_rad, flight.pitch_rad, flight.roll_rad]
    assert np.isnan([*unknown, flight.hfov_rad, flight.vehicle_heading_rad]).all()


@pytest.mark.parametrize(("first", "last", "middle"), [(350, 20, 5), (20, 350, 5), (170, 200, 185), (0, 90, 45)])
def test_angles_and_longitudes_go_the_short_way_round(first, last, middle):
    angle, zeros = np.radians([first, last]), np.zeros(2)
    flown = replace(
        Telemetry(np.array([0.0, 1.0]), zeros, zeros, np.array([[179.9, 10.0], [-179.9, 11.0]])),
        heading_rad=angle,
        vehicle_heading_rad=angle,
        roll_rad=(angle + np.pi) % (2 * np.pi) - np.pi,
    )
    flight = flown.at(0.5)
    assert flight is not None and abs(flight.roll_rad) <= math.pi
    turned = np.degrees([flight.heading_rad, flight.vehicle_heading_rad, flight.roll_rad % (2 * math.pi)])
    np.testing.assert_allclose(turned, middle)
    assert abs(flight.place[0]) == pytest.approx(180) and flight.place[1] == pytest.approx(10.5)
    local = replace(flown, place=np.array([[900.0, 0.0], [1100.0, 10.0]]), geographic=False).at(0.25)
    assert local is not None and local.place == (950, 2.5)


@pytest.mark.parametrize(("from_s", "to_s", "good"), [(50, 60, False), (-60, -50, False), (14, 20, True), (5, 6, True)])
def test_whether_telemetry_covers_a_clip_is_said_with_both_spans(from_s, to_s, good):
    flown = Telemetry(np.array([from_s, to_s], float), np.zeros(2), np.zeros(2))
    if good:
        flown.check_overlap(15.0)
        return
    with pytest.raises(InputError, match=rf"covers {from_s:.1f} to {to_s:.1f} s, the clip 0.0 to 15.0 s"):
        flown.check_overlap(15.0)
    with pytest.raises(InputError, match="no samples"):
        Telemetry(np.zeros(0), np.zeros(0), np.zeros(0)).check_overlap(15.0)


# -- Tables of other programs ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("first", "second"), [("10:00:00Z", "10:00:01Z"), ("12:00:00+02:00", "12:00:01+0200")])
def test_a_table_in_utc_tells_the_clock(fly, first, second):
    rows = f"2021-05-01T{first},48.1,11.5,500\n2021-05-01T{second},48.1,11.5,500\n"
    flown = fly(f"timestamp,lat,lon,alt\n{rows}", clock_offset_s=-3.0)
    assert flown.start_utc_s == pytest.approx(1_619_863_200 + 3) and flown.time_s.tolist() == [-3, -2]


def test_a_flight_log_that_says_when_the_film_begins_tells_how_to_count_from_there(fly):
    rows = [f"{100 * k},48.1,{11.5 + k * 1e-5:.6f},130,{int(k >= 60)}" for k in range(120)]
    text = "\n".join(["time(millisecond),latitude,longitude,height_above_takeoff(feet),isVideo", *rows]) + "\n"
    assert [note for note in fly(text).notes if "began to film 6.0 s after" in note and "clock_offset_s=-6.0" in note]
    moved = fly(text, clock_offset_s=-6.0)
    assert moved.at(0.0).place[0] == pytest.approx(11.5006) and not [n for n in moved.notes if "film" in n]


def test_a_table_that_counts_frames_takes_the_rate_that_is_given(fly):
    flown = fly("frame,latitude,longitude,rel_alt\n1,48.1,11.5,50\n6,48.1,11.5,55\n", rate_hz=2.0)
    assert flown.time_s.tolist() == [0.0, 2.5]


def test_a_table_that_counts_frames_takes_the_times_of_its_clip(fly, tmp_path: Path):
    clip = tmp_path / "pictures"
    clip.mkdir()
    for number in range(3):
        cv2.imwrite(str(clip / f"{number}.png"), np.zeros((32, 32), np.uint8))
    flown = fly("frame,latitude,longitude,rel_alt\n1,48.1,11.5,50\n6,48.1,11.5,55\n", clip=clip)
    np.testing.assert_allclose(flown.time_s, [0, 0.5])  # 10 images a second
