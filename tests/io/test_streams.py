"""Streams: opening them, retries while nobody takes messages, rows of MOT text and Cursor-on-Target events."""

import errno
import os
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from torchvision_dddas.io.streams.tool_messages import PEOPLE_FROM, CotEvents, mot_rows

from tests.io.ground import tracks
from tests.io.streamed import ABOUT, Clock, FlakyOutlet, Told, followed, surveyed
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.maps.formats import cot
from torchvision_dddas.io.streams import Stream, open_stream, open_streams


@pytest.mark.parametrize("text", ["", "json", "json:", "xml:-", "JSON:-", "-", "json:tcp://127.0.0.1:5", ":-"])
def test_what_is_no_stream_is_refused_with_what_is(text):
    with pytest.raises(InputError, match=r"is no stream; wanted json, mot or cot, .* as in json:-$"):
        open_stream(text, ABOUT, Told())


@pytest.mark.parametrize(
    ("place", "words"),
    [("absent/x", "No such file"), ("", "Is a directory"), ("a\0b", "zero byte"), ("n" * 300, "too long")],
)
def test_a_file_that_cannot_be_written_is_refused_in_one_line(tmp_path, place, words):
    with pytest.raises(InputError, match=words) as refused:
        open_stream(f"json:{tmp_path}/{place}", ABOUT, Told())
    assert "\n" not in str(refused.value) and "choose another place" in str(refused.value)


@pytest.mark.parametrize("kind", ["json", "mot", "cot"])
def test_a_file_that_holds_something_else_is_left_alone(tmp_path, kind):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"\0\0\0\x18ftypmp42")
    with pytest.raises(InputError, match="holds something else than"):
        open_stream(f"{kind}:{path}", ABOUT, Told())
    assert path.read_bytes() == b"\0\0\0\x18ftypmp42"


@pytest.mark.parametrize(
    ("about", "words"),
    [(replace(ABOUT, geographic=False), "longitudes and latitudes"), (replace(ABOUT, clock=False), "time of day")],
)
def test_events_that_could_not_say_where_or_when_are_refused(about, words):
    with pytest.raises(InputError, match=words):
        open_stream("cot:-", about, Told())


def test_two_streams_to_one_place_are_refused_and_two_addresses_are_not(tmp_path):
    for one, other in (("json:-", "mot:-"), (f"json:{tmp_path}/x", f"mot:{tmp_path}/./x")):
        with pytest.raises(InputError, match="same place"):
            open_streams([one, other], ABOUT, Told())
    streams = open_streams(["json:udp://127.0.0.1:9", "cot:udp://127.0.0.1:9"], ABOUT, Told())
    assert len(streams) == 2
    for stream in streams:
        stream.close()


def test_of_several_all_are_opened_or_none_stays_open(tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr("torchvision_dddas.io.streams.stream.Stream.close", lambda stream: closed.append(stream.name))
    with pytest.raises(InputError, match="is no stream"):
        open_streams([f"json:{tmp_path}/x", "nothing"], ABOUT, Told())
    assert closed == [f"json:{tmp_path}/x"]


def test_each_kind_writes_its_own(tmp_path):
    for kind, begins in (("json", b'{"frame":1,'), ("mot", b"1,1,10.00,"), ("cot", b'<event version="2.0" ')):
        for _ in range(2):  # what it wrote itself it takes for its own
            stream = open_stream(f"{kind}:{tmp_path}/{kind}", ABOUT, Told())
            stream.write(surveyed(1))
            stream.close()
        written = (tmp_path / kind).read_bytes()
        assert written.startswith(begins) and written.count(begins) == 2


FRAME = surveyed(on_ground=False)


def numbered(surveyed, people, age_s, most_bytes):
    return [b"%d\n" % (surveyed or people).tracked.number]


class Bench:
    """A stream of frame numbers on an outlet that can be broken, and a clock that can be set."""

    def __init__(self, encode=numbered, **outlet):
        self.outlet, self.told, self.clock = FlakyOutlet(**outlet), Told(), Clock()
        self.stream = Stream("json:x", encode, self.outlet, self.told, 0.5, 8.0, self.clock)

    def write(self, *numbers):
        for number in numbers:
            self.stream.write(replace(FRAME, tracked=replace(FRAME.tracked, number=number)))


def test_what_a_full_disk_refused_is_written_when_there_is_room_again():
    bench = Bench()
    bench.write(1)
    bench.outlet.trouble = errno.ENOSPC
    bench.write(2, 3, 4)
    assert bench.told == ["json:x: No space left on device; trying again in 0.5 s"]
    assert bench.stream.trouble == "No space left on device"
    bench.outlet.trouble = None
    bench.clock.now_s += 0.5
    bench.write(5)
    assert bench.outlet.got == [b"1\n", b"2\n", b"3\n", b"4\n", b"5\n"]
    assert bench.told[1:] == ["json:x works again; no messages lost"] and bench.stream.trouble == ""


def test_a_broken_outlet_is_tried_again_after_times_that_double_up_to_the_longest():
    bench = Bench()
    bench.outlet.trouble = errno.EPIPE
    tried = []
    for tick in range(400):
        before = bench.outlet.attempts
        bench.write(tick + 1)
        if bench.outlet.attempts > before:
            tried.append(tick / 8)
        bench.clock.now_s += 0.125
    assert tried[:7] == [0, 0.5, 1.5, 3.5, 7.5, 15.5, 23.5]
    assert bench.told == ["json:x: broken; trying again in 0.5 s"]  # once, however long it lasts


def test_what_works_only_for_a_moment_is_not_tried_oftener_for_that():
    bench = Bench()
    for k in range(400):
        bench.outlet.trouble = None if k % 2 else errno.ENOSPC
        bench.write(k + 1)
        bench.clock.now_s += 0.1
    assert len(bench.told) < 16


def test_lost_messages_are_counted_and_told_less_and_less_often():
    bench = Bench(kept=1)
    bench.outlet.read = False
    for k in range(1, 1_000):
        bench.write(k)
        bench.clock.now_s += 1
    assert bench.stream.lost == 998 and len(bench.told) < 10
    assert bench.told[0] == "json:x: it is read too slowly; 1 message lost"
    bench.stream.close()
    told = sum(int(text.split(";")[1].split()[0]) for text in bench.told)
    assert told == bench.stream.lost == 999  # the one that was kept until then too
    assert bench.told[-1].startswith("json:x closed; ")


def test_closing_says_nothing_where_nothing_was_lost():
    bench = Bench()
    bench.write(1, 2)
    bench.stream.close()
    assert bench.outlet.closed and bench.told == []


def test_a_frame_that_cannot_be_told_is_an_event_and_the_next_one_goes_out():
    def of_odd_frames(surveyed, people, age_s, most_bytes):
        if surveyed.tracked.number % 2 == 0:
            raise ZeroDivisionError("division by zero")
        return numbered(surveyed, people, age_s, most_bytes)

    bench = Bench(of_odd_frames)
    bench.write(1, 2, 3, 4, 5)
    assert bench.outlet.got == [b"1\n", b"3\n", b"5\n"] and bench.stream.lost == 2
    assert bench.told == ["json:x: frame 2 cannot be told, ZeroDivisionError: division by zero; 1 message lost"]


def test_the_age_of_a_frame_is_counted_from_its_capture():
    ages = []

    def note(surveyed, people, age_s, most_bytes):
        ages.append(age_s)
        return []

    bench = Bench(note)
    bench.stream.write(surveyed(1, taken_s=99.75))
    bench.stream.write(None, followed(1, taken_s=99.0))
    bench.stream.write(None, None)  # nothing to tell
    assert ages == [0.25, 1.0]


def test_a_disk_that_refuses_to_keep_what_it_took_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path):
    bench = Bench()
    bench.outlet.path = tmp_path / "x"

    def refuse(file):
        raise OSError(errno.EIO, "Input/output error")

    bench.stream.sync()
    monkeypatch.setattr(os, "fsync", refuse)
    bench.stream.sync()
    assert bench.told == ["json:x: Input/output error; trying again in 0.5 s"]
    monkeypatch.undo()
    bench.clock.now_s += 1
    bench.write(1)
    assert bench.told[1:] == ["json:x works again; no messages lost"]


def test_people_have_rows_of_their_own_with_identities_that_no_target_has():
    (message,) = mot_rows(surveyed(4), followed(4, 3, kind="person"))
    rows = [row.split(",") for row in message.decode().splitlines()]
    assert [int(row[1]) for row in rows] == [1, 2, PEOPLE_FROM + 1, PEOPLE_FROM + 2, PEOPLE_FROM + 3]
    assert all(row[0] == "4" and row[7:] == ["-1"] * 3 for row in rows)


def test_rows_that_need_several_datagrams_are_cut_between_lines():
    whole = mot_rows(surveyed(1, 100), None)[0]
    parts = mot_rows(surveyed(1, 100), None, most_bytes=512)
    assert b"".join(parts) == whole and len(parts) > 5
    assert all(len(part) <= 512 and part.endswith(b"\n") for part in parts)


def test_a_box_without_end_is_no_row_and_a_frame_without_boxes_no_message():
    found = surveyed(1)
    boxes = np.array([[1e300, 0, 1, 1], [np.nan, 0, 1, 1]])
    odd = replace(found.tracked, tracks=replace(found.tracked.tracks, box_px=boxes))
    assert mot_rows(replace(found, tracked=odd), None) == []


def walk(events, count=25, targets=3):
    return [message.decode() for k in range(count) for message in events(surveyed(k + 1, targets))]


def test_events_that_come_one_by_one_are_those_of_the_file():
    frames = [surveyed(k + 1, 3).locations for k in range(25)]
    kept = tracks([f.positions for f in frames if f is not None])
    still = replace(kept, velocity_m_s=np.tile((3.0, 4.0), (len(kept), 1)))
    assert walk(CotEvents(ABOUT)) == cot(still).splitlines(keepends=True)[2:-1]


def test_a_target_keeps_its_name_when_the_clock_is_set_and_is_told_at_once_when_it_is_set_back():
    about = replace(ABOUT)
    events = CotEvents(about)
    first = ElementTree.fromstring(events(surveyed(30))[0])
    about.start_utc_s += 3600
    assert events(surveyed(31)) == []
    later = ElementTree.fromstring(events(surveyed(2))[0])
    assert first.get("uid") == later.get("uid") == "dddas-1600000000-1"
    assert (later.get("time") or "").startswith("2020-09-13T13:26:40")


def test_what_is_remembered_of_targets_does_not_grow_with_time():
    events = CotEvents(ABOUT)
    for k in range(1, 300):
        found = surveyed(k)
        assert found.locations is not None
        at = replace(found.locations.positions, target=np.array([k]))
        events(replace(found, locations=replace(found.locations, positions=at)))
    assert len(events._sent_s) <= 10


@pytest.mark.parametrize("lonlat", [(np.nan, 32.0), (np.inf, 32.0), (-110.0, 91.0), (1e300, 0.0)])
def test_a_place_that_is_none_on_earth_is_no_event(lonlat):
    found = surveyed(1)
    assert found.locations is not None
    at = replace(found.locations.positions, lonlat_deg=np.array([lonlat]))
    assert CotEvents(ABOUT)(replace(found, locations=replace(found.locations, positions=at))) == []


def test_a_name_with_odd_characters_leaves_the_event_whole():
    about = replace(ABOUT, source='a"<b>&\x07\ud800é')
    event = ElementTree.fromstring(CotEvents(about)(surveyed(1))[0])
    assert event.get("uid") == 'a"<b>&é-1600000000-1'


def test_without_degrees_clock_or_ground_there_are_no_events():
    assert CotEvents(ABOUT)(surveyed(1, origin=None)) == []
    assert CotEvents(ABOUT)(surveyed(1, on_ground=False)) == []
    assert CotEvents(replace(ABOUT, start_utc_s=float("nan")))(surveyed(1)) == []
    assert CotEvents(ABOUT)(None) == []
