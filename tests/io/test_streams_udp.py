"""Datagrams, on this machine's own network only."""

import errno
import json
import socket
from xml.etree import ElementTree

import pytest
from torchvision_dddas.io.streams.datagrams import MOST_BYTES, Address, DatagramOutlet, parse_address

from tests.io.streamed import ABOUT, Told, surveyed
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams import open_stream


@pytest.fixture
def listener():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(5)
        yield opened


def port(listener):
    return listener.getsockname()[1]


def test_a_frame_is_a_datagram_and_a_long_one_is_several(listener):
    stream = open_stream(f"json:udp://localhost:{port(listener)}?bytes=1000", ABOUT, told := Told())
    for targets in (1, 30):
        stream.write(surveyed(1, targets, on_ground=False))
    fields = json.loads(listener.recv(MOST_BYTES))
    assert "parts" not in fields and len(fields["targets"]) == 2
    first = listener.recv(MOST_BYTES)
    rest = [listener.recv(MOST_BYTES) for _ in range(json.loads(first)["parts"] - 1)]
    assert max(map(len, [first, *rest])) <= 1000
    assert sum(len(json.loads(part)["targets"]) for part in [first, *rest]) == 31
    stream.close()
    assert told == []


def test_an_event_is_a_datagram(listener):
    stream = open_stream(f"cot:udp://127.0.0.1:{port(listener)}", ABOUT, Told())
    stream.write(surveyed(1, 3))
    found = [ElementTree.fromstring(listener.recv(MOST_BYTES)).get("uid") for _ in range(2)]
    assert found == ["dddas-1600000000-1", "dddas-1600000000-2"]
    stream.close()


def test_datagrams_reach_those_who_listen_later_though_nobody_did_before(listener):
    place = listener.getsockname()
    listener.close()
    told = Told()
    stream = open_stream(f"json:udp://127.0.0.1:{place[1]}", ABOUT, told)
    for number in (1, 2, 3):
        stream.write(surveyed(number))
    assert told == [
        f"json:udp://127.0.0.1:{place[1]}: nobody listens at port {place[1]} of 127.0.0.1; 1 message lost",
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as later:
        later.bind(place)
        later.settimeout(5)
        stream.write(surveyed(4))
        assert json.loads(later.recv(MOST_BYTES))["frame"] == 4
    stream.close()


def test_without_a_network_only_the_newest_frame_is_kept_and_the_rest_counted(listener, monkeypatch):
    outlet = DatagramOutlet(Address("127.0.0.1", port(listener)))

    class Away:
        def send(self, message):
            raise OSError(errno.ENETUNREACH, "Network is unreachable")

        def close(self):
            pass

    monkeypatch.setattr(outlet, "_socket", Away())
    for message in (b"1", b"2", b"3"):
        outlet.put([message])
        with pytest.raises(OSError, match="unreachable"):
            outlet.flush()
    outlet.mend()
    outlet.flush()
    assert listener.recv(10) == b"3" and outlet.lost == 2
    outlet.close()


def test_a_message_too_long_for_any_datagram_is_lost_and_the_next_one_is_not(listener):
    outlet = DatagramOutlet(Address("127.0.0.1", port(listener)))
    outlet.put([bytes(MOST_BYTES + 1), b"next"])
    outlet.flush()
    assert listener.recv(10) == b"next"
    assert outlet.lost == 1 and "too much for a datagram" in outlet.reason
    outlet.close()


def test_an_address_of_version_6_works_too():
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as listener:
        try:
            listener.bind(("::1", 0))
        except OSError:
            pytest.skip("this machine has no IPv6")
        listener.settimeout(5)
        stream = open_stream(f"mot:udp://[::1]:{port(listener)}?ttl=3", ABOUT, Told())
        stream.write(surveyed(1, 1))
        assert listener.recv(MOST_BYTES) == b"1,1,10.00,20.00,30.00,40.00,0.875,-1,-1,-1\n"
        stream.close()


def test_all_who_listen_to_a_multicast_get_it_and_no_router_passes_it_on_unasked():
    outlet = DatagramOutlet(parse_address("udp://239.2.3.1:6969?interface=lo", ""))
    assert outlet._socket is not None
    assert outlet._socket.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 1
    outlet.close()
    outlet = DatagramOutlet(parse_address("udp://239.2.3.1:6969?ttl=4&interface=lo", ""))
    assert outlet._socket is not None
    assert outlet._socket.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 4
    group = socket.inet_aton("239.2.3.1") + socket.inet_aton("127.0.0.1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("", 6969))
        listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        listener.settimeout(5)
        outlet.put([b"all"])
        outlet.flush()
        assert listener.recv(10) == b"all"
    outlet.close()


@pytest.mark.parametrize(
    "place",
    [
        "udp://",
        "udp:127.0.0.1:5",
        "udp://127.0.0.1",
        "udp://127.0.0.1:0",
        "udp://127.0.0.1:70000",
        "udp://127.0.0.1:5/path",
        "udp://me@127.0.0.1:5",
        "udp://127.0.0.1:5?ttl=0",
        "udp://127.0.0.1:5?ttl=many",
        "udp://127.0.0.1:5?bytes=100",
        "udp://127.0.0.1:5?hops=3",
        "udp://[::1:5",
    ],
)
def test_a_place_that_is_no_address_is_refused_in_one_line(place):
    with pytest.raises(InputError, match=r"^--emit json:udp.*; wanted udp://HOST:PORT") as refused:
        open_stream(f"json:{place}", ABOUT, Told())
    assert "\n" not in str(refused.value)


def test_a_host_that_cannot_be_reached_at_the_start_is_refused(monkeypatch):
    def unknown(*asked, **more):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(InputError, match=r"json:udp://nowhere\.invalid:5: Name or service not known"):
        open_stream("json:udp://nowhere.invalid:5", ABOUT, Told())
    monkeypatch.undo()
    with pytest.raises(InputError, match="interface=none: no interface with this name"):
        open_stream("json:udp://239.2.3.1:5?interface=none", ABOUT, Told())
