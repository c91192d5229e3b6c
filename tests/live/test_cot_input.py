"""Landmarks that report by Cursor on Target, over datagrams and from a server."""

import json
import socket
import threading
import time
from datetime import UTC, datetime

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.maps.formats import event
from torchvision_dddas.live.cot_input import CotInput
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.live_landmarks import LiveLandmarks

PATIENCE_S = 30.0
WHEN_S = 1.7e9


def told(uid, latitude, longitude=11.5, kind="a-f-G-E-V", callsign="", ce="0.8", utc_s=WHEN_S):
    time_text = datetime.fromtimestamp(utc_s, UTC).isoformat().replace("+00:00", "Z")
    return (
        f'<?xml version="1.0"?>\n<event version="2.0" uid="{uid}" type="{kind}" how="m-g" time="{time_text}" '
        f'start="{time_text}" stale="{time_text}"><point lat="{latitude}" lon="{longitude}" hae="500" ce="{ce}" '
        f'le="9999999.0"/><detail><contact callsign="{callsign}"/></detail></event>'
    ).encode()


@pytest.fixture
def opened():
    made = []

    def open_it(query="ugv1=ALPHA&ugv2=uid-2"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        made.append(CotInput(f"cot:udp:/127.0.0.1:{port}?{query}", print))
        return made[-1], lambda *contents: send(port, contents)

    def send(port, contents):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for content in contents:
                sender.sendto(content, ("127.0.0.1", port))

    yield open_it
    for one in made:
        one.close()


def reports(source, count):
    found, end_s = list[bytes](), time.monotonic() + PATIENCE_S
    while len(found) < count:
        assert time.monotonic() < end_s, found
        found += [content for _, content in source.receive()]
    return found


def test_named_vehicles_are_told_by_uid_or_callsign_and_others_are_left_out(opened):
    source, send = opened()
    send(
        told("uid-1", 48.0, callsign="ALPHA"),
        told("uid-9", 1.0, callsign="OTHER"),
        told("uid-2", 48.1, kind="b-m-p-s-m"),  # a mark, and no vehicle
        told("uid-2", 48.1, ce="9999999.0", utc_s=WHEN_S + 1),
    )
    first, second = map(json.loads, reports(source, 2))
    assert first == {
        "landmark": "ugv1",
        "longitude_deg": 11.5,
        "latitude_deg": 48.0,
        "time_s": WHEN_S,
        "sigma_m": 0.8,
    }
    assert (second["landmark"], second["time_s"], "sigma_m" in second) == ("ugv2", WHEN_S + 1, False)


def test_events_of_this_program_are_read(opened):
    source, send = opened("ugv1=dddas-1")
    stamps = ("2026-01-02T03:04:05.000Z", "2026-01-02T03:04:15.000Z")
    nan = np.full(2, np.nan)
    send(event("dddas-1", 1, stamps, (11.5, 48.0, 500.0), np.array([2.0, 1.0]), nan, None, "").encode())
    (row,) = map(json.loads, reports(source, 1))
    assert (row["landmark"], row["longitude_deg"], row["latitude_deg"]) == ("ugv1", 11.5, 48.0)


def test_events_of_a_server_are_split_and_a_damaged_one_is_an_event():
    content = (
        told("a", 48.0)
        + told("b", 48.5)
        + b'<event uid="a" type="a-f"><point/></event>'
        + told("a", 48.0001, utc_s=WHEN_S + 1)
    )
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(PATIENCE_S)
        done = threading.Event()

        def serve():
            client, _ = listener.accept()
            with client:
                for place in range(0, len(content), 100):
                    client.sendall(content[place : place + 100])
                done.wait(PATIENCE_S)

        threading.Thread(target=serve, daemon=True).start()
        health, place = Health(), f"127.0.0.1:{listener.getsockname()[1]}"
        source = CotInput(f"cot:tcp://{place}?ugv1=a&ugv2=b", print)
        marks = LiveLandmarks("cot", source, dict(enumerate(source.names.values())), health)
        marks.wait(None)
        end_s = time.monotonic() + PATIENCE_S
        while len(marks.record(WHEN_S, 10.0)) < 3 or not health.snapshot().events:
            assert time.monotonic() < end_s
            time.sleep(0.01)
        done.set()
        marks.close()
    table = marks.record(WHEN_S, 10.0)
    assert table.geographic and set(table.names) == {"ugv1", "ugv2"}
    assert sorted(table.place[:, 1]) == [48.0, 48.0001, 48.5] and table.frame.max() == pytest.approx(11)


@pytest.mark.parametrize(
    "damaged",
    [
        b"<event><point></event>",
        b'<!DOCTYPE x [<!ENTITY a "aaaa">]><event uid="ALPHA" type="a-f"><point lat="1" lon="&a;"/></event>',
        told("uid-2", "north"),
        b"\xbf\x01\xbf\x0a\x00 binary",
        b'<event uid="ALPHA" type="a-f" cut off',
        b'<event uid="ALPHA" type="a-f"><point lat="0.0" lon="0" ce="9999999.0"/></event>',
        b'<event uid="\xff" type="a-f"><point lat="1" lon="1"/></event>',
    ],
)
def test_a_damaged_event_is_handed_on_as_it_is_and_the_next_is_read(opened, damaged):
    source, send = opened()
    send(damaged, told("uid-2", 48.0))
    odd, good = reports(source, 2)
    assert odd[:20] == damaged[:20] and json.loads(good)["landmark"] == "ugv2"


def test_an_event_in_an_unknown_encoding_does_not_end_the_input(opened):
    source, send = opened()
    for encoding in (b"nope", b"utf-16", b"utf-7"):
        send(told("uid-2", 48.0).replace(b'"1.0"', b'"1.0" encoding="' + encoding + b'"'), told("uid-2", 48.5))
        assert json.loads(reports(source, 2)[1])["latitude_deg"] == 48.5


@pytest.mark.parametrize("query", ["ugv1=a&ugv1=b", "ugv1=a&ugv2=a"])
def test_each_landmark_has_a_uid_of_its_own(query):
    with pytest.raises(InputError, match="once"):
        CotInput(f"cot:udp:127.0.0.1:4242?{query}", print)


def test_a_message_on_a_wrong_address_names_the_option_for_landmarks():
    with pytest.raises(InputError, match=r"^--landmarks cot:udp:127.0.0.1:99999.*wanted cot:udp"):
        CotInput("cot:udp:127.0.0.1:99999?a=b", print)
    with pytest.raises(InputError, match=r"^--landmarks .* cannot be opened"):
        CotInput("cot:udp:no.such.host.invalid:4242?a=b", print)


@pytest.mark.parametrize(
    "text",
    ["cot:udp:/127.0.0.1:4242", "cot:udp:/127.0.0.1?a=b", "cot:/x", "cot:tls://h:1?a=b", "cot:udp://h:1?a=", "cot:"],
)
def test_an_input_without_the_names_of_vehicles_is_refused(text):
    with pytest.raises(InputError, match=r"wanted cot:udp:HOST:PORT or"):
        CotInput(text, print)
