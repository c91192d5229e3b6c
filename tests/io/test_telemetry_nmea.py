"""NMEA 0183: what receivers say, how programs wrap it, and what is wrong with sentences."""

import math

import numpy as np
import pytest

from tests.io.flights import sentence
from torchvision_dddas.io.telemetry import read_telemetry

PLACE = [-(11 + 31 / 60), 48 + 7.038 / 60]
TIMES = [f"12351{i}.50" for i in range(5)]


def gga(clock: str, quality: int = 1, talker: str = "GP", separation: str = "46.9", latitude: str = "4807.0380") -> str:
    return sentence(f"{talker}GGA,{clock},{latitude},N,01131.0000,W,{quality},08,0.9,545.4,M,{separation},M,,")


def rmc(clock: str, date: str = "230321") -> str:
    return sentence(f"GNRMC,{clock},A,4807.0380,N,01131.0000,W,10.0,084.4,{date},003.1,W")


def bare(line: str) -> str:
    return line.split("*")[0]


def resummed(line: str, other) -> str:
    """The sentence with another checksum, which depends on the right one."""
    return f"{line[:-2]}{other(int(line[-2:], 16)) % 256:02X}"


def test_places_heights_speeds_and_headings_of_a_receiver(fly):
    lines = []
    for clock in TIMES:
        lines += [gga(clock), rmc(clock), sentence("HEHDT,274.0,T"), sentence("PUBX,00,1,2"), "noise"]
    flown = fly("\r\n".join(lines), "track.nmea", clock_offset_s=1.0)
    assert flown.time_s.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(flown.place, [PLACE] * 5)
    assert flown.above_sea_m.tolist() == [545.4] * 5 and np.isnan(flown.altitude_m).all()
    np.testing.assert_allclose(flown.above_ellipsoid_m, 545.4 + 46.9)
    np.testing.assert_allclose(flown.speed_m_s, 10 * 1852 / 3600)
    np.testing.assert_allclose(np.degrees(flown.vehicle_heading_rad), 274)
    assert not any("left out" in note or "checksum" in note for note in flown.notes)
    assert flown.start_utc_s == 1_616_502_910.5 - 1.0  # 2021-03-23T12:35:10.5Z is the first


def test_time_goes_on_over_midnight_and_without_a_fix_nothing_is_known(fly):
    flown = fly("\n".join([gga("235958"), gga("235959", quality=0), gga("000000"), gga("000001")]), "track.nmea")
    assert flown.time_s.tolist() == [0, 1, 2, 3]
    assert np.isnan(flown.place[:, 0]).tolist() == [False, True, False, False]
    assert math.isnan(flown.at(1.2).place[0])


@pytest.mark.parametrize(
    ("body", "name", "value"),
    [
        ("GNGNS,{},4807.0380,N,01131.0000,W,AN,08,0.9,545.4,46.9,,", "above_ellipsoid_m", 592.3),
        ("GPGLL,4807.0380,N,01131.0000,W,{},A,A", "place", PLACE),
        ("GPGGA,{},4807.0380,N,01131.0000,W,1,08,,,M,,M,,\n$GNTHS,77.5,A", "vehicle_heading_rad", math.radians(77.5)),
        ("GPGGA,{},4807.0380,N,01131.0000,W,1,08,,,M,,M,,\n$GNTHS,77.5,V", "vehicle_heading_rad", math.nan),
        ("GPGGA,{},4807.0380,N,01131.0000,W,1,08,,,M,,M,,\n$GNVTG,54.7,T,,M,5.5,N,36.0,K,A", "speed_m_s", 10),
        ("GPGGA,{},4807.0380,N,01131.0000,W,1,08,,,M,,M,,\n$GNVTG,54.7,T,,M,5.5,N,36.0,K", "speed_m_s", 10),
        ("GPGGA,{},4807.0380,N,01131.0000,W,1,08,0.9,545.4,M,,M,,", "above_ellipsoid_m", math.nan),
    ],
)
def test_each_kind_of_sentence_gives_its_quantity(fly, body, name, value):
    flown = fly("\n".join(f"${body.format(clock)}" for clock in TIMES), "track.nmea")
    np.testing.assert_allclose(getattr(flown, name)[2], value)


@pytest.mark.parametrize(
    "wrapped",
    [
        "NMEA,{},1499000000000",
        "[1499000000000]{}",
        "2021-03-23 12:35:10.123 {}",
        '{{"nmea": "{}\\r\\n", "t": 1}}',
        "b'{}\\r\\n'",
        '17,"{}",3',
        "\\s:r001,c:1499000000*3F\\{}",
        "<sentence>{}</sentence>",
        "{}{}",
        "GPS: {} ok",
    ],
)
@pytest.mark.parametrize("change", [str, bare, lambda line: line.lstrip("$")])
def test_a_sentence_is_found_in_other_text(fly, wrapped, change):
    if change is not str and wrapped == "{}{}":
        pytest.skip("nothing tells where the first of two sentences ends")
    text = "\n".join(wrapped.format(change(gga(clock)), change(gga(clock))) for clock in TIMES)
    for name in ("log.txt", "log.csv"):
        flown = fly(text, name)
        np.testing.assert_allclose(flown.place, [PLACE] * 5)
        assert flown.above_sea_m.tolist() == [545.4] * 5


def test_sentences_behind_many_other_lines_are_found(fly):
    other = ["# Raw,ElapsedRealtimeMillis"] * 50 + ["Raw," + "1," * 100] * 150
    assert len(fly("\n".join([*other, *(f"NMEA,{gga(clock)},1" for clock in TIMES)]), "gnss_log.txt")) == 5


def test_talkers_of_all_constellations_are_read(fly):
    talkers = ["GP", "GL", "GA", "GB", "BD", "GQ", "QZ", "GI", "GN"]
    assert len(fly("\n".join(gga(f"12351{i}", talker=talker) for i, talker in enumerate(talkers)), "a.nmea")) == 9


@pytest.mark.parametrize(
    ("change", "known", "words"),
    [
        (lambda i, line: line, 5, ()),
        (lambda i, line: line[:-2] + line[-2:].lower(), 5, ()),
        (lambda i, line: bare(line), 5, ("5 of 5 sentences have no checksum",)),
        (lambda i, line: line[:-1], 5, ("5 of 5 sentences have a short checksum",)),
        (lambda i, line: line[:-2], 5, ("5 of 5 sentences have a short checksum",)),
        (lambda i, line: resummed(line, lambda right: 0), 5, ("5 of 5", "wrong in the same way")),
        (lambda i, line: resummed(line, lambda right: right ^ ord("$")), 5, ("5 of 5", "wrong in the same way")),
        (lambda i, line: line.replace("545.4", "945.4") if i == 1 else line, 4, ("line 2", "1 with a wrong checksum")),
        (lambda i, line: line[:40] if i == 1 else line, 4, ("line 2", "1 without a checksum")),
        (lambda i, line: bare(line)[: 40 if i == 1 else None], 4, ("line 2", "1 too short")),
        (lambda i, line: bare(line).replace("4807", "48x7" if i == 1 else "4807"), 4, ("line 2", "1 with a garbled")),
        (lambda i, line: bare(line).replace("4807", "9907" if i == 1 else "4807"), 4, ("line 2", "1 with a garbled")),
    ],
)
def test_what_is_wrong_with_sentences_decides_and_is_said(fly, change, known, words):
    flown = fly("\n".join(change(i, gga(clock)) for i, clock in enumerate(TIMES)), "track.nmea")
    assert len(flown) == known and flown.above_sea_m.tolist() == [545.4] * known
    assert all(any(word in note for note in flown.notes) for word in words)
    assert bool(words) == any("checksum" in note or "left out" in note for note in flown.notes)


def test_sentences_without_checksums_are_read_beside_others_that_have_them(fly):
    lines = [line for clock in TIMES for line in (gga(clock), bare(sentence("HEHDT,274.0,T")))]
    flown = fly("\n".join(lines), "track.nmea")
    np.testing.assert_allclose(np.degrees(flown.vehicle_heading_rad), 274)
    assert any("5 of 10 sentences have no checksum" in note for note in flown.notes)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([sentence("GPGSV,1,1,00")] * 3, ("no NMEA sentence gives",)),
        ([resummed(gga(clock), lambda r, i=i: r + 17 * i + 3) for i, clock in enumerate(TIMES)], ("5 with a wrong",)),
        ([gga(clock)[:30] for clock in TIMES], ("5 too short",)),
        ([sentence("HEHDT,274.0,T")] * 3, ("together with a time",)),
    ],
)
def test_a_log_without_a_sentence_to_trust_is_refused_with_what_is_wrong(refused, lines, words):
    said = refused(read_telemetry, "\n".join(lines), "a.nmea")
    assert all(word in said for word in words)


@pytest.mark.parametrize(
    ("dates", "start_utc_s"),
    [
        (["230321"] * 5, 1_616_502_910.5),
        (["060180", *["230321"] * 4], 1_616_502_910.5),  # before the first fix
        (["060180"] * 5, math.nan),
        (["070801"] * 5, math.nan),  # 2021-03-23, 1024 weeks early
        (["230380"] * 5, math.nan),
        (["000000"] * 5, math.nan),
    ],
)
def test_a_clock_that_cannot_be_is_none(fly, dates, start_utc_s):
    flown = fly("\n".join(rmc(clock, date) for clock, date in zip(TIMES, dates, strict=True)), "track.nmea")
    np.testing.assert_equal(flown.start_utc_s, start_utc_s)
    assert any("which cannot be" in note for note in flown.notes) == (dates[-1] not in ("230321", "000000"))


@pytest.mark.parametrize("talker", ["GN", "GP"])
def test_of_two_receivers_at_two_places_the_first_counts_with_a_note(fly, talker):
    lines = [one for k in range(4) for one in (gga(f"12000{k}"), gga(f"12000{k}", talker=talker, latitude="4907.038"))]
    flown = fly("\n".join(lines) + "\n", "a.nmea")
    assert len(flown) == 4 and flown.place[:, 1] == pytest.approx(48.1173)
    assert [note for note in flown.notes if "line 2: the log has two receivers" in note and "4 sentences" in note]


def test_the_date_of_zda_sets_the_clock(fly):
    text = "\n".join([sentence("GNZDA,123510.50,23,03,2021,00,00"), *map(gga, TIMES)])
    assert fly(text, "track.nmea").start_utc_s == 1_616_502_910.5


def test_a_receiver_without_a_geoid_is_named(fly):
    flown = fly("\n".join(gga(clock, separation="0.0") for clock in TIMES), "track.nmea")
    assert any("may be above the ellipsoid" in note for note in flown.notes)
