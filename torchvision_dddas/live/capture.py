"""Live capture: a thread reads a camera, a stream or a recording at its own pace."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from torchvision_dddas import open_video
from torchvision_dddas.config import LiveParameters
from torchvision_dddas.errors import without_secrets
from torchvision_dddas.io.live_streams import LiveStream, open_stream
from torchvision_dddas.io.sources import ImageSource, VideoSource, stream_target
from torchvision_dddas.live.frame_queue import CaptureLog, Clock, FrameQueue
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.receiver import OPENING, Receiver
from torchvision_dddas.live.refusal import open_or_refuse
from torchvision_dddas.types import Frame, Problem, Source

_JOIN_S = 1.0
_LATE_S = 1.0  # a recording that is later than this skips the delay instead of catching up in a burst


class LiveSource:
    """A Source of frames in real time; a slow run gets the newest frames.

    It begins at the first iteration. A recording (file, folder, sim:) plays at live.pace times its own speed and
    ends; with pace 0 it waits for the run. A camera or stream is reopened whenever it is lost, and ends by `stop`.
    Frame numbers follow the clock at rate_hz; `skipped` of a frame counts the frames before it that were dropped, left
    out or lost. time_s is a recording's own; for a camera it counts from the first picture. Failures during the run
    become an event of `health` (kind `stream`) and a problem; only a driver that hangs repeatedly raises DeadCamera.

    name: the given name, without passwords. recorded: the number of frames of a recording, None if uncertain. busy_s:
    time spent by the run on the previous frame. Raise InputError if the source cannot be opened or sends no picture.
    """

    count: int | None = None
    exact = False
    levels: object = None

    def __init__(
        self,
        spec: str,
        parameters: LiveParameters | None = None,
        health: Health | None = None,
        *,
        rate_hz: float | None = None,
        full_scale: int | tuple[int, int] | None = None,
        opener: Callable[[], LiveStream] | None = None,
        clock: Clock | None = None,
        waiting: Callable[[], object] | None = None,
    ) -> None:
        """spec, rate_hz, full_scale: as for `open_video`. opener: opens the stream instead of OpenCV.

        waiting: called every second while waiting for an absent camera; None: do not wait for it.
        """
        text = str(spec)
        self.name, self.last, self.busy_s = without_secrets(text), 0, 0.0
        self.parameters, self.health, self._clock = parameters or LiveParameters(), health or Health(), clock or Clock()
        self._queue = FrameQueue(self.parameters.queue_frames, self.health, self._clock)
        self._log = CaptureLog(self.health, self._clock)
        shared = (self._queue, self._log, self.health, self._clock)
        target = stream_target(text)
        self.is_stream = opener is not None or target is not None
        self._feed: Player | Receiver
        self.recorded: int | None = None
        if not self.is_stream:
            recording = open_video(text, rate_hz=rate_hz, full_scale=full_scale)
            self._feed = Player(recording, self.parameters.pace, *shared)
            self.rate_hz = recording.rate_hz
            self.recorded = recording.count if recording.exact else None
            self.levels = getattr(recording, "levels", None)
            return
        limit_s = self.parameters.stall_s
        where = text if target is None else target
        opening = opener or (lambda: self._open(where, (OPENING * limit_s, limit_s)))
        self._feed = Receiver(self.name, opening, rate_hz, self.parameters, *shared, waiting)
        self.rate_hz = self._feed.rate_hz

    def _open(self, target: str | int, limits_s: tuple[float, float]) -> LiveStream:
        # Do not ask a lost stream for a reason: it was there, and may limit its clients.
        return (open_stream if self._queue.begun else open_or_refuse)(target, self.name, limits_s)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pictures; a stream may change it."""
        return self._feed.size

    @property
    def seeking(self) -> bool:
        """Whether the camera is lost and is being reopened by a driver that responds."""
        return self._feed.seeking

    @property
    def apart_s(self) -> float:
        """Seconds between frames by the clock; 0 if they wait for the run."""
        return self._feed.apart_s

    @property
    def start_utc_s(self) -> float:
        """Seconds since 1970 at time_s = 0, NaN before the first frame; adjusted when the machine's clock is set."""
        return self._log.start_utc_s

    @property
    def problems(self) -> list[Problem]:
        """The latest 64 problems."""
        return self._log.problems

    @property
    def metadata(self) -> deque[tuple[float, bytes]] | None:
        """Times of day, by the clock of the pictures, and contents of the newest KLV packets; None without any."""
        return getattr(self._feed, "metadata", None)

    def look_at(self, every: int) -> None:
        """From now on yield one of `every` frames; the others are left out on purpose."""
        with self._queue.changed:
            self._queue.every = max(int(every), 1)

    def every(self, interval: int) -> Iterator[Frame]:
        """Yield each `interval`-th frame."""
        self.look_at(interval)
        return iter(self)

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames, the newest if the run is late; a further iteration continues where the last one ended."""
        if not self._queue.begun:
            self._queue.note(begun=True)
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
        """End the iteration. May be called from any thread, and from a signal handler."""
        self._queue.note(closed=True)

    def close(self) -> None:
        """Stop and release the camera; a thread that hangs in its driver is abandoned."""
        self.stop()
        for thread in self._feed.threads:
            if thread.is_alive():
                thread.join(timeout=_JOIN_S)


class Player:
    """Play a recording at `pace` times its speed; with 0 as fast as frames are taken."""

    def __init__(
        self, recording: Source, pace: float, queue: FrameQueue, log: CaptureLog, health: Health, clock: Clock
    ) -> None:
        self._recording, self._pace, self._queue, self._log = recording, pace, queue, log
        self._health, self._clock = health, clock
        self.seeking, self._concealed = False, 0
        if isinstance(recording, (VideoSource, ImageSource)):
            recording.tolerant = True  # a single picture of another size is skipped
        self.apart_s = 1 / (recording.rate_hz * pace) if pace else 0.0
        self.threads = [threading.Thread(target=self._play, name="playing", daemon=True)]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pictures; a recording may change it."""
        return self._recording.size

    def begin(self) -> None:
        """Start playing."""
        self.threads[0].start()

    def check(self) -> float | None:
        """Do nothing, because a player never hangs. Same interface as Receiver."""
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
                        self._log.report(f"reading is slower than playing: {late_s:.1f} s late", topic="late")
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
                    queue.put(replace(frame, skipped=0, taken_s=taken_s))
        except Exception as error:  # ends the recording; results of earlier frames still come
            self._log.report(f"the recording cannot be read further: {error}")
        finally:
            self._report()
            queue.note(ended=True)

    def _report(self) -> None:
        concealed = getattr(self._recording, "concealed", 0)
        self._health.count("concealed", concealed - self._concealed)
        self._concealed = concealed
        for problem in self._recording.problems:
            self._log.damaged(problem.what, problem.frame)
        self._recording.problems.clear()
