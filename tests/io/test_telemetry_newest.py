"""The newest reports of a link, read by the readers of logs."""

import json
from functools import reduce
from operator import xor
from typing import Any

import numpy as np
import pytest

from tests.io.flights import START_US, packet
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import ReportWindow, kind_of_report, split_reports

NOW_S = 1.7e9
HEADER = b"time_s,longitude_deg,latitude_deg,altitude_m"


@pytest.fixture
def window():
    made = ReportWindow("udp:x")
    yield made
    made.close()


def fill(window: ReportWindow, lines: list[bytes], apart_s: float = 0.1) -> list[str]:
    """Add lines that come one after the other until NOW_S. Return what is said of each."""
    return [window.add(NOW_S - apart_s * (len(lines) - 1 - k), line) for k, line in enumerate(lines)]


def rows(first_s: float, count: int = 30) -> list[bytes]:
    return [HEADER, *(f"{first_s + k / 10:.3f},11.5,{48 + k * 1e-5:.6f},50".encode() for k in range(count))]


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b'{"lat": 1}', "json"),
        (b"  {}", "json"),
        (b"$GPGGA,1,2", "nmea"),
        (b"1,2,3", "csv"),
        (packet(0), "klv"),
        (b"\0\1\2\3\4" + packet(0), "klv"),
        (bytes([0xFD, 9, 0, 0, 0, 1, 1, 0, 0, 0]), "mavlink"),
        (b"\x00\x01\x02", ""),
        (b"hello", ""),
        (b"", ""),
    ],
)
def test_a_report_shows_its_kind(content, kind):
    assert kind_of_report(content) == kind


def test_a_datagram_is_split_into_its_lines_and_messages():
    assert list(split_reports(b'{"a": 1}\r\n\n{"a": 2}')) == [b'{"a": 1}', b'{"a": 2}']
    one = bytes([0xFD, 2, 0, 0, 0, 1, 1, 0, 0, 0, 7, 7, 8, 8])
    old = bytes([0xFE, 1, 0, 1, 1, 0, 7, 8, 8])
    assert list(split_reports(one + old + one[:5])) == [one, old, one[:5]]
    assert list(split_reports(packet(0))) == [packet(0)]


@pytest.mark.parametrize("first_s", [NOW_S - 2.9, 500.0, -7.0])
def test_times_count_from_1970_or_else_by_reception(window, first_s):
    fill(window, rows(first_s))
    log = window.read()
    assert log.start_utc_s == 0 and log.time_s[-1] == pytest.approx(NOW_S, abs=0.01)
    np.testing.assert_allclose(np.diff(log.time_s), 0.1, atol=1e-6)
    assert log.origin == "udp:x (CSV)"


def test_a_window_keeps_the_newest_seconds_and_a_few_reports_of_a_slow_link(window):
    fill(window, rows(NOW_S - 59.9, 600))
    assert len(window.read()) == 81
    slow = ReportWindow("slow")
    fill(slow, [HEADER, *(f"{NOW_S - 10 * (19 - k)},11,48,50".encode() for k in range(20))], 10.0)
    log = slow.read()
    assert log is not None and np.isfinite(log.altitude_m).sum() == 12 and log.time_s[-1] == NOW_S
    slow.close()


def test_damaged_and_other_reports_are_left_out_with_a_word(window):
    row = json.dumps({"time_s": NOW_S, "longitude_deg": 11.5, "latitude_deg": 48, "altitude_m": 50}).encode()
    said = fill(window, [row, b'{"time_s": ', b"[1]", b"$GPGGA,1", b"\x00\x00"])
    assert said[0] == "" and "no JSON object" in said[1] and "no report" in said[2]
    assert "NMEA 0183 comes beside JSON lines" in said[3] and "no report" in said[4]
    assert window.read().place[-1] == pytest.approx((11.5, 48))


def test_a_damaged_row_passes_with_the_older_half(window):
    fill(window, [*rows(NOW_S - 2.9)[:15], b"garbage,x,y,z", *rows(NOW_S - 1.5, 16)[1:]])
    with pytest.raises(InputError, match="udp:x"):
        window.read()
    assert window.read().time_s[-1] == pytest.approx(NOW_S, abs=0.1)


def test_nested_json_and_names_of_other_programs_are_read(window):
    for k in range(5):
        at = f"2023-11-14T22:13:{10 + k}Z"
        row = {"timestamp": at, "position": {"lat": 48.5, "lon": 11.5}, "gimbal": {"gimbal_pitch": -60}, "tags": [1]}
        window.add(NOW_S, json.dumps(row).encode())
    log = window.read()
    assert log.place[-1] == pytest.approx((11.5, 48.5)) and np.degrees(log.pitch_rad[-1]) == pytest.approx(60)
    assert log.time_s[-1] == pytest.approx(NOW_S - 6)


def test_reports_of_gpsd_without_a_fix_are_no_place(window):
    window.add(NOW_S, b'{"class":"VERSION","release":"3.25"}')
    window.add(NOW_S, b'{"class":"TPV","mode":1}')
    assert window.read() is None
    tpv = {"class": "TPV", "mode": 3, "time": "2023-11-14T22:13:20Z", "lat": 48.5, "lon": 11.5, "altHAE": 540.0}
    window.add(NOW_S, json.dumps(tpv).encode())
    log = window.read()
    assert log.place[-1] == pytest.approx((11.5, 48.5)) and log.above_ellipsoid_m[-1] == 540
    assert log.time_s[-1] == NOW_S


def test_times_of_klv_are_those_of_the_stream_and_not_of_its_stamps(window):
    for k in range(25):
        window.add(NOW_S + 0.04 * k, packet(k))
    log = window.read()
    assert abs(START_US / 1e6 - NOW_S) > 1e6
    np.testing.assert_allclose(log.time_s, NOW_S + 0.04 * np.arange(25), atol=1e-5)
    assert window.delay_s == pytest.approx(NOW_S - START_US / 1e6)


@pytest.mark.parametrize("unit_us", [1, 1000])
def test_reports_of_klv_have_the_times_of_their_pictures_even_if_these_are_irregular(window, unit_us):
    times = NOW_S + np.cumsum(np.tile([0.03, 0.05, 0.04], 10))
    for k, time_s in enumerate(times):
        window.add(time_s, packet(k, {2: ((START_US + k * 40_000) // unit_us).to_bytes(8, "big")}))
    np.testing.assert_allclose(window.read().time_s, times, atol=1e-5)
    assert window.delay_s == pytest.approx(NOW_S + 0.04 - START_US / 1e6, abs=0.011)


def test_pauses_of_a_link_are_no_remarks(window):
    times = [*np.arange(10) / 10, 3.0, *(3.1 + np.arange(10) / 10)]
    fill(window, [HEADER, *(f"{NOW_S - 5 + t:.3f},11.5,48,50".encode() for t in times)])
    assert not [note for note in window.read().notes if "unknown" in note or "gap" in note]


def test_the_first_autopilot_is_taken_and_messages_of_other_systems_are_left_out(window):
    pytest.importorskip("pymavlink")
    from pymavlink.dialects.v20 import all as dialect

    def say(system: int, message: Any, version: int = 2) -> str:
        packer = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
        return window.add(NOW_S, bytes(message.pack(packer, force_mavlink1=version == 1)))

    def place(k: int, latitude_deg: float) -> Any:
        north = round(1e7 * latitude_deg)
        return dialect.MAVLink_global_position_int_message(100 * k, north, 115_000_000, 540_000, 15_000, 0, 0, 0, 0)

    station = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    vehicle = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    assert say(255, station) == "" and say(9, place(0, 40)) == ""  # nothing is known yet
    assert say(7, vehicle, version=1) == "" and window.system == 7
    said = [say(system, place(k, system)) for k in range(5) for system in (7, 9, 9)]
    assert {"MAVLink system 9 is left out: system 7 is taken; see ?system=N", ""} == set(said)
    assert say(7, dialect.MAVLink_system_time_message(1_000_000, 0)) == "" == say(9, vehicle)
    log = window.read()
    assert log.place[-1] == pytest.approx((11.5, 7)) and log.time_s[-1] == pytest.approx(NOW_S, abs=1)


def objects(count: int = 20) -> list[bytes]:
    """Reports as JSON, ten a second."""
    return [line(NOW_S - 2 + k / 10, 48 + k * 1e-5) for k in range(count)]


def line(time_s: float, latitude_deg: float, **more: Any) -> bytes:
    row = {"time_s": time_s, "longitude_deg": 11.5, "latitude_deg": latitude_deg, "altitude_m": 50}
    return json.dumps(row | more).encode()


def test_datagrams_that_came_in_another_order_are_read_by_their_times(window):
    lines = objects()
    lines[10], lines[13] = lines[13], lines[10]
    fill(window, lines)
    log = window.read()
    assert log is not None and len(log) == 20
    assert (np.diff(log.time_s) > 0).all() and (np.diff(log.place[:, 1]) > 0).all()


def test_times_of_different_clocks_are_not_mixed(window):
    said = fill(window, [*objects(), line(NOW_S + 1e6, 48.0), line(NOW_S, 48.1)])
    assert [words for words in said if words] == [said[-2]] and "ahead of the others" in said[-2]
    log = window.read()
    assert log is not None and np.isfinite(log.altitude_m).sum() == 21 and log.time_s[-1] == pytest.approx(NOW_S)


def test_a_report_that_cannot_be_written_is_forgotten_as_other_damage(window):
    fill(window, [b'{"time_s": 1699999997, "odd": "\\ud800"}', *objects()])
    with pytest.raises(UnicodeEncodeError):
        window.read()
    log = window.read()
    assert log is not None and len(log) == 10


def test_names_beyond_a_limit_are_not_read(window):
    fill(window, [line(NOW_S - 2 + k / 10, 48.0, **{f"odd{k}x{j}": 1 for j in range(200)}) for k in range(20)])
    log = window.read()
    assert log is not None and len(log) == 20
    assert window._content().partition(b"\r\n")[0].count(b",") < 500


@pytest.mark.parametrize("behind_s", [0.0, 3600.0, -30.0])
def test_the_time_of_day_of_sentences_without_a_date_counts(window, behind_s):
    lines = []
    for k in range(20):
        utc_s = NOW_S - 2 + k / 10 - behind_s
        clock = f"{utc_s // 3600 % 24:02.0f}{utc_s // 60 % 60:02.0f}{utc_s % 60:05.2f}"
        body = f"GPGGA,{clock},4800.{k:03d},N,01130.000,E,1,08,0.9,545.4,M,46.9,M,,"
        lines.append(f"${body}*{reduce(xor, body.encode()):02X}".encode())
    fill(window, lines)
    log = window.read()
    assert log is not None
    assert log.time_s[-1] == pytest.approx(NOW_S - 0.1 - behind_s, abs=0.01)


@pytest.mark.parametrize("odd", [NOW_S + 1e6, 4e9, 1e18, 1e300, NOW_S - 1e6])
@pytest.mark.parametrize("kind", ["json", "csv"])
def test_a_row_with_an_odd_time_is_left_out_and_the_others_stay_readable(window, kind, odd):
    told = [odd if k == 20 else NOW_S - 4 + k / 10 for k in range(40)]
    lines = [line(told_s, 48 + k * 1e-5) for k, told_s in enumerate(told)]
    if kind == "csv":
        lines = [HEADER, *(f"{told_s},11.5,48,50".encode() for told_s in told)]
    said = [words for words in fill(window, lines) if words]
    assert len(said) == 1 and said[0].endswith("such rows are left out")
    log = window.read()
    assert log is not None and len(log) == 39 and log.time_s[-1] == pytest.approx(NOW_S - 0.1)


def test_rows_after_a_clock_was_set_are_taken_again(window):
    told = [NOW_S - 2 + k / 10 + (500 if k >= 10 else 0) for k in range(20)]
    said = fill(window, [line(told_s, 48 + k * 1e-5) for k, told_s in enumerate(told)])
    assert [bool(words) for words in said] == [k in (10, 11) for k in range(20)]
    log = window.read()
    assert log is not None and len(log) == 8


def test_rows_that_an_outage_held_back_are_all_taken(window):
    said = fill(window, [line(NOW_S - 90 + k, 48.0) for k in range(10)], 1.0)
    said += [window.add(NOW_S, line(NOW_S - 80 + k, 48.0)) for k in range(80)]
    assert not any(said)
