"""A camera, a stream or a recording as a run meets it live: pictures come whether or not anyone has time for them."""

from collections.abc import Callable, Iterator
from dataclasses import replace

from torchvision_dddas import open_video
from torchvision_dddas.config import LiveParameters
from torchvision_dddas.io.video import OpenedStream, Stream, stream_target, without_secrets
from torchvision_dddas.live.capture_log import Diary
from torchvision_dddas.live.clock import Clock
from torchvision_dddas.live.frame_queue import Inbox
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.playback import Player
from torchvision_dddas.live.receiver import OPENING, Receiver
from torchvision_dddas.types import Frame, Problem

# How long a thread is waited for that was told to end.
_JOIN_S = 1.0


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
        self._inbox = Inbox(self.parameters.queue_frames, self.health, self._clock)
        self._diary = Diary(self.health, self._clock)
        told = (self._inbox, self._diary, self.health, self._clock)
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
        return self._diary.start_utc_s

    @property
    def problems(self) -> list[Problem]:
        """The latest."""
        return self._diary.problems

    def look_at(self, every: int) -> None:
        """From now on every so many-th picture is handed on; the others are left out on purpose."""
        with self._inbox.changed:
            self._inbox.every = max(int(every), 1)

    def every(self, interval: int) -> Iterator[Frame]:
        """Each `interval`-th picture alone."""
        self.look_at(interval)
        return iter(self)

    def __iter__(self) -> Iterator[Frame]:
        """The pictures, the newest where the run is late; a second iteration goes on where the first one ended."""
        if self._inbox.begin():
            self._feed.begin()
        while not self._inbox.over:
            frame = self._inbox.take(self._feed.check())
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
        self._inbox.close()

    def close(self) -> None:
        """Stop, and let go of the camera; a thread that hangs in its driver is left behind."""
        self.stop()
        for thread in self._feed.threads:
            if thread.is_alive():
                thread.join(timeout=_JOIN_S)
