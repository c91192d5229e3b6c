"""The inputs of a live run: its pictures, its telemetry and its landmarks, from files or as they come."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from math import isnan, nan
from pathlib import Path

from torchvision_dddas.config import Settings, is_set
from torchvision_dddas.io.sources import stream_target
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.live_landmarks import open_landmarks
from torchvision_dddas.live.live_telemetry import open_telemetry
from torchvision_dddas.live.log_alignment import describe_landmarks, describe_log
from torchvision_dddas.live.report_inputs import KLV
from torchvision_dddas.live.runner import Feed
from torchvision_dddas.pipeline import AerialInput, Assembly, Pipeline, assemble_files, completion
from torchvision_dddas.types import Telemetry


class RunInputs:
    """Opens the telemetry and the landmarks beside the pictures of a source, and connects them to the run's feed.

    given: as for `assemble_files`. is_recording: whether the source is a recording. reports: live telemetry, or None.
    marks: live landmarks, or None.
    """

    def __init__(
        self,
        source: LiveSource,
        clip: str,
        given: AerialInput | None,
        telemetry: Path | None,
        settings: Settings,
        backend: str,
        health: Health,
        waiting: Callable[[], object] | None,
        stack: ExitStack,
    ) -> None:
        """Wait for the first report and for the landmarks if they come live. waiting: is called meanwhile.

        stack: closes what is opened. Raise InputError.
        """
        self.source, self.given, self.is_recording = source, given, stream_target(clip) is None
        self._clip, self._telemetry, self._settings, self._backend = clip, telemetry, settings, backend
        self.reports = open_telemetry(telemetry, source, settings.aerial, health)
        if self.reports is not None:
            stack.callback(self.reports.close)
            if self.reports.is_awaited:
                self.reports.wait(waiting)
                self.given = replace(given or AerialInput(), telemetry=Path(self.reports.name))
        self.marks = open_landmarks(None if self.given is None else self.given.landmarks, source, health)
        if self.marks is not None:
            stack.callback(self.marks.close)
            self.marks.wait(waiting)

    @property
    def telemetry_name(self) -> Path | str | None:
        """Name of the telemetry for the record of the run."""
        return self._telemetry if self.reports is None else self.reports.name

    def assemble(self) -> Assembly:
        """Assemble the run with its files, or with the newest reports."""
        newest, source = self.given, self.source
        log = self._telemetry if self.reports is None or self.reports.raw is None else self.reports.record()
        if newest is not None and isinstance(log, Telemetry):
            newest = replace(newest, telemetry=log)
        if newest is not None and self.marks is not None:
            start_utc_s = time.time() if isnan(source.start_utc_s) else source.start_utc_s
            newest = replace(newest, landmarks=self.marks.record(start_utc_s, source.rate_hz))
        return assemble_files(newest, log, self._settings, source, self._backend, self._clip)

    def describe(self, ready: Assembly) -> list[str]:
        """Return notes on the telemetry and the landmarks."""
        notes: list[str] = []
        if self.reports is not None and self.reports.is_awaited:
            notes.append(f"the telemetry comes live from {self.reports.name}, and is aligned by the clock")
        elif ready.telemetry is not None:
            offset_s = self._settings.aerial.clock_offset_s
            notes.append(describe_log(ready.telemetry, self.is_recording, time.time(), offset_s))
        if ready.watch is not None and not self.is_recording and self.marks is None:
            notes.extend(describe_landmarks(ready.watch.locator.site.landmarks))
        return notes

    def connect(self, feed: Feed, notes: Sequence[str]) -> None:
        """Let the feed take over reports and landmarks as they come. notes: of the run."""
        offset_s = self._settings.aerial.clock_offset_s
        feed.clock_offset_s = nan if self.is_recording else offset_s
        if self.reports is not None and not self.is_recording:
            feed.live, self.reports.clock_offset_s = self.reports, offset_s
            feed.began = partial(self._follow, feed, notes)
        if (marks := self.marks) is not None:
            feed.place_landmarks = lambda: marks.place(feed.locator, feed.exposed_utc_s, self.source.rate_hz)

    def _follow(self, feed: Feed, notes: Sequence[str], pipeline: Pipeline) -> None:
        """Complete live reports for the site of the locator, and compare them with the pictures.

        Estimate the clock offset, unless it is given or known.
        """
        reports = self.reports
        assert reports is not None
        if (locator := feed.locator) is None:
            reports.begin(lambda log: (log, []), notes)
            return
        reports.begin(completion(self.given, self._settings, locator), notes)
        reports.compare = lambda: reports.find_contradiction(locator, pipeline.motions)
        if not is_set(self._settings, "aerial.clock_offset_s") and reports.name != KLV:
            reports.measure = lambda: reports.estimate_clock_offset(locator, pipeline.motions)
