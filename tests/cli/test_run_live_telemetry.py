"""`dddas run --live --telemetry` with reports that come during the run."""

import json
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from fractions import Fraction
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import pytest

from tests.cli.conftest import bad
from tests.cli.test_run_live import FAST, film_camera, session
from tests.io.flights import local_set, spread
from tests.synthetic_clip import render
from torchvision_dddas.geometry import DEGREE_M

__all__ = ["film_camera"]
SPEED_M_S = 50.0
CAMERA = "hfov_deg = 60\npitch_deg = 60\nheading_deg = 0\nheight_m = 15\n"


def north_m(utc_s: float) -> float:
    return utc_s % 1000 * SPEED_M_S


def latitude(utc_s: float) -> float:
    return 48 + north_m(utc_s) / DEGREE_M


class Sender:
    """Calls `send(now)` ten times a second, from now on until the test ends."""

    def __init__(self, send: Callable[[float], object]) -> None:
        self._ended, self._send = threading.Event(), send
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.1):
            self._send(time.time())

    def close(self) -> None:
        self._ended.set()
        self._thread.join(10)


@pytest.fixture
def sender() -> Iterator[Callable[[Callable[[float], object]], Sender]]:
    opened: list[Sender] = []

    def begin(send: Callable[[float], object]) -> Sender:
        opened.append(Sender(send))
        return opened[-1]

    yield begin
    for one in opened:
        one.close()


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def as_row(utc_s: float) -> dict[str, float]:
    row = {"time_s": utc_s, "longitude_deg": 11.5, "latitude_deg": latitude(utc_s), "altitude_m": 15}
    return {**row, "heading_deg": 0, "pitch_deg": 60, "hfov_deg": 60}


def as_csv(utc_s: float) -> bytes:
    return (",".join(f"{value:.9f}" for value in as_row(utc_s).values()) + "\n").encode()


HEADER = (",".join(as_row(0)) + "\n").encode()


def as_nmea(utc_s: float) -> bytes:
    moment = datetime.fromtimestamp(utc_s, UTC)
    clock = f"{moment:%H%M%S}.{moment.microsecond // 1000:03d}"
    place = f"48{60 * (latitude(utc_s) - 48):010.7f},N,01130.0000000,E"
    lines = [
        f"GPRMC,{clock},A,{place},97.2,0.0,{moment:%d%m%y},,,A",
        f"GPGGA,{clock},{place},1,10,1.0,540.0,M,46.0,M,,",
    ]
    return "".join(f"${line}*{reduce(xor, line.encode()):02X}\r\n" for line in lines).encode()


def as_tpv(utc_s: float) -> bytes:
    stamp = datetime.fromtimestamp(utc_s, UTC).isoformat().replace("+00:00", "Z")
    row = {"class": "TPV", "mode": 3, "time": stamp, "lat": latitude(utc_s), "lon": 11.5, "altMSL": 540.0}
    return (json.dumps(row) + "\r\n").encode()


def as_mavlink(system: int) -> Callable[[float], bytes]:
    from pymavlink.dialects.v20 import all as dialect

    packer = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
    begin_s = time.time()

    def write(utc_s: float) -> bytes:
        boot_ms, degrees = round(1000 * (utc_s - begin_s)), (round(1e7 * latitude(utc_s)), 115_000_000)
        north = round(100 * SPEED_M_S)
        place = dialect.MAVLink_global_position_int_message(boot_ms, *degrees, 540_000, 15_000, north, 0, 0, 0)
        nose = dialect.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0)
        beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
        return b"".join(bytes(one.pack(packer)) for one in (place, nose, beat))

    return write


def datagrams(port: int, write: Callable[[float], bytes]) -> Callable[[float], object]:
    way = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    return lambda now_s: way.sendto(write(now_s), ("127.0.0.1", port))


def server(write: Callable[[float], bytes], greeting: bytes, ended: threading.Event) -> int:
    """Accept one connection, wait for the greeting, and send ten times a second."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        listener.settimeout(20)
        way = listener.accept()[0]
        assert not greeting or way.recv(len(greeting)) == greeting
        with listener, way:
            while not ended.wait(0.1):
                way.sendall(write(time.time()))

    threading.Thread(target=serve, daemon=True).start()
    return int(listener.getsockname()[1])


def after_results(out: Path, lines: int, act: Callable[[], object], otherwise: Callable[[], object]) -> None:
    """Do something in a thread once a session has written so many results; do another thing after a minute."""

    def watch() -> None:
        end_s = time.monotonic() + 60
        while time.monotonic() < end_s:
            if sum(len(path.read_bytes().splitlines()) for path in out.glob("*/results.jsonl")) >= lines:
                act()
                return
            time.sleep(0.05)
        otherwise()

    threading.Thread(target=watch, daemon=True).start()


def check_places(out: Any) -> tuple[str, dict[str, Any], list[dict[str, Any]]]:
    """The places of a session are those of the vehicle at the times of the pictures. Returns its events."""
    folder, record, results = session(out)
    placed = [(line, target) for line in results for target in line["targets"] if target.get("lonlat_deg")]
    events = (folder / "events.log").read_text()
    assert placed, events
    for line, target in placed:
        # The targets lie within tens of metres of the vehicle, and a busy machine is late; a second is 50 m.
        flown_m = north_m(datetime.fromisoformat(line["utc"]).timestamp())
        assert (target["lonlat_deg"][1] - 48) * DEGREE_M == pytest.approx(flown_m, abs=75), events
    return events, record, results


def faults(events: str) -> list[str]:
    """The events about reports, without the silences that a busy machine causes."""
    return [line for line in events.splitlines() if " telemetry: " in line and " telemetry is " not in line]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["json", "nmea", "tpv", "mavlink", "nmea:udp"])
def test_places_are_those_of_datagrams_told_apart_by_content(dddas, film_camera, file, sender, tmp_path, kind):
    if kind == "mavlink":
        pytest.importorskip("pymavlink")
    film_camera(120)
    port = free_port(socket.SOCK_DGRAM)
    write = {"json": lambda s: json.dumps(as_row(s)).encode(), "tpv": as_tpv, "mavlink": as_mavlink(1)}.get(
        kind, as_nmea
    )
    sender(datagrams(port, write))
    given = () if kind == "json" else ("--camera", file("camera.toml", CAMERA))
    address = f"{kind if ':' in kind else 'udp'}:127.0.0.1:{port}"
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, "--telemetry", address, *given, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    events, record, _ = check_places(tmp_path / "out")
    assert not faults(events)
    assert record["telemetry"] == address and record["counts"]["reports"] > 10
    assert any("comes live" in note for note in record["notes"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fifo", "-", "grows", "header"])
def test_places_are_those_of_rows_that_are_added(dddas, film_camera, sender, tmp_path, request, kind):
    film_camera(120)
    path = tmp_path / "log.csv"
    if kind == "fifo":
        os.mkfifo(path)
        way = os.open(path, os.O_RDWR)
        os.write(way, HEADER)
    elif kind == "-":
        read, way = os.pipe()
        os.write(way, HEADER)
        kept = os.dup(0)
        os.dup2(read, 0)
        request.addfinalizer(lambda: os.dup2(kept, 0))
    else:
        now_s = time.time()
        path.write_bytes(HEADER + b"".join(as_csv(now_s - 5 + k) for k in range(5 * (kind == "grows"))))
        way = os.open(path, os.O_WRONLY | os.O_APPEND)
    sender(lambda now_s: os.write(way, as_csv(now_s)))
    given = "-" if kind == "-" else path
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, "--telemetry", given, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    events, _, _ = check_places(tmp_path / "out")
    if kind != "header":  # a row may come before the start
        assert (f"the log {path} grows: its new rows are used" in events) == (kind == "grows")


@pytest.mark.slow
def test_places_are_those_of_gpsd(dddas, film_camera, file, tmp_path):
    film_camera(120)
    ended = threading.Event()
    port = server(as_tpv, b'?WATCH={"enable":true,"json":true};\n', ended)
    given = ("--telemetry", f"gpsd:127.0.0.1:{port}", "--camera", file("camera.toml", CAMERA))
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, *given, "--out", tmp_path / "out")
    ended.set()
    assert done.exit_code == 0, done.output
    check_places(tmp_path / "out")


@pytest.mark.slow
def test_places_are_those_of_one_system_of_mavlink_and_others_are_one_event(dddas, film_camera, file, sender, tmp_path):
    pytest.importorskip("pymavlink")
    film_camera(120)
    port = free_port(socket.SOCK_DGRAM)
    sender(datagrams(port, as_mavlink(7)))
    other = as_mavlink(3)
    sender(datagrams(port, lambda now_s: other(now_s + 400)))
    given = ("--telemetry", f"mavlink:udp:127.0.0.1:{port}?system=7", "--camera", file("camera.toml", CAMERA))
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, *given, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    events, _, _ = check_places(tmp_path / "out")
    assert events.count("MAVLink system 3 is left out: system 7 is taken; see ?system=N") == 1


@pytest.mark.slow
def test_reports_that_stop_end_the_places_and_are_one_event_and_a_trouble(dddas, film_camera, sender, tmp_path):
    film_camera(500)
    port = free_port(socket.SOCK_DGRAM)
    one = sender(datagrams(port, lambda s: json.dumps(as_row(s)).encode()))
    after_results(tmp_path / "out", 5, one.close, one.close)
    address = ("--telemetry", f"udp:127.0.0.1:{port}")
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, *address, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    events, _, results = check_places(tmp_path / "out")
    silent = re.findall(r"(\d+) telemetry: telemetry is silent: the newest report is \d\.\d s older", events)
    assert len(silent) == events.count("telemetry is there again") + 1, events
    late = [line for line in results if line["frame"] > int(silent[-1]) + 5]
    assert late and not any(target.get("lonlat_deg") for line in late for target in line["targets"])


@pytest.mark.slow
@pytest.mark.parametrize(("off_s", "which"), [(-3600, "behind"), (86_400, "ahead of")])
def test_a_wrong_clock_is_one_event_and_places_nothing(dddas, film_camera, sender, tmp_path, off_s, which):
    film_camera(90)
    port = free_port(socket.SOCK_DGRAM)
    sender(datagrams(port, lambda s: json.dumps(as_row(s + off_s)).encode()))
    given = ("--telemetry", f"udp:127.0.0.1:{port}")
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, *given, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    folder, _, results = session(tmp_path / "out")
    events = (folder / "events.log").read_text()
    said = rf"the reports of udp:127.0.0.1:{port} are \d+ s {which} this machine's clock: they are not used"
    assert len(re.findall(said, events)) == 1, events
    assert events.count(" telemetry: telemetry is silent\n") == 1
    assert not any(target.get("lonlat_deg") for line in results for target in line["targets"])


@pytest.mark.slow
def test_garbage_between_reports_is_one_event_and_costs_nothing(dddas, film_camera, sender, tmp_path):
    film_camera(120)
    port = free_port(socket.SOCK_DGRAM)
    good = datagrams(port, lambda s: json.dumps(as_row(s)).encode())
    damaged = [datagrams(port, write) for write in (lambda s: b"\x00\x01\x02", lambda s: b'{"broken": ', as_nmea)]
    sender(lambda now_s: [send(now_s) for send in (good, *damaged)])  # the first report decides the kind
    given = ("--telemetry", f"udp:127.0.0.1:{port}")
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, *given, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    events, record, _ = check_places(tmp_path / "out")
    told = faults(events)
    assert len(told) == 3 and record["counts"]["telemetry_left_out"] > 10, told


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), ("--telemetry", "klv")])
def test_places_are_those_of_klv_in_the_stream_of_the_pictures(dddas, tmp_path, words):
    """The stamps of the packets are an hour late: the times of the stream count."""
    av = pytest.importorskip("av")
    port, ended = free_port(socket.SOCK_DGRAM), threading.Event()
    images = render(0, 14, (240, 180)).images

    def send() -> None:
        container = av.open(f"udp://127.0.0.1:{port}?pkt_size=1316", "w", format="mpegts")
        video = container.add_stream(
            "libx264", rate=25, options={"preset": "ultrafast", "tune": "zerolatency", "g": "5"}
        )
        video.width, video.height, video.pix_fmt = 240, 180, "yuv420p"
        data = container.add_data_stream("klv")
        begin_s, k = time.time(), 0
        while not ended.wait(max(0.0, begin_s + k / 25 - time.time())):
            now_s = time.time()
            picture = av.VideoFrame.from_ndarray(images[k % 14], format="bgr24")
            picture.pts = k
            for packet in video.encode(picture):
                container.mux(packet)
            angles = {18: spread(0, 0, 360, 4), 19: spread(-60, 0, 180, 4, True), 5: spread(0, 0, 360, 2)}
            place = {13: spread(latitude(now_s), 0, 90, 4, True), 14: spread(11.5, 0, 180, 4, True)}
            heights = {15: spread(515, -900, 19000, 2), 16: spread(60, 0, 180, 2), 25: spread(500, -900, 19000, 2)}
            stamp = {2: round(1e6 * (now_s - 3600)).to_bytes(8, "big")}
            klv = av.Packet(
                local_set(
                    {**stamp, **place, **angles, **heights, 6: spread(0, 0, 20, 2, True), 7: spread(0, 0, 50, 2, True)}
                )
            )
            klv.stream, klv.time_base, klv.pts = data, Fraction(1, 90_000), 3600 * k
            klv.dts = klv.pts
            container.mux(klv)
            k += 1
        container.close()

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    after_results(tmp_path / "out", 40, lambda: os.kill(os.getpid(), signal.SIGTERM), ended.set)
    try:
        clip = f"udp://127.0.0.1:{port}?timeout=3000000"
        done = dddas(
            "run", clip, "--live", "--config", "fast", "--set", "live.watchdog_s=0", *words, "--out", tmp_path / "out"
        )
    finally:
        ended.set()
        thread.join(10)
    assert done.exit_code == 0, done.output
    folder, record, results = session(tmp_path / "out")
    assert record["telemetry"] == "klv"
    placed = [(line, target) for line in results for target in line["targets"] if target.get("lonlat_deg")]
    assert placed, (folder / "events.log").read_text()
    for line, target in placed:
        # Encoding and receiving take a part of a second on a busy machine; by the stamps it would be an hour.
        flown_m = north_m(datetime.fromisoformat(line["utc"]).timestamp())
        assert (target["lonlat_deg"][1] - 48) * DEGREE_M == pytest.approx(flown_m, abs=150)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("udp:127.0.0.1", "lacks HOST:PORT"),
        ("nmea:carrier-pigeon:4", "is unknown; wanted"),
        ("klv", "announces no KLV"),
        ("mavlink:udp:127.0.0.1:5?system=900", "system must be one number from 1 to 255"),
        ("gpsd:127.0.0.1:9", "cannot be opened: Connection refused; is it there?"),
    ],
)
def test_an_input_that_cannot_be_opened_is_one_line(dddas, film_camera, tmp_path, address, words):
    film_camera(40)
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, "--telemetry", address, "--out", tmp_path / "out")
    assert words in bad(done)
    assert not (tmp_path / "out").exists()


def test_reports_that_never_come_are_one_line(dddas, film_camera, tmp_path, monkeypatch):
    film_camera(300)
    monkeypatch.setattr("torchvision_dddas.live.live_telemetry._WAIT_S", 0.5)
    address = f"udp:127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, "--telemetry", address, "--out", tmp_path / "out")
    assert f"no telemetry of {address} for 0.5 s: is it sending?" in bad(done)


def test_a_system_that_never_reports_is_one_line_that_names_the_others(
    dddas, film_camera, sender, tmp_path, monkeypatch
):
    pytest.importorskip("pymavlink")
    film_camera(300)
    monkeypatch.setattr("torchvision_dddas.live.live_telemetry._WAIT_S", 1.0)
    port = free_port(socket.SOCK_DGRAM)
    sender(datagrams(port, as_mavlink(3)))
    address = f"mavlink:udp:127.0.0.1:{port}?system=4"
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, "--telemetry", address, "--out", tmp_path / "out")
    assert "MAVLink system 3 is left out: system 4 is taken; see ?system=N" in bad(done)


@pytest.mark.parametrize("live", [(), ("--live",)])
def test_live_telemetry_beside_a_recording_is_refused(dddas, clip, tmp_path, live):
    done = dddas("run", clip, *live, "--telemetry", "udp:127.0.0.1:5", "--out", tmp_path / "out")
    assert ("for a recording give its log" if live else "give --live, or a file") in bad(done)
