"""The annotated pictures as a transport stream over UDP and TCP, with the camera's pose and the targets."""

import math
import socket
import threading
from dataclasses import replace

import numpy as np
import pytest

from tests.io.streamed import ABOUT, located
from tests.io.test_vmti import packs
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry.projection import axes_of
from torchvision_dddas.io.streams import open_stream
from torchvision_dddas.io.streams.video import VideoMessages, encode_result
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.misb import LocalSet, imap, local_sets
from torchvision_dddas.io.telemetry.misb import mapped as read_mapped
from torchvision_dddas.io.video_packets import VideoEncoder
from torchvision_dddas.types import Camera, CameraPose

av = pytest.importorskip("av", reason="the extra video is not installed")

CAMERA = Camera("falcon", (160, 120), (160.0, 160.0), (79.5, 59.5))
KNOWN = replace(ABOUT, camera=CAMERA, plane_above_sea_m=700.0, plane_above_ellipsoid_m=730.0)
PATIENCE_S = 30.0


def shown(number, pitch=0.9):
    result = located(number, 3, rate=25.0)
    pose = CameraPose(np.array([0.0, -5.0, 50.0]), axes_of(0.4, pitch, 0.02))
    ground = result.locations
    assert ground is not None
    heights = replace(ground.positions, above_ellipsoid_m=np.full(len(ground.positions), 730.0))
    return replace(result, locations=replace(ground, fix=replace(ground.fix, pose=pose), positions=heights))


def send(stream, numbers):
    encoder = VideoEncoder((160, 120), 25.0)
    picture = np.zeros((120, 160, 3), np.uint8)
    for number in numbers:
        result = shown(number)
        picture[:, :] = (number, 90, 200)
        stream.video.packets = encoder.encode(picture, result.frame.time_s)
        stream.video.encoder = encoder
        stream.write(result)


def read(path):
    """The pictures and the metadata of a transport stream."""
    pictures = list[np.ndarray]()
    sets = list[LocalSet]()
    with av.open(str(path)) as opened:
        for packet in opened.demux():
            if packet.stream.type == "data" and packet.size:
                sets += local_sets(bytes(packet))
            elif packet.stream.type == "video":
                pictures += [frame.to_ndarray(format="bgr24") for frame in packet.decode()]
    return pictures, sets


def test_a_receiver_of_datagrams_gets_pictures_the_pose_and_the_targets(tmp_path):
    path, told = tmp_path / "got.ts", []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.2)
        port = receiver.getsockname()[1]
        stream = open_stream(f"video:udp://127.0.0.1:{port}", KNOWN, lambda kind, text: told.append(text))
        send(stream, range(1, 31))
        stream.close()
        with path.open("wb") as file:
            try:
                while True:
                    datagram = receiver.recv(1 << 16)
                    assert len(datagram) % 188 == 0
                    file.write(datagram)
            except TimeoutError:
                pass
    pictures, sets = read(path)
    assert not told and len(pictures) == 30 and len(sets) >= 29 and all(one.whole for one in sets)
    assert abs(int(pictures[20][60, 80, 2]) - 200) < 6
    log = read_telemetry(path)
    assert log.start_utc_s == pytest.approx(ABOUT.start_utc_s, abs=1e-3)
    now = log.at(0.5)
    assert now is not None and now.altitude_m == pytest.approx(50.0, abs=0.01)
    assert (now.heading_rad, now.pitch_rad) == pytest.approx((0.4, 0.9), abs=1e-3)
    assert now.above_sea_m == pytest.approx(750.0, abs=0.3)
    assert now.hfov_rad == pytest.approx(2 * math.atan(0.5), abs=1e-4)
    targets = packs(sets[5].tags[74])
    assert list(targets) == [1, 2, 3]
    degrees = shown(6).locations.positions.lonlat_deg
    for identity in (1, 2):
        place = targets[identity][17]
        found = imap(place[4:8], -180, 180), imap(place[:4], -90, 90)
        assert found == pytest.approx(tuple(degrees[identity - 1]), abs=1e-6)
    assert 17 not in targets[3]  # it is not located


def test_datagrams_are_no_longer_than_the_address_says():
    picture = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    for most_bytes, packets in ((600, 3), (65507, 7), (0, 7)):
        encoder, video = VideoEncoder((160, 120), 25.0), VideoMessages(KNOWN)
        video.packets, video.encoder = encoder.encode(picture, 0.0), encoder
        datagrams = video(shown(1), most_bytes=most_bytes)
        assert {len(one) for one in datagrams[:-1]} == {packets * 188}


def test_a_server_gets_the_same_bytes_through_a_connection(tmp_path):
    path, content = tmp_path / "got.ts", bytearray()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(PATIENCE_S)

        def take():
            client, _ = listener.accept()
            with client:
                while piece := client.recv(1 << 16):
                    content.extend(piece)

        reader = threading.Thread(target=take, daemon=True)
        reader.start()
        stream = open_stream(f"video:tcp://127.0.0.1:{listener.getsockname()[1]}", KNOWN, lambda kind, text: None)
        send(stream, range(1, 31))
        stream.close()
        reader.join(PATIENCE_S)
    path.write_bytes(content)
    pictures, sets = read(path)
    assert stream.lost == 0 and len(pictures) == 30 and len(sets) >= 29


def test_the_middle_of_the_picture_lies_ahead_of_the_camera():
    (one,) = local_sets(encode_result(shown(1), KNOWN, (160, 120)))
    sensor, middle = (
        [read_mapped(one.tags[tag], 0, high, True) for tag, high in pair]
        for pair in (
            ((13, 90), (14, 180)),
            ((23, 90), (24, 180)),
        )
    )
    north_m = (middle[0] - sensor[0]) * 111_000
    assert north_m == pytest.approx(50 / math.tan(0.9) * math.cos(0.4), rel=0.01)
    (level,) = local_sets(encode_result(shown(1, pitch=-0.1), KNOWN, (160, 120)))
    assert not {21, 23, 24} & level.tags.keys()


def test_without_a_place_the_targets_are_told_and_without_a_clock_nothing():
    (bare,) = local_sets(encode_result(located(1, on_ground=False), ABOUT, (160, 120)))
    assert bare.whole and list(packs(bare.tags[74])) == [1, 2] and 13 not in bare.tags
    assert encode_result(shown(1), replace(KNOWN, start_utc_s=math.nan), (160, 120)) == b""


@pytest.mark.parametrize("place", ["-", "film.ts", "mqtt://127.0.0.1/x", "udp://127.0.0.1"])
def test_pictures_go_to_an_address_of_datagrams_or_a_connection(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"wanted|video goes to"):
        open_stream(f"video:{place}", ABOUT, lambda kind, text: None)
    assert list(tmp_path.iterdir()) == []
