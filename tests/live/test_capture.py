"""A live source: numbers by the clock, the newest for who is slow, and whatever a camera does is got over."""

import itertools
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.io.clips import number_of, picture, spoil_avi_frame, write_by_av, write_images, write_video
from tests.live.streams import PATIENCE_S, FakeClock, FakeStream, Gate, Streams, after, grey, taken
from torchvision_dddas.config import LiveParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.live import Health, LiveSource

APART_S = 0.04


class Camera:
    """A live source before streams that play scripts; the first one begins when pictures are taken."""

    def __init__(self, clock: FakeClock, *scripts: list[Any] | None, **parameters: Any) -> None:
        self.health, self.clock, self.rest = Health(), clock, Gate()
        first, *more = scripts
        assert first is not None
        scripts_run = [[grey(0), self.begun, *first], *more]
        scripts_run[-1] = [*(scripts_run[-1] or []), self.rest]
        self.streams = [None if s is None else FakeStream(s) for s in scripts_run]
        self.opener = Streams(*self.streams)
        self.source: LiveSource | None = None
        self.built = threading.Event()
        parameters = {"queue_frames": 64, "stall_s": 5.0, "retry_s": 0.5, "retry_most_s": 4.0} | parameters
        self.source = LiveSource(
            "camera:0", LiveParameters(**parameters), self.health, opener=self.opener, clock=self.clock
        )
        self.built.set()
        self.frames = iter(self.source)

    def begun(self) -> None:
        assert self.built.wait(PATIENCE_S)
        assert self.source is not None
        inbox = self.source._queue
        with inbox.changed:
            assert inbox.changed.wait_for(lambda: inbox.begun or inbox.closed, PATIENCE_S)

    @property
    def counts(self) -> dict[str, int]:
        return dict(self.health.snapshot().counts)

    @property
    def told(self) -> list[str]:
        return [event.text for event in self.health.snapshot().events]

    def end(self) -> None:
        assert self.source is not None
        self.source.stop()
        self.rest.open.set()
        self.source.close()


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def later(clock: FakeClock) -> Callable[..., Callable[[], None]]:
    """A step of a script: time passes."""

    def step(seconds: float = APART_S) -> Callable[[], None]:
        return lambda: setattr(clock, "now_s", clock.now_s + seconds)

    return step


@pytest.fixture
def camera(clock: FakeClock) -> Iterator[Callable[..., Camera]]:
    made: list[Camera] = []

    def make(*scripts: list[Any] | None, **options: Any) -> Camera:
        made.append(Camera(clock, *scripts, **options))
        return made[-1]

    yield make
    for one in made:
        one.end()
        assert one.source is not None
        assert not any(thread.is_alive() for thread in one.source._feed.threads), "a thread is left behind"
        assert all(stream is None or stream.released.is_set() for stream in one.streams[: one.opener.opened])


def test_frames_are_numbered_by_the_clock_and_what_did_not_come_is_skipped(camera, later) -> None:
    some = camera([grey(1), later(), grey(2), later(10 * APART_S), grey(3), later(), grey(4)])
    frames = taken(some.frames, 4)
    assert [(f.number, f.skipped) for f in frames] == [(1, 0), (2, 0), (12, 9), (13, 0)]
    assert [f.time_s for f in frames] == pytest.approx([0, 0.04, 0.44, 0.48])
    assert [f.taken_s for f in frames] == pytest.approx([100, 100.04, 100.44, 100.48])
    assert [int(f.image[0, 0, 0]) for f in frames] == [1, 2, 3, 4]
    assert (some.source.rate_hz, some.source.size, some.source.count) == (25.0, (64, 48), None)
    assert some.source.start_utc_s == pytest.approx(1.7e9 + 100)


def test_pictures_that_come_in_bursts_keep_their_order_and_stay_near_the_clock(camera, later) -> None:
    burst = [later(3 * APART_S), grey(1), grey(1), grey(1)]
    some = camera([grey(1), *burst * 20])
    frames = taken(some.frames, 61)
    assert all(b.number > a.number for a, b in itertools.pairwise(frames))
    assert all(abs(f.number - 1 - f.time_s * 25) <= 2.01 for f in frames)


def test_a_camera_that_sends_more_than_it_announced_is_thinned_and_told_of(camera, later) -> None:
    some = camera([grey(1), *[later(APART_S / 2), grey(1)] * 300], queue_frames=64)
    while some.frames.__next__().number < 130:
        pass
    counts = some.counts
    assert counts["dropped"] > 50
    frame = next(some.frames)
    assert frame.number <= 1 + frame.time_s * 25 + 0.5 * 25 + 1
    assert [what for what in some.told if "sends 50.0 pictures a second, not 25" in what]


def test_who_is_slow_gets_the_newest_pictures_and_knows_how_many_were_dropped(camera, later) -> None:
    done = Gate()
    some = camera([grey(1), done, *[later(), grey(2)] * 9], queue_frames=2)
    first = next(some.frames)
    done.open.set()
    assert some.rest.reached.wait(PATIENCE_S)
    frames = [first, *taken(some.frames, 2)]
    assert [(f.number, f.skipped) for f in frames] == [(1, 0), (9, 7), (10, 0)]
    assert some.counts["dropped"] == 7
    assert (some.counts["captured"], some.counts["looked_at"]) == (10, 3)


def test_how_many_pictures_are_looked_at_can_be_set_while_it_runs(camera, later) -> None:
    few = Gate()
    some = camera([grey(1), later(), grey(1), few, *[later(), grey(1)] * 7])
    taken(some.frames, 2)
    some.source.look_at(3)
    few.open.set()
    frames = taken(some.frames, 2)
    assert [(f.number, f.skipped) for f in frames] == [(5, 2), (8, 2)]
    assert "dropped" not in some.counts


def test_single_bad_pictures_are_left_out_counted_and_reported_once(camera, later) -> None:
    some = camera([grey(1), later(), None, later(), None, later(), grey(1), later(), grey(1, 32, 24), later(), grey(1)])
    assert [(f.number, f.skipped) for f in taken(some.frames, 3)] == [(1, 0), (4, 2), (6, 1)]
    assert (some.counts["undecoded"], some.counts["wrong_size"]) == (2, 1)
    assert some.told == [
        "frame 2 could not be decoded and was left out",
        "pictures are 32x24 in place of 64x48: they are left out",
    ]


def test_a_stream_that_can_no_longer_be_decoded_is_opened_again(camera, later) -> None:
    some = camera([grey(1), *[later(1.0), None] * 20], [grey(2)])
    assert [int(f.image[0, 0, 0]) for f in taken(some.frames, 2)] == [1, 2]
    assert any("could be decoded for 6.0 s" in what for what in some.told)


def test_a_camera_that_comes_back_with_another_size_is_scaled_where_it_shows_the_same(camera, later) -> None:
    other = camera([grey(1), *[later(1.0), grey(7, 64, 64)] * 20, later(1.0), grey(9)])
    assert [int(f.image[0, 0, 0]) for f in taken(other.frames, 2)] == [1, 9]  # another shape is never bent
    some = camera([grey(1), *[later(1.0), grey(7, 128, 96)] * 8])
    frames = taken(some.frames, 3)
    assert [f.image.shape for f in frames] == [(48, 64, 3)] * 3
    assert [f.time_s for f in frames] == pytest.approx([0, 6, 7])
    assert any("for 5.0 s: they are scaled" in what for what in some.told)


def test_a_lost_stream_is_opened_again_with_ever_longer_pauses(camera, later) -> None:
    some = camera([grey(1)], None, None, None, None, None, [grey(2)])
    frames = taken(some.frames, 2)
    assert some.clock.slept_s[:6] == pytest.approx([0.5, 1, 2, 4, 4, 4])
    assert [f.number for f in frames] == [1, 1 + round(15.5 * 25)]
    assert frames[1].skipped == frames[1].number - 2
    assert some.counts["reconnects"] == 1
    assert some.told == [
        "camera:0 is lost: it sends no more pictures; it is opened again as soon as it is there",
        "camera:0 is back after 15.5 s, at 6 tries",
    ]
    assert some.health.snapshot().gauges["connected"] == 1


def test_pauses_are_short_again_after_a_connection_that_held_and_grow_after_one_that_did_not(camera, later) -> None:
    some = camera([grey(1)], [grey(2)], [grey(3), *[later(1.0), grey(3)] * 6], [grey(4)])
    taken(some.frames, 10)
    assert some.clock.slept_s[:3] == pytest.approx([0.5, 1, 0.5])


def test_whatever_a_driver_raises_is_got_over(camera) -> None:
    def bad() -> None:
        raise MemoryError("the driver is out of memory")

    some = camera([grey(1), bad], [grey(2)])
    assert [int(f.image[0, 0, 0]) for f in taken(some.frames, 2)] == [1, 2]
    assert "the driver is out of memory" in some.told[0]


def test_a_read_that_never_returns_is_given_up_and_its_thread_ends_when_it_does(camera) -> None:
    stuck = Gate()
    some = camera([grey(1), stuck, grey(66)], [grey(2)])
    frames = taken(some.frames, 1)
    waking = after(stuck, lambda: some.clock.pass_s(60))
    frames += taken(some.frames, 1)
    waking.join()
    assert [int(f.image[0, 0, 0]) for f in frames] == [1, 2]  # and what the one that hung still brings is not wanted
    assert "its driver has not answered for 60.0 s" in some.told[0]
    stuck.open.set()
    assert some.streams[0].released.wait(PATIENCE_S)


def test_no_more_than_four_threads_hang_at_a_time(camera, monkeypatch) -> None:
    stuck = [Gate() for _ in range(4)]
    some = camera([grey(1), stuck[0]], *[[gate] for gate in stuck[1:]], [grey(2)])
    frames = taken(some.frames, 1)
    feed, given_up, opened = some.source._feed, threading.Event(), list[int]()
    check = feed.check

    def watched() -> float:
        until_s = check()
        if feed._turn == len(stuck):
            given_up.set()
        return until_s

    monkeypatch.setattr(feed, "check", watched)
    for gate in stuck:
        after(gate, lambda: some.clock.pass_s(60))

    def end_one() -> None:
        assert given_up.wait(PATIENCE_S)
        opened.append(some.opener.opened)
        third = feed.threads[2]
        stuck[2].open.set()
        third.join(PATIENCE_S)
        some.clock.pass_s(10)  # looked after again as time passes

    ending = threading.Thread(target=end_one)
    ending.start()
    frames += taken(some.frames, 1)
    ending.join()
    assert opened == [4]
    assert int(frames[1].image[0, 0, 0]) == 2
    for gate in stuck:
        gate.open.set()


def test_times_of_day_follow_the_machines_clock_when_it_is_set(camera, later) -> None:
    def set_forward() -> None:
        some.clock.utc_ahead_s += 3600

    some = camera([grey(1), later(), set_forward, grey(2), later(), grey(3)])
    frames = taken(some.frames, 3)
    assert [f.time_s for f in frames] == pytest.approx([0, 0.04, 0.08])
    assert some.source.start_utc_s == pytest.approx(1.7e9 + 3700)
    assert some.told == ["the machine's clock was set forward by 3600.0 s; times of day follow"]


def test_the_rate_is_measured_where_none_is_announced_and_given_where_the_user_knows_it() -> None:
    clock = FakeClock()
    paced = [step for _ in range(30) for step in (lambda: setattr(clock, "now_s", clock.now_s + 0.05), grey(1))]
    source = LiveSource("camera:0", opener=Streams(FakeStream(paced, None)), clock=clock)
    assert source.rate_hz == pytest.approx(20)
    source.close()
    source = LiveSource("camera:0", rate_hz=12, opener=Streams(FakeStream([grey(1)] * 30, None)), clock=clock)
    assert source.rate_hz == 12
    source.close()


@pytest.mark.parametrize(
    ("stream", "words"),
    [(None, "cannot open it"), ([False] * 20, "no picture comes from camera:0"), ([None] * 200, "can be decoded")],
)
def test_what_cannot_be_opened_or_shows_nothing_is_one_line_at_the_start(stream, words) -> None:
    opener = Streams(None if stream is None else FakeStream(stream))
    with pytest.raises(InputError, match=words) as error:
        LiveSource("camera:0", opener=opener, clock=FakeClock())
    assert "\n" not in str(error.value)
    assert opener.opened == 1


def test_a_camera_that_hangs_at_the_start_is_one_line_too() -> None:
    stuck, clock = Gate(), FakeClock()
    stream = FakeStream([stuck, grey(1)])
    given_up = threading.Event()

    def wait_on() -> None:
        while not given_up.is_set():
            clock.pass_s(10)

    waking = after(stuck, wait_on)
    with pytest.raises(InputError, match="camera:0 sends nothing for 25 s"):
        LiveSource("camera:0", opener=Streams(stream), clock=clock)
    given_up.set()
    waking.join()
    stuck.open.set()
    assert stream.released.wait(PATIENCE_S)


@pytest.mark.parametrize("spec", ["tcp://127.0.0.1:9", "camera:x", "nowhere.mp4"])
def test_an_input_that_is_not_there_is_one_line(spec) -> None:
    with pytest.raises(InputError) as error:
        LiveSource(spec, LiveParameters(stall_s=1.0))
    assert spec in str(error.value)
    assert "\n" not in str(error.value)


def test_a_password_in_an_address_is_never_told() -> None:
    with pytest.raises(InputError) as error:
        LiveSource("rtsp://pilot:s3cret@127.0.0.1:9/a", LiveParameters(stall_s=1.0))
    assert "rtsp://127.0.0.1:9/a" in str(error.value)
    opener = Streams(FakeStream(itertools.repeat(grey(1))))
    source = LiveSource("rtsp://pilot:s3cret@drone/a", opener=opener, clock=FakeClock())
    source.close()
    assert source.name == "rtsp://drone/a"


def test_stop_ends_the_iteration_of_who_waits_for_a_picture(camera) -> None:
    some = camera([grey(1)])
    next(some.frames)
    stopping = after(some.rest, some.source.stop)
    assert list(some.frames) == []
    stopping.join()


def test_a_step_is_timed_from_a_picture_to_the_next_request(camera) -> None:
    some = camera([grey(1), grey(2), grey(3)])
    next(some.frames)
    some.clock.now_s += 0.7
    next(some.frames)
    assert some.source.busy_s == pytest.approx(0.7)
    assert some.health.snapshot().seconds["step"][0] == pytest.approx(0.7)


# -- recordings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pace", [1.0, 8.0])
def test_a_recording_plays_at_its_pace_with_its_own_times_and_ends(tmp_path: Path, pace: float) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG", frames=20)
    clock = FakeClock()
    source = LiveSource(str(path), LiveParameters(pace=pace, queue_frames=64), clock=clock)
    frames = list(source)
    assert [f.number for f in frames] == list(range(1, 21))
    assert [number_of(f.image) for f in frames] == pytest.approx(range(1, 21), abs=1)
    assert [f.time_s for f in frames] == pytest.approx(np.arange(20) / 10, abs=1e-3)
    assert [f.taken_s for f in frames] == pytest.approx(100 + np.arange(20) / 10 / pace, abs=1e-3)
    assert source.apart_s == pytest.approx(0.1 / pace)
    assert source.last == 20
    source.close()


def test_a_recording_without_pace_waits_for_the_run(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG", frames=20)
    health = Health()
    source = LiveSource(str(path), LiveParameters(pace=0, queue_frames=1), health)
    assert [(f.number, f.skipped) for f in source] == [(n, 0) for n in range(1, 21)]
    assert source.apart_s == 0
    assert "dropped" not in health.snapshot().counts
    source.close()


def test_what_is_damaged_in_a_recording_is_left_out(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG", frames=20)
    spoil_avi_frame(path, 12)
    health = Health()
    frames = list(LiveSource(str(path), LiveParameters(pace=0), health))
    assert [f.number for f in frames] == [n for n in range(1, 21) if n != 12]
    assert health.snapshot().counts["undecoded"] == 1
    assert [(e.kind, e.frame) for e in health.snapshot().events] == [("stream", 12)]
    folder = write_images(tmp_path / "frames", range(1, 6))
    cv2.imwrite(str(folder / "frame3.png"), picture(3, 32, 24))
    source = LiveSource(str(folder), LiveParameters(pace=0))
    assert [f.number for f in source] == [1, 2, 4, 5]
    assert "32x24" in source.problems[0].what


def test_a_recording_that_is_left_in_the_middle_leaves_no_thread(tmp_path: Path) -> None:
    source = LiveSource(str(write_video(tmp_path / "clip.avi", "MJPG")), LiveParameters(pace=0.001))
    next(iter(source))
    source.close()
    assert not any(thread.is_alive() for thread in source._feed.threads)


# -- a real stream -----------------------------------------------------------------------------------------------------


def test_a_network_stream_that_is_cut_is_read_on_by_a_new_connection(tmp_path: Path) -> None:
    clip = write_by_av(tmp_path / "clip.ts", "mpeg4", [100 * k for k in range(40)])
    listener = socket.create_server(("127.0.0.1", 0))
    health_pages: list[int] = []

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection:
                health_pages.append(1)
                connection.sendall(clip.read_bytes())

    server = threading.Thread(target=serve)
    server.start()
    health = Health()
    parameters = LiveParameters(retry_s=0.01, retry_most_s=0.1, stall_s=20, queue_frames=64)
    source = LiveSource(f"tcp://127.0.0.1:{listener.getsockname()[1]}", parameters, health)
    assert source.size == (64, 48)
    for frame in source:
        assert frame.image.shape == (48, 64, 3)
        if len(health_pages) > 2 and health.snapshot().counts.get("reconnects", 0) > 1:
            break
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    source.close()
    server.join()
    assert [event.kind for event in health.snapshot().events[:2]] == ["stream", "stream"]
