"""DJI's subtitles: every dialect by what its keys and values say, never by which camera it may be."""

import math

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry

KEYED = (
    '<font size="28">FrameCnt: {n}, DiffTime: 33ms\n2024-05-27 13:10:00.{ms:03d}\n[iso: 200] [shutter: 1/6400.0] '
    "[fnum: 1.8] [ev: 0] [focal_len: 24.00] [dzoom_ratio: 1.00], [latitude: 53.365080] [longitude: 6.460739] "
    "[rel_alt: 5.400 abs_alt: 44.744] [gb_yaw: -162.8 gb_pitch: -30.0 gb_roll: 1.0] [pp_target:0.9, -0.0] </font>"
)

HOME = "HOME(149.02,-20.25)"


def timed(*bodies: str, step_s: float = 1.0, first_s: float = 0.0) -> str:
    def clock(time_s: float) -> str:
        return f"{int(time_s // 3600):02d}:{int(time_s // 60) % 60:02d}:{time_s % 60:06.3f}".replace(".", ",")

    parts = [
        f"{i + 1}\n{clock(first_s + i * step_s)} --> {clock(first_s + (i + 1) * step_s)}\n{body}\n"
        for i, body in enumerate(bodies)
    ]
    return "\n".join(parts)


@pytest.fixture
def read(fly):
    return lambda *bodies: fly(timed(*bodies), "flight.SRT")


def test_the_keys_of_late_cameras_with_a_gimbal(fly):
    bodies = [KEYED.format(n=i + 1, ms=33 * i) for i in range(4)]
    found = fly(timed(*bodies, step_s=0.033), "flight.SRT", clock_offset_s=10)
    np.testing.assert_allclose(found.time_s, 10 + 0.033 * np.arange(4), atol=1e-9)
    assert found.place.tolist() == [[6.460739, 53.36508]] * 4
    assert (found.altitude_m[0], found.above_sea_m[0]) == (5.4, 44.744)
    angles = np.degrees([found.heading_rad[0], found.pitch_rad[0], found.roll_rad[0], found.hfov_rad[0]])
    np.testing.assert_allclose(angles, [197.2, 30, 1, 73.74], atol=0.01)
    assert math.isnan(found.start_utc_s) and any("zone" in note for note in found.notes)
    assert found.origin == "flight.SRT (DJI subtitles)"


@pytest.mark.parametrize(
    ("body", "place", "altitude_m", "above_sea_m"),
    [
        ("[latitude : -20.2533] [longtitude : 149.0251] [iso : 100]", (149.0251, -20.2533), None, None),
        (f"{HOME} 2017.08.05 14:11:51\nGPS(149.0251,-20.2533,16) BAROMETER:1.9", (149.0251, -20.2533), 1.9, None),
        (f"{HOME} 2017.8.5 14:11:51\nGPS(149.0251,-20.2533,16) Hb:1.9 Hs:1.7", (149.0251, -20.2533), 1.9, None),
        ("2022.06.21 16:06:17\nGPS(36.6146,-6.1120,0.0M) BAROMETER:8.4M", (-6.112, 36.6146), 8.4, None),
        ("2022.06.21 16:06:17\nGPS(36.6146,-6.1120,52.5M) BAROMETER:8.4M", (-6.112, 36.6146), 8.4, 52.5),
        ("2022.06.21 16:06:17\nGPS(36.6146,-106.1120,0.0M) BAROMETER:8.4M", (-106.112, 36.6146), 8.4, None),
        ("SS 206.14, GPS (-82.6669, 27.7716, 10), D 2.80m, H 3.00m, H.S 1.00m/s", (-82.6669, 27.7716), 3.0, None),
        ("RTK (120.083799, 30.213635, 28), HOME (120.08, 30.21, 103m), H 76.1m", (120.083799, 30.213635), 76.1, None),
        ("GPS(W: 120.5, S: 20.25, 31.5m) ISO:100", (-120.5, -20.25), None, 31.5),
        ("HOME (lat: 41.5, lon: 2.5, alt: 90m), GPS (2.23, 41.42, 16), H 5.0m", (2.23, 41.42), 5.0, None),
        ("[focal_len : 240] [latitude: 41.42] [longitude: 2.23] [altitude: 117.0]", (2.23, 41.42), None, 117.0),
        ("[latitude: 53,365080] [longitude: 6,460739] [rel_alt: 5,4 abs_alt: 44,7]", (6.460739, 53.36508), 5.4, 44.7),
        ("GPS(149,0251,-20,2533,16) BAROMETER:1,9", (149.0251, -20.2533), 1.9, None),
        ("Luma 106, Coef(1.0, 1.0), R(X:0, H:0), GPS (-2.5, 52.0, 15), D 0.6m, H 1.50m", (-2.5, 52.0), 1.5, None),
    ],
)  # fmt: skip
def test_a_place_is_found_in_every_dialect(read, body, place, altitude_m, above_sea_m):
    found = read(body, body, body)
    np.testing.assert_allclose(found.place, [place] * 3)
    np.testing.assert_allclose(found.altitude_m, math.nan if altitude_m is None else altitude_m)
    np.testing.assert_allclose(found.above_sea_m, math.nan if above_sea_m is None else above_sea_m)


def test_speed_and_attitudes_of_aircraft_and_gimbal_are_told_apart(fly):
    body = (
        "GPS (-58.85, -34.23, 15), D 698.70m, H 85.80m, H.S 2.88m/s, V.S 1.00m/s, F.PRY (2.7°, -7.0°, 100.1°), "
        "G.PRY (-24.4°, 0.5°, -110.4°)"
    )
    for encoding in ("utf-8", "latin-1", "utf-16"):
        found = fly(timed(body, body).encode(encoding), "flight.SRT")
        angles = [found.heading_rad[0], found.pitch_rad[0], found.roll_rad[0], found.vehicle_heading_rad[0]]
        np.testing.assert_allclose(np.degrees(angles), [249.6, 24.4, 0.5, 100.1])
        assert found.speed_m_s.tolist() == [2.88, 2.88]


def test_one_place_of_a_file_that_can_be_no_latitude_settles_the_order_for_all(read):
    found = read("GPS(89.9995,10.5,16) BAROMETER:1", "GPS(90.0005,10.5,16) BAROMETER:1")
    assert found.place.tolist() == [[89.9995, 10.5], [90.0005, 10.5]]
    assert not any("order" in note for note in found.notes)
    assert any("order" in note for note in read("GPS(80.5,10.5,16) BAROMETER:1").notes)


def test_without_timings_the_dated_lines_tell_the_time(fly):
    place = "[latitude : -20.25] [longtitude : 149.02]"
    dates = ["2017.08.05 14:11:51,393,525,393,525", "2017.08.05 14:11:52,393,525", "2017.08.05 14:11:54,893,525"]
    text = "\n".join(f"{i + 1}\n{date}\n{place}\n" for i, date in enumerate(dates))
    np.testing.assert_allclose(fly(text, "flight.SRT").time_s, [0, 1, 3.5], atol=1e-5)


@pytest.mark.parametrize(
    ("keys", "degrees"),
    [
        ("[fnum : 280] [focal_len : 240]", 73.74),  # both ten and a hundred times too large
        ("[fnum: 1.8] [focal_len: 24.00]", 73.74),
        ("[fnum: 3.4] [focal_len: 166.00]", 12.38),  # a long lens, not 16.6 mm
        ("[fnum: 1.8] [focal_len: 24.00] [dzoom_ratio: 2.00]", 41.11),
        ("[fnum : 170] [focal_len : 240] [dzoom_ratio: 10000, delta:0]", 73.74),
        ("[fnum: 1.8] [focal_len: 0.00]", math.nan),
    ],
)
def test_a_focal_length_tells_the_field_of_view_where_it_can_be_one(read, keys, degrees):
    found = read(f"{keys} [latitude: 53.3] [longitude: 6.4]")
    np.testing.assert_allclose(np.degrees(found.hfov_rad), degrees, atol=0.01)


def test_a_file_that_ends_within_a_subtitle_is_read_as_far_as_it_goes_and_says_what_is_missing(fly):
    body = "HOME(-58.4,-34.7) 2017.07.03 10:15:03\nGPS(-58.4563,-34.7383,19) BAROMETER:20.1\nISO:100"
    text = timed(*[body] * 5, "HOME(-58.4,-34.7) 2017.07.03 10:15:08", first_s=1.0)
    found = fly(text, "flight.SRT")
    assert len(found) == 6
    assert np.isnan(found.altitude_m).tolist() == [False] * 5 + [True]
    assert np.isnan(found.place).any(axis=1).tolist() == [False] * 5 + [True]
    (note,) = [note for note in found.notes if "lacks" in note]
    assert "line 32" in note and "above_takeoff_m, latitude_deg, longitude_deg" in note and "incomplete" in note


def test_a_subtitle_between_others_that_lacks_the_place_is_not_bridged(read):
    body = "[latitude: 53.3] [longitude: 6.4] [rel_alt: 5.0 abs_alt: 44.0]"
    found = read(body, body, "[rel_alt: 5.0 abs_alt: 44.0]", body)
    assert np.isnan(found.place).any(axis=1).tolist() == [False, False, True, False]
    assert any("line 10" in note and "latitude_deg, longitude_deg" in note for note in found.notes)


def test_no_fix_is_no_place_and_no_height_above_the_sea(read):
    fixed = "[latitude: 41.4] [longitude: 2.2] [altitude: 117.0]"
    found = read("[latitude: 0.000000] [longitude: 0.000000] [altitude: 0.000000]", fixed, fixed)
    assert np.isnan(found.place[0]).all() and math.isnan(found.above_sea_m[0])
    assert found.above_sea_m[1:].tolist() == [117, 117]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (timed("[iso: 100]", "[iso: 100]"), "holds a place, an altitude"),
        (
            timed("[latitude: 118.2] [longitude: 34.1]"),
            "line 2: latitude_deg is 118.2; wanted -90 to 90; are longitude",
        ),
        (timed("[latitude: 18.2] [longitude: 234.1]"), "line 2: longitude_deg is 234.1"),
        (timed(*["[latitude: 18.2] [longitude: 34.1]"] * 9) * 2, "time runs back from 8.000 to 0.000"),
        ("\n\n", "is empty"),
        ("no telemetry at all", "of no supported kind"),
    ],
)
def test_a_file_of_no_use_is_refused_in_one_line(refused, text, words):
    assert words in refused(read_telemetry, text, "flight.SRT")


def test_the_kind_of_a_file_goes_by_its_content_not_its_name(fly):
    assert fly(timed(KEYED.format(n=1, ms=0)), "telemetry.txt").altitude_m.tolist() == [5.4]
    assert fly("time_s,altitude_m\n0,20\n", "telemetry.txt").altitude_m.tolist() == [20]


@pytest.mark.parametrize(
    "groups",
    [
        "[Gimbal: Yaw:10.0, Pitch:-45.0, Roll:1.0] [Drone: Yaw:2.0, Pitch:-3.1, Roll:1.5]",
        "[Drone: Yaw:2.0, Pitch:-3.1, Roll:1.5] [Gimbal: Yaw:10.0, Pitch:-45.0, Roll:1.0]",
        "[drone : yaw = 2.0, pitch = -3.1] [Gimbal : yaw = 10.0, pitch = -45.0, roll = 1.0]",
        "[drone_yaw: 2.0 drone_pitch: -3.1 drone_roll: 1.5] [gb_yaw: 10.0 gb_pitch: -45.0 gb_roll: 1.0]",
        "[gimbal_pitch: -45.0 gimbal_yaw: 10.0 gimbal_roll: 1.0] yaw: 2.0",
        "[Gimbal:\n Yaw: 10.0, Pitch: -45.0,\n Roll: 1.0]\n[Drone: Yaw: 2.0]",
        "Gimbal(Yaw:10.0, Pitch:-45.0, Roll:1.0) Drone(Yaw:2.0, Pitch:-3.1)",
        "Gimbal {yaw: 10.0, pitch: -45.0, roll: 1.0}, UAV {yaw: 2.0}",
        "Gimbal: Yaw: 10.0, Pitch: -45.0, Roll: 1.0; Aircraft: Yaw: 2.0",
        "Gimbal Yaw: 10.0 Gimbal Pitch: -45.0 Gimbal Roll: 1.0 Drone Yaw: 2.0",
        "[Gimbal attitude: yaw: 10.0, pitch: -45.0, roll: 1.0] [yaw: 2.0]",
    ],
)
def test_the_angles_of_camera_and_aircraft_are_told_apart_in_any_order(read, groups):
    found = read(f"[latitude: 48.1] [longitude: 11.5] {groups}")
    angles = [found.heading_rad[0], found.pitch_rad[0], found.roll_rad[0], found.vehicle_heading_rad[0]]
    np.testing.assert_allclose(np.degrees(angles), [10, 45, 1, 2])


@pytest.mark.parametrize(
    ("zooms", "degrees", "note"),
    [
        (["1.79"], 21.89, None),
        (["179"], 21.89, "counted in 1/100: 179 is 1.79"),
        (["1790"], 21.89, "counted in 1/1000"),
        (["17871"], 21.92, "counted in 1/10000: 17871 is 1.7871"),
        (["1.79x"], 21.89, None),
        (["x1.79"], 21.89, None),
        (["2X"], 19.64, None),
        (["140000"], 2.83, "counted in 1/10000: 140000 is 14"),
        (
            ["1500"],
            25.99,
            "counted in 1/1000: 1500 is 1.5; the log does not give the scale: in 1/100 it would be 15",
        ),
        (["2.00", "2.00"], 19.64, "the zoom is 2 throughout; a focal length in the camera's file must include it"),
        (["15"], 2.64, "the zoom is 15 throughout"),
        (["10000", "120000"], 3.31, "counted in 1/10000"),
        (["0"], 38.19, "a zoom of 0 is impossible"),
    ],
)
def test_a_zoom_may_be_in_any_scale(read, zooms, degrees, note):
    found = read(
        *(f"[focal_len: 52.00] [dzoom_ratio: {zoom}, delta:0] [latitude: 48] [longitude: 11]" for zoom in zooms)
    )
    assert np.degrees(found.hfov_rad[-1]) == pytest.approx(degrees, abs=0.01)
    assert [text for text in found.notes if "zoom" in text and (note or "none") in text] or note is None


@pytest.mark.parametrize(
    ("body", "altitude_m", "above_sea_m", "zero"),
    [
        ("SrtCnt : 1, DiffTime : 33ms\n[latitude: 0.41] [longitude: 36.8] [altitude: 35.4]", 35.4, None, "takeoff"),
        ("FrameCnt : 1\n[latitude: -36.8] [longtitude: 74.6] [altitude: 28.7]", None, 28.7, "takeoff"),
        ("[latitude: -36.8] [longitude: 74.6] [altitude: 28.7]", None, 28.7, "unknown"),
        ("GPS(48.1,11.5,569.8) BAROMETER(91.2) HOME(48.1,11.5)", 91.2, 569.8, "takeoff"),
        ("GPS (48.1, 11.5, 569.8), H 91.2m", 91.2, 569.8, "takeoff"),
        ("GPS(11.5,48.1,16) BAROMETER(300ft)", 91.44, None, "takeoff"),
    ],
)
def test_a_height_counts_from_where_its_dialect_has_it(read, body, altitude_m, above_sea_m, zero):
    found = read(body)
    heights = [math.nan if height is None else height for height in (altitude_m, above_sea_m)]
    np.testing.assert_allclose([found.altitude_m[0], found.above_sea_m[0]], heights)
    assert found.height_zero == zero
    assert bool([note for note in found.notes if "takeoff_above_sea_m" in note]) == (zero == "unknown")


@pytest.mark.parametrize(
    ("body", "place"),
    [
        ("GPS(48.1371,11.5753,569.800) BAROMETER(91.2)", [11.5753, 48.1371]),
        ("GPS(48.1371,11.5753,52.5M) BAROMETER:9.2", [11.5753, 48.1371]),
        ("GPS(11.5753,48.1371,16) BAROMETER:9.2", [11.5753, 48.1371]),
        ("GPS(48.1371,111.5753) BAROMETER:9.2", [111.5753, 48.1371]),
        ("GPS(48.1371,11.5753,569) BAROMETER(91.2)", [11.5753, 48.1371]),
        ("GPS(48,1371;11,5753;569,8) BAROMETER(91,2)", [11.5753, 48.1371]),
        ("GPS(48,1371,11,5753,569,8) BAROMETER(91,2)", [11.5753, 48.1371]),
        ("[latitude: 48.1371 N] [longitude: 11.5753 W]", [-11.5753, 48.1371]),
        ("[latitude: S48.1371] [longitude: E11.5753]", [11.5753, -48.1371]),
        ("[latitude: 48,1371° S] [longitude: 11,5753° W]", [-11.5753, -48.1371]),
        ("[latitude: 48°08'13.56\"S] [longitude: 11°34'31.08\"E]", [11.5753, -48.1371]),
        ("lat: 48.1371N, lon: 11.5753W, rel_alt: 5", [-11.5753, 48.1371]),
        ("GPS: 48.1371, 111.5753, Alt: 40m", [111.5753, 48.1371]),
    ],
)
def test_the_dialect_tells_which_coordinate_comes_first(read, body, place):
    found = read(body, body)
    np.testing.assert_allclose(found.place, [place] * 2, atol=1e-7)
    assert "BAROMETER(91" not in body or (found.altitude_m[0], found.above_sea_m[0] // 1) == (91.2, 569)


def test_two_coordinates_alone_need_an_order(fly):
    text = timed("GPS(48.1, 11.5) BAROMETER:9.2")
    with pytest.raises(InputError, match=r"GPS\(...\) may be lat-lon or lon-lat; set aerial\.order=lat-lon or"):
        fly(text, "flight.SRT")
    assert fly(text, "flight.SRT", order="lat-lon").place.tolist() == [[11.5, 48.1]]
    assert fly(text, "flight.SRT", order="lon-lat").place.tolist() == [[48.1, 11.5]]


@pytest.mark.parametrize(
    ("timings", "times"),
    [
        (
            ["00:00:00,000 --> 00:00:00,998", "00:00:00,998 --> 00:00:00,1824", "00:00:00,1824 --> 00:00:01,857"],
            [0, 0.998, 1.824],
        ),
        (
            ["00:00:00,0 --> 00:00:00,33", "00:00:00,33 --> 00:00:00,100", "00:00:00,100 --> 00:00:01,0"],
            [0, 0.033, 0.1],
        ),
        (["00:00:00,000000 --> 00:00:00,500000", "00:00:00,500000 --> 00:00:01,000000"], [0, 0.5]),
        (["00:00,000 --> 00:00,333", "00:00,333 --> 01:00,000", "01:00,500 --> 01:01,000"], [0, 0.333, 60.5]),
        (["00:00:00.5 --> 00:00:01.0", "00:00:01.0 --> 00:00:01.5"], [0.5, 1]),
    ],
)
def test_milliseconds_may_be_over_999_or_without_zeros(fly, timings, times):
    text = "\n".join(f"{k}\n{timing}\n[latitude: 1] [longitude: 2] [rel_alt: 3]\n" for k, timing in enumerate(timings))
    np.testing.assert_allclose(fly(text, "flight.SRT").time_s, times)


def flight(hour: int, latitude: float, count: int = 5) -> list[str]:
    return [
        f"2024-05-27 {hour}:10:{k:02d}.000\n[latitude: {latitude}] [longitude: 6.4] [rel_alt: {k}.0]"
        for k in range(count)
    ]


@pytest.mark.parametrize(
    ("bodies", "before_s", "after_s"),
    [
        ([*flight(13, 53.0), *flight(15, 53.0001)], 4, 5),  # the date jumps
        ([body.split("\n")[1] for body in [*flight(13, 53.0), *flight(13, 54.0)]], 4, 5),  # the place jumps
    ],
)
def test_a_jump_of_date_or_place_splits_a_file_into_flights(read, bodies, before_s, after_s):
    found = read(*bodies)
    assert [note for note in found.notes if "these are several flights" in note]
    between = found.at((before_s + after_s) / 2)
    assert math.isnan(between.place[0]) and math.isnan(between.altitude_m)
    assert np.isfinite([found.at(before_s).place, found.at(after_s).place]).all()


def test_times_that_begin_again_go_on_by_their_dates(fly):
    found = fly(timed(*flight(13, 53.0)) + "\n" + timed(*flight(15, 53.5)), "flight.SRT")
    assert found.at(3600.0) is None or math.isnan(found.at(3600.0).altitude_m)
    assert found.at(7203.0).place == pytest.approx((6.4, 53.5)) and found.at(3.0).place == pytest.approx((6.4, 53.0))


def test_a_later_flight_that_comes_first_counts_from_its_beginning_and_the_earlier_one_lies_before_it(fly):
    found = fly(timed(*flight(15, 53.5)) + "\n" + timed(*flight(13, 53.0)), "flight.SRT")
    assert found.at(-7198.0).place == pytest.approx((6.4, 53.0)) and found.at(2.0).place == pytest.approx((6.4, 53.5))


def test_times_that_begin_again_elsewhere_without_dates_go_on(fly):
    first, second = ([body.split("\n")[1] for body in flight(13, latitude)] for latitude in (53.0, 54.0))
    found = fly(timed(*first) + "\n" + timed(*second), "flight.SRT")
    assert found.at(5.0).place == pytest.approx((6.4, 54.0)) and math.isnan(found.at(4.5).place[0])
    assert [note for note in found.notes if "these are several flights" in note]


@pytest.mark.parametrize(
    ("date", "start"), [("03/05/2023", None), ("13/05/2023", 1683968132.0), ("05.03.2023", 1678006532.0)]
)
def test_a_date_whose_day_and_month_may_be_swapped_tells_no_clock_even_in_a_zone(fly, date, start):
    text = timed(*[f"{date} 10:55:3{k}\n[latitude: 53] [longitude: 6.4] [rel_alt: 5]" for k in (2, 3)])
    found = fly(text, "flight.SRT", time_zone="+02:00")
    assert found.start_utc_s == pytest.approx(start or math.nan, nan_ok=True)
    assert bool([note for note in found.notes if "whether day or month comes first" in note]) == (start is None)
    assert np.isfinite(found.latest_utc_s) == (start is None)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_what_begins_with_the_second_flight_is_unknown_before(fly):
    first, second = ("[latitude: 53] [longitude: 6]",) * 3, ("[latitude: 54] [longitude: 6] [rel_alt: 5]",) * 3
    found = fly(timed(*first) + "\n" + timed(*second), "flight.SRT")
    assert found.at(3.0).altitude_m == 5 and math.isnan(found.at(2.0).altitude_m)


def test_a_time_lapse_whose_dates_run_fast_is_one_flight(read):
    bodies = [f"2024-05-27 13:{k:02d}:00.000\n[latitude: 53] [longitude: 6.4] [rel_alt: {k}.0]" for k in range(20)]
    found = read(*bodies)
    assert not [note for note in found.notes if "flights" in note] and found.at(4.5).altitude_m == 4.5


LOCAL = """1
00:00:00,000 --> 00:00:01,000
2024-07-01 14:00:00.500
[latitude: 52.500000] [longitude: 13.400000] [rel_alt: 30.000 abs_alt: 70.000] </font>

2
00:00:01,000 --> 00:00:02,000
2024-07-01 14:00:01.500
[latitude: 52.500010] [longitude: 13.400000] [rel_alt: 30.000 abs_alt: 70.000] </font>
"""
NOON_UTC_S = 1719835200.5  # 2024-07-01 12:00:00.5 UTC


@pytest.mark.parametrize("zone", ["Europe/Berlin", "+02:00", "+0200", "+2"])
def test_a_time_zone_tells_the_clock_of_a_log_in_local_time(fly, zone):
    assert np.isnan(fly(LOCAL, "clip.SRT").start_utc_s)
    told = fly(LOCAL, "clip.SRT", time_zone=zone)
    assert told.start_utc_s == pytest.approx(NOON_UTC_S)
    assert not any("time zone" in note for note in told.notes)
    table = "time,latitude,longitude,rel_alt\n2024-07-01 14:00:00.5,52.5,13.4,30\n2024-07-01 14:00:01.5,52.5,13.4,30\n"
    in_zone = fly(table, time_zone=zone)
    assert in_zone.start_utc_s == pytest.approx(NOON_UTC_S) and not any("zone" in note for note in in_zone.notes)
    # A date that says its zone keeps it.
    assert fly(table.replace(".5,52", ".5Z,52"), time_zone=zone).start_utc_s == pytest.approx(NOON_UTC_S + 7200)


@pytest.mark.parametrize("zone", ["Mars/Olympus", "+25:00", "../etc/passwd", "+02:75"])
def test_a_time_zone_that_does_not_exist_is_refused_in_one_line(fly, zone):
    with pytest.raises(InputError, match=r"aerial\.time_zone .* is not known; wanted a name such as Europe/Berlin"):
        fly(LOCAL, "clip.SRT", time_zone=zone)
