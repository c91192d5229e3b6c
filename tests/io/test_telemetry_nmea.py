"""NMEA 0183 of a receiver."""

import math
from pathlib import Path

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry

pytest.importorskip("pynmea2")
from tests.io.flights import sentence


def written(folder: Path, lines: list[str]) -> Path:
    path = folder / "track.nmea"
    path.write_text("\r\n".join(lines))
    return path


def gga(clock: str, minutes: float = 7.038, quality: int = 1) -> str:
    return sentence(f"GPGGA,{clock},48{minutes:07.4f},N,01131.0000,W,{quality},08,0.9,545.4,M,46.9,M,,")


def rmc(clock: str, knots: float = 10.0, date: str = "230394") -> str:
    return sentence(f"GNRMC,{clock},A,4807.0380,N,01131.0000,W,{knots},084.4,{date},003.1,W")


def test_places_heights_speeds_and_headings(tmp_path: Path) -> None:
    lines = []
    for i in range(5):
        lines += [gga(f"12351{i}.50"), rmc(f"12351{i}.50"), sentence("HEHDT,274.0,T"), sentence("PUBX,00,1,2"), "noise"]
    found = read_telemetry(written(tmp_path, lines), clock_offset_s=1.0)
    assert found.time_s.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(found.place, [[-(11 + 31 / 60), 48 + 7.038 / 60]] * 5)
    assert found.above_sea_m.tolist() == [545.4] * 5 and np.isnan(found.altitude_m).all()
    np.testing.assert_allclose(found.speed_m_s, 10 * 1852 / 3600)
    np.testing.assert_allclose(np.degrees(found.vehicle_heading_rad), 274)
    assert not any("left out" in note for note in found.notes)
    assert (
        found.start_utc_s == pytest.approx(764_426_119.5 - 1.0 - 0.0, abs=3600 * 24 * 366)
        and found.start_utc_s % 1 == 0.5
    )


def test_time_goes_on_over_midnight(tmp_path: Path) -> None:
    lines = [gga("235958"), gga("235959"), gga("000000"), gga("000001")]
    assert read_telemetry(written(tmp_path, lines)).time_s.tolist() == [0, 1, 2, 3]


def test_without_a_fix_nothing_is_known(tmp_path: Path) -> None:
    lines = [gga("120000"), gga("120001", quality=0), gga("120002"), gga("120003")]
    found = read_telemetry(written(tmp_path, lines))
    assert np.isnan(found.place[:, 0]).tolist() == [False, True, False, False]
    flight = found.at(1.2)
    assert flight is not None and math.isnan(flight.place[0])


def test_a_sentence_with_a_wrong_checksum_is_left_out_and_noted_with_its_line(tmp_path: Path) -> None:
    lines = [gga("120000"), gga("120001").replace("545.4", "945.4"), gga("120002"), gga("120003")[:30]]
    found = read_telemetry(written(tmp_path, lines))
    assert found.time_s.tolist() == [0, 2] and found.above_sea_m.tolist() == [545.4] * 2
    assert any("line 2" in note and "2 lines are left out" in note for note in found.notes)


def test_sentences_without_checksums_are_taken_where_none_has_one(tmp_path: Path) -> None:
    lines = [gga(f"12000{i}").split("*")[0] for i in range(3)]
    assert len(read_telemetry(written(tmp_path, lines))) == 3


def test_sentences_that_tell_no_place_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no NMEA sentence tells"):
        read_telemetry(written(tmp_path, [sentence("GPGSV,1,1,00")] * 3))
