"""A camera, a stream or a recording as a run meets it live: pictures come whether or not anyone has time for them."""

import threading
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.clock import Clock
from torchvision_dddas.live.health import Health
from torchvision_dddas.settings import LiveKnobs
from torchvision_dddas.sources import Problem, Source, open_source
from torchvision_dddas.sources.stream import OpenedStream, Stream, first_picture, target_of
from torchvision_dddas.types import Frame

# A stream whose rate nobody tells.
_FALLBACK_HZ = 10.0
# To open a stream takes longer than to read from it: it is looked at for a while before its first picture.
_OPENING = 2.0
# Reads that may fail in a row before a stream counts as lost.
_MOST_FAILED = 10
# A stream that sends more than it announced is thinned once it is ahead of the clock by this.
_AHEAD_S = 0.5
_PROBLEMS = 64

Opener = Callable[[], Stream]


class LiveSource:
    """A Source whose pictures come by the clock, read in a thread of its own; who is slow gets the newest ones.

    It begins when it is first iterated. A recording (file, folder, sim:) plays at live.pace times its own speed, and
    ends; with pace 0 it waits for the run. A camera or stream is opened again whenever it is lost, and ends by `close`.

    number: of frames by the clock at rate_hz, so that it stays in step with time; those that were dropped, not looked
    at or lost are in the next one's `skipped`. time_s: a recording's own; a camera's by the clock since the first.
    start_utc_s: seconds since 1970 at time_s = 0, NaN before the first picture; follows the machine's clock when set.
    apart_s: from picture to picture by the clock; 0 where they wait for the run. busy_s: what the last look took.
    Whatever goes wrong while it runs is an event of `health` (kind `stream`), and a problem; never an exception.
    Raises InputError when it cannot be opened, or sends no picture.
    """

    count: int | None = None
    exact = False

    def __init__(
        self,
        spec: str,
        knobs: LiveKnobs | None = None,
        health: Health | None = None,
        *,
        rate_hz: float | None = None,
        full_scale: int | None = None,
        opener: Opener | None = None,
        clock: Clock | None = None,
    ) -> None:
        """spec, rate_hz, full_scale: as `open_source` takes them. opener: opens the stream in place of OpenCV."""
        self.name = str(spec)
        self.knobs, self.health, self.clock = knobs or LiveKnobs(), health or Health(), clock or Clock()
        self.last = 0
        self.problems: list[Problem] = []
        self.start_utc_s = float("nan")
        self.busy_s = 0.0
        self.recording: Source | None = None
        self._changed = threading.Condition()  # guards all that follows
        self._waiting: deque[Frame] = deque()
        self._every = 1
        self._begun = self._ended = self._closed = False
        self._offered = 0  # number of the newest picture that was put in the queue
        self._number = 0  # of the newest picture captured
        self._start_s = float("nan")
        self._threads: list[threading.Thread] = []
        target = target_of(self.name)
        if opener is None and target is None:
            self.recording = open_source(self.name, rate_hz=rate_hz, full_scale=full_scale)
            self.rate_hz, self.size = self.recording.rate_hz, self.recording.size
            self._threads.append(threading.Thread(target=self._play, name="playing", daemon=True))
            return
        limit_s = _OPENING * self.knobs.stall_s
        self._open = opener or (lambda: OpenedStream(target if target is not None else self.name, self.name, limit_s))
        stream = self._open()
        try:
            first = first_picture(stream, self.name)
        except BaseException:
            stream.release()
            raise
        self.rate_hz = rate_hz or stream.rate_hz or _FALLBACK_HZ
        self.size = (first.shape[1], first.shape[0])
        self._threads.append(threading.Thread(target=self._receive, args=(stream,), name="receiving", daemon=True))
        self._threads[0].start()

    @property
    def apart_s(self) -> float:
        """Seconds from picture to picture; 0 where they wait for the run."""
        pace = self.knobs.pace if self.recording is not None else 1.0
        return 1 / (self.rate_hz * pace) if pace else 0.0

    def look_at(self, every: int) -> None:
        """From now on every so many-th picture is handed on; the others are left out on purpose."""
        with self._changed:
            self._every = max(int(every), 1)

    def every(self, interval: int) -> Iterator[Frame]:
        """Each `interval`-th picture alone."""
        self.look_at(interval)
        return iter(self)

    def __iter__(self) -> Iterator[Frame]:
        """The pictures, the newest where the run is late; a second iteration goes on where the first one ended."""
        with self._changed:
            if not self._begun and self.recording is not None:
                self._threads[0].start()
            self._begun = True
        while (frame := self._take()) is not None:
            self.last = max(self.last, frame.number)
            self.health.count("looked_at")
            began = self.clock.now()
            yield frame
            self.busy_s = self.clock.now() - began
            self.health.took("step", self.busy_s)

    def stop(self) -> None:
        """No more pictures: the iteration ends. May be called from anywhere, a signal's handler too."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def close(self) -> None:
        """Stop, and let go of the camera; a thread that hangs in its driver is left behind."""
        self.stop()
        for thread in self._threads:
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join(timeout=1.0)

    # -- the run's side ----------------------------------------------------------------------------------------------

    def _take(self) -> Frame | None:
        with self._changed:
            while not self._waiting:
                if self._ended or self._closed:
                    return None
                self.clock.wait(self._changed, self.knobs.stall_s)
            if self._closed:
                return None
            frame = self._waiting.popleft()
            self.health.gauge("queue", len(self._waiting))
            self._changed.notify_all()
        skipped = frame.number - self.last - 1
        return Frame(frame.number, frame.time_s, frame.image, skipped, frame.taken_s)

    # -- the camera's side -------------------------------------------------------------------------------------------

    def _wanted(self, number: int) -> bool:
        """Whether a picture is one of those to look at."""
        return self._begun and (not self._offered or number - self._offered >= self._every)

    def _offer(self, frame: Frame) -> None:
        with self._changed:
            self._offered = frame.number
            while len(self._waiting) >= self.knobs.queue_frames:
                self._waiting.popleft()
                self.health.count("dropped")
            self._waiting.append(frame)
            self.health.gauge("queue", len(self._waiting))
            self._changed.notify_all()

    def _tell(self, what: str, number: int) -> None:
        self.health.event("stream", what, number)
        self.problems.append(Problem(number, what))
        del self.problems[:-_PROBLEMS]

    def _sleep(self, until_s: float) -> None:
        with self._changed:
            while not self._closed and (left := until_s - self.clock.now()) > 0:
                self.clock.wait(self._changed, left)

    def _play(self) -> None:
        """The thread of a recording."""
        assert self.recording is not None
        pace, start_s = self.knobs.pace, float("nan")
        try:
            for frame in self.recording:
                for problem in self.recording.problems:
                    self._tell(problem.what, problem.frame)
                self.recording.problems.clear()
                if not np.isfinite(start_s):
                    start_s, self.start_utc_s = self.clock.now(), self.clock.utc()
                if pace:
                    self._sleep(start_s + frame.time_s / pace)
                else:
                    with self._changed:
                        while len(self._waiting) >= self.knobs.queue_frames and not self._closed:
                            self.clock.wait(self._changed)
                if self._closed:
                    return
                self.health.count("captured")
                self.health.count("undecoded", frame.number - self._number - 1)
                self._number = frame.number
                if self._wanted(frame.number):
                    self._offer(Frame(frame.number, frame.time_s, frame.image, 0, self.clock.now()))
        except Exception as error:
            self._tell(str(error), self._number)
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _receive(self, stream: Stream | None) -> None:
        """The thread of a camera or stream."""
        pause_s = self.knobs.retry_s
        while not self._closed:
            if stream is None:
                self._sleep(self.clock.now() + pause_s)
                pause_s = min(2 * pause_s, self.knobs.retry_most_s)
                try:
                    stream = self._open()
                except InputError:
                    continue
                self.health.count("reconnects")
                self._tell("the stream is back", self._number)
            try:
                if self._read(stream):
                    pause_s = self.knobs.retry_s
            finally:
                stream.release()
            stream = None
            if not self._closed:
                self._tell("the stream is lost; it is opened again", self._number)

    def _read(self, stream: Stream) -> int:
        """Read until the stream is lost; returns how many pictures came."""
        failed = came = 0
        while not self._closed and failed < _MOST_FAILED:
            if not stream.grab():
                failed += 1
                continue
            failed, came = 0, came + 1
            self._picture(stream, self.clock.now())
        return came

    def _picture(self, stream: Stream, taken_s: float) -> None:
        """Number the picture that was grabbed, and hand it on if it is wanted."""
        if not self._begun:
            return
        if not np.isfinite(self._start_s):
            self._start_s, self.start_utc_s = taken_s, self.clock.utc()
        place = (taken_s - self._start_s) * self.rate_hz
        self.health.count("captured")
        if self._number - place > max(_AHEAD_S * self.rate_hz, 2):
            self.health.count("dropped")
            return
        self._number = max(self._number + 1, 1 + round(place))
        if not self._wanted(self._number):
            return
        image = stream.retrieve()
        if image is None or (image.shape[1], image.shape[0]) != self.size:
            self.health.count("undecoded")
            return
        self._offer(Frame(self._number, taken_s - self._start_s, image, 0, taken_s))
