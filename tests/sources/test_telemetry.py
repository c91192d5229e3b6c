"""Telemetry: read by column name, interpolated in time, never invented."""

from pathlib import Path

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.sources.telemetry import at, read_telemetry
from torchvision_dddas.types import Telemetry

HEADER = "time_s,altitude_m,speed_m_s\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "telemetry.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_columns_are_found_by_name_whatever_their_order_and_company(tmp_path: Path) -> None:
    text = "\ufeffspeed_m_s, battery, time_s, altitude_m\n5,99,0,20\n\n6,98,0.5,25\n"
    read = read_telemetry(write(tmp_path, text))
    np.testing.assert_array_equal(read.time_s, [0, 0.5])
    np.testing.assert_array_equal(read.altitude_m, [20, 25])
    np.testing.assert_array_equal(read.speed_m_s, [5, 6])


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", ["lacks time_s, altitude_m, speed_m_s", "none"]),
        ("time_s,height,speed_m_s\n0,1,2\n", ["lacks altitude_m", "time_s, height, speed_m_s"]),
        ("time_s;altitude_m;speed_m_s\n0;1;2\n", ["lacks", "time_s;altitude_m;speed_m_s"]),
        (HEADER, ["no rows"]),
        (HEADER + "0,20,5\n1,high,5\n", ["line 3", "altitude_m is 'high'"]),
        (HEADER + "0,20,nan\n", ["line 2", "speed_m_s is 'nan'"]),
        (HEADER + "0,inf,5\n", ["line 2", "altitude_m is 'inf'"]),
        (HEADER + "0,20,-5\n", ["line 2", "speed_m_s is '-5'", "0 or more"]),
        (HEADER + "0,20\n", ["line 2", "speed_m_s is ''"]),
        (HEADER + "0,20,5\n2,20,5\n1,20,5\n", ["line 4", "runs back from 2 to 1"]),
    ],
)
def test_a_mistake_gets_one_line_with_file_and_place(tmp_path: Path, text: str, wanted: list[str]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as error:
        read_telemetry(path)
    assert "\n" not in str(error.value)
    for part in [str(path), *wanted]:
        assert part in str(error.value)


def test_a_file_that_is_absent_or_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_telemetry(tmp_path / "absent.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError, match="no CSV text"):
        read_telemetry(tmp_path / "bytes.csv")


def _told(flown: Telemetry, time_s: float) -> tuple[float, float]:
    flight = at(flown, time_s)
    assert flight is not None
    return flight.altitude_m, flight.speed_m_s


def test_between_samples_it_is_linear_and_far_outside_nothing_is_known() -> None:
    flown = Telemetry(np.array([1.0, 3.0]), np.array([20.0, 40.0]), np.array([4.0, 8.0]))
    assert _told(flown, 1.5) == (25, 5)
    assert _told(flown, 3) == (40, 8)
    assert _told(flown, 0.5) == (20, 4)
    assert _told(flown, 3.9) == (40, 8)
    assert at(flown, 4.1) is None
    assert at(flown, -0.1) is None
    assert at(flown, 0.5, tolerance_s=0.1) is None


def test_without_samples_nothing_is_known() -> None:
    assert at(Telemetry(np.zeros(0), np.zeros(0), np.zeros(0)), 0) is None
