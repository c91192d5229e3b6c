"""Streams: opening them, retries, and files, pipes and datagrams with the trouble that a real system makes."""

import errno
import json
import os
import resource
import socket
import threading
from dataclasses import replace

import pytest

from tests.io.streamed import ABOUT, located, tracked
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams import Stream, open_stream, open_streams
from torchvision_dddas.io.streams.outlets import (
    KEPT_BYTES,
    MOST_BYTES,
    DatagramOutlet,
    LineOutlet,
    Outlet,
    open_datagrams,
)


class Notes(list):
    """What streams told the user."""

    def __call__(self, kind, text):
        assert kind == "sink"
        self.append(text)


@pytest.fixture
def notes():
    return Notes()


def frames_in(content):
    return [json.loads(line)["frame"] for line in content.splitlines()]


# -- Opening -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["", "json", "json:", "xml:-", "JSON:-", "-", "json:ftp://127.0.0.1:5", ":-"])
def test_no_stream_is_refused_with_what_is_one(text, notes):
    with pytest.raises(InputError, match=r"is no stream; wanted json, mot or cot, .* as in json:-$"):
        open_stream(text, ABOUT, notes)


@pytest.mark.parametrize(
    ("place", "words"),
    [("absent/x", "No such file"), ("", "Is a directory"), ("a\0b", "zero byte"), ("n" * 300, "too long")],
)
def test_a_file_that_cannot_be_written_is_refused_in_one_line(tmp_path, place, words, notes):
    with pytest.raises(InputError, match=words) as refused:
        open_stream(f"json:{tmp_path}/{place}", ABOUT, notes)
    assert "choose another place" in str(refused.value)


@pytest.mark.parametrize(("kind", "begins"), [("json", b'{"frame":1,'), ("mot", b"1,1,10.00,"), ("cot", b"<event v")])
def test_each_kind_goes_on_in_its_own_file_and_leaves_others_alone(tmp_path, kind, begins, notes):
    for _ in range(2):
        stream = open_stream(f"{kind}:{tmp_path}/own", ABOUT, notes)
        stream.write(located(1))
        stream.close()
    written = (tmp_path / "own").read_bytes()
    assert written.startswith(begins) and written.count(begins) == 2
    other = tmp_path / "clip.mp4"
    other.write_bytes(b"\0\0\0\x18ftypmp42")
    with pytest.raises(InputError, match="holds something else than"):
        open_stream(f"{kind}:{other}", ABOUT, notes)
    assert other.read_bytes() == b"\0\0\0\x18ftypmp42"


def test_events_need_degrees(notes):
    with pytest.raises(InputError, match="longitudes and latitudes"):
        open_stream("cot:-", replace(ABOUT, geographic=False), notes)


def test_two_streams_to_one_place_are_refused_and_two_addresses_are_not(tmp_path, notes):
    for one, other in (("json:-", "mot:-"), (f"json:{tmp_path}/x", f"mot:{tmp_path}/./x")):
        with pytest.raises(InputError, match="same place"):
            open_streams([one, other], ABOUT, notes)
    streams = open_streams(["json:udp://127.0.0.1:9", "cot:udp://127.0.0.1:9"], ABOUT, notes)
    assert len(streams) == 2
    for stream in streams:
        stream.close()


def test_several_are_all_opened_or_none_stays_open(tmp_path, monkeypatch, notes):
    closed = []
    monkeypatch.setattr(Stream, "close", lambda stream: closed.append(stream.name))
    with pytest.raises(InputError, match="is no stream"):
        open_streams([f"json:{tmp_path}/x", "nothing"], ABOUT, notes)
    assert closed == [f"json:{tmp_path}/x"]


# -- Retries -----------------------------------------------------------------------------------------------------------


def numbered(result, people, age_s, most_bytes):
    return [b"%d\n" % (result or people).tracked.number]


class Bench(Outlet):
    """A stream of frame numbers on an outlet that can be broken, and a clock that can be set. It is its own outlet."""

    def __init__(self, encode=numbered, most_kept=1000, path=None):
        super().__init__()
        self.notes, self.now_s, self.reason = Notes(), 100.0, "it is read too slowly"
        self.most_kept, self.trouble, self.is_read, self.path = most_kept, None, True, path
        self.kept, self.got, self.attempts = [], [], 0
        self.stream = Stream("json:x", encode, self, self.notes, 0.5, 8.0, lambda: self.now_s)

    def write(self, *numbers):
        frame = located(on_ground=False)
        for number in numbers:
            self.stream.write(replace(frame, tracked=replace(frame.tracked, number=number)))

    def put(self, messages):
        self.kept += messages
        self.lost += max(0, len(self.kept) - self.most_kept)
        self.kept = self.kept[-self.most_kept :]

    def flush(self):
        self.attempts += 1
        if self.trouble is not None:
            raise OSError(self.trouble, {errno.ENOSPC: "No space left on device"}.get(self.trouble, "broken"))
        if self.is_read:
            self.got += self.kept
            self.kept = []

    def mend(self):
        pass

    def handle(self):
        return None if self.path is None else os.open(self.path, os.O_CREAT | os.O_WRONLY)

    def close(self):
        self.lost += len(self.kept)


def test_what_a_full_disk_refused_is_written_when_there_is_room_again():
    bench = Bench()
    bench.write(1)
    bench.trouble = errno.ENOSPC
    bench.write(2, 3, 4)
    assert bench.notes == ["json:x: No space left on device; trying again in 0.5 s"]
    bench.trouble = None
    bench.now_s += 0.5
    bench.write(5)
    bench.stream.close()
    assert bench.got == [b"1\n", b"2\n", b"3\n", b"4\n", b"5\n"]
    assert bench.notes[1:] == ["json:x works again; no messages lost"]


def test_a_broken_outlet_is_tried_again_after_times_that_double_up_to_the_longest():
    bench = Bench()
    bench.trouble = errno.EPIPE
    tried = []
    for tick in range(400):
        before = bench.attempts
        bench.write(tick + 1)
        tried += [tick / 8] if bench.attempts > before else []
        bench.now_s += 0.125
    assert tried[:7] == [0, 0.5, 1.5, 3.5, 7.5, 15.5, 23.5]
    assert bench.notes == ["json:x: broken; trying again in 0.5 s"]  # once, however long it lasts


def test_lost_messages_are_counted_and_reported_less_and_less_often():
    bench = Bench(most_kept=1)
    bench.is_read = False
    for k in range(1, 1_000):
        bench.write(k)
        bench.now_s += 1
    assert bench.stream.lost == 998 and len(bench.notes) < 10
    assert bench.notes[0] == "json:x: it is read too slowly; 1 message lost"
    bench.stream.close()
    reported = sum(int(text.split(";")[1].split()[0]) for text in bench.notes)
    assert reported == bench.stream.lost == 999  # the one that was kept until then too
    assert bench.notes[-1].startswith("json:x closed; ")


def test_a_stream_is_in_trouble_while_it_cannot_send_and_for_a_while_after_a_message_was_lost():
    bench = Bench(most_kept=1)
    bench.write(1)
    assert bench.stream.trouble() == ""
    bench.trouble = errno.ENOSPC
    bench.write(2)
    assert bench.stream.trouble() == "json:x: No space left on device"
    bench.trouble = None
    bench.now_s += 0.5
    bench.write(3)  # 2 is lost: one message is kept
    assert bench.stream.trouble() == "json:x: it is read too slowly; messages are lost"
    bench.now_s += 29
    bench.write(4)
    assert bench.stream.trouble()
    bench.now_s += 2
    assert bench.stream.trouble() == ""


def test_a_frame_that_cannot_be_encoded_is_reported_and_the_next_one_goes_out():
    def encode(result, people, age_s, most_bytes):
        return numbered(result, people, 1 / (result.tracked.number % 2), most_bytes)

    bench = Bench(encode)
    bench.write(1, 2, 3, 4, 5)
    assert bench.got == [b"1\n", b"3\n", b"5\n"] and bench.stream.lost == 2
    assert bench.notes == ["json:x: frame 2 cannot be encoded, ZeroDivisionError: division by zero; 1 message lost"]


def test_the_age_of_a_frame_is_counted_from_its_capture():
    ages = []

    def encode(result, people, age_s, most_bytes):
        ages.append(age_s)
        return []

    bench = Bench(encode)
    bench.stream.write(located(1, taken_s=99.75))
    bench.stream.write(None, tracked(1, taken_s=99.0))
    bench.stream.write(None, None)
    assert ages == [0.25, 1.0]


def test_a_disk_that_refuses_to_keep_what_it_took_is_reported(monkeypatch, tmp_path):
    bench = Bench(path=tmp_path / "x")

    def refuse(file):
        raise OSError(errno.EIO, "Input/output error")

    bench.stream.sync()
    monkeypatch.setattr(os, "fsync", refuse)
    bench.stream.sync()
    assert bench.notes == ["json:x: Input/output error; trying again in 0.5 s"]
    bench.now_s += 1
    bench.write(1)
    assert bench.notes[1:] == ["json:x works again; no messages lost"]


# -- Lines -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def room():
    """Lets no file grow beyond a size, as a full disk does: the kernel writes a part of a line and refuses the rest."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def lines(*sizes):
    return [b"%d" % (k % 10) * (size - 1) + b"\n" for k, size in enumerate(sizes, 1)]


def reader_of(pipe):
    return os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)


def taken(reader):
    """What a pipe holds at the moment."""
    found = b""
    try:
        while more := os.read(reader, 1 << 16):
            found += more
    except BlockingIOError:
        pass
    return found


def test_a_file_holds_each_line_at_once_and_an_unfinished_one_does_not_spoil_the_next(tmp_path, notes):
    path = tmp_path / "x.jsonl"
    path.write_bytes(b'{"frame":1}\n{"fra')
    for first in (2, 4):
        stream = open_stream(f"json:{path}", ABOUT, notes)
        for number in (first, first + 1):
            stream.write(located(number))
            assert json.loads(path.read_text().splitlines()[-1])["frame"] == number  # before it is closed
            stream.sync()
        stream.close()
    first, torn, *rest = path.read_text().splitlines()
    assert (first, torn) == ('{"frame":1}', '{"fra') and frames_in("\n".join(rest)) == [2, 3, 4, 5]


@pytest.mark.parametrize("is_standard_output", [False, True])
def test_a_disk_that_fills_up_within_a_line_keeps_whole_lines_and_loses_none(
    tmp_path, room, monkeypatch, is_standard_output
):
    path = tmp_path / "x.txt"
    with path.open("wb") as file:  # `> FILE`: not for appending
        outlet = LineOutlet(None if is_standard_output else path)
        if is_standard_output:
            monkeypatch.setattr(outlet, "_file", file.fileno())
            monkeypatch.setattr(outlet, "_regular", True)
        one, two, three = lines(100, 10_000, 200)
        room(5_000)
        outlet.put([one, two, three])
        with pytest.raises(OSError, match="too large"):
            outlet.flush()
        assert path.read_bytes() == one
        room(resource.RLIM_INFINITY)
        outlet.mend()
        outlet.flush()
        outlet.close()
    assert path.read_bytes() == one + two + three and outlet.lost == 0


def test_a_file_that_is_moved_away_or_removed_is_begun_anew(tmp_path, notes):
    path, moved = tmp_path / "x.jsonl", tmp_path / "x.jsonl.1"
    stream = open_stream(f"json:{path}", ABOUT, notes)
    stream.write(located(1))
    path.rename(moved)
    stream.write(located(2))
    path.unlink()
    stream.write(located(3))
    stream.close()
    assert frames_in(moved.read_text()) == [1] and frames_in(path.read_text()) == [3] and notes == []


def test_a_folder_that_disappears_is_reported_and_comes_back(tmp_path, notes):
    folder = tmp_path / "out"
    folder.mkdir()
    stream = open_stream(f"json:{folder}/x", ABOUT, notes, retry_s=0.0, retry_most_s=0.0)
    (folder / "x").unlink()
    folder.rmdir()
    stream.write(located(1))
    stream.write(located(2))
    folder.mkdir()
    stream.write(located(3))
    stream.close()
    assert frames_in((folder / "x").read_text()) == [1, 2, 3]
    assert [text.split("; ")[0].split(": ")[-1] for text in notes] == [
        "No such file or directory",
        f"json:{folder}/x works again",
    ]


def test_a_pipe_that_nobody_reads_neither_blocks_nor_grows_and_a_slow_reader_gets_whole_lines(pipe):
    reader = reader_of(pipe)
    outlet, count = LineOutlet(pipe), 40
    for line in lines(*[100_000] * count):  # more than the pipe and what is kept
        outlet.put([line])
        outlet.flush()
        assert outlet._kept_bytes <= KEPT_BYTES
    assert 0 < outlet.lost < count
    got = b""
    while outlet._kept:
        got += taken(reader)
        outlet.flush()
    found = (got + taken(reader)).split(b"\n")[:-1]
    assert len(found) == count - outlet.lost
    assert all(len(line) == 99_999 and len(set(line)) == 1 for line in found)
    assert found[-1][:1] == b"0"  # the newest: the oldest are lost
    os.close(reader)
    outlet.close()


def test_a_pipe_is_read_by_another_after_its_reader_went_away(pipe, notes):
    reader = reader_of(pipe)
    stream = open_stream(f"json:{pipe}", ABOUT, notes, retry_s=0.0, retry_most_s=0.0)
    stream.write(located(1))
    os.close(reader)
    stream.write(located(2))
    stream.write(located(3))
    reader = reader_of(pipe)
    stream.write(located(4))
    assert frames_in(taken(reader)) == [2, 3, 4]
    assert [text.split("; ")[0] for text in notes] == [f"json:{pipe}: nobody reads it", f"json:{pipe} works again"]
    os.close(reader)
    stream.close()


def test_closing_waits_a_little_for_a_reader_that_is_at_work(pipe):
    reader = reader_of(pipe)
    outlet = LineOutlet(pipe)
    (line,) = lines(500_000)
    outlet.put([line])
    outlet.flush()
    got: list[bytes] = []
    os.set_blocking(reader, True)
    thread = threading.Thread(target=lambda: got.extend(iter(lambda: os.read(reader, 1 << 16), b"")))
    thread.start()
    outlet.close()
    thread.join()
    os.close(reader)
    assert b"".join(got) == line and outlet.lost == 0


def test_standard_output_gets_the_lines_and_stays_open(capfd, notes):
    stream = open_stream("mot:-", ABOUT, notes)
    stream.write(located(7))
    stream.close()
    os.write(1, b"open\n")
    rest = ",20.00,30.00,40.00,0.875,-1,-1,-1"
    assert capfd.readouterr().out.splitlines() == [f"7,1,10.00{rest}", f"7,2,20.00{rest}", "open"]


# -- Datagrams, on this machine's own network only ---------------------------------------------------------------------


@pytest.fixture
def listener():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(5)
        yield opened


def port(listener):
    return listener.getsockname()[1]


def test_a_frame_is_a_datagram_and_a_long_one_is_several(listener, notes):
    stream = open_stream(f"json:udp://localhost:{port(listener)}?bytes=1000", ABOUT, notes)
    for targets in (1, 30):
        stream.write(located(1, targets, on_ground=False))
    fields = json.loads(listener.recv(MOST_BYTES))
    assert "parts" not in fields and len(fields["targets"]) == 2
    first = listener.recv(MOST_BYTES)
    parts = [first, *(listener.recv(MOST_BYTES) for _ in range(json.loads(first)["parts"] - 1))]
    assert max(map(len, parts)) <= 1000
    assert sum(len(json.loads(part)["targets"]) for part in parts) == 31
    stream.close()
    assert notes == []


def test_datagrams_reach_those_who_listen_later_though_nobody_did_before(listener, notes):
    place, name = listener.getsockname(), f"json:udp://127.0.0.1:{port(listener)}"
    listener.close()
    stream = open_stream(name, ABOUT, notes)
    for number in (1, 2, 3):
        stream.write(located(number))
    assert notes == [f"{name}: nobody listens at port {place[1]} of 127.0.0.1; 1 message lost"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as later:
        later.bind(place)
        later.settimeout(5)
        stream.write(located(4))
        assert frames_in(later.recv(MOST_BYTES)) == [4]
    stream.close()


def test_without_a_network_only_the_newest_frame_is_kept_and_the_rest_counted(listener, monkeypatch):
    outlet = DatagramOutlet("127.0.0.1", port(listener))

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
    outlet.put([b"4", bytes(MOST_BYTES + 1), b"5"])  # the second is too long for any
    outlet.flush()
    assert (listener.recv(10), listener.recv(10)) == (b"4", b"5")
    assert outlet.lost == 4 and "too much for a datagram" in outlet.reason
    outlet.close()


def test_an_address_of_version_6_works_too(notes):
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as listener:
        try:
            listener.bind(("::1", 0))
        except OSError:
            pytest.skip("this machine has no IPv6")
        listener.settimeout(5)
        stream = open_stream(f"mot:udp://[::1]:{port(listener)}?ttl=3", ABOUT, notes)
        stream.write(located(1, 1))
        assert listener.recv(MOST_BYTES) == b"1,1,10.00,20.00,30.00,40.00,0.875,-1,-1,-1\n"
        stream.close()


def test_all_who_listen_to_a_multicast_get_it_and_no_router_passes_it_on_unasked():
    for option, hops in (("", 1), ("&ttl=4", 4)):
        outlet = open_datagrams(f"udp://239.2.3.1:6969?interface=lo{option}", "")
        assert (
            outlet._socket is not None and outlet._socket.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == hops
        )
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(("", 6969))
            group = socket.inet_aton("239.2.3.1") + socket.inet_aton("127.0.0.1")
            listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
            listener.settimeout(5)
            outlet.put([b"all"])
            outlet.flush()
            assert listener.recv(10) == b"all"
        outlet.close()


@pytest.mark.parametrize(
    "place",
    [
        *("udp://", "udp:127.0.0.1:5", "udp://127.0.0.1", "udp://127.0.0.1:0", "udp://127.0.0.1:70000", "udp://[::1:5"),
        *("udp://127.0.0.1:5/path", "udp://me@127.0.0.1:5", "udp://127.0.0.1:5?ttl=0", "udp://127.0.0.1:5?ttl=many"),
        *("udp://127.0.0.1:5?bytes=100", "udp://127.0.0.1:5?hops=3"),
    ],
)
def test_a_place_that_is_no_address_is_refused_in_one_line(place, notes):
    with pytest.raises(InputError, match=r"^--emit json:udp.*; wanted udp://HOST:PORT"):
        open_stream(f"json:{place}", ABOUT, notes)


@pytest.mark.parametrize("scheme", ["udp", "tcp"])
def test_a_name_that_no_host_can_have_is_refused_in_one_line(scheme, notes):
    with pytest.raises(InputError, match=rf"--emit json:{scheme}://a+:80: .*; choose another place"):
        open_stream(f"json:{scheme}://{'a' * 70}:80", ABOUT, notes)


def test_a_host_that_cannot_be_reached_at_the_start_is_refused(monkeypatch, notes):
    with pytest.raises(InputError, match="interface=none: no interface with this name"):
        open_stream("json:udp://239.2.3.1:5?interface=none", ABOUT, notes)

    def unknown(*asked, **more):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(InputError, match=r"json:udp://nowhere\.invalid:5: Name or service not known"):
        open_stream("json:udp://nowhere.invalid:5", ABOUT, notes)
