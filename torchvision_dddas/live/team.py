"""Further platforms of a live run: each is read and located in a thread of its own, and one more thread fuses.

The thread of the main pictures hands its records over and does not wait: where the machine is too slow, the work of
further platforms is left out and counted.
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
from torchvision_dddas.live.runner import Feed, RepeatedFailure, results
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.pipeline import prepare_uav
from torchvision_dddas.types import FrameResult, FusedTargets

_MOST = 50  # records that wait to be fused
_KEPT = 1000  # looks of a platform that are kept while no main picture comes
_SAME_S = 1e-6  # times that differ by less are the same
_FRESH_S = 1.0  # an older look confirms nothing: the targets have walked on
_REST_S, _END_S = 0.05, 10.0  # until late main results are looked at again; for all threads at the end


class PlatformHealth(Health):
    """The health of a platform, whose events and troubles become those of the run. over: why nothing more comes."""

    def __init__(self, name: str, run: Health) -> None:
        super().__init__()
        self.over, self._name, self._run = "", name, run
        run.ask(lambda: "; ".join(f"{name}: {words}" for words in self.snapshot().troubles))

    def event(self, kind: str, text: str, frame: int = 0) -> Event:
        """Add an event of the run with the platform's name."""
        return self._run.event("platform", f"{self._name}: {text}")

    @property
    def facts(self) -> dict[str, Any]:
        """Its state in words, and how many pictures came and were dropped."""
        now = self.snapshot()
        comes = now.gauges.get("connected", now.counts.get("captured", 0))
        state = self.over or ("sends pictures" if comes else "sends no pictures")
        return {"state": state, **{name: now.counts.get(name, 0) for name in ("captured", "dropped")}}


class LiveTeam:
    """Adds what further platforms see to the results of a live run: `confirmed` at once, `fused` seconds later.

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
        """given: files of platforms on the ground, and of UAVs. The others are of the run.

        Raises InputError for bad files, and for live platforms beside recorded ones.
        """
        site = None if watch is None else watch.locator.site
        origin_deg = self._origin_deg = None if site is None else site.origin_deg
        self._settings, self._source, self._run = settings, source, health
        self._backend, self._waits = backend, not (source.is_stream or settings.live.pace)
        uavs = [FurtherUav(read_aerial_platform(path), (), origin_deg, math.nan, tuple) for path in given[1]]
        self._team = GroundTeam(given[0], settings, self._backend, uavs, live=True)
        for one in self._team.members:
            if one.detections is not None:
                raise InputError(f"{one.name} has detections, boxes of before; wanted a clip alone beside --live")
            if one.is_stream != source.is_stream:
                kinds = ("live", "recorded") if source.is_stream else ("recorded", "live")
                raise InputError(f"the main clip is {kinds[0]}, that of {one.name} {kinds[1]}; give all of a kind")
            if one.is_stream and math.isnan(one.starts_s):
                raise InputError(f"{one.name} is live and begins when it comes; leave starts_utc out")
        clock = math.nan if site is None or site.telemetry is None else site.telemetry.start_utc_s
        self._team.check(site is not None, origin_deg, clock)
        self._healths = {one.name: PlatformHealth(one.name, health) for one in self._team.members}
        self._changed, self._ended = threading.Condition(), threading.Event()
        self._looks: dict[str, deque[PlatformLook]] = {name: deque(maxlen=_KEPT) for name in self._healths}
        self._notes: list[str] | None = None
        self._is_fusing = False
        self._refused, self._now_s = False, -math.inf  # by the disk; time of the newest main result
        self._inbox, self._fused = deque[PlatformLook](), deque[FusedTargets]()
        self._left_out, self._facts = Counter[str](), self._team.facts
        self._open: list[LiveSource] = []
        works: list[Callable[[], None]] = [*(partial(self._read, one) for one in self._team.members), self._fuse]
        self._threads = [threading.Thread(target=work, name="platform", daemon=True) for work in works]
        health.platforms = lambda: {name: one.facts | self._facts[name] for name, one in self._healths.items()}

    def begin(self, folder: Path) -> None:
        """Start the threads, and the tables in a folder."""
        self._tables = confirmed_positions(folder, has := self._origin_deg is not None), fused_table(folder, has)
        for thread in self._threads:
            thread.start()

    def add(self, result: FrameResult) -> FrameResult:
        """The next main result with what platforms add; its `fused` is the newest that is final by now."""
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
        """End the threads within seconds, and put the tables in their places; returns notes."""
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
        if not self._threads[-1].is_alive():  # it would change what is read here
            self._team.finish()
        for name, one in self._healths.items():
            if one.facts["dropped"]:
                told = "{dropped} of {captured} pictures were dropped, so that the others keep up"
                notes.append(f"{name}: {told.format(**one.facts)}")
            notes += [f"{name}: {words}" for words in one.snapshot().troubles]
        late = [look for looks in self._looks.values() for look in [*looks] if look.time_s <= self._now_s]
        self._left_out.update(look.name for look in [*self._inbox, *late])
        notes += [f"{name}: records not fused, for lack of time: {n}" for name, n in self._left_out.items()]
        if count := self._team.fusion.late:
            notes.append(f"records not fused, as they came later than fusion.delay_s: {count}")
        notes += self._team.notes
        return notes

    def _have_come(self, time_s: float) -> bool:
        """Whether each platform has come as far as the main pictures, or comes no further."""
        last = ((self._healths[name].over, looks[-1].time_s if looks else -1.0) for name, looks in self._looks.items())
        return all(over or at_s > time_s for over, at_s in last)

    def _rest(self) -> None:
        """Wait while the main results are late."""
        while self._run.is_late and not self._waits and not self._ended.wait(_REST_S):
            pass

    def _read(self, one: Platform) -> None:
        """Locate what a platform sees until the end, whatever happens to it."""
        _give_way()
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
        """What a platform sees. A stream that is not there is waited for, also where it was there before."""
        from torchvision_dddas.live.session import build_path  # which needs this file

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
                raise InputError("its places and those of the main clip are not of one kind")
            feed = Feed(source, own, Watchdog(own, 0.0), ready.telemetry)
            feed.clock_offset_s = ready.settings.aerial.clock_offset_s if one.is_stream else math.nan
            begin = build_path(ready, source, False, one.interval, self._backend, own, prepare)
            for result, _ in results(begin, feed, own):
                if (located := result.locations) is None or result.repeats:
                    continue
                if (time_s := located.time_s + self._shift_s(one, source)) >= 0:  # not NaN: the main clip has begun
                    yield PlatformLook(time_s, one.name, located)

    def _pictures(self, one: PlatformFile, source: LiveSource) -> Iterator[Picture]:
        """The newest pictures of a platform on the ground."""
        for frame in source.every(one.interval):
            check_size(one, (frame.image.shape[1], frame.image.shape[0]))
            if (time_s := frame.time_s + self._shift_s(one, source)) >= 0:
                yield frame.number, time_s, frame.image

    def _shift_s(self, one: Platform, source: LiveSource) -> float:
        """From a platform's times to those of the main clip. Of streams the clock at reception counts."""
        start_s = self._team.starts_s[one.name]
        if not one.is_stream:
            return start_s
        return source.start_utc_s - self._source.start_utc_s + start_s + self._settings.aerial.clock_offset_s

    def _fuse(self) -> None:
        """Fuse the records that wait, and what is left at the end; one that cannot be fused is left out."""
        _give_way()
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
        """Write a result and all that has become final; returns the newest of that. None: the end of the tables."""
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
                self._run.event("sink", f"confirmed.csv and fused.csv are not whole: {error.strerror}")
            self._refused = True
        return final[-1] if final else None


def _give_way() -> None:
    """Lower the priority of this thread."""
    if sys.platform == "linux":  # elsewhere threads have no priority of their own
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
