"""Streams through TCP connections, with and without TLS: they never wait, and go on when the server comes back."""

import json
import socket
import ssl
import struct
import threading
import time
from contextlib import suppress

import pytest

from tests.io.certificates import make_certificates
from tests.io.streamed import ABOUT, located, tracked
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams import open_stream
from torchvision_dddas.io.streams.outlets import KEPT_BYTES

PATIENCE_S = 60.0


class Server:
    """A server on 127.0.0.1 that accepts connections one after another and keeps what each one sent."""

    def __init__(self, port=0, context=None, greeting=b""):
        self.listener = socket.create_server(("127.0.0.1", port))
        self.port = self.listener.getsockname()[1]
        self.received: list[bytearray] = []
        self.greeted = 0
        self._context, self._greeting = context, greeting
        self._reading = threading.Event()
        self._reading.set()
        self._client: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self):
        while True:
            try:
                self._client, _ = self.listener.accept()
            except OSError:
                return
            content = bytearray()
            self.received.append(content)
            with suppress(OSError):
                if self._context is not None:
                    safe = self._context.wrap_socket(self._client, server_side=True, do_handshake_on_connect=False)
                    self._client = safe
                    safe.do_handshake()
                self._client.sendall(self._greeting)
                self.greeted += 1
                while self._reading.wait(PATIENCE_S) and (piece := self._client.recv(65536)):
                    content += piece
            self._client.close()

    def pause(self):
        self._reading.clear()

    def go_on(self):
        self._reading.set()

    def hang_up(self):
        with suppress(OSError):
            if self._client is not None:
                self._client.shutdown(socket.SHUT_RDWR)

    def close(self):
        self._reading.set()
        with suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        while self._thread.is_alive():
            self.hang_up()
            self._thread.join(0.05)


@pytest.fixture
def serve():
    servers = []

    def begin(*args, **options):
        servers.append(Server(*args, **options))
        return servers[-1]

    yield begin
    for server in servers:
        server.close()


@pytest.fixture
def notes():
    told = []
    return told, lambda kind, text: told.append(text)


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    return make_certificates(tmp_path_factory.mktemp("keys"))


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def write_until(stream, is_done, first=1):
    """Write frames until something is true; return the number of the next frame."""
    number, end_s = first, time.monotonic() + PATIENCE_S
    while not is_done():
        assert time.monotonic() < end_s, "nothing came"
        stream.write(located(number))
        number += 1
        time.sleep(0.005)
    return number


def wait_until(is_true):
    end_s = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < end_s, "nothing came"
        time.sleep(0.005)


def frames_in(content):
    return [json.loads(line)["frame"] for line in bytes(content).splitlines()]


def opened(text, notes):
    return open_stream(text, ABOUT, notes[1], retry_s=0.0, retry_most_s=0.01)


def test_lines_arrive_whole_and_in_order_and_closing_sends_the_rest(serve, notes):
    server = serve()
    stream = opened(f"json:tcp://localhost:{server.port}", notes)
    number = write_until(stream, lambda: server.received and server.received[0])
    for later in range(number, number + 50):
        stream.write(located(later))
    stream.close()
    wait_until(lambda: bytes(server.received[0]).count(b"\n") == number + 49)
    assert frames_in(server.received[0]) == list(range(1, number + 50))
    assert stream.lost == 0 and notes[0] == [] and stream.trouble() == ""


def test_an_absent_server_is_waited_for_and_gets_what_was_kept(serve, notes):
    port = free_port()
    stream = opened(f"mot:tcp://127.0.0.1:{port}", notes)
    number = write_until(stream, lambda: stream.trouble() != "")
    assert "Connection refused; trying again" in notes[0][0]
    server = serve(port)
    number = write_until(stream, lambda: stream.trouble() == "", number)
    stream.close()
    wait_until(lambda: bytes(server.received[-1]).count(b"\n") == 2 * (number - 1))
    assert notes[0][-1].endswith("works again; no messages lost")
    assert bytes(server.received[-1]).startswith(b"1,1,")


def test_a_connection_that_the_server_closes_is_opened_again_and_its_lines_are_whole(serve, notes):
    server = serve()
    stream = opened(f"json:tcp://127.0.0.1:{server.port}", notes)
    number = write_until(stream, lambda: server.received and server.received[0])
    server.hang_up()
    number = write_until(stream, lambda: len(server.received) == 2 and server.received[1], number)
    stream.close()
    assert any("closed the connection" in note or "reset" in note or "Broken" in note for note in notes[0])
    wait_until(lambda: frames_in(server.received[1])[-1:] == [number - 1])
    first, second = frames_in(server.received[0]), frames_in(server.received[1])
    assert first == list(range(1, len(first) + 1)) and second == list(range(second[0], number))


@pytest.mark.parametrize("scheme", ["tcp", "tls"])
def test_a_server_that_does_not_read_costs_a_bounded_memory_and_gets_whole_lines(serve, notes, keys, scheme):
    server = serve(context=server_context(keys, False) if scheme == "tls" else None)
    query = f"?ca={keys}/ca.pem" if scheme == "tls" else ""
    stream = opened(f"json:{scheme}://127.0.0.1:{server.port}{query}", notes)
    number = write_until(stream, lambda: server.received and server.received[0]) - 1
    server.pause()
    busy, end_s = tracked(1, 3000), time.monotonic() + PATIENCE_S
    while stream.lost < 3:
        number += 1
        stream.write(None, busy)
        assert time.monotonic() < end_s
        assert stream._outlet._kept_bytes <= KEPT_BYTES
    assert "read too slowly" in stream.trouble()
    server.go_on()
    stream.close()
    wait_until(lambda: bytes(server.received[0]).count(b"\n") == number - stream.lost)
    whole, end, _ = bytes(server.received[0]).rpartition(b"\n")
    assert len(frames_in(whole + end)) == number - stream.lost


def test_what_had_not_arrived_when_a_connection_broke_is_counted_as_lost(notes):
    pytest.importorskip("termios")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
        stream = opened(f"json:tcp://127.0.0.1:{listener.getsockname()[1]}", notes)
        busy, written = tracked(1, 100), 0
        while len(stream._outlet._ends) < 5:  # the server accepts, but never reads
            written += 1
            stream.write(None, busy)
            time.sleep(0.005)
        first, _ = listener.accept()
        arrived = first.recv(1 << 24, socket.MSG_PEEK).count(b"\n")
        assert stream.lost == 0
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)  # the next connection has room for all
        first.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        first.close()
        written += write_until(stream, lambda: any("works again" in note for note in notes[0])) - 1
        stream.close()
        second, _ = listener.accept()
        with second:
            content = bytearray()
            while piece := second.recv(1 << 16):
                content += piece
    assert stream.lost >= 5 and arrived + content.count(b"\n") + stream.lost == written
    assert notes[0][-1].endswith(f"works again; {stream.lost} messages lost") and len(notes[0]) == 2


def test_what_a_server_sends_is_read_so_that_neither_side_stands_still(serve, notes):
    server = serve(greeting=b"<event/>\n" * 1_000_000)
    stream = opened(f"json:tcp://127.0.0.1:{server.port}", notes)
    write_until(stream, lambda: server.greeted and server.received[0])
    stream.close()
    assert notes[0] == []


def server_context(keys, wants_client=True):
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(keys / "server.pem", keys / "server.key")
    if wants_client:
        context.load_verify_locations(keys / "ca.pem")
        context.verify_mode = ssl.CERT_REQUIRED
    return context


def test_tls_with_a_client_certificate_carries_events(serve, notes, keys):
    server = serve(context=server_context(keys))
    files = f"ca={keys}/ca.pem&cert={keys}/client.pem&key={keys}/client.key"
    stream = opened(f"cot:tls://127.0.0.1:{server.port}?{files}", notes)
    number = write_until(stream, lambda: server.received and server.received[0])
    stream.close()
    wait_until(lambda: bytes(server.received[0]).count(b"</event>") == 1 + (number - 2) // 10)
    assert notes[0] == [] and stream.lost == 0
    assert str(keys) not in stream.name


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("", "certificate is not accepted: self-signed certificate in certificate chain"),
        ("ca={keys}/ca.pem&server=other.example", "certificate is not accepted: Hostname mismatch"),
        ("ca={keys}/ca.pem", "certificate required"),
    ],
)
def test_a_connection_that_tls_refuses_is_a_trouble_told_once(serve, notes, keys, query, words):
    server = serve(context=server_context(keys))
    stream = opened(f"json:tls://127.0.0.1:{server.port}?{query.format(keys=keys)}".rstrip("?"), notes)
    write_until(stream, lambda: len(server.received) > 3)
    assert words.lower() in stream.trouble().lower()
    assert len(notes[0]) == 1, notes[0]
    server.close()
    stream.close()


def test_a_server_without_tls_is_named_as_the_trouble(serve, notes, keys):
    server = serve(greeting=b"hello, this is no TLS\n")
    stream = opened(f"json:tls://127.0.0.1:{server.port}?ca={keys}/ca.pem", notes)
    write_until(stream, lambda: stream.trouble() != "")
    assert "TLS failed: " in stream.trouble()
    stream.close()


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("tcp://127.0.0.1", "is no address; wanted tcp://HOST:PORT"),
        ("tcp://:5", "is no address"),
        ("tcp://127.0.0.1:5?ca=x", "is no address with ca"),
        ("tls://127.0.0.1:5?ttl=3", "is no address with ttl"),
        ("tls://127.0.0.1:5?ca=", "is no address"),
        ("tcp://127.0.0.1:5/path", "is no address"),
        ("tcp://127.0.0.1:99999", "is no address"),
        ("tcp://nowhere.invalid:5", "choose another place"),
        ("tls://127.0.0.1:5?key=/k", "give the certificate with cert=FILE too"),
        ("tls://127.0.0.1:5?ca=/absent.pem", "ca=/absent.pem cannot be used: No such file"),
        ("tls://127.0.0.1:5?ca={keys}/client.key", "client.key cannot be used: no certificate"),
        ("tls://127.0.0.1:5?cert={keys}/client.pem&key={keys}/server.key", "key values mismatch"),
        ("tls://127.0.0.1:5?cert={keys}/client.pem&key={keys}/locked.key", "the key without a password"),
    ],
)
def test_what_is_no_connection_is_refused_in_one_line(place, words, notes, keys):
    with pytest.raises(InputError) as refused:
        opened(f"json:{place.format(keys=keys)}", notes)
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_a_refusal_does_not_show_a_password(notes):
    with pytest.raises(InputError) as refused:
        opened("json:tcp://me:q1?z2@127.0.0.1:5", notes)
    assert "q1" not in str(refused.value) and "z2" not in str(refused.value)
