"""Lines of JSON for browsers over a WebSocket of the served page."""

import json
import select
import sys
import threading
import time
import urllib.error
import urllib.request
from types import SimpleNamespace

import pytest

from tests.zoned import result
from torchvision_dddas.io.streams import About
from torchvision_dddas.live import line_socket
from torchvision_dddas.live.access import Access
from torchvision_dddas.live.line_socket import LineSocket
from torchvision_dddas.live.server import HealthServer

PATIENCE_S = 30.0


@pytest.fixture
def served():
    lines = LineSocket(About(1.6e9))
    with HealthServer(("127.0.0.1", 0), {"/stream": lines}) as server:
        yield lines, "{}:{}".format(*server.address)


def connect(host, path="/stream", **options):
    client = pytest.importorskip("websockets.sync.client", reason="the extra links has no websockets here")
    return client.connect(f"ws://{host}{path}", open_timeout=PATIENCE_S, **options)


def until(is_true):
    end_s = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def test_each_client_gets_the_lines_from_now_on(served):
    lines, host = served
    lines.write(result(1, [(1, 2)]), None, 1.6e9)
    with connect(host) as first, connect(host, origin=f"http://{host}") as second:
        until(lambda: len(lines._clients) == 2)
        for number in (2, 3):
            lines.write(result(number, [(1, 2)]), None, 1.6e9)
        for client in (first, second):
            read = [json.loads(client.recv(PATIENCE_S)) for _ in range(2)]
            assert [line["frame"] for line in read] == [2, 3] and read[0]["targets"][0]["id"] == 1
        assert first.ping().wait(PATIENCE_S), "programs ask whether the server is still there"
    until(lambda: not lines._clients)


def test_the_end_of_a_run_sends_the_last_lines_and_closes_the_connection(served):
    closed = pytest.importorskip("websockets.exceptions").ConnectionClosedOK
    lines, host = served
    with connect(host, max_queue=200) as client:
        until(lambda: lines._clients)
        for number in range(1, 51):
            lines.write(result(number, [(1, 2)]), None, 1.6e9)
        lines.close()
        assert [json.loads(client.recv(PATIENCE_S))["frame"] for _ in range(50)] == list(range(1, 51))
        with pytest.raises(closed, match="the run has ended"):
            client.recv(PATIENCE_S)
    until(lambda: not lines._clients)


def test_a_line_has_the_time_of_its_own_result(served):
    lines, host = served
    with connect(host) as client:
        until(lambda: lines._clients)
        lines.write(result(1, [(1, 2)]), None, 0.0)
        assert json.loads(client.recv(PATIENCE_S))["utc"].startswith("1970-01-01T00:00:0")


def test_other_sites_and_plain_requests_are_refused(served):
    _, host = served
    refused = pytest.importorskip("websockets.exceptions").InvalidStatus
    with pytest.raises(refused, match="403"), connect(host, origin="http://evil.example"):
        pass
    with pytest.raises(urllib.error.HTTPError, match="426"):
        urllib.request.urlopen(f"http://{host}/stream", timeout=PATIENCE_S)


def test_a_token_is_asked_for_as_on_other_pages():
    lines = LineSocket(About(1.6e9))
    with HealthServer(("127.0.0.1", 0), {"/stream": lines}, Access("a-long-token")) as server:
        host = "{}:{}".format(*server.address)
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(f"http://{host}/stream", timeout=PATIENCE_S)
        with connect(host, "/stream?token=a-long-token"):
            pass


def test_the_server_ends_while_a_client_reads_and_a_slow_client_misses_the_oldest_lines(monkeypatch):
    monkeypatch.setattr(line_socket, "_KEPT", 5)
    lines, go_on, ready = LineSocket(About(1.6e9)), threading.Event(), select.select

    def wait(*given):
        assert go_on.wait(PATIENCE_S)
        return ready(*given)

    monkeypatch.setattr(line_socket, "select", SimpleNamespace(select=wait))
    server = HealthServer(("127.0.0.1", 0), {"/stream": lines})
    server.__enter__()
    with connect("{}:{}".format(*server.address)) as client:
        until(lambda: lines._clients)
        for number in range(1, 101):
            lines.write(result(number, [(1, 2)]), None, 1.6e9)
        go_on.set()
        assert json.loads(client.recv(PATIENCE_S))["frame"] == 96
        server.__exit__(None, None, None)
        until(lambda: not lines._clients)


def test_a_ninth_client_and_a_machine_without_the_extra_get_one_line(served, monkeypatch):
    pytest.importorskip("websockets")
    _, host = served
    monkeypatch.setattr(line_socket, "_MOST_CLIENTS", 0)
    with pytest.raises(urllib.error.HTTPError) as full:
        urllib.request.urlopen(f"http://{host}/stream", timeout=PATIENCE_S)
    assert (full.value.code, full.value.read()) == (503, b"0 clients read the lines already\n")
    for name in [name for name in sys.modules if name.startswith("websockets")]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(urllib.error.HTTPError) as missing:
        urllib.request.urlopen(f"http://{host}/stream", timeout=PATIENCE_S)
    assert b"torchvision-dddas[links]" in missing.value.read()
