"""Telemetry that comes during a live run: a thread reads the reports and offers the newest record of the flight."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import (
    AerialLocator,
    Contradiction,
    find_contradictions,
    flying_height,
    has_places,
    measure_clock_offset,
    predict_flight,
)
from torchvision_dddas.io.output import without_numbers
from torchvision_dddas.io.sources import names_file
from torchvision_dddas.io.telemetry import ReportWindow
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.report_inputs import KLV, ReportInput, is_live_input, open_input
from torchvision_dddas.types import COLUMNS_OF_TELEMETRY, Telemetry

Complete = Callable[[Telemetry], tuple[Telemetry, list[str]]]
"""Return reports in the site's local metres with their gaps filled, and notes."""

_REFRESH_S = 0.2
_KEPT_S = 90.0  # of the flight, from which a clock offset is estimated
_GAP_S = 2.0  # nothing is interpolated over a longer pause
_WRONG_CLOCK_S, _SAME_DELAY_S = 5.0, 0.05
_WAIT_S, _SETTLING_S = 10.0, 1.0  # for the first report, and for those of other kinds after it
# A clock offset is estimated so often; a less certain or larger estimate is not used.
_MEASURE_S, _SURE_S, _MOST_OFFSET_S = 10.0, 0.1, 10.0
# Reports and pictures of the last _COMPARED_S are compared every _COMPARE_S, and a contradiction holds for
# _CONTRADICTED_S. Pictures of the last _UNSURE_S before the newest report wait, because a clock offset is allowed.
_COMPARE_S, _COMPARED_S, _CONTRADICTED_S, _UNSURE_S = 1.0, 75.0, 2.0, 1.0
_MOST_EVENTS = 50
_FIRST_BYTES = 1 << 16


def open_telemetry(
    telemetry: Path | None, source: LiveSource, aerial: AerialParameters, health: Health
) -> "LiveTelemetry | None":
    """Open the live telemetry of a camera or a stream; None if none is given.

    A file is followed too: rows that are added to it replace what was read at the start. Without --telemetry, KLV in
    the stream of the pictures is used. Raise InputError as `open_input`, and for live telemetry beside a recording.
    """
    text = str(telemetry or (KLV if source.metadata is not None else ""))
    is_awaited = bool(text) and is_live_input(text)
    if not source.is_stream and is_awaited and not names_file(text):
        raise InputError(f"--telemetry {text} is for a camera or a stream; for a recording give its log")
    if not source.is_stream or not (is_awaited or Path(text).is_file()):
        return None
    if not is_awaited:  # a log of column names alone, or of JSON lines, cannot be read as a whole
        with Path(text).open("rb") as file:
            lines = file.readlines(_FIRST_BYTES)
        is_awaited = len(lines) < 2 or lines[0].startswith(b"{")
    found = open_input(text, lambda words: health.event("telemetry", words), source.metadata)
    window = ReportWindow(text, aerial.time_zone, aerial.order, found.system)
    return LiveTelemetry(found, window, health, aerial, is_awaited)


class LiveTelemetry:
    """A thread that reads an input of telemetry. Times of its records count from 1970 by this machine's clock.

    raw: the newest reports as they were read; None before the first. log: the flight of the latest minute and a half,
    completed and continued beyond the newest report. measure: called now and then in the thread, to estimate the clock
    offset. compare: called every second in the thread, to compare reports and pictures. clock_offset_s: as in
    `align_log`. delay_s: from the exposure of pictures, by the stamps of their KLV, to their reception; 0 if unknown.
    """

    def __init__(
        self,
        source: ReportInput,
        window: ReportWindow,
        health: Health,
        aerial: AerialParameters,
        is_awaited: bool = True,
    ) -> None:
        """is_awaited: whether the run needs reports from here at its start."""
        self.name, self.is_awaited, self._aerial = window.name, is_awaited, aerial
        self.raw: Telemetry | None = None
        self.log: Telemetry | None = None
        self.clock_offset_s = self.delay_s = 0.0
        self.measure: Callable[[], object] = lambda: None
        self.compare: Callable[[], object] = lambda: None
        self._source, self._window, self._health = source, window, health
        self._complete: Complete | None = None
        self._flown: Telemetry | None = None  # the completed flight
        self._first: Telemetry | None = None  # the first report with a place, whose height may be that of the take-off
        self._told, self._has_wrong_clock = set[str](), False
        self._contradiction: Contradiction | None = None  # the current one
        self._compared_s = -math.inf  # time of the newest picture that was compared
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def wait(self, waiting: Callable[[], object] | None) -> Telemetry:
        """Return the first reports, with a place if one comes in time.

        waiting: called every second while there are none; None: wait ten seconds at most. Raise InputError after that.
        """
        began_s = time.monotonic()
        found_s = math.inf
        while time.monotonic() < found_s + _SETTLING_S:
            if has_places(self.raw):
                found_s = min(found_s, time.monotonic())
            elif waiting is not None and self.raw is None:
                waiting()
            elif time.monotonic() - began_s > _WAIT_S:
                if self.raw is not None:
                    break
                told = [event.text for event in self._health.snapshot().events if event.kind == "telemetry"]
                raise InputError(f"no telemetry of {self.name} for {_WAIT_S:g} s: {(told or ['is it sending?'])[-1]}")
            time.sleep(_REFRESH_S)
        return self.record()

    def record(self) -> Telemetry:
        """Return the newest reports behind the first one, for a new assembly."""
        assert self.raw is not None
        return self.raw if self._first is None else _join(self._first, self.raw)

    def begin(self, complete: Complete, known: Sequence[str] = ()) -> None:
        """Complete and continue the records from now on. known: notes that were given already."""
        self._told |= {without_numbers(note) for note in known}
        self._complete, until_s = complete, time.monotonic() + _SETTLING_S
        while self.raw is not None and self.log is None and time.monotonic() < until_s:
            time.sleep(_REFRESH_S / 10)  # the log that was read at the start may have become old meanwhile

    def estimate_clock_offset(self, locator: AerialLocator, motions: Sequence[tuple[float, np.ndarray]]) -> None:
        """Estimate by how much pictures come after their exposure, from the camera's turns; keep a sure estimate."""
        found = measure_clock_offset(locator, motions)
        if found is None or found[1] > _SURE_S or abs(self.clock_offset_s + found[0]) > _MOST_OFFSET_S:
            return
        self.clock_offset_s += found[0]
        self._health.gauge("clock_offset_s", self.clock_offset_s)
        when = f"{abs(found[0]):.3f} s {'later' if found[0] > 0 else 'earlier'}"
        turns = f"the camera turns {when} in the pictures than in the reports (sigma {found[1]:.3f} s)"
        offset = f"aerial.clock_offset_s={self.clock_offset_s:.3f} is used from now on"
        self._health.event("telemetry", f"{turns}: {offset}")

    def find_contradiction(self, locator: AerialLocator, motions: Sequence[tuple[float, np.ndarray]]) -> None:
        """Report a trouble while the newest reports and pictures contradict each other."""
        # The flight beyond the newest report is a guess.
        until_s = self._reported_until_s(locator) - _UNSURE_S
        motions = [motion for motion in motions if motion[0] <= until_s]
        newest_s, before_s = motions[-1][0] if motions else -math.inf, self._compared_s
        self._compared_s = newest_s
        if not newest_s > before_s:  # without a new picture nothing is known
            self._health.trouble("contradiction")
            return
        found = find_contradictions(locator, [motion for motion in motions if motion[0] > newest_s - _COMPARED_S])[-1:]
        now = found[0] if found and found[0].end_s > newest_s - _CONTRADICTED_S else None
        words = ""
        if now is not None:
            words = f"telemetry and pictures contradict each other: {now.describe(flying_height(locator))}"
        if (now is None) != (self._contradiction is None):
            leapt = self._contradiction is not None and self._contradiction.leaps and not found
            ended = "since the last leap, but places may still be wrong" if leapt else "again"
            self._health.event("telemetry", words or f"telemetry and pictures agree {ended}")
        self._contradiction = now
        self._health.trouble("contradiction", words)

    def _reported_until_s(self, locator: AerialLocator) -> float:
        """Return the time of the newest report by the clock of the pictures, s; infinite if nothing is predicted."""
        telemetry, log, raw = locator.site.telemetry, self.log, self.raw
        if telemetry is None or log is None or raw is None:
            return math.inf
        return float(telemetry.time_s[-1] - (log.time_s[-1] - raw.time_s[-1]))

    def describe_silence(self, utc_s: float) -> str:
        """Return how old the newest report is at a time; "" if there is none, or by a wrong clock."""
        if self.raw is None or self._has_wrong_clock:
            return ""
        return f": the newest report is {utc_s - self.raw.time_s[-1]:.1f} s older than the picture"

    def close(self) -> None:
        """End the thread and close the input."""
        self._closing.set()
        self._thread.join(timeout=2.0)
        self._source.close()
        self._window.close()

    def _run(self) -> None:
        refreshed_s = measured_s = compared_s = time.monotonic()
        is_new, complete = False, self._complete
        while not self._closing.is_set():
            try:
                for came_s, content in self._source.receive():
                    why = self._window.add(came_s, content)
                    is_new |= not why
                    self.tell(f"{self.name}: {why}" if why else "")
                    self._health.count("telemetry_left_out" if why else "reports")
                now_s = time.monotonic()
                if self._complete is not complete:
                    complete, is_new, self._flown = self._complete, True, None
                if is_new and now_s > refreshed_s + _REFRESH_S:
                    refreshed_s, is_new = now_s, False
                    self.raw = self._window.read() or self.raw
                    self._measure_delay(self._window.delay_s)
                    self._refresh(complete)
                if now_s > measured_s + _MEASURE_S:
                    measured_s = now_s
                    self.measure()
                if now_s > compared_s + _COMPARE_S:
                    compared_s = now_s
                    self.compare()
            except InputError as error:
                self.tell(str(error))
            except Exception as error:  # no fault of a report ends the run
                self.tell(f"{self.name}: {type(error).__name__}: {error}")

    def tell(self, words: str) -> None:
        """Make an event of words that differ from earlier ones by more than numbers."""
        kind = without_numbers(words)
        if words and kind not in self._told and len(self._told) < _MOST_EVENTS:
            self._told.add(kind)
            self._health.event("telemetry", words)

    def _refresh(self, complete: Complete | None) -> None:
        if (raw := self.raw) is None:
            return
        if self._first is None and has_places(raw):
            placed = np.isfinite(raw.place).all(axis=1)
            self._first = raw[placed][:1]
            self.tell("" if self.is_awaited else f"the log {self.name} grows: its new rows are used")
        self._check_clock(raw)
        if complete is None:
            return
        log, notes = complete(self.record())
        for note in (*raw.notes, *notes):
            self.tell(note)
        self._flown = _merge(self._flown, log[log.time_s >= raw.time_s[0]])
        self.log = predict_flight(self._flown, self._aerial)

    def _measure_delay(self, delay_s: float) -> None:
        """Take a delay of the pictures, unless it is like the last one, or shows that the sender's clock is wrong."""
        if abs(delay_s - self.delay_s) <= _SAME_DELAY_S or math.isnan(delay_s):
            return
        is_right = 0 <= delay_s < _WRONG_CLOCK_S
        self.delay_s = delay_s if is_right else 0.0
        self._health.gauge("picture_delay_s", self.delay_s)
        if is_right:  # the first delay is often longer, because pictures wait while the stream is opened
            self.tell(f"results have the times of the stamps of {self.name}; pictures come picture_delay_s later")
        else:
            when = f"{abs(delay_s):.0f} s {'before' if delay_s > 0 else 'after'} the pictures come"
            self.tell(f"the stamps of {self.name} are {when}: results have the times of reception; set the clocks")

    def _check_clock(self, raw: Telemetry) -> None:
        behind_s = self._window.came_s - (float(raw.time_s[-1]) + self.clock_offset_s)
        is_wrong = abs(behind_s) > _WRONG_CLOCK_S
        if is_wrong == self._has_wrong_clock:
            return
        self._has_wrong_clock = is_wrong
        words = (
            f"the reports of {self.name} are {abs(behind_s):.0f} s {'behind' if behind_s > 0 else 'ahead of'} this "
            "machine's clock: they are not used for current pictures; set the clocks, or aerial.clock_offset_s"
        )
        self._health.event("telemetry", words if is_wrong else f"the clock of {self.name} is right again")
        self._health.trouble("telemetry clock", words if is_wrong else "")


def _merge(flown: Telemetry | None, log: Telemetry) -> Telemetry:
    """Return the flight so far with new reports, the newest of which are known better than before."""
    if flown is None or not len(log):
        return log if flown is None else flown
    # In its first half a window lacks what came before it, as the rows between which a slower quantity lies.
    begin_s = log.time_s[0] if flown.time_s[-1] < log.time_s[0] else (log.time_s[0] + log.time_s[-1]) / 2
    before = flown[(flown.time_s < begin_s) & (flown.time_s > log.time_s[-1] - _KEPT_S)]
    return _join(before, log[log.time_s >= begin_s]) if len(before) else log


def _join(first: Telemetry, second: Telemetry) -> Telemetry:
    """Return the rows of both, with what the second says of all; nothing is known within a long pause between them."""
    first = first[first.time_s < second.time_s[0]] if len(second) else first
    if not len(first) or not len(second):
        return second if len(second) else first
    ends = first.time_s[-1], second.time_s[0]
    pause = np.array([sum(ends) / 2]) if ends[1] - ends[0] > _GAP_S else np.zeros(0)
    rows = dict[str, Any](time_s=np.concatenate([first.time_s, pause, second.time_s]))
    for name in COLUMNS_OF_TELEMETRY:
        before, after = getattr(first, name), getattr(second, name)
        rows[name] = np.concatenate([before, np.full((len(pause), *before.shape[1:]), np.nan), after])
    return replace(second, heading_from=second.heading_from or first.heading_from, **rows)
