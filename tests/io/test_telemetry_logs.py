"""Logs of autopilots and receivers: MAVLink, PX4, NMEA 0183; and files that are none of these."""

import math

import numpy as np
import pytest

from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.autopilots import px4_lonlat

pytest.importorskip("pymavlink")
pytest.importorskip("pyulog")
pytest.importorskip("pynmea2")
from tests.io.flights import CLOCK_S, eastward, sentence, tlog, ulog

HEARTBEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3}


def quaternion(heading: float, pitch_up: float, roll: float) -> list[float]:
    y, p, r = (math.radians(angle) / 2 for angle in (heading, pitch_up, roll))
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (y, p, r))
    imaginary = [sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy]
    return [cr * cp * cy + sr * sp * sy, *imaginary]


def in_order(said: list) -> bytes:
    return tlog(sorted(said, key=lambda row: row[0]))


def camera_deg(flight):
    return [math.degrees(angle) for angle in (flight.heading_rad, flight.pitch_rad, flight.roll_rad)]


# -- MAVLink -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [1, 2])
def test_positions_of_a_mavlink_log_since_the_first_of_them(fly, version):
    content = tlog([(CLOCK_S - 2, "HEARTBEAT", HEARTBEAT), *eastward()], version=version)
    flown = fly(content, "flight.tlog", clock_offset_s=-1.0)
    assert flown.time_s[0] == -1.0 and flown.start_utc_s == pytest.approx(CLOCK_S + 1.0, abs=0.02)
    flight = flown.at(1.5)  # the eleventh position
    assert flight.place == pytest.approx((149.0001, -35.0), abs=1e-9)
    assert (flight.altitude_m, flight.above_sea_m, flight.speed_m_s) == pytest.approx((60, 160, 5))
    assert math.degrees(flight.vehicle_heading_rad) == pytest.approx(100) and not flown.notes


def test_messages_that_come_late_keep_the_times_at_which_they_were_sent(fly):
    delay = np.random.default_rng(2).uniform(0, 1.2, 60) * (np.arange(60) % 3 > 0)
    flown = fly(in_order(eastward(60, delays_s=delay.tolist())), "flight.tlog")
    assert [flown.at(i * 0.25).altitude_m for i in (7, 20, 41)] == pytest.approx([57, 70, 91], abs=0.1)


@pytest.mark.parametrize(("flags", "heading"), [(32, 140), (0, 140), (64, 40), (16, 40), (48, 140)])
def test_a_gimbal_turns_against_the_vehicle_or_against_north(fly, flags, heading):
    others = ("target_system", "target_component", "failure_flags", *(f"angular_velocity_{axis}" for axis in "xyz"))
    gimbal = {**dict.fromkeys(others, 0), "flags": flags, "q": quaternion(40, -60, 3)}
    times = [(CLOCK_S + i * 0.25, {"time_boot_ms": 5000 + 250 * i}) for i in range(8)]
    turns = [(time_s, "GIMBAL_DEVICE_ATTITUDE_STATUS", {**stamp, **gimbal}) for time_s, stamp in times]
    flight = fly(in_order(eastward(8) + turns), "flight.tlog").at(1.0)
    assert camera_deg(flight) == pytest.approx([heading, 60, 3], abs=1e-4)


@pytest.mark.parametrize(
    ("name", "fields", "degrees"),
    [
        ("MOUNT_STATUS", {"pointing_a": -4500, "pointing_b": 200, "pointing_c": 3000}, [130, 45, 2]),
        ("MOUNT_ORIENTATION", {"pitch": -45, "roll": 2, "yaw": 30}, [130, 45, 2]),
        ("MOUNT_ORIENTATION", {"pitch": -45, "roll": 2, "yaw": 30, "yaw_absolute": 77}, [77, 45, 2]),
    ],
)
def test_an_old_mount_is_levelled_and_turns_with_the_vehicle(fly, name, fields, degrees):
    rest = {"target_system": 0, "target_component": 0} if name == "MOUNT_STATUS" else {}
    said = []
    for k, row in enumerate(eastward(8)):
        stamp = {} if rest else {"time_boot_ms": 5000 + 125 * k}
        said += [row, (row[0], name, {**fields, **rest, **stamp})]
    numbers = (f"{what}_{where}" for what in ("lat", "lon", "alt") for where in ("camera", "image"))
    view: dict = {**dict.fromkeys(numbers, 0), "time_boot_ms": 6750, "q": [1, 0, 0, 0], "hfov": 60, "vfov": 40}
    flown = fly(tlog([*said, (said[-1][0], "CAMERA_FOV_STATUS", view)]), "flight.tlog")
    assert camera_deg(flown.at(1.0)) == pytest.approx(degrees, abs=1e-4)
    assert any("mount" in note for note in flown.notes) == (name == "MOUNT_STATUS")
    assert math.degrees(np.nanmax(flown.hfov_rad)) == pytest.approx(60)


def test_without_an_estimate_the_receivers_places_are_taken_where_it_has_a_fix(fly):
    place = {"lat": 481_000_000, "lon": 115_000_000, "alt": 560_000, "vel": 700}
    rest = {"eph": 100, "epv": 100, "cog": 0, "satellites_visible": 9}
    said = [
        (CLOCK_S + i / 5, "GPS_RAW_INT", {"time_usec": i * 200_000, "fix_type": 3 if i > 2 else 1, **place, **rest})
        for i in range(10)
    ]
    flown = fly(tlog(said), "flight.tlog")
    assert np.isnan(flown.place[:, 0]).tolist() == [True] * 3 + [False] * 7
    assert flown.place[5].tolist() == [11.5, 48.1] and flown.speed_m_s[5] == 7 and flown.above_sea_m[5] == 560
    assert np.isnan(flown.altitude_m).all() and any("above ground" in note for note in flown.notes)


def test_of_two_vehicles_the_one_that_reports_most_is_taken_and_the_other_named(fly):
    other = tlog([(t + 9, name, part) for t, name, part in eastward(5)], system=7)
    flown = fly(tlog(eastward(20)) + other, "flight.tlog")
    assert np.nanmax(flown.altitude_m) == 69
    assert any("system 1 is taken, left out are 7" in note for note in flown.notes)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda c: c[:-20], "cut off"),
        (lambda c: c[:500] + bytes(range(99)) + c[500:], "no MAVLink messages"),
        (lambda c: c[:30] + bytes([c[30] ^ 0x40]) + c[31:], "1 of 40 messages are damaged"),  # in the first position
    ],
)
def test_a_damaged_mavlink_log_is_read_around_the_damage(fly, damage, words):
    flown = fly(damage(tlog(eastward())), "flight.tlog")
    assert any(words in note for note in flown.notes) and np.nanmax(flown.altitude_m) == 69


def test_a_single_damaged_time_does_not_spoil_a_mavlink_log(fly):
    said = eastward(20)
    whole = fly(tlog(said), "whole.tlog")
    damaged_time = (10**18).to_bytes(8, "big")  # the year 33658
    flown = fly(tlog(said[:10]) + damaged_time + tlog(said[10:])[8:], "damaged.tlog")
    np.testing.assert_allclose(flown.time_s, whole.time_s, atol=0.02)
    np.testing.assert_array_equal(flown.altitude_m, whole.altitude_m)


# -- PX4 ---------------------------------------------------------------------------------------------------------------

GLOBAL: tuple = (
    ("double lat", "double lon", "float alt"),
    [(i * 100_000, 63.4 + i * 1e-6, 10.4, 60 + i) for i in range(50)],
)
LOCAL: tuple = (
    (*(f"float {name}" for name in ("x", "y", "z", "vx", "vy")), "double ref_lat", "double ref_lon", "float ref_alt"),
    [(i * 50_000, 10.0, 20.0, -30 - i, 3, 4, 63.4, 10.4, 60) for i in range(100)],
)


def test_the_places_heights_and_speeds_of_a_px4_log(fly):
    topics: dict = {
        "vehicle_global_position": GLOBAL,
        "vehicle_local_position": LOCAL,
        "vehicle_attitude": (("float[4] q",), [(i * 5000 + 1000, *quaternion(80, 5, -5)) for i in range(900)]),
        "home_position": (("float x", "float y", "float z"), [(0, 0, 0, -2)]),
    }
    flight = fly(ulog(topics), "flight.ulg").at(2.0)
    assert flight.place == pytest.approx((10.4, 63.40002), abs=1e-9)
    heading = math.degrees(flight.vehicle_heading_rad)
    values = (flight.altitude_m, flight.above_sea_m, flight.speed_m_s, heading)
    assert values == pytest.approx((30 + 40 - 2, 80, 5, 80), abs=1e-3)
    assert math.isnan(flight.pitch_rad)  # the vehicle's own is not the camera's


def test_without_a_global_estimate_the_local_one_is_placed_about_its_origin(fly):
    ranged = [(*row[:-3], 1, 12.5, *row[-3:]) for row in LOCAL[1]]
    fields = (*LOCAL[0][:5], "bool dist_bottom_valid", "float dist_bottom", *LOCAL[0][5:])
    for content, altitude_m in (
        (ulog({"vehicle_local_position": LOCAL}), 30),
        (ulog({"vehicle_local_position": (fields, ranged)}), 12.5),
    ):
        flown = fly(content, "flight.ulg")
        degree_m = 6_371_000 * math.pi / 180
        east_m = (flown.place[0, 0] - 10.4) * degree_m * math.cos(math.radians(63.4))
        assert (east_m, (flown.place[0, 1] - 63.4) * degree_m) == pytest.approx((20, 10), abs=1e-3)
        assert flown.altitude_m[0] == altitude_m and flown.above_sea_m[0] == 90


EIGHTH_M = 6_371_000 * math.pi / 4  # of a great circle


@pytest.mark.parametrize(
    ("east_north_m", "origin", "place"),
    [
        ((0, 0), (10.4, 63.4), (10.4, 63.4)),
        ((0, EIGHTH_M), (10.0, 0.0), (10, 45)),
        ((EIGHTH_M, 0), (10.0, 0.0), (55, 0)),
        # sin(latitude) = cos 45 sin 45; tan(longitude) = sin 45 / (cos 45 cos 45)
        ((EIGHTH_M, 0), (0.0, 45.0), (54.735610317, 30)),
        ((EIGHTH_M, 0), (170.0, 0.0), (-145, 0)),
        ((0, 111_194.9266446), (5.0, -30.0), (5, -29)),  # 6,371,000 m pi / 180
    ],
)
def test_px4_local_positions_lie_on_its_sphere(east_north_m, origin, place):
    assert px4_lonlat(*map(np.asarray, (*east_north_m, *origin))) == pytest.approx(place, abs=1e-8)


@pytest.mark.parametrize("is_old", [True, False])
def test_the_satellites_clock_tells_when_a_px4_log_begins(fly, is_old):
    fields = ["int32_t lat", "int32_t lon", "int32_t alt"]
    fields = fields if is_old else ["double latitude_deg", "double longitude_deg", "double altitude_msl_m"]
    place = (634_000_000, 104_000_000, 60_000) if is_old else (63.4, 10.4, 60.0)
    rows = [(7_000_000 + i * 200_000, 1_618_986_658_000_000 + i * 200_000, *place, 3 if i else 0) for i in range(20)]
    topic = ("uint64_t time_utc_usec", *fields, "uint8_t fix_type"), rows
    flown = fly(ulog({"vehicle_gps_position" if is_old else "sensor_gps": topic}), "flight.ulg")
    assert flown.start_utc_s == pytest.approx(1_618_986_658) and flown.time_s[0] == 0
    assert np.isnan(flown.place[0]).all() and flown.place[1].tolist() == pytest.approx([10.4, 63.4])


@pytest.mark.parametrize("is_old", [True, False])
def test_a_gimbal_of_a_px4_log_turns_with_the_vehicle(fly, is_old):
    gimbal = ("float[4] q", "uint16_t device_flags"), [(i * 100_000, *quaternion(30, -90, 0), 32) for i in range(20)]
    mount = ("float[3] attitude_euler_angle",), [(i * 100_000, 0, -math.pi / 2, math.radians(30)) for i in range(20)]
    topics = {"mount_orientation": mount} if is_old else {"gimbal_device_attitude_status": gimbal}
    attitude = ("float[4] q",), [(i * 20_000, *quaternion(350, 0, 0)) for i in range(100)]
    flight = fly(ulog({"vehicle_attitude": attitude, **topics}), "flight.ulg").at(1.0)
    assert camera_deg(flight)[:2] == pytest.approx([20, 90], abs=0.05)


def test_a_px4_log_that_is_cut_or_has_a_damaged_time_is_read_as_far_as_it_goes(fly):
    flown = fly(ulog({"vehicle_global_position": GLOBAL})[:-300], "flight.ulg")
    assert 30 < len(flown) < 50 and any("cut off" in note for note in flown.notes)
    rows = list(GLOBAL[1])
    rows[20] = (10**15, *rows[20][1:])
    flown = fly(ulog({"vehicle_global_position": (GLOBAL[0], rows)}), "flight.ulg")
    assert len(flown) == 49 and np.ptp(flown.time_s) == pytest.approx(4.9)


# -- NMEA 0183 ---------------------------------------------------------------------------------------------------------


def gga(clock: str, quality: int = 1) -> str:
    return sentence(f"GPGGA,{clock},4807.0380,N,01131.0000,W,{quality},08,0.9,545.4,M,46.9,M,,")


def test_places_heights_speeds_and_headings_of_a_receiver(fly):
    lines = []
    for i in range(5):
        rmc = f"GNRMC,12351{i}.50,A,4807.0380,N,01131.0000,W,10.0,084.4,230394,003.1,W"
        lines += [gga(f"12351{i}.50"), sentence(rmc), sentence("HEHDT,274.0,T"), sentence("PUBX,00,1,2"), "noise"]
    flown = fly("\r\n".join(lines), "track.nmea", clock_offset_s=1.0)
    assert flown.time_s.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(flown.place, [[-(11 + 31 / 60), 48 + 7.038 / 60]] * 5)
    assert flown.above_sea_m.tolist() == [545.4] * 5 and np.isnan(flown.altitude_m).all()
    np.testing.assert_allclose(flown.speed_m_s, 10 * 1852 / 3600)
    np.testing.assert_allclose(np.degrees(flown.vehicle_heading_rad), 274)
    assert not any("left out" in note for note in flown.notes)
    assert flown.start_utc_s == 764_426_110.5 - 1.0  # 1994-03-23T12:35:10.5Z is the first


def test_time_goes_on_over_midnight_and_without_a_fix_nothing_is_known(fly):
    flown = fly("\n".join([gga("235958"), gga("235959", quality=0), gga("000000"), gga("000001")]), "track.nmea")
    assert flown.time_s.tolist() == [0, 1, 2, 3]
    assert np.isnan(flown.place[:, 0]).tolist() == [False, True, False, False]
    assert math.isnan(flown.at(1.2).place[0])


def test_a_damaged_sentence_is_left_out_unless_none_has_a_checksum(fly):
    lines = [gga("120000"), gga("120001").replace("545.4", "945.4"), gga("120002"), gga("120003")[:30]]
    flown = fly("\n".join(lines), "track.nmea")
    assert flown.time_s.tolist() == [0, 2] and flown.above_sea_m.tolist() == [545.4] * 2
    assert any("line 2" in note and "2 lines are left out" in note for note in flown.notes)
    assert len(fly("\n".join(line.split("*")[0] for line in lines[:3]), "track.nmea")) == 3


# -- Files of no use ---------------------------------------------------------------------------------------------------

BATTERY = ulog({"battery_status": (("float voltage",), [(0, 12.0)])})


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.tlog", tlog([(CLOCK_S + i, "HEARTBEAT", HEARTBEAT) for i in range(5)]), "none of its 5 MAVLink messages"),
        ("a.ulg", BATTERY, "has no position, height or attitude"),
        ("a.ulg", b"XX" + BATTERY, "does not begin as a PX4 log"),
        ("a.ulg", BATTERY[:12], "damaged from its beginning"),
        ("a.ulg", b"", "is empty"),
        ("a.nmea", (sentence("GPGSV,1,1,00") + "\n").encode() * 3, "no NMEA sentence gives"),
        ("a.bin", b"\x00\x00\x00\x20ftypisom" + bytes(90), "is a video"),
        ("a.bin", b"\xa3\x95\x80\x80" + bytes(90), "DataFlash"),
        ("a.bin", np.random.default_rng(0).bytes(500), "none of the kinds"),
    ],
)
def test_a_file_of_no_use_is_refused_in_one_line(refused, name, content, words):
    assert words in refused(read_telemetry, content, name)
