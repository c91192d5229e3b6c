"""Streams to an MQTT broker, with mosquitto as the broker."""

import json
import shutil
import socket
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from tests.io.certificates import make_certificates
from tests.io.streamed import ABOUT, located
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams import open_stream

PATIENCE_S = 60.0
MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin")


@pytest.fixture
def mqtt():
    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed (Debian: apt install mosquitto)")
    return pytest.importorskip("paho.mqtt.client", reason="the extra links is not installed")


@pytest.fixture
def notes():
    told = []
    return told, lambda kind, text: told.append(text)


@pytest.fixture
def broker(mqtt, tmp_path):
    """Start a broker, on a port that stays the same if it is started again."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    running = []

    def begin(*lines):
        (tmp_path / "mosquitto.conf").write_text("\n".join([f"listener {port} 127.0.0.1", "user root", *lines]) + "\n")
        # Started by root, the broker would become another user, who cannot read the files of the test.
        running.append(subprocess.Popen([str(MOSQUITTO), "-c", tmp_path / "mosquitto.conf"], stderr=subprocess.DEVNULL))
        end_s = time.monotonic() + PATIENCE_S
        while True:
            assert time.monotonic() < end_s and running[-1].poll() is None
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                return running[-1]
            except OSError:
                time.sleep(0.02)

    yield SimpleNamespace(start=begin, port=port)
    for process in running:
        process.kill()
        process.wait()


@pytest.fixture
def reader(mqtt, broker):
    """Subscribe, and return the list of received payloads."""
    clients = []

    def begin(topic):
        got, ready = [], []
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        client.on_message = lambda _client, _data, message: got.append(message.payload)
        client.on_connect = lambda one, *_: one.subscribe(topic, qos=1)
        client.on_subscribe = lambda *_: ready.append(1)
        client.reconnect_delay_set(1, 1)
        client.connect("127.0.0.1", broker.port)
        client.loop_start()
        clients.append(client)
        wait_until(lambda: ready)
        return got, ready

    yield begin
    for client in clients:
        client.disconnect()
        client.loop_stop()


def wait_until(is_true):
    end_s = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < end_s, "nothing came"
        time.sleep(0.01)


def write_until(stream, is_done, first=1):
    number, end_s = first, time.monotonic() + PATIENCE_S
    while not is_done():
        assert time.monotonic() < end_s, "nothing came"
        stream.write(located(number))
        number += 1
        time.sleep(0.01)
    return number


def opened(text, notes):
    return open_stream(text, ABOUT, notes[1], retry_s=0.0, retry_most_s=0.01)


def test_each_line_is_a_message_on_the_topic_and_closing_waits_for_the_broker(broker, reader, notes):
    broker.start("allow_anonymous true")
    got, _ = reader("uav/1/targets")
    stream = opened(f"json:mqtt://127.0.0.1:{broker.port}/uav/1/targets", notes)
    number = write_until(stream, lambda: got)
    for later in range(number, number + 50):
        stream.write(located(later))
    stream.close()
    wait_until(lambda: len(got) == number + 49 - stream.lost)
    assert [json.loads(line)["frame"] for line in got][:number] == list(range(1, number + 1))
    assert notes[0] == [] or stream.lost


@pytest.mark.slow
def test_a_broker_that_was_away_gets_what_was_kept(broker, reader, notes):
    first = broker.start("allow_anonymous true")
    got, ready = reader("t")
    stream = opened(f"json:mqtt://127.0.0.1:{broker.port}/t", notes)
    number = write_until(stream, lambda: got)
    first.terminate()
    first.wait()
    number = write_until(stream, lambda: stream.trouble() != "", number)
    broker.start("allow_anonymous true")
    wait_until(lambda: len(ready) == 2)
    number = write_until(stream, lambda: stream.trouble() == "", number)
    wait_until(lambda: json.loads(got[-1])["frame"] > 1)
    stream.close()
    assert stream.lost == 0 and "works again; no messages lost" in notes[0][-1]
    assert "not connected" in notes[0][0] and len(notes[0]) == 2


@pytest.mark.slow
def test_a_broker_that_refuses_is_a_trouble_told_once(broker, notes, tmp_path):
    broker.start("allow_anonymous false")
    stream = opened(f"json:mqtt://me:wrong@127.0.0.1:{broker.port}/t", notes)
    write_until(stream, lambda: stream.trouble() != "")
    for number in range(200):
        stream.write(located(number + 1))
        time.sleep(0.01)
    assert "Not authorized" in stream.trouble() and "wrong" not in stream.trouble() and len(notes[0]) == 1
    stream.close()
    assert stream.lost > 0


def test_tls_with_a_client_certificate_reaches_the_broker(broker, mqtt, notes, tmp_path):
    keys = make_certificates(tmp_path)
    files = [f"cafile {keys}/ca.pem", f"certfile {keys}/server.pem", f"keyfile {keys}/server.key"]
    broker.start("allow_anonymous true", *files, "require_certificate true")
    query = f"ca={keys}/ca.pem&cert={keys}/client.pem&key={keys}/client.key"
    stream = opened(f"json:mqtts://127.0.0.1:{broker.port}/t?{query}", notes)
    write_until(stream, lambda: stream._outlet._confirmed > 3)
    stream.close()
    assert notes[0] == []
    stranger = opened(f"json:mqtts://127.0.0.1:{broker.port}/t", notes)
    write_until(stranger, lambda: stranger.trouble() != "")
    assert "one side does not accept the certificate" in stranger.trouble()
    stranger.close()


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("mqtt://127.0.0.1:5", "is no address; wanted mqtt://HOST:PORT/TOPIC"),
        ("mqtt://127.0.0.1:5/a/+/b", "is no address"),
        ("mqtt://127.0.0.1:x1/t", "is no address"),
        ("mqtt://127.0.0.1:5/t?ca=x", "is no address with ca"),
        ("mqtts://127.0.0.1:5/t?ca=/absent.pem", "ca=/absent.pem cannot be used: No such file"),
    ],
)
def test_what_is_no_broker_is_refused_in_one_line(place, words, notes):
    with pytest.raises(InputError) as refused:
        opened(f"json:{place}", notes)
    assert words in str(refused.value)


def test_without_the_extra_one_line_names_it(notes, monkeypatch):
    for name in [*(name for name in sys.modules if name.startswith("paho")), "paho", "paho.mqtt"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"pip install 'torchvision-dddas\[links\]'"):
        opened("json:mqtt://127.0.0.1:5/t", notes)
