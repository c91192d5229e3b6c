"""A thread reads reports as they come, completes the flight, and tells what is wrong with them."""

import itertools
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.live.streams import PATIENCE_S, FakeClock, FakeStream, Streams
from tests.live.test_log_alignment import Camera, feed_of
from torchvision_dddas.config import AerialParameters, LiveParameters
from torchvision_dddas.geo.turn_agreement import Contradiction
from torchvision_dddas.io.telemetry import ReportWindow
from torchvision_dddas.live import live_telemetry
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.live_telemetry import LiveTelemetry
from torchvision_dddas.live.report_inputs import ReportInput, is_live_input, open_input
from torchvision_dddas.types import Telemetry


class Taken:
    """What came from an input so far."""

    def __init__(self, source: ReportInput) -> None:
        self.source, self.contents = source, list[bytes]()

    def take(self) -> int:
        self.contents += [content for _, content in self.source.receive()]
        return len(self.contents)


def row(utc_s: float, altitude_m: float = 50.0) -> bytes:
    return b'{"time_s": %.3f, "longitude_deg": 11.5, "latitude_deg": 48, "altitude_m": %.2f}' % (utc_s, altitude_m)


class Script:
    """An input that a test fills."""

    system = 0

    def __init__(self) -> None:
        self.reports: deque[tuple[float, bytes]] = deque()
        self.closed = False

    def receive(self) -> list[tuple[float, bytes]]:
        time.sleep(0.005)
        return [self.reports.popleft() for _ in range(len(self.reports))]

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def live(monkeypatch):
    monkeypatch.setattr(live_telemetry, "_REFRESH_S", 0.01)
    monkeypatch.setattr(live_telemetry, "_SETTLING_S", 0.0)
    script, health = Script(), Health()
    made = LiveTelemetry(script, ReportWindow("udp:x"), health, AerialParameters())
    yield made, script, health
    made.close()
    assert script.closed


def until(is_true: Any) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < end_s, "nothing happens any more"
        time.sleep(0.005)


def same(log: Telemetry) -> tuple[Telemetry, list[str]]:
    return log, []


def texts(health: Health) -> list[str]:
    return [event.text for event in health.snapshot().events]


def test_the_flight_goes_on_behind_the_window_and_keeps_its_first_place(live):
    made, script, health = live
    begin_s = time.time() - 20
    made.begin(same)
    for k in range(200):
        script.reports.append((begin_s + k / 10, row(begin_s + k / 10, 50 + k)))
    until(lambda: made.log is not None and made.log.at(begin_s + 19.9).altitude_m > 248)
    assert made.raw is not None and len(made.raw) < 100  # the window is shorter
    assert made.record().altitude_m[0] == 50 or len(made.raw) > len(made.record()) - 3
    np.testing.assert_allclose(np.diff(made.log.time_s[made.log.time_s < begin_s + 19.9]), 0.1, atol=1e-3)
    assert texts(health) == []


def test_a_pause_is_not_interpolated(live):
    made, script, _ = live
    begin_s = time.time() - 60
    made.begin(same)
    for first_s in (begin_s, begin_s + 30):
        for k in range(30):
            script.reports.append((first_s + k / 10, row(first_s + k / 10)))
        until(lambda after_s=first_s + 2.8: made.log is not None and made.log.time_s[-1] > after_s)
    assert made.log.at(begin_s + 2.5).altitude_m == 50 and made.log.at(begin_s + 32.5).altitude_m == 50
    assert np.isnan(made.log.at(begin_s + 17.0).altitude_m)


def test_a_wrong_clock_is_one_event_and_a_trouble_until_it_is_right(live):
    made, script, health = live
    now_s = time.time()
    for part, off_s in enumerate((-100, -100, 0)):
        for k in range(12):
            came_s = now_s + 2 * part + k / 10
            script.reports.append((came_s, row(came_s + off_s)))
        until(lambda: made.raw is not None and not script.reports)
        if off_s:
            until(lambda: texts(health))
            assert len(texts(health)) == 1
            assert "the reports of udp:x are 100 s behind this machine's clock" in health.snapshot().troubles[0]
    until(lambda: texts(health)[-1] == "the clock of udp:x is right again")
    assert health.snapshot().troubles == ()


def test_errors_in_the_work_on_reports_are_one_event_and_the_next_reports_are_used(live):
    made, script, health = live
    broken = [True]

    def complete(log: Telemetry) -> tuple[Telemetry, list[str]]:
        if broken[0]:
            raise ZeroDivisionError(f"report {len(log)}")
        return log, [f"a note on {len(log)} rows"]

    made.begin(complete)
    now_s = time.time()
    for k in range(6):
        script.reports.append((now_s + k / 10, row(now_s + k / 10)))
        until(lambda: not script.reports)
    until(lambda: texts(health))
    assert texts(health)[0].startswith("udp:x: ZeroDivisionError: report")
    broken[0] = False
    script.reports.append((now_s + 1, row(now_s + 1)))
    until(lambda: made.log is not None)
    script.reports.append((now_s + 2, row(now_s + 2)))
    until(lambda: made.log is not None and made.log.time_s[-1] > now_s + 1.5)
    assert len(texts(health)) == 2 and texts(health)[1].startswith("a note on")


def test_a_feed_takes_the_newest_record_and_falls_silent_behind_it(live):
    made, _, _ = live
    feed, health = feed_of(Camera(1.7e9, 60), Telemetry(np.arange(2.0), np.full(2, 50.0), np.zeros(2)), 0.0)
    feed.live = made
    taken: list[Telemetry] = []
    feed.aligned = taken.append
    made.raw = made.log = Telemetry(1.7e9 + np.arange(0, 3.0, 0.1), np.full(30, 60.0), np.zeros(30), start_utc_s=0.0)
    heights = [None if feed.log is None else feed.log.at(frame.time_s, tolerance_s=0.05) for frame in feed]
    assert [flight is not None for flight in heights] == [True] * 30 + [False] * 30
    assert len(taken) == 1
    (event,) = health.snapshot().events
    assert event.text.startswith("telemetry is silent: the newest report is 0.1 s older than the picture")


def test_a_sure_estimate_of_the_clock_offset_is_used_and_reported(live, monkeypatch):
    made, _, health = live
    found = iter([None, (0.4, 0.5), (0.42, 0.02), (30.0, 0.01)])
    monkeypatch.setattr(live_telemetry, "measure_clock_offset", lambda *_: next(found))
    locator: Any = None
    for _ in range(4):
        made.estimate_clock_offset(locator, [])
    assert made.clock_offset_s == 0.42
    (said,) = texts(health)
    assert "0.420 s later in the pictures" in said and "aerial.clock_offset_s=0.420 is used from now on" in said
    feed, _ = feed_of(Camera(1.7e9, 2), Telemetry(np.arange(2.0), np.full(2, 50.0), np.zeros(2)), 0.0)
    feed.live = made
    made.log = Telemetry(1.7e9 + np.arange(3.0), np.arange(3.0), np.zeros(3), start_utc_s=0.0)
    list(feed)
    flight = None if feed.log is None else feed.log.at(1.42)
    assert flight is not None and flight.altitude_m == pytest.approx(1.0, abs=1e-6)


def test_a_contradiction_of_reports_and_pictures_is_a_trouble_while_it_lasts(live, monkeypatch):
    made, _, health = live
    found: list[Contradiction] = []
    monkeypatch.setattr(live_telemetry, "find_contradictions", lambda *_: found)
    site = SimpleNamespace(telemetry=Telemetry(np.arange(2.0), np.full(2, 50.0), np.zeros(2)))
    locator: Any = SimpleNamespace(site=site)

    def compare(until_s: float) -> None:
        made.find_contradiction(locator, [(k / 10, np.eye(3)) for k in range(round(10 * until_s))])

    made.find_contradiction(locator, [])
    compare(28.0)
    assert texts(health) == [] and health.snapshot().troubles == ()
    found.append(Contradiction(25.0, 29.5, 3.0, 0.0, 120.0))
    for until_s in (29.0, 30.0):
        compare(until_s)
    (trouble,) = health.snapshot().troubles
    assert "the log leaps" in trouble and "and by 105 m or turns by over 90 degrees in the log" in trouble
    compare(33.0)
    assert health.snapshot().troubles == ()
    assert texts(health) == [trouble, "telemetry and pictures agree again"]
    # Without a new picture nothing is known; nor is it when the leap is too long ago.
    found[0] = found[0]._replace(end_s=40.0)
    compare(40.0)
    compare(40.0)
    assert health.snapshot().troubles == ()
    compare(41.0)
    found.clear()
    compare(42.0)
    assert health.snapshot().troubles == () and len(texts(health)) == 4
    assert texts(health)[-1] == "telemetry and pictures agree since the last leap, but places may still be wrong"


def test_results_have_the_times_of_exposure_by_the_stamps_of_klv_unless_its_clock_is_wrong(live):
    made, script, health = live
    made._window.delay_s = 0.3
    script.reports.append((1.7e9, row(1.7e9)))
    until(lambda: made.delay_s == 0.3)
    feed, _ = feed_of(Camera(1.7e9, 2), Telemetry(np.arange(2.0), np.full(2, 50.0), np.zeros(2)), 0.2)
    feed.live = made
    assert feed.exposed_utc_s == pytest.approx(1.7e9 - 0.5)
    feed.clock_offset_s = -3600.0  # the zone of a log, and no delay
    assert feed.exposed_utc_s == pytest.approx(1.7e9 - 0.3)
    made._window.delay_s = -61.0
    script.reports.append((1.7e9, row(1.7e9)))
    until(lambda: made.delay_s == 0.0)
    said = [text for text in texts(health) if "stamps" in text]
    assert said[0].startswith("results have the times of the stamps of ")
    assert "are 61 s after the pictures come: results have the times of reception" in said[1]


class WithMetadata(FakeStream):
    """Pictures with time stamps and metadata. stamp, packet: those of a picture. wait_s: time before the k-th one."""

    stamp_s = float("nan")

    def __init__(
        self,
        clock: FakeClock,
        stamp: Callable[[int], float],
        packet: Callable[[int], tuple[float, bytes]],
        wait_s: Callable[[int], float],
    ) -> None:
        pause = partial(time.sleep, 0.001)
        super().__init__((step for k in itertools.count() for step in (wait_s(k), pause, k % 200)), clock=clock)
        self._stamp, self._packet, self.count = stamp, packet, 0
        self.metadata: deque[tuple[float, bytes]] = deque()

    def grab(self) -> bool:
        came = super().grab()
        self.stamp_s = self._stamp(self.count)
        self.metadata.append(self._packet(self.count))
        self.count += 1
        return came


def test_metadata_waits_for_the_picture_with_its_stamp_and_has_its_time():
    clock = FakeClock()

    def stamp(count: int) -> float:
        return 5000 + 0.04 * count + 0.007 * (count % 3)  # irregular, as the times of the pictures are

    def packet(count: int) -> tuple[float, bytes]:  # the packet of a picture comes with the picture before it
        return stamp(count + 1), b"%d" % (count + 1)

    stream = WithMetadata(clock, stamp, packet, lambda k: 0.03 + 0.02 * (k % 2))
    source = LiveSource("fake", LiveParameters(lost_s=1.0), opener=Streams(stream), clock=clock)
    try:
        packets, shown = dict[bytes, float](), set[float]()
        for frame in source:
            assert source.metadata is not None
            packets |= {content: utc_s for utc_s, content in list(source.metadata)}
            shown.add(round(source.start_utc_s + frame.time_s, 3))
            if frame.number > 40:
                break
        known = sorted(round(utc_s, 3) for utc_s in packets.values())[5:-5]
        assert len(known) > 10 and len(shown.intersection(known)) > 0.8 * len(known)
    finally:
        source.close()


def test_packets_of_metadata_have_the_times_of_the_pictures_with_their_stamps():
    clock = FakeClock()

    def stamp(count: int) -> float:
        return 5000 + 0.04 * count

    stream = WithMetadata(clock, stamp, lambda count: (stamp(count) - 0.02, b"%d" % count), lambda k: 0.04)
    source = LiveSource("fake", LiveParameters(lost_s=1.0), opener=Streams(stream), clock=clock)
    try:
        assert source.metadata is not None
        packets: list[tuple[float, bytes]] = []
        for frame in source:
            packets += [source.metadata.popleft() for _ in range(len(source.metadata))]
            if frame.number > 30:
                break
        times = np.array([utc_s for utc_s, _ in packets])
        assert len(times) > 10
        # The stamp of a packet lies half a picture before that of the picture with which it came.
        np.testing.assert_allclose(np.diff(times)[-8:], 0.04, atol=0.002)
    finally:
        source.close()


@pytest.mark.parametrize(
    ("text", "is_live"),
    [("-", True), ("klv", True), ("udp:h:1", True), ("nmea:tcp:h:1", True), ("gpsd:h:1", True), ("mavlink:x", True),
     ("log.csv", False), ("udp.csv", False)],
)  # fmt: skip
def test_the_name_tells_whether_telemetry_comes_live(text, is_live, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert is_live_input(text) == is_live
    (tmp_path / text.replace("/", "_")).touch()
    assert not is_live_input(text)  # a file of this name comes first


def test_a_lost_connection_is_an_event_and_opened_again():
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    said: list[str] = []
    source = open_input(f"nmea:tcp:127.0.0.1:{port}", said.append)
    got = Taken(source)
    try:
        with listener.accept()[0] as way:
            way.sendall(b"$GPGGA,1\r\n$GPG")
            until(lambda: got.take() >= 1)
        until(lambda: got.take() and said)
        assert "is lost" in said[0]

        def serve() -> None:
            with listener.accept()[0] as way:
                way.sendall(b"GA,2\n$GPRMC,3\n")
                assert ended.wait(PATIENCE_S)

        ended, server = threading.Event(), threading.Thread(target=serve)
        server.start()
        until(lambda: got.take() >= 3)
        ended.set()
        server.join(PATIENCE_S)
        # The rest of the lost connection is not joined with the beginning of the next.
        assert got.contents == [b"$GPGGA,1", b"GA,2", b"$GPRMC,3"]
        assert any("is there again" in one for one in said)
    finally:
        source.close()
        listener.close()


def test_rows_of_a_file_before_the_start_are_not_new_and_a_file_that_is_begun_anew_is_read(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(b"time_s,altitude_m\n1,50\n2,51\n3,5")
    source = open_input(str(path), lambda words: None)
    got = Taken(source)

    def take(count: int) -> list[bytes]:
        until(lambda: got.take() >= count)
        return got.contents

    try:
        assert take(1) == [b"time_s,altitude_m"]
        with path.open("ab") as file:
            file.write(b"2\n4,5")
        assert take(2)[1:] == [b"3,52"]
        with path.open("ab") as file:
            file.write(b"3\n")
        assert take(3)[2:] == [b"4,53"]
        path.write_bytes(b"time_s,altitude_m\n9,99\n")
        assert take(5)[3:] == [b"time_s,altitude_m", b"9,99"]
    finally:
        source.close()
