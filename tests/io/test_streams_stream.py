import errno
import os
from dataclasses import replace

import pytest

from tests.io.streamed import Clock, FlakyOutlet, Told, followed, surveyed
from torchvision_dddas.io.streams import Stream

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
