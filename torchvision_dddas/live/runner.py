"""The loop of a live run: take frames, send results, use cheaper settings under load, and restart after an error."""

import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from math import isfinite, nan

import numpy as np

from torchvision_dddas import control
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import AerialLocator
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.frame_queue import Clock
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.live_telemetry import LiveTelemetry
from torchvision_dddas.live.log_alignment import align_log
from torchvision_dddas.live.receiver import DeadCamera
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.pipeline import Pipeline
from torchvision_dddas.types import Adjustment, Frame, FrameResult, Telemetry, TrackedFrame

_MOST_DELAY_S = 10.0  # a larger clock offset says that the clock of a log is wrong

_MOST_FAILURES = 25
"""Consecutive restarts without a result after which the run gives up."""


class RepeatedFailure(Exception):
    """The work failed too often in succession, or the camera is dead. The message is for the user."""


class Feed:
    """The source that the pipeline reads. The stream of frames continues when the pipeline is restarted.

    A step lasts from the moment a frame is taken until the next one is requested. newest: the frame taken last. log:
    the telemetry. seen: is called with each frame. telemetry: a function that returns the log, as the pipeline expects
    of a source; None if there is none. clock_offset_s: the offset of the camera's clock, with which `align_log` aligns
    a log that has a clock. aligned: is called with the aligned log. locator: of the pipeline that runs now; None if
    nothing is located. began: is called with the pipeline that begins. live: telemetry that comes during the run, which
    replaces the log; None without it. place_landmarks: is called before each picture.
    """

    count = None
    exact = False

    def __init__(
        self, source: LiveSource, health: Health, watchdog: Watchdog, telemetry: Telemetry | None = None
    ) -> None:
        """telemetry: the log whose gaps are reported; None reports none."""
        self.name, self.rate_hz, self.size = source.name, source.rate_hz, source.size
        self.problems: list[object] = []
        self.newest: Frame | None = None
        self.ended = False
        self.log, self.clock_offset_s, self._silent, self._start_utc_s = telemetry, nan, False, nan
        self.telemetry = None if telemetry is None else lambda: self.log
        self.aligned: Callable[[Telemetry], object] = lambda log: None
        self.locator: AerialLocator | None = None
        self.began: Callable[[Pipeline], object] = lambda pipeline: None
        self.place_landmarks: Callable[[], object] = lambda: None
        self.seen: Callable[[Frame], object] = lambda frame: None
        self.live: LiveTelemetry | None = None
        self._newest: Telemetry | None = None  # the latest log of `live`
        self._source, self._health, self._watchdog = source, health, watchdog
        self._frames = iter(source)
        self._has_altitude = telemetry is not None and bool(np.isfinite(telemetry.altitude_m).any())
        self._is_blind, self._has_angles = False, False
        if telemetry is not None:
            self._has_angles = bool(np.isfinite(telemetry.heading_rad + telemetry.pitch_rad).any())
        self._first = True
        self._held: Frame | None = None  # first frame of another size, kept for the restarted pipeline

    @property
    def last(self) -> int:
        """Number of the newest frame, as in Source."""
        return self._source.last

    @property
    def exposed_utc_s(self) -> float:
        """Seconds since 1970 at time_s = 0: at the exposure of that picture, or at its reception without a delay."""
        offset_s = self.clock_offset_s if 0 <= self.clock_offset_s < _MOST_DELAY_S else 0.0
        return self._source.start_utc_s - offset_s - (0.0 if self.live is None else self.live.delay_s)

    def restart(self) -> None:
        """Prepare for a new iteration by a pipeline that has seen no frame."""
        self._watchdog.done()
        self._frames = iter(self._source)  # the source's own iteration may have failed
        self._first = True

    def __iter__(self) -> Iterator[Frame]:
        while not self.ended:
            self._watchdog.done()
            frame, self._held = self._held or next(self._frames, None), None
            if frame is None:
                self.ended = True
                return
            if (size := (frame.image.shape[1], frame.image.shape[0])) != self.size:
                # The pipeline finishes its frames, and restarts with this one.
                self._held, self.size = frame, size
                words = f"pictures are {size[0]}x{size[1]} from now on: begun anew"
                self._health.event("run", words, frame.number)
                self._health.count("begun_anew")
                return
            if self._first:
                # Earlier frames are not missing: the pipeline that failed has seen them.
                frame, self._first = replace(frame, skipped=frame.number - 1), False
            self.newest = frame
            self.seen(frame)
            self._read_log(frame)
            self.place_landmarks()
            self._watchdog.begin(frame.number)
            yield frame

    def _read_log(self, frame: Frame) -> None:
        """Align the log with the first picture, again whenever the machine's clock was set; report its gaps.

        Live telemetry replaces the log by its newest record first.
        """
        if self.log is None:
            return
        live, tolerance_s = self.live, 1.0
        if live is not None and live.log is not None:
            tolerance_s = self.log.hold_s  # the record is continued already, so nothing more holds
            if live.log is not self._newest:
                self._newest = self.log = live.log
                self.clock_offset_s, self._start_utc_s = live.clock_offset_s, nan
        if isfinite(self.log.start_utc_s + self.clock_offset_s) and self._source.start_utc_s != self._start_utc_s:
            self._start_utc_s = self._source.start_utc_s
            self.log = align_log(self.log, self._start_utc_s, self.clock_offset_s)
            self.aligned(self.log)
        flight = self.log.at(frame.time_s, tolerance_s=tolerance_s)
        silent = flight is None or (self._has_altitude and not isfinite(flight.altitude_m))
        is_blind = flight is not None and self._has_angles and not isfinite(flight.heading_rad + flight.pitch_rad)
        if is_blind != self._is_blind:
            self._is_blind = is_blind
            words = f"telemetry gives {'no angles' if is_blind else 'angles'} of the camera{' again' * (not is_blind)}"
            self._health.event("telemetry", words, frame.number)
            self._health.trouble("camera angles", words if is_blind else "")
        if silent != self._silent:
            self._silent = silent
            ended = ": its log has ended" if silent and frame.time_s > self.log.time_s[-1] else ""
            if ended and live is not None and live.raw is not None:
                ended = live.describe_silence(self._start_utc_s + frame.time_s)
            words = f"telemetry is {'silent' if silent else 'there again'}{ended}"
            self._health.event("telemetry", words, frame.number)
            self._health.trouble("telemetry", words if silent else "")

    def stop(self) -> None:
        """Take no further frame; results of frames already taken still come."""
        self.ended = True


Result = tuple[FrameResult, TrackedFrame | None]
"""A frame and the people in it; None if people are not detected."""


class _Renumbering:
    """Continues the numbers of targets and people after a restart, so that none is used twice."""

    def __init__(self) -> None:
        self._before, self._highest = [0, 0], [0, 0]

    def __call__(self, result: Result) -> Result:
        located, people = result
        locations, before = located.locations, self._before[0]
        if locations is not None and before:
            places = locations.positions
            locations = replace(locations, positions=replace(places, target=places.target + before))
        located = replace(located, tracked=self._shift(0, located.tracked), locations=locations)
        return located, None if people is None else self._shift(1, people)

    def restart(self) -> None:
        self._before = list(self._highest)

    def _shift(self, kind: int, tracked: TrackedFrame) -> TrackedFrame:
        before, tracks = self._before[kind], tracked.tracks
        self._highest[kind] = max(self._highest[kind], before + int(tracks.identity.max(initial=0)))
        if not before:
            return tracked
        corrects = tuple(identity + before for identity in tracks.corrects)
        return replace(tracked, tracks=replace(tracks, identity=tracks.identity + before, corrects=corrects))


def results(begin: Callable[[Feed], Iterable[Result]], feed: Feed, health: Health) -> Iterator[Result]:
    """Yield the results of `begin(feed)`; after an error call it again, and continue with the next frames.

    Each error is an event, but the 25th without a settled result in between raises RepeatedFailure, and so does a dead
    camera. An InputError after the end of the feed ends the run. `begin(feed)` also ends when the size of the pictures
    changes.
    """
    renumbered, failures = _Renumbering(), 0
    while True:
        try:
            for result in begin(feed):
                if not result[0].tracks.provisional:  # a provisional result comes before most of the work
                    failures = 0
                yield renumbered(result)
        except DeadCamera as error:
            raise RepeatedFailure(str(error)) from error
        except Exception as error:
            if feed.ended and isinstance(error, InputError):  # for example a clip stopped after its second frame
                health.event("run", str(error))
                return
            failures += 1
            number = feed.newest.number if feed.newest is not None else 0
            words = f"{type(error).__name__}: {error} ({where_raised(error)})"
            if failures >= _MOST_FAILURES:
                raise RepeatedFailure(
                    f"{failures} times in a row the work on a frame failed, at last: {words}"
                ) from error
            health.event("run", f"{words}; begun anew with the next frame", number)
            health.count("begun_anew")
        if feed.ended:
            return
        feed.restart()
        renumbered.restart()


def where_raised(error: BaseException) -> str:
    """Return the innermost line of this package in the traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "torchvision_dddas" in f.filename] or frames
    return f"{ours[-1].filename.rpartition('torchvision_dddas/')[2]}:{ours[-1].lineno}" if ours else "nowhere"


# The cost of a frame is the mean of recent costs without the largest one, which may include waiting for something else.
_MOST_FRAMES = 20
_FEWEST_FRAMES = 5


class LoadShedding:
    """Applies the rule `control.shed`. Call it before each frame; it returns settings that keep up with the source.

    settings: the current settings. people: whether people are detected, so that their search can be narrowed.
    """

    def __init__(
        self,
        source: LiveSource,
        settings: Settings,
        health: Health | None = None,
        people: bool = False,
        clock: Clock | None = None,
    ) -> None:
        self.settings, self.load = settings, control.Load()
        self._source, self._base, self._people = source, settings, people
        self._health, self._clock = health or Health(), clock or Clock()
        self._costs: deque[float] = deque(maxlen=_MOST_FRAMES)
        self._has_begun = False
        self._show(control.rungs(settings, people)[0])

    def __call__(self, frame: Frame) -> tuple[Settings, tuple[Adjustment, ...]]:
        """Return the settings from this frame on, and the record of changes."""
        if not self._has_begun:  # no frame was processed before the first
            self._has_begun = True
            return self.settings, ()
        self._costs.append(self._source.busy_s)
        if len(self._costs) < _FEWEST_FRAMES:
            return self.settings, ()
        cost_s, rung = float(np.mean(sorted(self._costs)[:-1])), self.load.rung
        self.load, moved = control.shed(
            frame.number, self.load, cost_s, self._source.apart_s, self._clock.now(), self._base, self._people
        )
        if self.load.rung != rung:
            values = control.rungs(self._base, self._people)[self.load.rung]
            in_settings = {name: value for name, value in values.items() if name != control.SAMPLING}
            self.settings = with_parameters(self._base, in_settings)
            self._source.look_at(int(values[control.SAMPLING]))
            self._costs.clear()  # these were measured with the old settings
            self._show(values)
            words = ", ".join(f"{a.parameter} {a.old:g} -> {a.new:g}" for a in moved)
            self._health.event("load", f"{words}: {moved[0].cause}", frame.number)
        return self.settings, moved

    def _show(self, values: dict[str, float]) -> None:
        self._health.gauge("every", values[control.SAMPLING])
        self._health.gauge("keypoints", values["registration.keypoints"])
