"""Local sets that are written are those that the reader reads."""

import math

import pytest

from torchvision_dddas.io.telemetry import encode_flight, read_telemetry
from torchvision_dddas.io.telemetry.misb import local_sets
from torchvision_dddas.types import Flight

UTC_S = 1_767_225_600.0


def flight(**columns):
    known = {"altitude_m": 51.25, "speed_m_s": 7.0, "place": (-110.95, 31.6), "above_sea_m": 1350.5}
    angles = {"heading_rad": 5.9, "pitch_rad": 0.7, "roll_rad": -0.02, "hfov_rad": 0.8}
    return Flight(**{**known, **angles, **columns})


@pytest.mark.parametrize(
    "said",
    [
        {},
        {"heading_rad": 0.0, "pitch_rad": 1.5, "roll_rad": 0.03},
        {"place": (179.9999, -89.9), "above_sea_m": -100.0},
        {"vehicle_heading_rad": 2.5},
    ],
)
def test_a_written_flight_is_read_again(tmp_path, said):
    path, one = tmp_path / "log.klv", flight(**said)
    path.write_bytes(b"".join(encode_flight(one, UTC_S + k) for k in range(3)))
    read = read_telemetry(path)
    assert read.start_utc_s == pytest.approx(UTC_S)
    assert read.time_s.tolist() == pytest.approx([0, 1, 2])
    now = read.at(1.0)
    assert now is not None
    assert now.place == pytest.approx(one.place, abs=1e-7)
    assert now.altitude_m == pytest.approx(one.altitude_m, abs=1e-3)
    assert now.above_sea_m == pytest.approx(one.above_sea_m, abs=0.2)
    assert now.speed_m_s == one.speed_m_s
    for name in ("heading_rad", "pitch_rad", "roll_rad", "hfov_rad"):
        assert math.remainder(getattr(now, name) - getattr(one, name), 2 * math.pi) == pytest.approx(0, abs=1e-4)


def test_unknown_values_are_left_out():
    nan = math.nan
    silent = flight(place=(nan, nan), heading_rad=nan, pitch_rad=nan, roll_rad=nan, altitude_m=nan, above_sea_m=1e6)
    (found,) = local_sets(encode_flight(silent, UTC_S))
    assert found.whole
    assert set(found.tags) == {1, 2, 16, 56, 65}
