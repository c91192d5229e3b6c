"""Connections to MAVLink peers: whole messages from damaged bytes, several subscribers, signing, and recovery."""

import hashlib
import itertools
import os
import queue
import random
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.mavlink_link import MavlinkLink, open_mavlink, take_system, take_systems

dialect: Any = pytest.importorskip("pymavlink.dialects.v20.all")
LONG_S = 20.0
KEY = bytes(range(32))


class Peer:
    """Another program on the link, which builds messages with pymavlink itself."""

    def __init__(self, key: bytes = b"", system: int = 1) -> None:
        self.mav = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
        if key:
            self.mav.signing.secret_key, self.mav.signing.sign_outgoing = key, True
            self.mav.signing.timestamp = int((time.time() - 1_420_070_400) * 1e5)

    def heartbeat(self, mode: int = 4) -> bytes:
        message = dialect.MAVLink_heartbeat_message(2, 3, 217, mode, 4, 3)
        self.mav.seq = (self.mav.seq + 1) % 256
        return bytes(message.pack(self.mav))


class Heard:
    """Events and messages of a link."""

    def __init__(self) -> None:
        self.events = list[str]()
        self.messages = queue.Queue[Any]()

    def notify(self, kind: str, text: str) -> None:
        assert kind == "mavlink"
        self.events.append(text)

    def take(self, utc_s: float, message: Any) -> None:
        assert abs(utc_s - time.time()) < 60
        self.messages.put(message)

    def next(self) -> Any:
        return self.messages.get(timeout=LONG_S)


def wait_for(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < end_s, "nothing came within a long time"
        time.sleep(0.01)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def heard() -> Heard:
    return Heard()


@pytest.fixture
def udp(heard: Heard) -> Iterator[tuple[MavlinkLink, Callable[[bytes], object], socket.socket]]:
    port = free_port()
    with (
        open_mavlink(f"mavlink:udp:127.0.0.1:{port}", heard.notify) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        link.subscribe(heard.take)
        peer.settimeout(LONG_S)
        peer.bind(("127.0.0.1", 0))
        yield link, lambda content: peer.sendto(content, ("127.0.0.1", port)), peer


def decode(content: bytes) -> Any:
    (message,) = dialect.MAVLink(None).parse_buffer(content)
    return message


def test_every_subscriber_gets_every_message(udp, heard: Heard) -> None:
    link, send, _ = udp
    second = Heard()
    link.subscribe(second.take)
    peer = Peer()
    for mode in range(5):
        send(peer.heartbeat(mode))
    assert [heard.next().custom_mode for _ in range(5)] == list(range(5))
    assert [second.next().custom_mode for _ in range(5)] == list(range(5))
    assert heard.events == []


def test_a_listening_link_answers_who_spoke_with_the_given_sender(udp, heard: Heard) -> None:
    link, send, peer = udp
    send(Peer().heartbeat())
    heard.next()
    for sequence in range(2):
        assert link.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 7, 191)
        answer = decode(peer.recv(1000))
        header = answer.get_header()
        assert (header.srcSystem, header.srcComponent, header.seq) == (7, 191, sequence)
    assert link.sent == 2


def test_garbage_costs_no_message_and_gives_one_event(udp, heard: Heard) -> None:
    link, send, _ = udp
    peer, noise = Peer(), random.Random(3)
    for mode in range(50):
        junk = bytes(noise.choice((0xFD, 0xFE, noise.randrange(256))) for _ in range(noise.randrange(40)))
        send(junk + peer.heartbeat(mode))
    send(bytes(300))  # completes frames that only seem to begin in the last garbage
    assert [heard.next().custom_mode for _ in range(50)] == list(range(50))
    wait_for(lambda: link.garbage_bytes > 300)
    assert len([text for text in heard.events if "no whole MAVLink" in text]) == 1


def test_frames_that_are_longer_than_their_message_are_not_decoded(udp, heard: Heard, monkeypatch) -> None:
    link, send, _ = udp
    decode_frame, decoded = link._decoder.decode, list[bytes]()

    def note(frame: bytearray) -> object:
        decoded.append(bytes(frame))
        return decode_frame(frame)

    monkeypatch.setattr(link._decoder, "decode", note)
    send(b"\xfe" * 1000)
    send(Peer().heartbeat(3))
    send(bytes(300))
    assert heard.next().custom_mode == 3
    assert not [frame for frame in decoded if frame.startswith(b"\xfe\xfe")]


def test_a_message_does_not_wait_for_what_seemed_to_begin_before_it(udp, heard: Heard) -> None:
    _, send, _ = udp
    send(b"\xfd\xff\x00" + Peer().heartbeat(7))
    assert heard.next().custom_mode == 7


def test_a_damaged_message_is_not_handed_on(udp, heard: Heard) -> None:
    _, send, _ = udp
    damaged = bytearray(Peer().heartbeat(1))
    damaged[12] ^= 0x40
    send(bytes(damaged))
    send(Peer().heartbeat(2))
    assert heard.next().custom_mode == 2


def test_a_message_of_an_unknown_number_is_counted_once_as_an_event(udp, heard: Heard) -> None:
    link, send, _ = udp
    unknown = bytes([0xFD, 2, 0, 0, 0, 1, 1, 0xF0, 0xFF, 0xFF, 1, 2, 3, 4])
    for _ in range(3):
        send(unknown)
    send(Peer().heartbeat())
    heard.next()
    assert link.unknown == 3
    assert heard.events == [f"{link.name}: messages of unknown numbers are skipped and counted, first 16777200"]


def test_a_subscriber_that_fails_does_not_end_the_link(udp, heard: Heard) -> None:
    link, send, _ = udp

    def fail(utc_s: float, message: Any) -> None:
        raise RuntimeError("no")

    link._subscribers = (fail, *link._subscribers)
    peer = Peer()
    send(peer.heartbeat(1))
    send(peer.heartbeat(2))
    assert [heard.next().custom_mode for _ in range(2)] == [1, 2]
    assert heard.events == [f"{link.name}: HEARTBEAT failed: RuntimeError: no"]


@given(cuts=st.lists(st.integers(0, 200), max_size=12), junk=st.binary(max_size=20))
def test_messages_do_not_depend_on_where_the_bytes_are_cut(cuts: list[int], junk: bytes) -> None:
    link = MavlinkLink.__new__(MavlinkLink)
    link.name, link.dialect, link.garbage_bytes, link.unknown, link.refused = "link", dialect, 0, 0, 0
    link._told, link._buffers, link._notify = set(), {}, lambda kind, text: None
    from torchvision_dddas.io.mavlink_link import _build_decoder

    link._decoder = _build_decoder(dialect, b"")
    peer = Peer()
    content = b"".join([peer.heartbeat(1), junk, peer.heartbeat(2), peer.heartbeat(3), bytes(300)])
    places = sorted({min(cut, len(content)) for cut in cuts} | {0, len(content)})
    got = [
        message.custom_mode
        for begin, end in itertools.pairwise(places)
        for message in link._decode(None, content[begin:end])
        if message.get_type() == "HEARTBEAT"
    ]
    assert got == [1, 2, 3]


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    path = tmp_path / "station.key"
    path.write_text(KEY.hex() + "\n", "ascii")
    return path


def test_a_signed_link_takes_and_sends_signed_messages_only(heard: Heard, key_file: Path) -> None:
    port = free_port()
    with (
        open_mavlink(f"mavlink:udp:127.0.0.1:{port}?key={key_file}", heard.notify) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        link.subscribe(heard.take)
        peer.settimeout(LONG_S)
        peer.connect(("127.0.0.1", port))
        signed = Peer(KEY)
        forged = bytearray(signed.heartbeat(3))
        # The time of a forged message must not lock out the sender.
        forged[-12:-6] = b"\xff" * 6
        for content in (Peer().heartbeat(1), Peer(bytes(32)).heartbeat(2), bytes(forged), signed.heartbeat(4)):
            peer.send(content)
        assert heard.next().custom_mode == 4
        assert link.refused == 3
        assert link.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 1, 191)
        answer = peer.recv(1000)
        assert answer[2] & 1
        assert hashlib.sha256(KEY + answer[:-6]).digest()[:6] == answer[-6:]
        peer.send(signed.heartbeat(5))
        assert heard.next().custom_mode == 5
    assert heard.events[0].endswith("messages without a valid signature are refused and counted")
    assert heard.events[1].endswith("2 messages received; 3 badly signed")


def test_a_repeated_signed_message_is_refused(heard: Heard, key_file: Path) -> None:
    port = free_port()
    with (
        open_mavlink(f"mavlink:udp:127.0.0.1:{port}?key={key_file}", heard.notify) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        link.subscribe(heard.take)
        signed = Peer(KEY)
        first = signed.heartbeat(1)
        for content in (first, first, signed.heartbeat(2)):
            peer.sendto(content, ("127.0.0.1", port))
        assert [heard.next().custom_mode for _ in range(2)] == [1, 2]
        assert link.refused == 1


def test_an_outgoing_link_hears_the_answer(heard: Heard) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.settimeout(LONG_S)
        peer.bind(("127.0.0.1", 0))
        with open_mavlink(f"mavlink:udpout:127.0.0.1:{peer.getsockname()[1]}", heard.notify) as link:
            link.subscribe(heard.take)
            link.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 1, 191)
            content, sender = peer.recvfrom(1000)
            assert decode(content).type == dialect.MAV_TYPE_ONBOARD_CONTROLLER
            peer.sendto(Peer().heartbeat(9), sender)
            assert heard.next().custom_mode == 9


def test_a_lost_tcp_connection_is_opened_again(heard: Heard) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(LONG_S)
        with open_mavlink(f"mavlink:tcp:127.0.0.1:{server.getsockname()[1]}", heard.notify) as link:
            link.subscribe(heard.take)
            for mode in (1, 2):
                peer, _ = server.accept()
                with peer:
                    peer.sendall(Peer().heartbeat(mode))
                    assert heard.next().custom_mode == mode
            wait_for(lambda: len(heard.events) >= 3)
    assert heard.events[:2] == [
        f"{link.name} lost: the peer closed the connection; trying again",
        f"{link.name} works again",
    ]


def test_a_closed_link_sends_nothing(heard: Heard) -> None:
    link = open_mavlink(f"mavlink:udp:127.0.0.1:{free_port()}", heard.notify)
    link.close()
    assert not link.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 1, 191)
    assert not link.connected
    link.close()


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="pseudo terminals are a matter of POSIX")
def test_a_serial_line_carries_messages(heard: Heard) -> None:
    pytest.importorskip("serial")
    leader, follower = os.openpty()
    try:
        with open_mavlink(f"mavlink:serial:{os.ttyname(follower)}:115200", heard.notify) as link:
            link.subscribe(heard.take)
            os.write(leader, b"boot\n" + Peer().heartbeat(6))
            assert heard.next().custom_mode == 6
            assert link.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 1, 191)
            content = b""
            while len(content) < 12 + 9:
                content += os.read(leader, 1000)
            assert decode(content).type == 18
    finally:
        os.close(leader)
        os.close(follower)


def test_options_of_the_same_connection_share_it(heard: Heard) -> None:
    text = f"mavlink:udp:127.0.0.1:{free_port()}"
    one, two = open_mavlink(text, heard.notify), open_mavlink(text, heard.notify, "--command")
    assert one is two
    one.close()
    assert two.connected, "the other option still uses it"
    two.close()
    assert not one.connected
    with open_mavlink(text, heard.notify) as later:
        assert later is not one


def test_the_same_connection_with_another_key_is_refused(heard: Heard, key_file: Path) -> None:
    text = f"mavlink:udp:127.0.0.1:{free_port()}"
    with (
        open_mavlink(text, heard.notify),
        pytest.raises(InputError, match=r"give the same \?key=FILE in both options"),
    ):
        open_mavlink(f"{text}?key={key_file}", heard.notify, "--command")


def test_one_system_is_taken_where_no_other_is_wanted() -> None:
    assert take_system("mavlink:udp:h:1?system=7&key=a", "--telemetry") == ("mavlink:udp:h:1?key=a", 7)
    assert take_system("mavlink:udp:h:1", "--telemetry") == ("mavlink:udp:h:1", 0)
    with pytest.raises(InputError, match=r"mavlink:udp:h:1: ugv1 is unknown; wanted system=N"):
        take_system("mavlink:udp:h:1?ugv1=7", "--telemetry")


def test_systems_are_taken_out_of_the_text() -> None:
    assert take_systems("mavlink:udp:h:1", "--command") == ("mavlink:udp:h:1", {})
    assert take_systems("mavlink:udp:h:1?system=7", "--command") == ("mavlink:udp:h:1", {"system": 7})
    text = "mavlink:udp:h:1?key=a&system=7&ugv1=11"
    assert take_systems(text, "--command") == ("mavlink:udp:h:1?key=a", {"system": 7, "ugv1": 11})
    for bad in ("system=0", "system=256", "system=x", "system=", "system=1&system=2", "=3", "system"):
        with pytest.raises(InputError, match=r"must be one number from 1 to 255"):
            take_systems(f"mavlink:udp:h:1?{bad}", "--command")


@pytest.mark.parametrize(
    "text",
    [
        "mavlink:",
        "mavlink:udp:",
        "mavlink:udp:14550",
        "mavlink:udp:127.0.0.1:0",
        "mavlink:udp:127.0.0.1:99999",
        "mavlink:ftp:127.0.0.1:14550",
        "mavlink:udp:127.0.0.1:14550?color=blue",
        "mavlink:udp:127.0.0.1:14550?key",
        "udp:127.0.0.1:14550",
    ],
)
def test_an_unknown_form_is_refused_in_one_line(heard: Heard, text: str) -> None:
    with pytest.raises(InputError, match=r"wanted mavlink:udp:HOST:PORT"):
        open_mavlink(text, heard.notify)


def test_a_name_that_no_host_can_have_is_refused(heard: Heard) -> None:
    with pytest.raises(InputError, match="no host can have this name"):
        open_mavlink(f"mavlink:tcp:{'a' * 70}:5760", heard.notify)


def test_a_port_in_use_is_refused(heard: Heard) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match=r"--command mavlink:udp:127\.0\.0\.1:\d+ cannot be opened: .*in use"):
            open_mavlink(f"mavlink:udp:127.0.0.1:{other.getsockname()[1]}", heard.notify, "--command")


@pytest.mark.parametrize("content", ["", "00" * 31, "zz" * 32, "00" * 33])
def test_a_bad_key_is_refused_without_showing_it(heard: Heard, tmp_path: Path, content: str) -> None:
    path = tmp_path / "bad.key"
    path.write_text(content, "ascii")
    with pytest.raises(InputError, match=r"must hold 64 hexadecimal digits") as raised:
        open_mavlink(f"mavlink:udp:127.0.0.1:{free_port()}?key={path}", heard.notify)
    assert not content or content not in str(raised.value)


def test_an_absent_key_file_is_refused(heard: Heard, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.key cannot be read: No such file"):
        open_mavlink(f"mavlink:udp:127.0.0.1:{free_port()}?key={tmp_path / 'absent.key'}", heard.notify)


def test_the_extra_is_named_where_pymavlink_is_missing(heard: Heard, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(InputError, match=r"torchvision-dddas\[telemetry\]"):
        open_mavlink("mavlink:udp:127.0.0.1:14550", heard.notify)
