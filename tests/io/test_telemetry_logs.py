"""Logs of autopilots: MAVLink and PX4."""

import math
from pathlib import Path

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry

pytest.importorskip("pymavlink")
pytest.importorskip("pyulog")
from tests.io.flights import global_position, tlog, ulog

CLOCK_S = 1_533_737_161.0
LEVEL = {"roll": 0, "pitch": 0, "rollspeed": 0, "pitchspeed": 0, "yawspeed": 0}


def written(folder: Path, content: bytes, name: str) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def quaternion(heading: float, pitch_up: float, roll: float) -> list[float]:
    y, p, r = (math.radians(angle) / 2 for angle in (heading, pitch_up, roll))
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (y, p, r))
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


def flown(count: int = 20, step_s: float = 0.25, delay_s: np.ndarray | None = None) -> list[tuple[float, str, dict]]:
    """Positions eastwards, each followed by an attitude whose heading is 100 degrees."""
    delay = np.zeros(count) if delay_s is None else delay_s
    said = []
    for i in range(count):
        came, boot_ms = CLOCK_S + i * step_s + delay[i], round(5000 + 1000 * i * step_s)
        said.append((came, "GLOBAL_POSITION_INT", global_position(boot_ms, 149.0 + i * 1e-5, -35.0, 50 + i)))
        rates = {"rollspeed": 0, "pitchspeed": 0, "yawspeed": 0}
        said.append(
            (came, "ATTITUDE", {"time_boot_ms": boot_ms + 10, "roll": 0, "pitch": 0, "yaw": 1.7453293, **rates})
        )
    return said


@pytest.mark.parametrize("version", [1, 2])
def test_positions_of_a_mavlink_log_since_the_first_of_them(tmp_path: Path, version: int) -> None:
    heartbeat = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3}
    content = tlog([(CLOCK_S - 2, "HEARTBEAT", heartbeat), *flown()], version=version)
    found = read_telemetry(written(tmp_path, content, "flight.tlog"), clock_offset_s=-1.0)
    assert found.time_s[0] == -1.0 and found.start_utc_s == pytest.approx(CLOCK_S + 1.0, abs=0.02)
    flight = found.at(1.5)  # the eleventh position
    assert flight is not None
    assert flight.place == pytest.approx((149.0001, -35.0), abs=1e-9)
    assert (flight.altitude_m, flight.above_sea_m) == pytest.approx((60, 160))
    assert flight.speed_m_s == pytest.approx(5) and math.degrees(flight.vehicle_heading_rad) == pytest.approx(100)
    assert not found.notes


def test_messages_that_come_late_keep_the_times_at_which_they_were_sent(tmp_path: Path) -> None:
    delay = np.random.default_rng(2).uniform(0, 1.2, 60) * (np.arange(60) % 3 > 0)
    in_order = sorted(flown(60, delay_s=delay), key=lambda row: row[0])
    found = read_telemetry(written(tmp_path, tlog(in_order), "flight.tlog"))
    for i in (7, 20, 41):
        flight = found.at(i * 0.25)
        assert flight is not None and flight.altitude_m == pytest.approx(50 + i, abs=0.1)


def test_a_gap_of_seconds_in_a_mavlink_log_is_noted_and_not_bridged(tmp_path: Path) -> None:
    said = flown(40)
    found = read_telemetry(written(tmp_path, tlog(said[:20] + said[60:]), "flight.tlog"))
    flight = found.at(5.0)
    assert flight is not None and math.isnan(flight.place[0]) and math.isnan(flight.altitude_m)
    assert any("place is unknown" in note and "5.2 s" in note for note in found.notes)


@pytest.mark.parametrize(("flags", "heading"), [(32, 140), (0, 140), (64, 40), (16, 40), (48, 140)])
def test_a_gimbal_turns_against_the_vehicle_or_against_north(tmp_path: Path, flags: int, heading: float) -> None:
    gimbal = {
        "target_system": 0,
        "target_component": 0,
        "flags": flags,
        "q": quaternion(40, -60, 3),
        "angular_velocity_x": 0,
        "angular_velocity_y": 0,
        "angular_velocity_z": 0,
        "failure_flags": 0,
    }
    said = flown(8)
    for i in range(8):
        said.append((CLOCK_S + i * 0.25, "GIMBAL_DEVICE_ATTITUDE_STATUS", {"time_boot_ms": 5000 + 250 * i, **gimbal}))
    found = read_telemetry(written(tmp_path, tlog(sorted(said, key=lambda row: row[0])), "flight.tlog"))
    flight = found.at(1.0)
    assert flight is not None
    degrees = [math.degrees(a) for a in (flight.heading_rad, flight.pitch_rad, flight.roll_rad)]
    assert degrees == pytest.approx([heading, 60, 3], abs=1e-4)


def test_an_old_mount_is_levelled_and_turns_with_the_vehicle(tmp_path: Path) -> None:
    mount = {"target_system": 0, "target_component": 0, "pointing_a": -4500, "pointing_b": 200, "pointing_c": 3000}
    said = [part for row in flown(8) for part in (row, (row[0], "MOUNT_STATUS", mount))]
    found = read_telemetry(written(tmp_path, tlog(said), "flight.tlog"))
    flight = found.at(1.0)
    assert flight is not None
    degrees = [math.degrees(a) for a in (flight.heading_rad, flight.pitch_rad, flight.roll_rad)]
    assert degrees == pytest.approx([130, 45, 2], abs=1e-4)
    assert any("mount" in note for note in found.notes)


def test_without_an_estimate_the_receivers_places_are_taken_where_it_has_a_fix(tmp_path: Path) -> None:
    def fix(i: int) -> dict:
        return {
            "time_usec": i * 200_000,
            "fix_type": 3 if i > 2 else 1,
            "lat": 481_000_000,
            "lon": 115_000_000,
            "alt": 560_000,
            "eph": 100,
            "epv": 100,
            "vel": 700,
            "cog": 0,
            "satellites_visible": 9,
        }

    content = tlog([(CLOCK_S + i / 5, "GPS_RAW_INT", fix(i)) for i in range(10)])
    found = read_telemetry(written(tmp_path, content, "flight.tlog"))
    assert np.isnan(found.place[:, 0]).tolist() == [True] * 3 + [False] * 7
    assert found.place[5].tolist() == [11.5, 48.1] and found.speed_m_s[5] == 7 and found.above_sea_m[5] == 560
    assert np.isnan(found.altitude_m).all() and any("above ground" in note for note in found.notes)


def test_of_two_vehicles_the_one_that_reports_most_is_taken_and_the_other_named(tmp_path: Path) -> None:
    content = tlog(flown(20)) + tlog([(t + 9, name, part) for t, name, part in flown(5)], system=7)
    found = read_telemetry(written(tmp_path, content, "flight.tlog"))
    assert np.nanmax(found.altitude_m) == 69
    assert any("system 1 is taken, left out are 7" in note for note in found.notes)


def test_a_mavlink_log_that_is_cut_or_damaged_is_read_around_the_damage(tmp_path: Path) -> None:
    content = tlog(flown())
    cut = read_telemetry(written(tmp_path, content[:-20], "cut.tlog"))
    assert any("cut off" in note for note in cut.notes) and np.nanmax(cut.altitude_m) == 69
    rubbish = read_telemetry(written(tmp_path, content[:500] + bytes(range(99)) + content[500:], "rubbish.tlog"))
    assert any("no MAVLink messages" in note for note in rubbish.notes) and np.nanmax(rubbish.altitude_m) == 69
    flipped = bytearray(content)
    flipped[8 + 10 + 12] ^= 0x40  # within the first position's payload
    found = read_telemetry(written(tmp_path, bytes(flipped), "flipped.tlog"))
    assert any("1 of 40 messages are damaged" in note for note in found.notes)


def test_a_mavlink_log_that_tells_nothing_is_refused(tmp_path: Path) -> None:
    heartbeat = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3}
    with pytest.raises(InputError, match="none of its 5 MAVLink messages has"):
        read_telemetry(written(tmp_path, tlog([(CLOCK_S + i, "HEARTBEAT", heartbeat) for i in range(5)]), "a.tlog"))


# -- PX4 ---------------------------------------------------------------------------------------------------------------

GLOBAL = (("double lat", "double lon", "float alt"), [(i * 100_000, 63.4 + i * 1e-6, 10.4, 60 + i) for i in range(50)])
LOCAL_FIELDS = (
    "float x",
    "float y",
    "float z",
    "float vx",
    "float vy",
    "double ref_lat",
    "double ref_lon",
    "float ref_alt",
)
LOCAL = (
    LOCAL_FIELDS,
    [(i * 50_000, 10.0, 20.0, -30 - i, 3, 4, 63.4, 10.4, 60) for i in range(100)],
)


def test_the_places_heights_and_speeds_of_a_px4_log(tmp_path: Path) -> None:
    attitude = (("float[4] q",), [(i * 5000 + 1000, *quaternion(80, 5, -5)) for i in range(900)])
    home = (("float x", "float y", "float z"), [(0, 0, 0, -2)])
    content = ulog(
        {
            "vehicle_global_position": GLOBAL,
            "vehicle_local_position": LOCAL,
            "vehicle_attitude": attitude,
            "home_position": home,
        }
    )
    found = read_telemetry(written(tmp_path, content, "flight.ulg"))
    flight = found.at(2.0)
    assert flight is not None
    assert flight.place == pytest.approx((10.4, 63.40002), abs=1e-9)
    assert flight.altitude_m == pytest.approx(30 + 40 - 2) and flight.above_sea_m == pytest.approx(80)
    assert flight.speed_m_s == pytest.approx(5) and math.degrees(flight.vehicle_heading_rad) == pytest.approx(
        80, abs=1e-3
    )
    assert math.isnan(flight.pitch_rad)  # the vehicle's own is not the camera's


def test_without_a_global_estimate_the_local_one_is_laid_around_its_origin(tmp_path: Path) -> None:
    found = read_telemetry(written(tmp_path, ulog({"vehicle_local_position": LOCAL}), "flight.ulg"))
    east_m = (found.place[0, 0] - 10.4) * 111_320 * math.cos(math.radians(63.4))
    assert (east_m, (found.place[0, 1] - 63.4) * 111_320) == pytest.approx((20, 10), abs=1e-3)
    assert found.altitude_m[0] == 30 and found.above_sea_m[0] == 90


def test_the_satellites_clock_tells_when_a_px4_log_begins(tmp_path: Path) -> None:
    fields = ("uint64_t time_utc_usec", "int32_t lat", "int32_t lon", "int32_t alt", "uint8_t fix_type")
    rows = [
        (7_000_000 + i * 200_000, 1_618_986_658_000_000 + i * 200_000, 634_000_000, 104_000_000, 60_000, 3 if i else 0)
        for i in range(20)
    ]
    found = read_telemetry(written(tmp_path, ulog({"vehicle_gps_position": (fields, rows)}), "flight.ulg"))
    assert found.start_utc_s == pytest.approx(1_618_986_658) and found.time_s[0] == 0
    assert np.isnan(found.place[0]).all() and found.place[1].tolist() == pytest.approx([10.4, 63.4])


def test_a_gimbal_of_a_px4_log_turns_with_the_vehicle(tmp_path: Path) -> None:
    attitude = (("float[4] q",), [(i * 20_000, *quaternion(350, 0, 0)) for i in range(100)])
    gimbal = (("float[4] q", "uint16_t device_flags"), [(i * 100_000, *quaternion(30, -90, 0), 32) for i in range(20)])
    content = ulog({"vehicle_attitude": attitude, "gimbal_device_attitude_status": gimbal})
    found = read_telemetry(written(tmp_path, content, "flight.ulg"))
    flight = found.at(1.0)
    assert flight is not None
    assert [math.degrees(flight.heading_rad), math.degrees(flight.pitch_rad)] == pytest.approx([20, 90], abs=0.05)


def test_a_px4_log_that_is_cut_is_read_as_far_as_it_goes_and_says_so(tmp_path: Path) -> None:
    content = ulog({"vehicle_global_position": GLOBAL})
    found = read_telemetry(written(tmp_path, content[:-300], "flight.ulg"))
    assert 30 < len(found) < 50 and any("cut off" in note for note in found.notes)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (ulog({"battery_status": (("float voltage",), [(0, 12.0)])}), "has no position, height or attitude"),
        (b"XX" + ulog({"vehicle_global_position": GLOBAL}), "does not begin as a PX4 log"),
        (ulog({"vehicle_global_position": GLOBAL})[:12], "damaged|tells no place"),
        (b"", "is empty"),
    ],
)
def test_a_px4_log_of_no_use_is_refused_in_one_line(tmp_path: Path, content: bytes, says: str) -> None:
    with pytest.raises(InputError, match=says) as error:
        read_telemetry(written(tmp_path, content, "flight.ulg"))
    assert "\n" not in str(error.value)


# -- Damaged times and other files -------------------------------------------------------------------------------------


def test_a_single_time_that_is_damaged_does_not_spoil_a_mavlink_log(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    whole = flown(20)
    path.write_bytes(tlog(whole))
    expected = read_telemetry(path)
    damaged_time = (10**18).to_bytes(8, "big")  # the year 33658
    path.write_bytes(tlog(whole[:10]) + damaged_time + tlog(whole[10:])[8:])
    found = read_telemetry(path)
    np.testing.assert_allclose(found.time_s, expected.time_s, atol=0.02)
    np.testing.assert_array_equal(found.altitude_m, expected.altitude_m)


def test_a_single_time_that_is_damaged_is_left_out_of_a_log_with_one_clock(tmp_path: Path) -> None:
    path = tmp_path / "flight.ulg"
    rows = list(GLOBAL[1])
    rows[20] = (10**15, *rows[20][1:])
    path.write_bytes(ulog({"vehicle_global_position": (GLOBAL[0], rows)}))
    found = read_telemetry(path)
    assert len(found) == 49 and np.ptp(found.time_s) == pytest.approx(4.9)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"\x00\x00\x00\x20ftypisom" + bytes(90), "is a video"),
        (b"\xa3\x95\x80\x80" + bytes(90), "DataFlash"),
        (np.random.default_rng(0).bytes(500), "none of the kinds"),
    ],
)
def test_other_binary_files_are_refused_with_what_is_wanted(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "flight.bin"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_telemetry(path)
