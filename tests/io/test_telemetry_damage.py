"""Whatever happened to a log: it is read as far as it is whole, or refused in one line; never a traceback or a hang."""

import random
from pathlib import Path

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.types import Telemetry

pytest.importorskip("pymavlink")
pytest.importorskip("pyulog")
pytest.importorskip("pynmea2")
from tests.io.flights import tlog, transport_stream, ulog
from tests.io.test_telemetry_logs import GLOBAL, LOCAL, flown
from tests.io.test_telemetry_misb import packet
from tests.io.test_telemetry_nmea import gga, rmc
from tests.io.test_telemetry_srt import KEYED, timed

WHOLE = {
    "own.csv": b"time_s,altitude_m,speed_m_s\n" + b"".join(b"%d,%d,5\n" % (i, 50 + i) for i in range(30)),
    "keyed.SRT": timed(*[KEYED.format(n=i, ms=i) for i in range(6)]).encode(),
    "spread.srt": timed(*["HOME(-58.4,-34.7) 2017.07.03 10:15:03\nGPS(-58.4,-34.7,19) BAROMETER:20.1"] * 9).encode(),
    "flight.tlog": tlog(flown(12)),
    "flight.ulg": ulog({"vehicle_global_position": GLOBAL, "vehicle_local_position": LOCAL}),
    "video.ts": transport_stream([3600 * i for i in range(8)], [(3600 * i, packet(i)) for i in range(8)]),
    "track.nmea": "\r\n".join(line(f"1200{i:02d}") for i in range(20) for line in (gga, rmc)).encode(),
}


def damaged(whole: bytes, rng: random.Random) -> bytes:
    content = bytearray(whole)
    kind = rng.randrange(4)
    if kind == 0:
        return bytes(content[: rng.randrange(len(content))])
    if kind == 1:
        first = rng.randrange(len(content))
        del content[first : first + rng.randrange(1, 200)]
    if kind == 2:
        first = rng.randrange(len(content))
        content[first:first] = rng.randbytes(rng.randrange(1, 60))
    for _ in range(rng.choice([1, 3, 30])):
        if content:
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return bytes(content)


def sound(found: Telemetry) -> bool:
    rising = bool((np.diff(found.time_s) > 0).all()) and bool(np.isfinite(found.time_s).all())
    columns = (found.altitude_m, found.speed_m_s, found.above_sea_m, found.heading_rad, found.pitch_rad, found.place)
    told = found.at(float(found.time_s[len(found) // 2]))
    return rising and told is not None and not any(np.isinf(column).any() for column in columns)


def tried(path: Path) -> tuple[Telemetry | None, str]:
    try:
        return read_telemetry(path), ""
    except InputError as error:
        return None, str(error)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", WHOLE)
def test_a_damaged_log_gives_a_sound_record_or_one_clear_line(tmp_path: Path, name: str) -> None:
    rng = random.Random(name)
    path = tmp_path / name
    path.write_bytes(WHOLE[name])
    assert sound(read_telemetry(path))
    read = 0
    for _ in range(60):
        path.write_bytes(damaged(WHOLE[name], rng))
        found, said = tried(path)
        if found is None:
            assert str(path) in said and "\n" not in said
        else:
            read += 1
            assert sound(found) and not any("\n" in note for note in found.notes)
    assert read > 0


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
