"""Further platforms of a live run: one thread per platform reads and locates, and one more thread fuses the records.

The thread of the main pictures passes its records on without waiting. If the machine is too slow, records of further
platforms are left out and counted.
"""

import math
import os
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings
from torchvision_dddas.control import UAV, FurtherUav, GroundTeam, Picture, PlatformLook, check_size
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import LandmarkWatch
from torchvision_dddas.io.output import Event, confirmed_positions, fused_table
from torchvision_dddas.io.platform_files import Platform, PlatformFile, read_aerial_platform
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.receiver import DeadCamera
from torchvision_dddas.live.run_path import build_path
from torchvision_dddas.live.runner import Feed, RepeatedFailure, results
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.pipeline import prepare_uav
from torchvision_dddas.types import FrameResult, FusedTargets

_MOST = 50  # largest number of records that wait to be fused
_KEPT = 1000  # largest number of looks of a platform that wait for a main picture
_SAME_S = 1e-6  # times with a smaller difference are equal
_FRESH_S = 1.0  # an older look confirms nothing, because the targets have moved on
_REST_S, _END_S = 0.05, 10.0  # wait between checks of late main results; wait for all threads at the end


class PlatformHealth(Health):
    """The health of a platform. Its events and troubles are added to the run. over: why no more pictures come."""

    def __init__(self, name: str, run: Health) -> None:
        super().__init__()
        self.over, self._name, self._run = "", name, run
        run.ask(lambda: "; ".join(f"{name}: {words}" for words in self.snapshot().troubles))

    def event(self, kind: str, text: str, frame: int = 0) -> Event:
        """Add an event of the run with the platform's name."""
        return self._run.event("platform", f"{self._name}: {text}")

    @property
    def facts(self) -> dict[str, Any]:
        """The platform's state in words, and the numbers of captured and dropped pictures."""
        now = self.snapshot()
        comes = now.gauges.get("connected", now.counts.get("captured", 0))
        state = self.over or ("sends pictures" if comes else "sends no pictures")
        return {"state": state, **{name: now.counts.get(name, 0) for name in ("captured", "dropped")}}


class LiveTeam:
    """Adds observations of further platforms to live results: `confirmed` at once, `fused` seconds later.

    Writes confirmed.csv and fused.csv.
    """

    def __init__(
        self,
        given: tuple[Sequence[Path], Sequence[Path]],
        settings: Settings,
        backend: str,
        watch: LandmarkWatch | None,
        source: LiveSource,
        health: Health,
    ) -> None:
        """given: files of platforms on the ground, and of UAVs. The other arguments belong to the run.

        Raise InputError for bad files, and if live and recorded platforms are mixed.
        """
        site = None if watch is None else watch.locator.site
        origin_deg = self._origin_deg = None if site is None else site.origin_deg
        self._settings, self._source, self._run = settings, source, health
        self._backend, self._waits = backend, not (source.is_stream or settings.live.pace)
        uavs = [FurtherUav(read_aerial_platform(path), (), origin_deg, math.nan, tuple) for path in given[1]]
        self._team = GroundTeam(given[0], settings, self._backend, uavs, live=True)
        for one in self._team.members:
            if one.detections is not None:
                raise InputError(f"{one.name} has detections, which --live cannot use; give its clip alone")
            if one.is_stream != source.is_stream:
                kinds = ("live", "recorded") if source.is_stream else ("recorded", "live")
                raise InputError(f"the main clip is {kinds[0]}, but {one.name} is {kinds[1]}; give clips of one kind")
            if one.is_stream and math.isnan(one.starts_s):
                raise InputError(f"{one.name} is live and begins with its first picture; leave starts_utc out")
        clock = math.nan if site is None or site.telemetry is None else site.telemetry.start_utc_s
        self._team.check(site is not None, origin_deg, clock)
        self._healths = {one.name: PlatformHealth(one.name, health) for one in self._team.members}
        self._changed, self._ended = threading.Condition(), threading.Event()
        self._looks: dict[str, deque[PlatformLook]] = {name: deque(maxlen=_KEPT) for name in self._healths}
        self._notes: list[str] | None = None
        self._is_fusing = False
        self._refused, self._now_s = False, -math.inf  # whether the disk refused; time of the newest main result
        self._inbox, self._fused = deque[PlatformLook](), deque[FusedTargets]()
        self._left_out, self._facts = Counter[str](), self._team.facts
        self._open: list[LiveSource] = []
        works: list[Callable[[], None]] = [*(partial(self._read, one) for one in self._team.members), self._fuse]
        self._threads = [threading.Thread(target=work, name="platform", daemon=True) for work in works]
        health.platforms = lambda: {name: one.facts | self._facts[name] for name, one in self._healths.items()}

    def begin(self, folder: Path) -> None:
        """Open the tables in a folder, and start the threads."""
        self._tables = confirmed_positions(folder, has := self._origin_deg is not None), fused_table(folder, has)
        for thread in self._threads:
            thread.start()

    def add(self, result: FrameResult) -> FrameResult:
        """Return the next main result with `confirmed`, and with the newest `fused` record that is final."""
        located = result.locations
        if located is None or not math.isfinite(located.time_s) or result.repeats:
            return result
        now_s, due = located.time_s, list[PlatformLook]()
        self._now_s = now_s
        with self._changed:
            if self._waits:
                self._changed.wait_for(lambda: len(self._inbox) < _MOST and self._have_come(now_s + _SAME_S))
            for looks in self._looks.values():
                due += [looks.popleft() for _ in range(sum(look.time_s <= now_s + _SAME_S for look in looks))]
            due = sorted((replace(look, time_s=min(look.time_s, now_s)) for look in due), key=lambda look: look.time_s)
            self._inbox.extend([*due, PlatformLook(now_s, UAV, located)])
            while len(self._inbox) > _MOST and not self._waits:
                self._left_out[self._inbox.popleft().name] += 1
            self._changed.notify_all()
            if self._waits:  # wait for the fusion, so that each run writes the same lines
                self._changed.wait_for(lambda: not self._inbox and not self._is_fusing)
        confirmed = self._team.confirm([look for look in due if now_s - look.time_s < _FRESH_S], located)
        result = replace(result, confirmed=confirmed)
        return replace(result, fused=self._write(result))

    def finish(self) -> list[str]:
        """End the threads within seconds, move the tables to their places, and return notes."""
        if self._notes is not None:
            return self._notes
        notes = self._notes = []
        with self._changed:
            self._ended.set()
            self._changed.notify_all()
        until_s = time.monotonic() + _END_S
        for source in self._open:
            source.stop()
        for thread in self._threads:
            thread.join(max(until_s - time.monotonic(), 0.0))
        self._write(None)
        if not self._threads[-1].is_alive():  # a running thread would change the records that are read here
            self._team.finish()
        for name, one in self._healths.items():
            if one.facts["dropped"]:
                told = "{dropped} of {captured} pictures were dropped, so that processing keeps up"
                notes.append(f"{name}: {told.format(**one.facts)}")
            notes += [f"{name}: {words}" for words in one.snapshot().troubles]
        late = [look for looks in self._looks.values() for look in [*looks] if look.time_s <= self._now_s]
        self._left_out.update(look.name for look in [*self._inbox, *late])
        notes += [f"{name}: records not fused for lack of time: {n}" for name, n in self._left_out.items()]
        if count := self._team.fusion.late:
            notes.append(f"records not fused because they came later than fusion.delay_s: {count}")
        notes += self._team.notes
        return notes

    def _have_come(self, time_s: float) -> bool:
        """Return whether each platform has ended, or has reached the time of the main pictures."""
        last = ((self._healths[name].over, looks[-1].time_s if looks else -1.0) for name, looks in self._looks.items())
        return all(over or at_s > time_s for over, at_s in last)

    def _rest(self) -> None:
        """Wait while the main results are late."""
        while self._run.is_late and not self._waits and not self._ended.wait(_REST_S):
            pass

    def _read(self, one: Platform) -> None:
        """Locate the pictures of a platform until it ends or fails. Its failure never ends the run."""
        give_way()
        own, looks, over = self._healths[one.name], self._looks[one.name], ""
        try:
            for look in self._see(one):
                with self._changed:
                    self._changed.wait_for(lambda: not self._waits or len(looks) < _MOST or self._ended.is_set())
                    looks.append(look)
                    self._changed.notify_all()
                self._rest()
        except (InputError, DeadCamera, RepeatedFailure) as error:
            over = str(error)
        except Exception as error:
            over = f"{type(error).__name__}: {error}"
        if not self._ended.is_set():
            own.trouble("over", over)
            own.event("run", over or "the recording has ended")
        with self._changed:
            own.over = over or "ended"
            self._changed.notify_all()

    def _see(self, one: Platform) -> Iterator[PlatformLook]:
        """Yield the looks of a platform. Wait for a stream that is missing or lost."""

        def wait() -> None:
            if self._ended.is_set():
                raise InputError("the run has ended")

        live, own = self._settings.live.model_copy(update={"lost_s": 0.0}), self._healths[one.name]
        source = LiveSource(one.clip, live, own, rate_hz=one.rate_hz, waiting=wait)
        self._open.append(source)
        with closing(source):
            wait()
            if isinstance(one, PlatformFile):
                yield from self._team.looks(one, self._pictures(one, source), source.rate_hz)
                return
            prepare = partial(prepare_uav, one, self._settings, source, self._backend)
            ready = prepare()
            if ready.watch is not None and (ready.watch.locator.site.origin_deg is None) != (self._origin_deg is None):
                raise InputError("it and the main clip need places of one kind: all in degrees, or all in local metres")
            feed = Feed(source, own, Watchdog(own, 0.0), ready.telemetry)
            feed.clock_offset_s = ready.settings.aerial.clock_offset_s if one.is_stream else math.nan
            begin = build_path(ready, source, False, one.interval, self._backend, own, prepare)
            for result, _ in results(begin, feed, own):
                if (located := result.locations) is None or result.repeats:
                    continue
                if (time_s := located.time_s + self._shift_s(one, source)) >= 0:  # NaN before the main clip begins
                    yield PlatformLook(time_s, one.name, located)

    def _pictures(self, one: PlatformFile, source: LiveSource) -> Iterator[Picture]:
        """Yield the newest pictures of a platform on the ground."""
        for frame in source.every(one.interval):
            check_size(one, (frame.image.shape[1], frame.image.shape[0]))
            if (time_s := frame.time_s + self._shift_s(one, source)) >= 0:
                yield frame.number, time_s, frame.image

    def _shift_s(self, one: Platform, source: LiveSource) -> float:
        """Return the shift from a platform's times to times of the main clip, for streams by the clock at reception."""
        start_s = self._team.starts_s[one.name]
        if not one.is_stream:
            return start_s
        return source.start_utc_s - self._source.start_utc_s + start_s + self._settings.aerial.clock_offset_s

    def _fuse(self) -> None:
        """Fuse waiting records, and the remaining records at the end. Leave out a record that cannot be fused."""
        give_way()
        is_last = False
        while not is_last:
            with self._changed:
                self._changed.wait_for(lambda: self._inbox or self._ended.is_set())
                look = self._inbox.popleft() if self._inbox else None
                is_last, self._is_fusing = look is None, True
                self._changed.notify_all()
            try:
                known = self._team.fusion.flush() if look is None else self._team.fuse(look)
                self._fused.extend(one for one in known if one.by == UAV)
                self._facts = self._facts if self._inbox else self._team.facts
            except Exception as error:
                self._run.event("platform", f"{look.name if look else UAV}: not fused, {type(error).__name__}: {error}")
            with self._changed:
                self._is_fusing = False
                self._changed.notify_all()
            self._rest()

    def _write(self, result: FrameResult | None) -> FusedTargets | None:
        """Write a result and all final fused records, and return the newest of them. None: close the tables."""
        final = [self._fused.popleft() for _ in range(len(self._fused))]
        confirmed, fused = self._tables
        try:
            if result is not None:
                confirmed.write(result)
            for one in final:
                fused.write(one)
            if result is None:
                confirmed.close()
                fused.close()
        except OSError as error:
            if not self._refused:
                self._run.event("sink", f"confirmed.csv and fused.csv are incomplete: {error.strerror}")
            self._refused = True
        return final[-1] if final else None


def give_way() -> None:
    """Lower the priority of this thread."""
    if sys.platform == "linux":  # other systems have no priority per thread
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
