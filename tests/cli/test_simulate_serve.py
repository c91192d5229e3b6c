"""`dddas simulate --serve`: other programs see and steer the world while it runs."""

import socket
import threading
from typing import Any

import numpy as np
import pytest

from tests.cli.conftest import bad, record, rows
from tests.lab.simulation.small import as_file, small
from torchvision_dddas.io.telemetry import read_telemetry

LONG_S = 60.0
STILL = {"wind_m_s": 0.0, "shake_deg": 0.0, "speed_m_s": 0.0, "way_m": ()}


@pytest.fixture
def world(tmp_path):
    """A scenario file of some seconds, whose UAV stays where it is unless it is steered."""
    return as_file(tmp_path / "tiny.toml", small(uav={"altitude_m": 30.0, **STILL}, clip={"seconds": 6.0}))


class Listener:
    """Receives the datagrams of a port of this machine until its context ends."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.1)
        self.port, self.heard = self.socket.getsockname()[1], list[tuple[bytes, tuple[str, int]]]()
        self._ended, self._thread = threading.Event(), threading.Thread(target=self._listen, daemon=True)

    def _listen(self):
        while True:
            try:
                self.heard.append(self.socket.recvfrom(65535))
            except TimeoutError:
                if self._ended.is_set():
                    return

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join(LONG_S)
        self.socket.close()


@pytest.mark.slow
def test_pictures_with_metadata_and_a_vehicle_are_served(dddas, world, tmp_path):
    pytest.importorskip("av")
    dialect = pytest.importorskip("pymavlink.dialects.v20.all")
    with Listener() as pictures, Listener() as vehicle:
        addresses = "--serve", f"udp://127.0.0.1:{pictures.port}", "--serve-mavlink", f"udpout:127.0.0.1:{vehicle.port}"
        done = dddas("simulate", world, *addresses, "--speed", 20, "--frames", 20, "--out", tmp_path / "out")
        assert done.exit_code == 0, done.output
    stream = tmp_path / "heard.ts"
    stream.write_bytes(b"".join(content for content, _ in pictures.heard))
    flown, told = read_telemetry(stream), read_telemetry(tmp_path / "out" / "telemetry.csv")
    assert len(flown) > 10  # a busy machine may lose datagrams
    assert np.abs(flown.place - told.place[0]).max() < 1e-3
    messages = dialect.MAVLink(None).parse_buffer(b"".join(content for content, _ in vehicle.heard))
    kinds = {message.get_type() for message in messages}
    assert {"HEARTBEAT", "GLOBAL_POSITION_INT", "ATTITUDE", "GIMBAL_DEVICE_ATTITUDE_STATUS", "SYSTEM_TIME"} <= kinds
    served = rows(tmp_path / "out" / "served.csv")
    assert [row["frame"] for row in served] == [str(k) for k in range(1, 21)]
    assert record(tmp_path / "out")["served"]["speed"] == 20
    assert not (tmp_path / "out" / "frames").exists()  # pictures are written only on request


@pytest.mark.slow
def test_the_vehicle_obeys_and_the_truth_is_that_of_the_steered_flight(dddas, world, tmp_path):
    dialect = pytest.importorskip("pymavlink.dialects.v20.all")
    ended, answers = threading.Event(), list[Any]()
    goal_deg = -110.9498, 31.6  # about 19 m to the east of the start
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(0.1)
        place = round(1e7 * goal_deg[1]), round(1e7 * goal_deg[0])
        order = dialect.MAVLink_command_int_message(1, 1, 3, 192, 0, 0, -1, 0, 0, 0, *place, 30.0)
        order = bytes(order.pack(dialect.MAVLink(None, srcSystem=255, srcComponent=190)))

        def command() -> None:
            reader = dialect.MAVLink(None)
            while not ended.is_set():
                try:
                    content, peer = station.recvfrom(65535)
                except TimeoutError:
                    continue
                found = reader.parse_buffer(content) or []
                answers.extend(one for one in found if one.get_type() == "COMMAND_ACK")
                if not answers:
                    station.sendto(order, peer)

        thread = threading.Thread(target=command, daemon=True)
        thread.start()
        link = f"udpout:127.0.0.1:{station.getsockname()[1]}"
        done = dddas("simulate", world, "--serve-mavlink", link, "--speed", 5, "--out", tmp_path / "out")
        ended.set()
        thread.join(LONG_S)
    assert done.exit_code == 0, done.output
    assert (answers[0].command, answers[0].result, answers[0].target_system) == (192, 0, 255)
    flown = read_telemetry(tmp_path / "out" / "telemetry.csv").place
    assert flown[-1, 0] - flown[0, 0] > 5e-5  # 5 m to the east


def test_a_world_that_nobody_hears_runs_to_its_end(dddas, world, tmp_path):
    pytest.importorskip("av")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    given = "--serve", f"udp://127.0.0.1:{port}", "--speed", 50, "--frames", 5, "--fault", "camera=off@0.1..0.3"
    done = dddas("simulate", world, *given, "--link", "latency=0.1,loss=0.5", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert len(rows(tmp_path / "out" / "served.csv")) == 5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--speed", "2"), "are for a served world: give --serve or --serve-mavlink"),
        (("--serve", "rtsp://127.0.0.1:9"), "wanted udp://HOST:PORT or tcp://HOST:PORT"),
        (("--serve", "udp://127.0.0.1:9", "--speed", "0"), "--speed must be between 0.01 and 100, got 0"),
        (("--serve", "udp://127.0.0.1:9", "--link", "delay=3"), "'delay=3' is no condition of a link"),
        (("--serve", "tcp://127.0.0.1:0", "--link", "loss=0.1"), "wanted udp://HOST:PORT or tcp://HOST:PORT"),
        (("--serve", "udp://127.0.0.1:9", "--fault", "gps=gone@1..2"), "wanted INSTRUMENT=VERB@FROM..TO"),
        (("--serve-mavlink", "carrier:pigeon"), "is no MAVLink connection"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(dddas, world, tmp_path, words, message):
    assert message in bad(dddas("simulate", world, *words, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_loss_needs_datagrams(dddas, world, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    words = "--serve", f"tcp://127.0.0.1:{port}", "--link", "loss=0.1"
    assert "TCP loses nothing" in bad(dddas("simulate", world, *words, "--out", tmp_path / "out"))
