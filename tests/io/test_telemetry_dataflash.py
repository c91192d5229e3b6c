"""ArduPilot's DataFlash logs, binary and as text, of new and old versions."""

import math
import struct

import numpy as np
import pytest

from tests.io.flights import dataflash, dataflash_text
from torchvision_dddas.io.telemetry.dataflash import _PER_UNIT, _TYPES

KINDS = {
    "GPS": ("QBBIHBcLLffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U"),
    "POS": ("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": ("QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "MNT": ("QBfffffffff", "TimeUS,I,DesRoll,Roll,DesPitch,Pitch,DesYawB,YawB,DesYawE,YawE,Dist"),
    "IMU": ("QBff", "TimeUS,I,GyrX,GyrY"),
}
BEFORE_4_1 = {
    "GPS": ("QBIHBcLLfff", "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs"),
    "GPS2": ("QBIHBcLLfff", "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs"),
    "ATT": KINDS["ATT"],
}
IN_2014 = {
    "GPS": ("BIHBcLLfff", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd"),
    "ATT": ("IccC", "TimeMS,Roll,Pitch,Yaw"),
}
IN_2014["GPS"] = (IN_2014["GPS"][0] + "I", IN_2014["GPS"][1] + ",T")
PLACE = [149.16523, -35.36326]
WEEK, OF_WEEK_MS = 2300, 200_000_000
START_UTC_S = 315_964_800 + WEEK * 604_800 + OF_WEEK_MS / 1e3 - 18


def messages(
    dead: int | None = 0, mounts: int = 0, names: tuple[str, ...] = ("GPS", "POS", "ATT"), week: int = WEEK
) -> list:
    """Two seconds of a flight. dead: the receiver without a fix."""
    said: list[tuple] = []
    for i in range(11):
        us, away = 10_000_000 + i * 200_000, i * 1e-6
        for k in range(2):
            place = (0.0, 0.0, 0.0, 0.0) if k == dead else (PLACE[1] - away - 0.01 * (k == 0), PLACE[0], 584.0, 5.5)
            said.append(("GPS", us, k, 0 if k == dead else 3, OF_WEEK_MS + i * 200, week, 9, 0.9, *place, 90.0, 0.0, 1))
        said.append(("POS", us, PLACE[1] - away, PLACE[0], 584.0, -0.26 + i, -1.2))
        said.append(("ATT", us, 0, 1, 0, -2, 90, 100))
        said += [("MNT", us, k, 0, 1.5, 0, -30.0 - 50 * k, 0, 40.0, 0, 140.0, math.nan) for k in range(mounts)]
        said += [("IMU", us + 1000 * k, 0, 0.1, 0.2) for k in range(10)]
    return [row for row in said if row[0] in (*names, "IMU")]


def forms(kinds: dict, rows: list) -> list[tuple[str, bytes | str]]:
    """The same log in each form that it comes in."""
    text = dataflash_text(kinds, rows)
    texts = [text, text.replace(", ", ","), text.replace("\n", "\r\n"), f" Ready to drive.\n\n{text}\n"]
    return [("a.bin", dataflash(kinds, rows)), ("a.BIN", dataflash(kinds, rows)), *(("a.log", one) for one in texts)]


def test_the_position_of_the_autopilot_is_read_in_each_form(fly):
    for name, content in forms(KINDS, messages(mounts=1, names=("GPS", "POS", "ATT", "MNT"))):
        flown = fly(content, name, clock_offset_s=-1.0)
        assert flown.time_s[0] == -1.0 and flown.start_utc_s == pytest.approx(START_UTC_S + 1.0)
        flight = flown.at(0.0)
        assert flight.place == pytest.approx((PLACE[0], PLACE[1] - 5e-6), abs=2e-7)
        values = flight.altitude_m, flight.above_sea_m, flight.speed_m_s
        assert values == pytest.approx((-0.26 + 5, 584, 5.5), abs=1e-4)
        degrees = (flight.vehicle_heading_rad, flight.heading_rad, flight.pitch_rad, flight.roll_rad)
        assert np.degrees(degrees) == pytest.approx([100, 140, 30, 1.5], abs=1e-4)
        assert flown.height_zero == "takeoff" and not flown.notes


def test_a_receiver_states_the_error_of_the_places(fly):
    rows = [("GPA", us, 0, 1.2, 2.0, 3.0, 0.5) for us in range(10_000_000, 12_000_000, 200_000)]
    kinds = KINDS | {"GPA": ("QBCCCC", "TimeUS,I,VDop,HAcc,VAcc,SAcc")}
    for name, content in forms(kinds, sorted(messages() + rows, key=lambda row: row[1])):
        assert fly(content, name).at(1.0).position_sigma_m == pytest.approx(math.sqrt(2))


@pytest.mark.parametrize("dead", [0, 1])
def test_of_two_receivers_the_one_with_a_fix_is_used(fly, dead):
    for name, content in forms(KINDS, messages(dead, names=("GPS",))):
        flown = fly(content, name)
        assert flown.place[0] == pytest.approx([PLACE[0], PLACE[1] - 0.01 * (dead == 1)], abs=2e-7)
        assert flown.above_sea_m[0] == 584 and flown.speed_m_s[0] == 5.5
        assert any(f"GPS device {1 - dead} is used, with 11 fixes" in note for note in flown.notes)


def test_receivers_of_older_logs_have_messages_of_their_own(fly):
    rows = []
    for i in range(5):
        us, clock = 10_000_000 + i * 200_000, (OF_WEEK_MS + i * 200, WEEK, 9, 0.9)
        rows += [
            ("GPS", us, 1, *clock, 0.0, 0.0, 0.0, 0.0, 0.0),
            ("GPS2", us, 4, *clock, *PLACE[::-1], 584.0, 5.5, 90.0),
        ]
    for name, content in forms(BEFORE_4_1, rows):
        flown = fly(content, name)
        np.testing.assert_allclose(flown.place, [PLACE] * 5, atol=1e-7)
        assert any("GPS2 device 0 is used" in note for note in flown.notes)


def test_a_log_of_2014_counts_milliseconds_and_has_one_leap_second_less(fly):
    rows = []
    for i in range(5):
        ms = 12_345 + i * 200
        rows += [
            ("GPS", 3, 271_594_800 + i * 200, 1782, 9, 1.53, *PLACE[::-1], 50.0, 634.0, 5.0, ms),
            ("ATT", ms, 0, 0, 90),
        ]
    for name, content in forms(IN_2014, rows):
        flown = fly(content, name)
        assert flown.time_s.tolist() == pytest.approx([0, 0.2, 0.4, 0.6, 0.8])
        assert flown.start_utc_s == pytest.approx(315_964_800 + 1782 * 604_800 + 271_594.8 - 16)
        assert (flown.altitude_m[0], flown.above_sea_m[0], flown.speed_m_s[0]) == (50, 634, 5)
        assert math.degrees(flown.vehicle_heading_rad[0]) == 90


@pytest.mark.parametrize(("week", "words"), [(WEEK - 1024, "2004-06-"), (2900, "2035-")])
def test_a_week_that_cannot_be_is_no_clock(fly, week, words):
    flown = fly(dataflash(KINDS, messages(week=week)), "a.bin")
    assert math.isnan(flown.start_utc_s) and any(words in note and "cannot be" in note for note in flown.notes)


def test_without_an_estimate_the_barometer_tells_the_height(fly):
    kinds = {"GPS": KINDS["GPS"], "BARO": ("QBff", "TimeUS,I,Alt,Press")}
    rows = [row for row in messages(names=("GPS",)) if row[0] == "GPS"]
    rows += [("BARO", row[1], 0, 12.5, 95_000.0) for row in rows if row[2] == 0]
    flown = fly(dataflash(kinds, rows), "a.bin")
    assert flown.altitude_m.tolist() == [12.5] * 11


@pytest.mark.parametrize(("gimbals", "taken"), [(1, None), (2, "device 0 is used; left out: device 1")])
def test_one_gimbal_is_used(fly, gimbals, taken):
    flown = fly(dataflash(KINDS, messages(mounts=gimbals, names=("POS", "ATT", "MNT"))), "a.bin")
    assert math.degrees(flown.at(1.0).pitch_rad) == pytest.approx(30)
    assert [taken in note for note in flown.notes if "gimbals" in note] == [True] * (gimbals - 1)


def test_a_gimbal_without_a_heading_against_north_turns_with_the_vehicle(fly):
    rows = [
        (*row[:10], math.nan, row[11]) if row[0] == "MNT" else row
        for row in messages(mounts=1, names=("POS", "ATT", "MNT"))
    ]
    assert math.degrees(fly(dataflash(KINDS, rows), "a.bin").at(1.0).heading_rad) == pytest.approx(140, abs=1e-4)


def test_letters_of_formats_mean_what_pymavlink_takes_them_for():
    known = pytest.importorskip("pymavlink.DFReader").FORMAT_TO_STRUCT
    for letter, (code, scale, kind) in known.items():
        dtype = np.dtype(f"<{_TYPES[letter]}")
        assert dtype.itemsize == struct.calcsize(f"<{code}")
        assert _PER_UNIT.get(letter, 1) == pytest.approx(1 / (scale or 1))
        assert dtype.kind == ("S" if kind is str or letter == "a" else np.dtype(code).kind)


RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("damage", "least"),
    [
        (lambda c: c[: len(c) // 2 + 7], 5),
        (lambda c: c[:900] + c[1300:], 8),
        (lambda c: c[:900] + RANDOM.bytes(5000) + c[900:], 10),
        (lambda c: c + b"\xff" * 900, 10),
        (lambda c: c[:900] + b"\xa3\x95\x80" * 30 + c[900:], 10),
        (lambda c: bytes(byte ^ 4 if i > 800 and i % 301 == 0 else byte for i, byte in enumerate(c)), 4),
    ],
)
def test_a_damaged_binary_log_is_read_around_the_damage(fly, damage, least):
    flown = fly(damage(dataflash(KINDS, messages())), "a.bin")
    assert np.isfinite(flown.altitude_m).sum() >= least and np.nanmax(flown.altitude_m) < 100
    assert any("are not whole messages and are left out" in note for note in flown.notes)


def test_a_damaged_text_log_is_read_around_the_damage(fly):
    lines = dataflash_text(KINDS, messages()).split("\n")
    lines[20:20] = ["POS, 12, 3", "POS, a, b, c, d, e, f", "MSG, 1, a, b", "", "\0\0"]
    flown = fly("\n".join(lines), "a.log")
    assert len(flown) == 11
    assert any("line 21: 2 messages are cut off or garbled" in note for note in flown.notes)


@pytest.mark.parametrize("columns", ["TimeUS,Lat,Lng,Alt,RelHomeAlt,TimeUS", "TimeUS,Lat", "TimeUS,TimeUS"])
def test_columns_that_are_damaged_on_the_way_spoil_no_other_row(fly, columns):
    lines = dataflash_text(KINDS, messages()).split("\n")
    layout, last = next(line for line in lines if line.startswith("FMT, 130, 50, POS")), lines[-1]
    damaged = [f"FMT, 130, 50, POS, QLLfff, {columns}", f"POS, {', '.join('1' * len(columns.split(',')))}", layout]
    flown = fly("\n".join([*lines[:40], *damaged, *lines[40:], last]), "a.log")
    assert np.isfinite(flown.altitude_m).sum() >= 11 and np.nanmax(flown.altitude_m) == pytest.approx(9.74)
