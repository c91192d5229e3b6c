"""Pictures and metadata in a transport stream, as other programs read them."""

import contextlib
import socket
import threading

import numpy as np
import pytest

from tests.synthetic_clip import render
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import encode_flight, read_telemetry
from torchvision_dddas.lab.simulation.served_camera import CameraStream, StreamSender
from torchvision_dddas.types import Flight

av = pytest.importorskip("av")

UTC_S, WAIT_S = 1_767_225_600.0, 20.0


def test_the_stream_has_the_pictures_and_the_places(tmp_path):
    images, datagrams = render(0, 14, (160, 120)).images, list[bytes]()
    stream = CameraStream((160, 120), 10.0, datagrams.append)
    for k, image in enumerate(images):
        stream.show(image, encode_flight(Flight(50.0, 1.0, (11.0, 48.0 + k / 1000)), UTC_S + k / 10))
        assert sum(map(len, datagrams)) % 188 == 0
    stream.close()
    assert max(map(len, datagrams)) <= 1316
    path = tmp_path / "flight.ts"
    path.write_bytes(b"".join(datagrams))
    with av.open(str(path)) as container:
        assert [one.name for one in container.streams] == ["h264", "klv"]
        read = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    assert len(read) == len(images)
    assert np.abs(read[5].astype(float) - images[5]).mean() < 8
    flown = read_telemetry(path)
    assert np.allclose(flown.place[:, 1], 48 + np.arange(14) / 1000, atol=1e-6)


def test_a_picture_or_its_metadata_may_be_missing(tmp_path):
    image, datagrams = render(0, 1, (160, 120)).images[0], list[bytes]()
    stream = CameraStream((160, 120), 10.0, datagrams.append)
    for k in range(12):
        report = encode_flight(Flight(50.0, place=(11.0, 48.0)), UTC_S + k)
        stream.show(None if k in (3, 4) else image, None if k in (7, 8) else report)
    stream.close()
    path = tmp_path / "flight.ts"
    path.write_bytes(b"".join(datagrams))
    with av.open(str(path)) as container:
        kinds = [packet.stream.type for packet in container.demux() if packet.size]
    assert (kinds.count("video"), kinds.count("data")) == (10, 10)


def test_odd_sizes_are_refused():
    with pytest.raises(InputError, match="even width and height, got 161x120"):
        CameraStream((161, 120), 10.0, lambda content: None)


@pytest.mark.parametrize("url", ["", "rtsp://127.0.0.1:5", "udp://127.0.0.1", "tcp://:5", "udp://127.0.0.1:99999"])
def test_a_wrong_address_is_named(url):
    with pytest.raises(InputError, match=r"--serve .*wanted udp://HOST:PORT or tcp://HOST:PORT"):
        StreamSender(url)


def test_an_address_in_use_is_named():
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(InputError, match="cannot be opened"):
        StreamSender(f"tcp://127.0.0.1:{other.getsockname()[1]}")


def test_clients_come_and_go():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    sender, heard, received = StreamSender(f"tcp://127.0.0.1:{port}"), threading.Event(), list[bytes]()

    def listen() -> None:
        with socket.create_connection(("127.0.0.1", port), timeout=WAIT_S) as client:
            received.append(client.recv(5))
        heard.set()

    with contextlib.closing(sender):
        sender.send(b"nobody listens")
        for _ in range(2):
            heard.clear()
            threading.Thread(target=listen, daemon=True).start()
            for _ in range(round(WAIT_S / 0.01)):
                if heard.wait(0.01):
                    break
                sender.send(b"again")
        sender.send(b"nobody listens")
    assert received == [b"again"] * 2
