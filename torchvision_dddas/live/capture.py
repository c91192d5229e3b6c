"""A camera, a stream or a recording as a run meets it live: pictures come whether or not anyone has time for them."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from torchvision_dddas import open_video
from torchvision_dddas.config import LiveParameters
from torchvision_dddas.io.images import ImageSource
from torchvision_dddas.io.video import OpenedStream, Stream, VideoSource, stream_target, without_secrets
from torchvision_dddas.live.frame_queue import CaptureLog, Clock, FrameQueue
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.receiver import OPENING, Receiver
from torchvision_dddas.types import Frame, Problem, Source

# How long a thread is waited for that was told to end.
_JOIN_S = 1.0
# A reader that is later than this is not waited for by the clock: its pictures would come in one burst.
_LATE_S = 1.0


class LiveSource:
    """A Source whose pictures come by the clock, read in a thread of its own; who is slow gets the newest ones.

    It begins when it is first iterated. A recording (file, folder, sim:) plays at live.pace times its own speed, and
    ends; with pace 0 it waits for the run. A camera or stream is opened again whenever it is lost, and ends by `stop`.

    name: as given, but for a password. number: of frames by the clock at rate_hz, so that it stays in step with time;
    those that were dropped, not looked at or lost are in the next one's `skipped`. time_s: a recording's own; a
    camera's by the clock since the first.
    recorded: pictures that a recording says for sure it holds; None where it does not, and of cameras.
    start_utc_s: seconds since 1970 at time_s = 0, NaN before the first picture; follows the machine's clock when set.
    apart_s: from picture to picture by the clock; 0 where they wait for the run. busy_s: what the last look took.
    problems: the latest. Whatever goes wrong while it runs is an event of `health` (kind `stream`), and a problem;
    never an exception.
    Raises InputError when it cannot be opened, or sends no picture.
    """

    count: int | None = None
    exact = False

    def __init__(
        self,
        spec: str,
        parameters: LiveParameters | None = None,
        health: Health | None = None,
        *,
        rate_hz: float | None = None,
        full_scale: int | None = None,
        opener: Callable[[], Stream] | None = None,
        clock: Clock | None = None,
    ) -> None:
        """spec, rate_hz, full_scale: as `open_video` takes them. opener: opens the stream in place of OpenCV."""
        text = str(spec)
        self.name, self.last, self.busy_s = without_secrets(text), 0, 0.0
        self.parameters, self.health, self._clock = parameters or LiveParameters(), health or Health(), clock or Clock()
        self._queue = FrameQueue(self.parameters.queue_frames, self.health, self._clock)
        self._log = CaptureLog(self.health, self._clock)
        told = (self._queue, self._log, self.health, self._clock)
        target = stream_target(text)
        self._feed: Player | Receiver
        self.recorded: int | None = None
        if opener is None and target is None:
            recording = open_video(text, rate_hz=rate_hz, full_scale=full_scale)
            self._feed = Player(recording, self.parameters.pace, *told)
            self.rate_hz, self.size = recording.rate_hz, recording.size
            self.recorded = recording.count if recording.exact else None
            return
        limit_s = self.parameters.stall_s
        where = text if target is None else target
        opening = opener or (lambda: OpenedStream(where, self.name, (OPENING * limit_s, limit_s)))
        self._feed = Receiver(self.name, opening, rate_hz, self.parameters, *told)
        self.rate_hz, self.size = self._feed.rate_hz, self._feed.size

    @property
    def apart_s(self) -> float:
        """Seconds from picture to picture; 0 where they wait for the run."""
        return self._feed.apart_s

    @property
    def start_utc_s(self) -> float:
        """Seconds since 1970 at time_s = 0; NaN before the first picture."""
        return self._log.start_utc_s

    @property
    def problems(self) -> list[Problem]:
        """The latest."""
        return self._log.problems

    def look_at(self, every: int) -> None:
        """From now on every so many-th picture is handed on; the others are left out on purpose."""
        with self._queue.changed:
            self._queue.every = max(int(every), 1)

    def every(self, interval: int) -> Iterator[Frame]:
        """Each `interval`-th picture alone."""
        self.look_at(interval)
        return iter(self)

    def __iter__(self) -> Iterator[Frame]:
        """The pictures, the newest where the run is late; a second iteration goes on where the first one ended."""
        if self._queue.begin():
            self._feed.begin()
        while not self._queue.over:
            frame = self._queue.take(self._feed.check())
            if frame is None:
                continue
            frame = replace(frame, skipped=frame.number - self.last - 1)
            self.last = frame.number
            self.health.count("looked_at")
            began_s = self._clock.now()
            yield frame
            self.busy_s = self._clock.now() - began_s
            self.health.took("step", self.busy_s)

    def stop(self) -> None:
        """No more pictures: the iteration ends. May be called from anywhere, a signal's handler too."""
        self._queue.close()

    def close(self) -> None:
        """Stop, and let go of the camera; a thread that hangs in its driver is left behind."""
        self.stop()
        for thread in self._feed.threads:
            if thread.is_alive():
                thread.join(timeout=_JOIN_S)


class Player:
    """Plays a recording `pace` times as fast as it was filmed; 0: as fast as it is taken."""

    def __init__(
        self, recording: Source, pace: float, queue: FrameQueue, log: CaptureLog, health: Health, clock: Clock
    ) -> None:
        self._recording, self._pace, self._queue, self._log = recording, pace, queue, log
        self._health, self._clock = health, clock
        if isinstance(recording, (VideoSource, ImageSource)):
            recording.tolerant = True  # a picture of another size is left out as one that cannot be decoded
        self._thread = threading.Thread(target=self._play, name="playing", daemon=True)

    @property
    def apart_s(self) -> float:
        """Seconds from picture to picture; 0 where they wait."""
        return 1 / (self._recording.rate_hz * self._pace) if self._pace else 0.0

    @property
    def threads(self) -> list[threading.Thread]:
        """Those that may be alive."""
        return [self._thread]

    def begin(self) -> None:
        """Somebody takes pictures from now on."""
        self._thread.start()

    def check(self) -> float | None:
        """Nothing is to be looked after."""
        return None

    def _play(self) -> None:
        queue, start_s = self._queue, float("nan")
        try:
            for frame in self._recording:
                self._report()
                start_s = self._clock.now() if np.isnan(start_s) else start_s
                if self._pace:
                    due_s = start_s + frame.time_s / self._pace
                    if (late_s := self._clock.now() - due_s) > _LATE_S:
                        self._log.tell(f"reading is slower than playing: {late_s:.1f} s late", topic="late")
                        start_s += late_s
                    queue.sleep(due_s)
                else:
                    queue.make_room()
                if queue.closed:
                    return
                taken_s = self._clock.now()
                self._health.count("undecoded", frame.number - self._log.number - 1)
                self._log.number = frame.number
                self._log.captured(taken_s)
                if queue.wanted(frame.number):
                    queue.put(Frame(frame.number, frame.time_s, frame.image, 0, taken_s))
        except Exception as error:  # told, and the end of the recording: the run settles what it has
            self._log.tell(f"the recording cannot be read further: {error}")
        finally:
            self._report()
            queue.end()

    def _report(self) -> None:
        for problem in self._recording.problems:
            self._log.tell(problem.what, problem.frame, topic="damage")
        self._recording.problems.clear()
