"""Read a camera or stream that may stop sending, hang or change its size, and reopen it when it is lost."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from torchvision_dddas.config import LiveParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.live_streams import LiveStream, first_picture
from torchvision_dddas.live.frame_queue import CaptureLog, Clock, FrameQueue
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.refusal import Refused
from torchvision_dddas.types import Frame

OPENING = 2.0
"""Time limit for opening a stream, in multiples of stall_s."""
_GRACE = 1.25  # a call that lasts this many times its limit is abandoned
_MOST_FAILED = 10  # consecutive failed reads after which a stream is lost
_AHEAD_S = 0.5  # frames further ahead of the clock than this are dropped
_OFF = 0.2  # relative error of the announced rate that is reported
_MOST_HUNG = 3  # threads that may hang in a driver, which cannot be ended
_MEASURED = 12  # pictures from which an unannounced rate is measured
_FALLBACK_HZ = 10.0  # rate if these pictures come all at once
_STAMPS = 25  # pictures whose time stamps give the times of metadata
_HELD_S = 2.0  # metadata waits for the picture with its time stamp, unless the picture is later than this


_WAITING_S = 1.0  # interval between calls of `waiting`


class DeadCamera(Exception):
    """The camera stays lost, or its driver hung repeatedly. The message is for the user."""


class _GivenUp(Exception):
    """Another thread replaced this thread while it hung."""


class Receiver:
    """Read a stream in a thread of its own from the start, and fill the queue once frames are taken.

    rate_hz: the given rate, else the announced rate, else the measured rate. size: size of the first picture; it
    changes with the stream. metadata: as in LiveSource; the time of a packet is that of the picture with its time
    stamp. waiting: as in LiveSource. Raise InputError if no first picture comes.
    """

    def __init__(
        self,
        name: str,
        opener: Callable[[], LiveStream],
        rate_hz: float | None,
        parameters: LiveParameters,
        queue: FrameQueue,
        log: CaptureLog,
        health: Health,
        clock: Clock,
        waiting: Callable[[], object] | None = None,
    ) -> None:
        self._waiting = waiting
        self.name, self.rate_hz, self.size = name, rate_hz or 0.0, (0, 0)
        self._opener, self._parameters, self._queue, self._log = opener, parameters, queue, log
        self._health, self._clock = health, clock
        self._failure: InputError | None = None
        self._ready = False
        self._turn = 0  # number of the current thread
        self._call: tuple[float, float] | None = None  # start of the current driver call, and its time limit
        self._pause_s = parameters.retry_s
        self._lost_s: float | None = None
        self._why = ""  # why the camera was lost, or could not be reopened
        self._tries = 0
        self._start_s = float("nan")
        self._odd_s: float | None = None  # time since which pictures differ from `size`; None: they do not
        self._off = False  # whether a wrong announced rate was reported
        self.metadata: deque[tuple[float, bytes]] | None = None
        self._shown: deque[tuple[float, float]] = deque(maxlen=_STAMPS)  # time stamps and times of the latest pictures
        self.threads: list[threading.Thread] = []
        self._at_work: threading.Thread | None = None  # the current thread; None if all hang
        self._spawn()
        try:
            self._await_first()
        except BaseException:
            queue.note(closed=True)
            raise

    @property
    def apart_s(self) -> float:
        """Measured seconds between pictures."""
        return 1 / (self._log.sent_hz or self.rate_hz)

    @property
    def seeking(self) -> bool:
        """Whether the stream is lost, may be sought without limit, and is being reopened by a driver that responds."""
        is_endless = self._parameters.lost_s == 0
        return is_endless and self._lost_s is not None and sum(thread.is_alive() for thread in self.threads) <= 1

    def begin(self) -> None:
        """Do nothing: reading began already, so that the first frame taken is a fresh one."""

    def check(self) -> float:
        """Replace a hung thread; called by the run while it waits. Return the time of the next check.

        Raise DeadCamera if too many threads hang, or if no picture has come for live.lost_s since the stream was lost.
        """
        with self._queue.changed:
            until_s = self._lost_until_s()
            if self._clock.now() >= until_s:
                raise DeadCamera(f"{self.name} is lost for {self._parameters.lost_s:g} s (live.lost_s): {self._why}")
            return min(self._check_driver(), until_s)

    def _lost_until_s(self) -> float:
        """Return the time at which a stream that was there counts as lost for good."""
        if self._lost_s is None or not self._ready or not self._parameters.lost_s:
            return float("inf")
        return self._lost_s + self._parameters.lost_s

    def _check_driver(self) -> float:
        """Check the driver alone, as check does; the caller holds the queue."""
        now_s = self._clock.now()
        if self._call is not None:
            since_s, allowed_s = self._call
            if now_s < since_s + allowed_s:
                return since_s + allowed_s
            self._turn += 1
            self._call = self._at_work = None
            self._lost(f"its driver has not answered for {now_s - since_s:.1f} s")
            self._pause_s = self._parameters.retry_s  # the hung call was a sufficient pause
        elif self._at_work is not None and self._at_work.is_alive():
            return now_s + self._parameters.stall_s
        self.threads = [thread for thread in self.threads if thread.is_alive()]
        if len(self.threads) >= _MOST_HUNG:
            raise DeadCamera(f"{self.name} is dead: its driver hung {_MOST_HUNG} times and cannot be ended")
        self._spawn()
        return now_s + self._parameters.stall_s

    def _spawn(self) -> None:
        thread = threading.Thread(target=self._work, args=(self._turn,), name="receiving", daemon=True)
        self.threads.append(thread)
        self._at_work = thread
        thread.start()

    def _await_first(self) -> None:
        if self._waiting is not None:
            self._wait_for_first(self._waiting)
        allowed_s = 2 * _GRACE * OPENING * self._parameters.stall_s
        with self._queue.changed:
            until_s = self._clock.now() + allowed_s
            while not self._ready and self._failure is None:
                if (left := until_s - self._clock.now()) <= 0:
                    self._turn += 1
                    self._failure = InputError(f"{self.name} sends nothing for {allowed_s:.0f} s; is it there?")
                    break
                self._clock.wait(self._queue.changed, left)
        if self._failure is not None:
            raise self._failure

    def _wait_for_first(self, waiting: Callable[[], object]) -> None:
        while not self._ready and self._failure is None:
            waiting()
            with self._queue.changed:
                left = min(self.check() - self._clock.now(), _WAITING_S)
                if not self._ready and self._failure is None:
                    self._clock.wait(self._queue.changed, max(left, 0.0))

    def _work(self, turn: int) -> None:
        try:
            while not self._queue.closed and turn == self._turn:
                if self._lost_s is not None:
                    self._queue.sleep(self._clock.now() + self._pause_s)
                    self._pause_s = min(2 * self._pause_s, self._parameters.retry_most_s)
                    if self._queue.closed or turn != self._turn:
                        return
                self._connected(turn)
        except _GivenUp:
            return

    def _connected(self, turn: int) -> None:
        """Open the stream, read it until it is lost, and release it."""
        self._tries += 1
        stream: LiveStream | None = None
        why, since_s = "", self._clock.now()
        try:
            with self._driver(turn, OPENING):
                stream = self._opener()
            self._shown.clear()  # the time stamps of another connection begin anew
            if not self._ready:
                with self._driver(turn, OPENING):
                    image = first_picture(stream, self.name)
                    rate_hz = self.rate_hz or stream.rate_hz or self._measured(stream)
                with self._queue.changed:
                    if turn != self._turn:
                        raise _GivenUp
                    self.size, self.rate_hz, self._ready = (image.shape[1], image.shape[0]), rate_hz, True
                    if getattr(stream, "metadata", None) is not None:
                        self.metadata = deque(maxlen=256)
                    self._found()
                    self._queue.changed.notify_all()
            why = self._read(stream, turn)
        except _GivenUp:
            raise
        except Exception as error:  # a driver may raise anything
            why = f"{error}"
            if not self._ready and (self._waiting is None or isinstance(error, Refused)):
                failure = error if isinstance(error, InputError) else InputError(f"{self.name} cannot be read: {error}")
                with self._queue.changed:
                    self._turn += 1
                    self._failure = failure
                    self._queue.changed.notify_all()
                raise _GivenUp from None
        finally:
            if stream is not None:
                with self._driver(turn):
                    stream.release()
        if self._clock.now() - since_s > max(self._parameters.stall_s, self._pause_s):
            self._pause_s = self._parameters.retry_s  # the connection lasted for a while
        if not self._queue.closed:
            self._lost(why)

    def _measured(self, stream: LiveStream) -> float:
        times_s = [self._clock.now() for _ in range(_MEASURED) if stream.grab()]
        apart_s = float(np.median(np.diff(times_s))) if len(times_s) > 2 else 0.0
        return 1 / apart_s if 0.001 < apart_s < 10 else _FALLBACK_HZ

    @contextmanager
    def _driver(self, turn: int, times: float = 1.0) -> Iterator[None]:
        """Set a time limit for a call that may never return."""
        with self._queue.changed:
            if turn == self._turn:
                self._call = (self._clock.now(), _GRACE * times * self._parameters.stall_s)
        try:
            yield
        finally:
            with self._queue.changed:
                mine = turn == self._turn
                if mine:
                    self._call = None
        if not mine:
            raise _GivenUp

    def _read(self, stream: LiveStream, turn: int) -> str:
        """Read until the stream is lost; return the reason."""
        failed, came_s = 0, self._clock.now()
        good_s = came_s
        while not self._queue.closed:
            with self._driver(turn):
                began_s = self._clock.now()
                came = stream.grab()
                blocked_s = self._clock.now() - began_s
            if blocked_s >= self._parameters.stall_s:  # a picture that comes now was buffered before the driver gave up
                return f"no picture has come for {self._clock.now() - came_s:.1f} s"
            if not came:
                failed += 1
                # A driver may time out repeatedly; one timeout is sufficient.
                if failed >= _MOST_FAILED or self._clock.now() - came_s >= self._parameters.stall_s:
                    return "it sends no more pictures"
                continue
            failed, came_s = 0, self._clock.now()
            taken_s = came_s
            is_good = self._picture(stream, taken_s)
            self._take_metadata(stream, taken_s)
            if is_good:
                good_s = taken_s
            elif taken_s - good_s > self._parameters.stall_s:
                return f"none of its pictures could be decoded for {taken_s - good_s:.1f} s"
        return ""

    def _picture(self, stream: LiveStream, taken_s: float) -> bool:
        """Number the grabbed picture, and queue it if it is wanted. Return whether it could be decoded."""
        if not self._queue.begun:
            return True
        log, rate_hz = self._log, self.rate_hz
        self._start_s = taken_s if np.isnan(self._start_s) else self._start_s
        place = (taken_s - self._start_s) * rate_hz
        log.captured(taken_s, self._compare)
        if getattr(stream, "concealed", False):
            self._health.count("concealed")
            log.damaged("the decoder conceals errors in the pictures")
        if log.number - place > max(_AHEAD_S * rate_hz, 2):
            self._health.count("dropped")
            return True
        # Numbers never decrease, even if pictures come in bursts.
        log.number = max(log.number + 1, 1 + round(place))
        if not self._queue.wanted(log.number):
            return True
        image = stream.retrieve()
        if image is None:
            self._health.count("undecoded")
            log.damaged(f"frame {log.number} could not be decoded and was left out", topic="undecoded")
            return False
        if self._fits(image, taken_s):
            self._found()
            # The time follows from the number, because the arrival times of pictures are less regular.
            damaged = getattr(stream, "damaged", False)
            self._queue.put(Frame(log.number, (log.number - 1) / rate_hz, image, 0, taken_s, damaged))
        return True

    def _take_metadata(self, stream: LiveStream, taken_s: float) -> None:
        """Give packets of metadata the times of the pictures with their time stamps, or between these pictures."""
        packets, stamp_s = getattr(stream, "metadata", None), getattr(stream, "stamp_s", np.nan)
        if packets is None or self.metadata is None:
            return
        shown_s = self._clock.utc() - self._clock.now() + taken_s
        if self._queue.begun:  # the time that the picture has for the run
            shown_s = self._log.start_utc_s + (self._log.number - 1) / self.rate_hz
        if self._shown and not stamp_s > self._shown[-1][0]:
            self._shown.clear()
        if np.isfinite(stamp_s):
            self._shown.append((stamp_s, shown_s))
        stamps, times = np.array(self._shown).reshape(-1, 2).T
        while packets and not 0 < packets[0][0] - stamp_s < _HELD_S:
            said_s, content = packets.popleft()
            if not len(stamps) or np.isnan(said_s):
                said_s = shown_s
            elif stamps[0] <= said_s <= stamps[-1]:
                said_s = float(np.interp(said_s, stamps, times))
            else:
                said_s += float(np.median(times - stamps))
            self.metadata.append((said_s, content))

    def _found(self) -> None:
        """Record that pictures come."""
        self._health.gauge("connected", 1)
        if self._lost_s is None:
            return
        gone_s, self._lost_s = self._clock.now() - self._lost_s, None
        self._health.trouble("stream")
        tries = f"{self._tries} tries" if self._tries > 1 else "the first try"
        if self._queue.begun:
            self._health.count("reconnects")
        self._log.report(f"{self.name} is {'back' if self._queue.begun else 'there'} after {gone_s:.1f} s, at {tries}")

    def _fits(self, image: np.ndarray, taken_s: float) -> bool:
        """Return whether the picture has the stream's size; adopt another size if it persists."""
        width, height = self.size
        if image.shape[:2] == (height, width):
            self._odd_s = None
            return True
        self._health.count("wrong_size")
        what = f"pictures are {image.shape[1]}x{image.shape[0]} in place of {width}x{height}"
        if self._odd_s is None:
            self._odd_s = taken_s
            self._log.report(f"{what}: they are left out", topic="size")
        if taken_s - self._odd_s < self._parameters.stall_s:  # leave out single pictures
            return False
        # The size may have changed again meanwhile; use the newest.
        self._log.report(f"{what} for {taken_s - self._odd_s:.1f} s: begun anew with them")
        self.size, self._odd_s = (image.shape[1], image.shape[0]), None
        return True

    def _lost(self, why: str) -> None:
        self._log.restart()
        self._why = why
        if self._lost_s is None:
            self._lost_s, self._tries = self._clock.now(), 0
            self._health.gauge("connected", 0)
            self._health.trouble("stream", f"{self.name} sends no pictures")
            if self._ready:
                self._log.report(f"{self.name} is lost: {why}; it is opened again as soon as it is there")
            else:
                self._log.report(f"{self.name} is not there yet: {why}; it is waited for")

    def _compare(self, sent_hz: float) -> None:
        if not self._off and abs(sent_hz / self.rate_hz - 1) > _OFF:
            self._off = True
            self._log.report(f"{self.name} sends {sent_hz:.1f} pictures a second, not {self.rate_hz:g}")
