"""A live source numbers pictures by the clock, keeps the newest, and survives whatever a camera does."""

import base64
import hashlib
import http.server
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
from tests.live.streams import PATIENCE_S, FakeClock, FakeStream, Gate, Streams, after, grey
from torchvision_dddas.config import LiveParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.live import Health, LiveSource
from torchvision_dddas.live.receiver import DeadCamera
from torchvision_dddas.types import Frame

APART_S = 0.04


class Camera:
    """A live source before streams that play scripts; the first script begins when pictures are taken."""

    def __init__(self, clock: FakeClock, *scripts: list[Any] | None, **parameters: Any) -> None:
        self.health, self.clock, self.rest, self.built = Health(), clock, Gate(), threading.Event()
        played = [None if script is None else list(script) for script in scripts]
        assert played[0] is not None and played[-1] is not None
        played[0][:0] = [0, self.begun]
        played[-1].append(self.rest)
        self.streams = [None if script is None else FakeStream(script, clock=clock) for script in played]
        self.opener = Streams(*self.streams)
        options = {"queue_frames": 64, "stall_s": 5.0, "retry_s": 0.5, "retry_most_s": 4.0} | parameters
        self.source = LiveSource("camera:0", LiveParameters(**options), self.health, opener=self.opener, clock=clock)
        self.built.set()
        self.frames = iter(self.source)

    def begun(self) -> None:
        assert self.built.wait(PATIENCE_S)
        inbox = self.source._queue
        with inbox.changed:
            assert inbox.changed.wait_for(lambda: inbox.begun or inbox.closed, PATIENCE_S)

    def take(self, count: int) -> list[Frame]:
        return [next(self.frames) for _ in range(count)]

    @property
    def counts(self) -> dict[str, int]:
        return dict(self.health.snapshot().counts)

    @property
    def reported(self) -> list[str]:
        return [event.text for event in self.health.snapshot().events]

    def end(self) -> None:
        self.source.stop()
        self.rest.open.set()
        self.source.close()
        assert not any(thread.is_alive() for thread in self.source._feed.threads), "a thread is left behind"
        assert all(stream is None or stream.released.is_set() for stream in self.streams[: self.opener.opened])


def levels(frames: list[Frame]) -> list[int]:
    return [int(frame.image[0, 0, 0]) for frame in frames]


def numbered(frames: list[Frame]) -> list[tuple[int, int]]:
    return [(frame.number, frame.skipped) for frame in frames]


@pytest.fixture
def camera() -> Iterator[Callable[..., Camera]]:
    made: list[Camera] = []

    def make(*scripts: list[Any] | None, **options: Any) -> Camera:
        made.append(Camera(FakeClock(), *scripts, **options))
        return made[-1]

    yield make
    for one in made:
        one.end()


def test_frames_are_numbered_by_the_clock_and_gaps_are_skipped(camera) -> None:
    some = camera([1, APART_S, 2, 10 * APART_S, 3, APART_S, 4])
    frames = some.take(4)
    assert numbered(frames) == [(1, 0), (2, 0), (12, 9), (13, 0)]
    assert [f.time_s for f in frames] == pytest.approx([0, 0.04, 0.44, 0.48])
    assert [f.taken_s for f in frames] == pytest.approx([100, 100.04, 100.44, 100.48])
    assert levels(frames) == [1, 2, 3, 4]
    assert (some.source.rate_hz, some.source.size, some.source.count) == (25.0, (64, 48), None)
    assert some.source.start_utc_s == pytest.approx(1.7e9 + 100)


def test_pictures_in_bursts_keep_their_order_and_stay_near_the_clock(camera) -> None:
    frames = camera([1, *[3 * APART_S, 1, 1, 1] * 20]).take(61)
    assert all(b.number > a.number for a, b in itertools.pairwise(frames))
    assert all(abs(f.number - 1 - f.time_s * 25) <= 2.01 for f in frames)


def test_a_camera_that_sends_more_than_it_announced_is_thinned_and_reported(camera) -> None:
    some = camera([1, *[APART_S / 2, 1] * 300])
    frame = next(frame for frame in some.frames if frame.number >= 130)
    assert some.counts["dropped"] > 50
    assert frame.number <= 1 + frame.time_s * 25 + 0.5 * 25 + 1
    assert any("sends 50.0 pictures a second, not 25" in what for what in some.reported)


def test_pictures_that_were_gathered_while_a_stream_was_opened_say_nothing_of_its_rate(camera) -> None:
    some = camera([*[0.01, 1] * 50, *[APART_S, 1] * 150])
    assert next(frame for frame in some.frames if frame.number >= 120)
    assert not any("pictures a second" in what for what in some.reported)


def test_a_slow_reader_gets_the_newest_pictures_and_how_many_were_dropped(camera) -> None:
    done = Gate()
    some = camera([1, done, *[APART_S, 2] * 9], queue_frames=2)
    first = some.take(1)
    done.open.set()
    assert some.rest.reached.wait(PATIENCE_S)
    assert numbered(first + some.take(2)) == [(1, 0), (9, 7), (10, 0)]
    assert [some.counts[name] for name in ("dropped", "captured", "looked_at")] == [7, 10, 3]


def test_every_nth_picture_can_be_asked_for_during_a_run(camera) -> None:
    few = Gate()
    some = camera([1, APART_S, 1, few, *[APART_S, 1] * 7])
    some.take(2)
    some.source.look_at(3)
    few.open.set()
    assert numbered(some.take(2)) == [(5, 2), (8, 2)]
    assert "dropped" not in some.counts


def test_single_bad_pictures_are_left_out_counted_and_reported_once(camera) -> None:
    some = camera([1, APART_S, None, APART_S, None, APART_S, 1, APART_S, grey(1, 32, 24), APART_S, 1])
    assert numbered(some.take(3)) == [(1, 0), (4, 2), (6, 1)]
    assert (some.counts["undecoded"], some.counts["wrong_size"]) == (2, 1)
    assert some.reported == [
        "frame 2 could not be decoded and was left out",
        "pictures are 32x24 in place of 64x48: they are left out",
    ]


def driver_error() -> None:
    raise MemoryError("the driver is out of memory")


@pytest.mark.parametrize(
    ("bad", "line"),
    [([1.0, None] * 20, "could be decoded for 6.0 s"), ([driver_error], "the driver is out of memory")],
)
def test_a_stream_that_cannot_be_decoded_or_raises_is_opened_again(camera, bad, line) -> None:
    some = camera([1, *bad], [2])
    assert levels(some.take(2)) == [1, 2]
    assert any(line in what for what in some.reported)


@pytest.mark.parametrize("size", [(64, 64), (128, 96)])
def test_a_stream_that_stays_at_another_size_goes_on_with_it(camera, size) -> None:
    some = camera([1, *[1.0, grey(7, *size)] * 8])
    frames = some.take(3)
    assert [(f.image.shape[1], f.image.shape[0]) for f in frames] == [(64, 48), size, size]
    assert some.source.size == size
    assert any("for 5.0 s: begun anew" in what for what in some.reported)


def test_sizes_that_change_again_and_again_leave_no_stream_blind(camera) -> None:
    some = camera([1, *[1.0, grey(7, 64, 64), 1.0, grey(7, 32, 32)] * 4])
    assert [f.image.shape[0] for f in some.take(2)] == [48, 32]


def test_a_picture_that_comes_only_when_the_driver_gave_up_is_not_used(camera) -> None:
    some = camera([1, 5.0, 66, 5.0, 67], [2])
    assert levels(some.take(2)) == [1, 2]
    assert "lost: no picture has come for 5.0 s" in some.reported[0]


def test_a_lost_stream_is_opened_again_with_ever_longer_pauses(camera) -> None:
    some = camera([1], None, None, None, None, None, [2])
    assert numbered(some.take(2)) == [(1, 0), (1 + round(15.5 * 25), round(15.5 * 25) - 1)]
    assert some.clock.slept_s[:6] == pytest.approx([0.5, 1, 2, 4, 4, 4])
    assert some.counts["reconnects"] == some.health.snapshot().gauges["connected"] == 1
    assert some.reported == [
        "camera:0 is lost: it sends no more pictures; it is opened again as soon as it is there",
        "camera:0 is back after 15.5 s, at 6 tries",
    ]


def test_pauses_are_short_again_only_after_a_connection_that_held(camera) -> None:
    some = camera([1], [2], [3, *[1.0, 3] * 6], [4])
    some.take(10)
    assert some.clock.slept_s[:3] == pytest.approx([0.5, 1, 0.5])


def test_a_read_that_never_returns_is_given_up_and_its_thread_ends_when_it_does(camera) -> None:
    stuck = Gate()
    some = camera([1, stuck, 66], [2])
    frames = some.take(1)
    waking = after(stuck.reached, lambda: some.clock.pass_s(60))
    frames += some.take(1)
    waking.join()
    assert levels(frames) == [1, 2]  # the late picture of the thread that hung is not used
    assert "its driver has not answered for 60.0 s" in some.reported[0]
    stuck.open.set()
    assert some.streams[0].released.wait(PATIENCE_S)


def test_a_driver_that_hangs_again_and_again_ends_the_run_within_a_minute(camera) -> None:
    stuck = [Gate() for _ in range(3)]
    some = camera([1, stuck[0]], [stuck[1]], [stuck[2]], [2])
    some.take(1)
    began_s, waking = some.clock.now(), [after(gate.reached, lambda: some.clock.pass_s(12.6)) for gate in stuck]
    with pytest.raises(DeadCamera, match="camera:0 is dead"):
        some.take(1)
    assert some.clock.now() - began_s < 60
    assert not some.source.seeking
    for thread in waking:
        thread.join()
    for gate in stuck:
        gate.open.set()


@pytest.mark.parametrize("lost_s", [LiveParameters().lost_s, 0.0])
def test_a_camera_whose_openings_fail_at_once_ends_the_run_unless_it_is_looked_for_for_ever(camera, lost_s) -> None:
    last = Gate()
    some = camera([1], None, None, [last, 66], [2], lost_s=lost_s)
    frames = some.take(1)
    waking = after(last.reached, lambda: some.clock.pass_s(60))
    if lost_s:
        with pytest.raises(DeadCamera, match=r"camera:0 is lost for 40 s \(live.lost_s\): cannot open it"):
            some.take(1)
    else:
        assert levels(frames + some.take(1)) == [1, 2]
    waking.join()
    last.open.set()


def test_a_camera_that_stays_lost_ends_the_run_before_systemd_does() -> None:
    default, watchdog_sec = LiveParameters(), 30.0
    notified_last_s = default.watchdog_s - watchdog_sec / 4
    assert default.lost_s + 1.25 * default.stall_s < notified_last_s + watchdog_sec < 60
    assert default.retry_most_s < default.lost_s / 5


def test_results_that_stop_are_told_to_the_supervisor_unless_the_camera_is_looked_for_for_ever(camera) -> None:
    for lost_s in (40.0, 0.0):
        lost = Gate()
        some = camera([1], [lost, 2], lost_s=lost_s)
        some.take(1)
        assert lost.reached.wait(PATIENCE_S)
        assert some.source.seeking == (lost_s == 0)
        lost.open.set()


def test_times_of_day_follow_the_machines_clock_when_it_is_set(camera) -> None:
    def set_forward() -> None:
        some.clock.utc_ahead_s += 3600

    some = camera([1, APART_S, set_forward, 2, APART_S, 3])
    assert [f.time_s for f in some.take(3)] == pytest.approx([0, 0.04, 0.08])
    assert some.source.start_utc_s == pytest.approx(1.7e9 + 3700)
    assert some.reported == ["the machine's clock was set forward by 3600.0 s; times of day follow"]


def test_each_time_that_the_clock_is_set_counts_and_both_directions_are_reported(camera) -> None:
    def set_by(seconds: float) -> Callable[[], None]:
        def act() -> None:
            some.clock.utc_ahead_s += seconds

        return act

    some = camera([1, APART_S, set_by(3600), 2, APART_S, set_by(-3600), 3, APART_S, set_by(0.2), 4])
    some.take(4)
    assert some.counts["clock_jumps"] == 2
    assert some.source.start_utc_s == pytest.approx(1.7e9 + 100)
    assert [words.partition(";")[0] for words in some.reported] == [
        "the machine's clock was set forward by 3600.0 s",
        "the machine's clock was set back by 3600.0 s",
    ]


def test_errors_that_the_decoder_conceals_are_counted_told_once_and_a_trouble_for_a_while(camera) -> None:
    def conceal(is_so: bool) -> Callable[[], None]:
        def act() -> None:
            some.streams[0].concealed = is_so

        return act

    some = camera([1, APART_S, conceal(True), 2, APART_S, 3, conceal(False), APART_S, 4])
    assert levels(some.take(4)) == [1, 2, 3, 4]
    assert some.counts["concealed"] == 2
    assert [words for words in some.reported if "conceals errors" in words] == list(some.health.snapshot().troubles)


def test_a_picture_that_cannot_be_decoded_is_a_trouble_for_a_while(camera) -> None:
    some = camera([1, APART_S, None, APART_S, 2])
    assert levels(some.take(2)) == [1, 2] and some.counts["undecoded"] == 1
    assert "could not be decoded" in some.health.snapshot().troubles[0]


@pytest.mark.parametrize(("given_hz", "rate_hz"), [(None, 20), (12, 12)])
def test_the_rate_is_measured_where_none_is_announced_or_given(given_hz, rate_hz) -> None:
    clock = FakeClock()
    source = LiveSource(
        "camera:0", rate_hz=given_hz, opener=Streams(FakeStream([0.05, 1] * 30, None, clock)), clock=clock
    )
    assert source.rate_hz == pytest.approx(rate_hz)
    source.close()


@pytest.mark.parametrize(
    ("stream", "words"),
    [(None, "cannot open it"), ([False] * 20, "no picture comes from camera:0"), ([None] * 200, "can be decoded")],
)
def test_a_stream_without_a_first_picture_is_one_line(stream, words) -> None:
    opener = Streams(None if stream is None else FakeStream(stream))
    with pytest.raises(InputError, match=words):
        LiveSource("camera:0", opener=opener, clock=FakeClock())
    assert opener.opened == 1


def test_a_camera_that_is_absent_at_the_start_is_waited_for_when_asked() -> None:
    clock, health, waited = FakeClock(), Health(), threading.Event()
    pictures = itertools.chain([lambda: waited.wait(PATIENCE_S)], itertools.repeat(1))
    opener = Streams(None, None, FakeStream(pictures))
    source = LiveSource("camera:0", health=health, opener=opener, clock=clock, waiting=waited.set)
    source.close()
    assert waited.is_set() and source.size == (64, 48) and not health.snapshot().troubles
    first, then = [event.text for event in health.snapshot().events][:2]
    assert "camera:0 is not there yet: cannot open it" in first
    assert then == "camera:0 is there after 1.5 s, at 2 tries"


class Camera401(http.server.BaseHTTPRequestHandler):
    """Answers as a camera: 401 without the right name and password, else 404."""

    def do_GET(self) -> None:
        right = "Basic " + base64.b64encode(b"pilot:s3cret").decode()
        self.send_response(404 if self.headers["Authorization"] == right else 401)
        self.send_header("WWW-Authenticate", 'Basic realm="camera"')
        self.end_headers()

    def do_DESCRIBE(self) -> None:
        nonce, uri = "abc", self.path
        inner = [hashlib.md5(text.encode()).hexdigest() for text in ("pilot:camera:s3cret", f"DESCRIBE:{uri}")]
        right = hashlib.md5(f"{inner[0]}:{nonce}:{inner[1]}".encode()).hexdigest()
        status = "404 Not Found" if right in (self.headers["Authorization"] or "") else "401 Unauthorized"
        challenge = f'WWW-Authenticate: Digest realm="camera", nonce="{nonce}"'
        sequence = self.headers["CSeq"]
        self.wfile.write(f"RTSP/1.0 {status}\r\nCSeq: {sequence}\r\n{challenge}\r\n\r\n".encode())

    def parse_request(self) -> bool:
        self.raw_requestline: bytes = self.raw_requestline.replace(b"RTSP/1.0", b"HTTP/1.0")
        return super().parse_request()

    def do_OPTIONS(self) -> None:
        self.wfile.write(f"RTSP/1.0 200 OK\r\nCSeq: {self.headers['CSeq']}\r\nPublic: DESCRIBE\r\n\r\n".encode())

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Requests are not logged."""


@pytest.mark.parametrize("scheme", ["http", "rtsp"])
@pytest.mark.parametrize(("user", "words"), [("", "401"), ("pilot:wrong@", "401"), ("pilot:s3cret@", "404")])
def test_a_camera_that_refuses_is_told_from_one_that_is_absent_and_not_waited_for(scheme, user, words) -> None:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Camera401) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        address = f"{scheme}://{user}127.0.0.1:{server.server_port}/cam"
        try:
            for waiting in (None, lambda: None):
                with pytest.raises(InputError, match=rf"/cam is refused \({words}\)") as error:
                    LiveSource(address, LiveParameters(stall_s=5.0), waiting=waiting)
                assert "s3cret" not in str(error.value)
        finally:
            server.shutdown()
            serving.join()


def test_a_camera_that_hangs_at_the_start_is_one_line() -> None:
    stuck, clock, given_up = Gate(), FakeClock(), threading.Event()
    stream = FakeStream([stuck, 1])

    def wait_on() -> None:
        while not given_up.is_set():
            clock.pass_s(10)

    waking = after(stuck.reached, wait_on)
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


def test_stop_ends_an_iteration_that_waits_for_a_picture(camera) -> None:
    some = camera([1])
    some.take(1)
    stopping = after(some.rest.reached, some.source.stop)
    assert list(some.frames) == []
    stopping.join()


def test_a_step_is_timed_from_a_picture_to_the_next_request(camera) -> None:
    some = camera([1, 2, 3])
    some.take(1)
    some.clock.now_s += 0.7
    some.take(1)
    assert some.source.busy_s == some.health.snapshot().seconds["step"][0] == pytest.approx(0.7)


# -- recordings --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("clip") / "clip.avi", "MJPG", frames=20)


@pytest.mark.parametrize("pace", [1.0, 8.0])
def test_a_recording_plays_at_its_pace_with_its_own_times_and_ends(recording: Path, pace: float) -> None:
    source = LiveSource(str(recording), LiveParameters(pace=pace, queue_frames=64), clock=FakeClock())
    frames = list(source)
    assert [f.number for f in frames] == list(range(1, 21))
    assert [number_of(f.image) for f in frames] == pytest.approx(range(1, 21), abs=1)
    assert [f.time_s for f in frames] == pytest.approx(np.arange(20) / 10, abs=1e-3)
    assert [f.taken_s for f in frames] == pytest.approx(100 + np.arange(20) / 10 / pace, abs=1e-3)
    assert source.apart_s == pytest.approx(0.1 / pace)
    source.close()


def test_a_recording_without_pace_waits_for_the_run(recording: Path) -> None:
    health = Health()
    source = LiveSource(str(recording), LiveParameters(pace=0, queue_frames=1), health)
    assert numbered(list(source)) == [(n, 0) for n in range(1, 21)]
    assert source.apart_s == 0
    assert "dropped" not in health.snapshot().counts
    source.close()


def test_damaged_pictures_of_a_recording_are_left_out(tmp_path: Path) -> None:
    path, health = write_video(tmp_path / "clip.avi", "MJPG", frames=20), Health()
    spoil_avi_frame(path, 12)
    frames = list(LiveSource(str(path), LiveParameters(pace=0), health))
    assert [f.number for f in frames] == [n for n in range(1, 21) if n != 12]
    assert health.snapshot().counts["undecoded"] == 1
    assert [(e.kind, e.frame) for e in health.snapshot().events] == [("stream", 12)]
    folder = write_images(tmp_path / "frames", range(1, 6))
    cv2.imwrite(str(folder / "frame3.png"), picture(3, 32, 24))
    source = LiveSource(str(folder), LiveParameters(pace=0))
    assert [f.number for f in source] == [1, 2, 4, 5]
    assert "32x24" in source.problems[0].what


def test_a_recording_that_is_closed_in_the_middle_leaves_no_thread(recording: Path) -> None:
    source = LiveSource(str(recording), LiveParameters(pace=0.001))
    next(iter(source))
    source.close()
    assert not any(thread.is_alive() for thread in source._feed.threads)


def test_a_network_stream_that_is_cut_is_read_on_by_a_new_connection(tmp_path: Path) -> None:
    content = write_by_av(tmp_path / "clip.ts", "mpeg4", [100 * k for k in range(40)]).read_bytes()
    listener, health = socket.create_server(("127.0.0.1", 0)), Health()

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection:
                connection.sendall(content)

    server = threading.Thread(target=serve)
    server.start()
    parameters = LiveParameters(retry_s=0.01, retry_most_s=0.1, stall_s=20, queue_frames=64)
    source = LiveSource(f"tcp://127.0.0.1:{listener.getsockname()[1]}", parameters, health)
    assert source.size == (64, 48)
    for frame in source:
        assert frame.image.shape == (48, 64, 3)
        if health.snapshot().counts.get("reconnects", 0) > 1:
            break
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    source.close()
    server.join()
    assert [event.kind for event in health.snapshot().events[:2]] == ["stream", "stream"]


def test_a_recording_whose_size_changes_goes_on_with_the_new_size(tmp_path: Path) -> None:
    shots = [picture(n, *size) for size in ((64, 48), (96, 48)) for n in range(1, 31)]
    (tmp_path / "film.mjpeg").write_bytes(b"".join(cv2.imencode(".jpg", shot)[1].tobytes() for shot in shots))
    health = Health()
    source = LiveSource(str(tmp_path / "film.mjpeg"), LiveParameters(pace=0), health)
    assert source.size == (64, 48)
    widths = [frame.image.shape[1] for frame in source]
    assert widths == [64] * 30 + [96] * 21 and source.size == (96, 48)
    assert any("left out" in event.text for event in health.snapshot().events)
