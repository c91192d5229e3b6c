"""Logs of autopilots: MAVLink and PX4; and files that are none of these."""

import math

import numpy as np
import pytest

from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.px4 import px4_lonlat

pytest.importorskip("pymavlink")
pytest.importorskip("pyulog")
from tests.io.flights import CLOCK_S, eastward, global_position, tlog, ulog

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


@pytest.mark.parametrize(("h_acc_mm", "sigma_m"), [(2000, math.sqrt(2)), (0, math.nan)])
def test_a_receiver_states_the_error_of_the_places(fly, h_acc_mm, sigma_m):
    fix = {"time_usec": 0, "fix_type": 3, "lat": 481_000_000, "lon": 115_000_000, "alt": 560_000, "vel": 700}
    fix |= {"eph": 100, "epv": 100, "cog": 0, "satellites_visible": 9, "h_acc": h_acc_mm}
    said = [
        row
        for k, place in enumerate(eastward(8))
        for row in (place, (place[0], "GPS_RAW_INT", {**fix, "time_usec": k}))
    ]
    flown = fly(tlog(said), "flight.tlog")
    assert flown.at(0.5).position_sigma_m == pytest.approx(sigma_m, nan_ok=True)
    assert any("states the error of its places" in note for note in flown.notes) == bool(h_acc_mm)


def test_of_two_vehicles_the_one_that_reports_most_is_taken_and_the_other_named(fly):
    other = tlog([(t + 9, name, part) for t, name, part in eastward(5)], system=7)
    flown = fly(tlog(eastward(20)) + other, "flight.tlog")
    assert np.nanmax(flown.altitude_m) == 69
    assert any("system 1 is used; left out: 7" in note for note in flown.notes)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda c: c[:-20], "cut off"),
        (lambda c: c[:500] + bytes(range(99)) + c[500:], "not MAVLink messages"),
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


# -- One vehicle, one gimbal, one clock --------------------------------------------------------------------------------

STATION = {**HEARTBEAT, "type": 6, "autopilot": 8}
TRACKER = {**HEARTBEAT, "type": 5}
ELSEWHERE = [(t + 0.01, name, {**fields, "lat": -360_000_000}) for t, name, fields in eastward(80, 0.05)[::2]]


def together(*parts: bytes) -> bytes:
    """Some logs as one, in order of time."""
    messages: list[bytes] = []
    for part in parts:
        place = 0
        while place < len(part):
            end = place + 20 + part[place + 9]
            messages.append(part[place:end])
            place = end
    messages.sort(key=lambda message: message[:8])
    return b"".join(messages)


@pytest.mark.parametrize(
    ("system", "component", "said", "left_out"),
    [
        (255, 190, ELSEWHERE, "255 (ground station)"),
        (255, 1, ELSEWHERE, "255 (ground station)"),
        (252, 0, ELSEWHERE, "252 (ground station)"),
        (1, 190, ELSEWHERE, "its component 190 (ground station)"),
        (7, 1, [(CLOCK_S, "HEARTBEAT", STATION), *ELSEWHERE], "7 (ground station)"),
        (2, 1, [(CLOCK_S, "HEARTBEAT", TRACKER), *ELSEWHERE], "2 (ground station)"),
        (245, 190, [(CLOCK_S, "HEARTBEAT", STATION), *ELSEWHERE], "245 (ground station)"),
        (42, 1, [row for row in ELSEWHERE if "lat" in row[2]], "42"),  # it says nothing but its place
        (1, 191, ELSEWHERE, "its component 191"),  # another part of the vehicle than the autopilot
    ],
)
def test_another_sender_is_never_the_vehicle_though_it_reports_more_often(fly, system, component, said, left_out):
    flown = fly(together(tlog(eastward()), tlog(said, system, component=component)), "flight.tlog")
    assert flown.place[:, 1].tolist() == [-35.0] * len(flown) and np.nanmax(flown.altitude_m) == 69
    assert any(f"system 1 is used; left out: {left_out}" in note for note in flown.notes)


def test_a_vehicle_without_a_fix_has_no_place_though_a_station_has_one(fly):
    nowhere = [
        (t, name, {**fields, "lat": 0, "lon": 0} if "lat" in fields else fields) for t, name, fields in eastward()
    ]
    flown = fly(together(tlog(nowhere), tlog(ELSEWHERE, 255, component=190)), "flight.tlog")
    assert np.isnan(flown.place).all() and np.nanmax(flown.altitude_m) == 69
    assert any("nothing in the log has a fix" in note for note in flown.notes)


def turns(pitch_up: float, count: int = 20, boot_ms: int = 5000, **more) -> list:
    others = ("target_system", "target_component", "failure_flags", *(f"angular_velocity_{axis}" for axis in "xyz"))
    gimbal = {**dict.fromkeys(others, 0), "flags": 32, "q": quaternion(40, pitch_up, 0), **more}
    stamps = [(CLOCK_S + i * 0.25, {"time_boot_ms": boot_ms + 250 * i}) for i in range(count)]
    return [(time_s, "GIMBAL_DEVICE_ATTITUDE_STATUS", {**stamp, **gimbal}) for time_s, stamp in stamps]


@pytest.mark.parametrize(
    ("gimbals", "pitch", "words"),
    [
        (
            [tlog(turns(-30), component=154), tlog(turns(-80), component=171)],
            30,
            "component 154 is used; left out: component 171",
        ),
        (
            [tlog(turns(-30, gimbal_device_id=1)), tlog(turns(-80, gimbal_device_id=2))],
            30,
            "left out: component 1 device 2",
        ),
        (
            [tlog(turns(-30, q=[0, 0, 0, 0]), component=154), tlog(turns(-80), component=171)],
            80,
            "component 171 is used",
        ),
        ([tlog(turns(-30, 3), component=154), tlog(turns(-80), component=171)], 80, "component 171 is used"),
        ([tlog(turns(-30), system=9, component=154)], 30, None),
        # The clock of a gimbal began at another time.
        ([tlog(turns(-30, boot_ms=9_000_000), component=154)], 30, None),
    ],
)
def test_one_gimbal_is_used_and_named(fly, gimbals, pitch, words):
    flown = fly(together(tlog(eastward()), *gimbals), "flight.tlog")
    assert camera_deg(flown.at(1.0))[:2] == pytest.approx([140, pitch], abs=1e-4)
    assert words is None or any("several gimbals report" in note and words in note for note in flown.notes)
    is_other = any(
        "the gimbal is component 154 of system 9, which is not the vehicle's" in note for note in flown.notes
    )
    assert is_other == (words is None and b"\x09\x9a" in gimbals[0])
    assert not any("drift" in note for note in flown.notes)


ROLLOVER_S = 1024 * 604_800
SINCE_1970 = -CLOCK_S + 100


def shifted(said: list, by_s: float) -> list:
    return [(time_s + by_s, *rest) for time_s, *rest in said]


def calls(utc_s: float, boot_ms: int = 5000) -> list:
    stamps = [(i * 1000, round((utc_s + i) * 1e6)) for i in range(5)]
    return [
        (CLOCK_S + at / 1e3, "SYSTEM_TIME", {"time_boot_ms": boot_ms + at, "time_unix_usec": utc}) for at, utc in stamps
    ]


@pytest.mark.parametrize(
    ("said", "start_utc_s", "words"),
    [
        (eastward(), CLOCK_S, None),
        (shifted(eastward(), SINCE_1970), math.nan, "1970-01-01T00:01:"),
        (shifted(eastward(), -ROLLOVER_S), math.nan, "1998-12-"),
        (shifted(eastward(), 2e9), math.nan, "2081-12-"),
        (shifted(eastward() + calls(CLOCK_S), SINCE_1970), CLOCK_S, "SYSTEM_TIME"),
        (shifted(eastward() + calls(CLOCK_S - ROLLOVER_S), SINCE_1970), math.nan, "1970-01-01"),
        (eastward() + calls(CLOCK_S + 3600), CLOCK_S + 3600, "3600 s behind"),
        (eastward() + calls(CLOCK_S + 0.5), CLOCK_S, None),
        # The computer's clock is set on the way.
        (shifted(eastward()[:14], SINCE_1970) + eastward()[14:], CLOCK_S, None),
        # A single damaged time is no clock.
        (
            [*shifted(eastward(80), SINCE_1970), (CLOCK_S, "SYSTEM_TIME", {"time_boot_ms": 0, "time_unix_usec": 0})],
            math.nan,
            "1970",
        ),
    ],
)
def test_a_clock_that_cannot_be_is_none_unless_the_vehicle_tells_it(fly, said, start_utc_s, words):
    for name in ("flight.tlog", "flight.bin"):
        flown = fly(tlog(sorted(said, key=lambda row: row[0])), name)
        assert flown.at(1.5).altitude_m == pytest.approx(56, abs=0.1) and flown.time_s[-1] < 25
        np.testing.assert_allclose(flown.start_utc_s, start_utc_s, atol=0.02, rtol=0)
        assert (words is None) == (not flown.notes) and all(words in note for note in flown.notes)


def test_a_sender_whose_own_clock_stands_still_has_the_times_of_reception(fly):
    said = [(t, name, {**fields, "time_boot_ms": 0}) for t, name, fields in eastward(8)]
    assert np.ptp(fly(tlog(said), "flight.tlog").time_s) == pytest.approx(1.75)


def receiver(fix: int, lat: float = 48.1, ellipsoid_m: float = 0.0, **more) -> dict:
    place = {"lat": round(lat * 1e7), "lon": 115_000_000, "alt": 560_000, "vel": 700, "fix_type": fix}
    rest = {"time_usec": 0, "eph": 100, "epv": 100, "cog": 0, "satellites_visible": 9}
    return {**place, **rest, "alt_ellipsoid": round(ellipsoid_m * 1000), **more}


@pytest.mark.parametrize("fused", [False, True])
def test_of_two_receivers_the_one_with_a_fix_is_used(fly, fused):
    second = {"dgps_numch": 0, "dgps_age": 0}
    said = []
    for i in range(10):
        time_s = CLOCK_S + i / 5
        said += [(time_s, "GPS_RAW_INT", receiver(1, 0.0)), (time_s, "GPS2_RAW", receiver(3, 48.1, 607.0, **second))]
        said += [(time_s, "GLOBAL_POSITION_INT", global_position(5000 + 200 * i, 0, 0, 50))] if fused else []
    flown = fly(tlog(said), "flight.tlog")
    np.testing.assert_allclose(flown.place, [[11.5, 48.1]] * 10)
    assert flown.above_ellipsoid_m[5] == 607 and flown.above_sea_m[5] == (150 if fused else 560)
    note = "GPS2_RAW component 1 is used, with 10 fixes; left out: GPS_RAW_INT component 1 (0)"
    assert any(note in one for one in flown.notes)


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


_REST = ("float vel_m_s", "uint8_t fix_type")
_PLACES = ("double latitude_deg", "double longitude_deg", "double altitude_msl_m", "double altitude_ellipsoid_m")
GPS = ("uint64_t time_utc_usec", *_PLACES, *_REST)
OLD_GPS = ("uint64_t time_utc_usec", *(f"int32_t {name}" for name in ("lat", "lon", "alt", "alt_ellipsoid")), *_REST)
UTC_US = 1_618_986_658_000_000


def fixes(fix: int, latitude: float = 47.4, utc_us: int = UTC_US, count: int = 20) -> list:
    place = (latitude, 8.5, 488.0, 535.0) if fix else (0.0,) * 4
    return [(i * 200_000, utc_us + i * 200_000 if fix else 0, *place, 5.5, fix) for i in range(count)]


def old_fixes(fix: int) -> list:
    return [
        (*row[:2], *(round(v * by) for v, by in zip(row[2:6], (1e7, 1e7, 1e3, 1e3), strict=True)), *row[6:])
        for row in fixes(fix)
    ]


INVALID = (
    ("double lat", "double lon", "float alt", "bool lat_lon_valid"),
    [(i * 100_000, 0, 0, 0, 0) for i in range(40)],
)


@pytest.mark.parametrize(
    ("topics", "taken"),
    [
        ({"sensor_gps": (GPS, fixes(0)), "sensor_gps 1": (GPS, fixes(3))}, "sensor_gps 1"),
        ({"sensor_gps": (GPS, fixes(3)), "sensor_gps 1": (GPS, fixes(0))}, "sensor_gps 0"),
        ({"sensor_gps 3": (GPS, fixes(0)), "sensor_gps 5": (GPS, fixes(4))}, "sensor_gps 5"),
        ({"sensor_gps": (GPS, fixes(3, 10.0, count=5)), "sensor_gps 1": (GPS, fixes(3))}, "sensor_gps 1"),
        ({"sensor_gps": (GPS, fixes(3)), "sensor_gps 1": (GPS, fixes(3, 10.0))}, "sensor_gps 0"),
        ({"vehicle_gps_position": (GPS, fixes(0)), "sensor_gps 1": (GPS, fixes(3))}, "sensor_gps 1"),
        (
            {"vehicle_gps_position": (OLD_GPS, old_fixes(0)), "vehicle_gps_position 1": (OLD_GPS, old_fixes(3))},
            "vehicle_gps_position 1",
        ),
        ({"vehicle_global_position": INVALID, "sensor_gps": (GPS, fixes(3))}, None),
    ],
)
def test_of_px4s_receivers_the_one_with_fixes_is_used(fly, topics, taken):
    flown = fly(ulog(topics), "flight.ulg")
    np.testing.assert_allclose(flown.place[:20], [[8.5, 47.4]] * 20)
    values = flown.above_sea_m[3], flown.above_ellipsoid_m[3], flown.speed_m_s[3], flown.start_utc_s
    assert values == pytest.approx((488, 535, 5.5, UTC_US / 1e6))
    assert taken is None or any(f"several receivers report: {taken} is used" in note for note in flown.notes)


def test_a_px4_log_whose_receivers_have_no_fix_says_so(fly, refused):
    none = {"sensor_gps": (GPS, fixes(0)), "sensor_gps 1": (GPS, fixes(1, 0.0))}
    flown = fly(ulog({**none, "vehicle_local_position": (LOCAL[0][:5], [row[:6] for row in LOCAL[1]])}), "flight.ulg")
    assert np.isnan(flown.place).all() and any("nothing in the log has a fix" in note for note in flown.notes)
    assert "holds a place" in refused(read_telemetry, ulog(none), "a.ulg")


@pytest.mark.parametrize(
    ("utc_us", "words"), [(UTC_US - round(ROLLOVER_S * 1e6), "2001-09-"), (315_964_800_000_000, "1980-01-06")]
)
def test_a_receivers_clock_that_cannot_be_is_none(fly, utc_us, words):
    flown = fly(ulog({"sensor_gps": (GPS, fixes(3, utc_us=utc_us))}), "flight.ulg")
    assert math.isnan(flown.start_utc_s) and any(words in note and "cannot be" in note for note in flown.notes)
    mixed = {"sensor_gps": (GPS, fixes(3, utc_us=utc_us)), "sensor_gps 1": (GPS, fixes(3))}
    assert fly(ulog(mixed), "flight.ulg").start_utc_s == pytest.approx(UTC_US / 1e6)


# -- Files of no use ---------------------------------------------------------------------------------------------------

BATTERY = ulog({"battery_status": (("float voltage",), [(0, 12.0)])})


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.tlog", tlog([(CLOCK_S + i, "HEARTBEAT", HEARTBEAT) for i in range(5)]), "none of its 5 MAVLink messages"),
        ("a.ulg", BATTERY, "has no position, height or attitude"),
        ("a.ulg", b"XX" + BATTERY, "does not begin like a PX4 log"),
        ("a.ulg", BATTERY[:12], "damaged from its beginning"),
        ("a.ulg", b"", "is empty"),
        ("a.bin", b"\x00\x00\x00\x20ftypisom" + bytes(90), "is a video"),
        ("a.bin", b"\xa3\x95\x80\x80" + bytes(90), "the DataFlash log has no position, height or attitude"),
        ("a.bin", np.random.default_rng(0).bytes(500), "of no supported kind"),
    ],
)
def test_a_file_of_no_use_is_refused_in_one_line(refused, name, content, words):
    assert words in refused(read_telemetry, content, name)
