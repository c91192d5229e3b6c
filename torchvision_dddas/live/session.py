"""One session of `dddas run --live`: process live pictures for as long as they come."""

import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import asdict, replace
from functools import partial
from math import inf, isnan, nan
from pathlib import Path
from typing import Any

from torchvision_dddas.config import LiveParameters, Settings, is_set, with_parameters
from torchvision_dddas.detection import OnnxDetector, check_length, load_engine
from torchvision_dddas.errors import InputError, printable, without_secrets
from torchvision_dddas.geo import Zones
from torchvision_dddas.io.interrupts import Stopped, StopSignals
from torchvision_dddas.io.output import (
    RESULTS,
    Event,
    SessionLog,
    ZoneCounts,
    describe_nothing_located,
    make_session_folder,
    without_numbers,
)
from torchvision_dddas.io.sources import stream_target
from torchvision_dddas.io.streams import About, Stream, open_streams
from torchvision_dddas.live.access import choose_access
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.commanding import CommandOptions, open_commands
from torchvision_dddas.live.health import Health, Snapshot, StatusWriter
from torchvision_dddas.live.live_landmarks import open_landmarks
from torchvision_dddas.live.live_telemetry import LiveTelemetry, open_telemetry
from torchvision_dddas.live.log_alignment import describe_landmarks, describe_log
from torchvision_dddas.live.operator_view import OperatorView
from torchvision_dddas.live.receiver import DeadCamera
from torchvision_dddas.live.report_inputs import KLV
from torchvision_dddas.live.runner import (
    Feed,
    LoadShedding,
    RepeatedFailure,
    Result,
    record_result,
    results,
    send_result,
)
from torchvision_dddas.live.server import HealthServer, Page, health_pages, parse_address
from torchvision_dddas.live.team import LiveTeam
from torchvision_dddas.live.watchdog import HUNG, UNWRITTEN, Supervisor, Watchdog
from torchvision_dddas.people import PersonTracker, load_scorer
from torchvision_dddas.pipeline import (
    AerialInput,
    Assembly,
    Pipeline,
    assemble_files,
    completion,
    locator_facts,
    map_site,
    note_unused,
)
from torchvision_dddas.runtime import VERSION
from torchvision_dddas.tracking import FrameTracker
from torchvision_dddas.types import Adjustment, Frame, FrameResult, Telemetry

_WAITING = "waiting for the camera"
# Parameters of the motion detector that landmarks and a commanded vehicle use too.
_SHARED = ("small.min_area_px", "gates.expected_size_m", "gates.focal_px")
_CLEAR = "\r\x1b[K"
_COUNTED = (
    *("captured", "dropped", "looked_at", "undecoded", "concealed", "reconnects", "clock_jumps"),
    *("results", "late", "begun_anew"),
)


def run_live(
    out: Path,
    clip: str,
    given: AerialInput | None,
    telemetry: Path | None,
    interval: int,
    settings: Settings,
    backend: str = "auto",
    emit: Sequence[str] = (),
    serve: str | None = None,
    people: bool = False,
    rate_hz: float | None = None,
    quiet: bool = False,
    wait: bool = False,
    zones: Zones | None = None,
    ground: Sequence[Path] = (),
    aerial: Sequence[Path] = (),
    detector: OnnxDetector | None = None,
    movers: bool = False,
    commanding: CommandOptions | None = None,
    serve_token: str | None = None,
) -> int:
    """Run until the pictures end or a signal ends the run, and return the exit code. Write a new folder under out.

    SIGTERM, by which a supervisor ends a session, gives 0; other signals give 128 plus their number. wait: wait for an
    absent camera at the start. detector, movers: as for `Pipeline`. commanding: the link of a vehicle and the limits of
    its commands. serve_token: as `choose_access` takes it. Raise InputError for any other fault at the start; a later
    fault becomes an event.
    """
    address = None if serve is None else parse_address(serve)
    access = None if address is None else choose_access(address[0], serve_token)
    if wait and stream_target(clip) is None:
        raise InputError(f"--wait is for a camera or a stream, but {clip} is neither; leave --wait out")
    if backend == "auto":  # the torch engine finishes frames in batches, which would delay live results
        backend = "onboard"
    # Measure O of the interval rule unless it is set; without a pace frames wait, so that every run gives the same.
    unused = note_unused(settings, _SHARED) if detector is not None and not movers and not aerial else []
    if settings.live.pace and not is_set(settings, "interval.cost"):
        settings = with_parameters(settings, {"interval.cost": 0.0})
    health, supervisor, live = Health(), Supervisor(), settings.live
    for name in _COUNTED:  # a count that exists from the start can be distinguished from a missing one
        health.count(name, 0)
    with ExitStack() as stack:
        # Find possible faults before the session has a folder.
        watchdog = Watchdog(health, live.watchdog_s, supervisor)
        name, pages = without_secrets(clip), dict[str, Page]()
        server = None if address is None else stack.enter_context(HealthServer(address, pages, access))
        view = OperatorView(partial(health.event, "page"))
        stack.callback(view.close)
        health.trouble("waiting", _WAITING)
        pages |= health_pages(health, watchdog, (), lambda: _WAITING, name, VERSION, inf, view)
        if wait:  # the service is up, but has no camera yet
            supervisor.say("READY=1", f"STATUS={_WAITING}")
            if server is not None and (not quiet or server.access.is_made):
                _print_page(server)
        told: list[Event] = []

        def waiting() -> None:
            """Notify the supervisor, and report once why there is no camera yet."""
            watchdog.check()
            if not told and (events := health.snapshot().events):
                told.append(events[0])
                _print_event(events[0])

        try:
            scale, told_by = settings.levels.given, waiting if wait else None
            source = LiveSource(clip, live, health, rate_hz=rate_hz, full_scale=scale, waiting=told_by)
        except DeadCamera as error:
            _print(str(error))
            return HUNG
        except Stopped as stopped:
            if stopped.number == signal.SIGTERM:  # a supervisor ends a run that has no camera yet
                return 0
            raise
        stack.callback(source.close)
        health.trouble("waiting")
        health.begin()
        if source.recorded is not None:
            check_length(source.recorded)
        reports = open_telemetry(telemetry, source, settings.aerial, health)
        is_awaited = reports is not None and reports.is_awaited
        if reports is not None:
            stack.callback(reports.close)
            if is_awaited:
                reports.wait(waiting if wait else None)
                given = replace(given or AerialInput(), telemetry=Path(reports.name))

        marks = open_landmarks(None if given is None else given.landmarks, source, health)
        if marks is not None:
            stack.callback(marks.close)
            marks.wait(waiting if wait else None)

        def prepare() -> Assembly:
            """Assemble the run with its files, or with the newest reports."""
            newest, log = given, telemetry if reports is None or reports.raw is None else reports.record()
            if newest is not None and isinstance(log, Telemetry):
                newest = replace(newest, telemetry=log)
            if newest is not None and marks is not None:
                start_utc_s = time.time() if isnan(source.start_utc_s) else source.start_utc_s
                newest = replace(newest, landmarks=marks.record(start_utc_s, source.rate_hz))
            return assemble_files(newest, log, settings, source, backend, clip)

        ready = prepare()
        ready.notes.extend([str(source.levels)] if source.levels else [])
        ready.notes.extend([*detector.notes, *unused] if detector is not None else ())
        flight, is_recording, offset_s = ready.telemetry, stream_target(clip) is None, settings.aerial.clock_offset_s
        site = None if ready.watch is None else ready.watch.locator.site
        if zones is not None:
            zones.check(site is not None, None if site is None else site.origin_deg)
        if reports is not None and is_awaited:
            ready.notes.append(f"the telemetry comes live from {reports.name}, and is aligned by the clock")
        elif flight is not None:
            ready.notes.append(describe_log(flight, is_recording, time.time(), offset_s))
        if site is not None and not is_recording and marks is None:
            ready.notes.extend(describe_landmarks(site.landmarks))
        team = LiveTeam((ground, aerial), settings, backend, ready.watch, source, health) if ground or aerial else None
        commands = None
        if commanding is not None:
            if commanding.allow and is_recording:
                raise InputError(f"--allow-commands is for a camera or a stream, but {name} shows another time")
            locator = None if ready.watch is None else ready.watch.locator
            opening = open_commands(commanding, ready.settings, source.size, source.rate_hz, locator, health)
            commands = stack.enter_context(opening)
        # For a recording, times of day come from its own log, if the log has a clock.
        recorded_utc_s = flight.start_utc_s if is_recording and flight is not None else nan
        begin = build_path(ready, source, people, interval, backend, health, prepare, detector, movers)
        # Data that streams need; the time follows the source's clock.
        about = About(time.time())
        if site is not None and ready.watch is not None:
            height_m, locator = site.plane_above_sea_m + site.geoid_m, ready.watch.locator
            about = About(time.time(), site.origin_deg is not None, site.landmarks.names, locator.camera, height_m)
        opened = stack.enter_context(ExitStack())
        streams = _open(opened, emit, about, health, live, "--emit")
        folder = make_session_folder(out)
        streams = _open(opened, [f"json:{folder / RESULTS}"], about, health, live, "--out") + streams
        facts: dict[str, Any] = {
            "input": name,
            "telemetry": telemetry if reports is None else reports.name,
            "clip": {"name": source.name, "size": source.size, "rate_hz": source.rate_hz},
            "interval_frames": interval,
            "people": people,
            "backend": ready.engine.name,
            "notes": list(ready.notes),
        }
        if given is not None and ready.watch is not None:
            facts |= {**given.facts, **locator_facts(ready.watch.locator)}
        facts |= {key: paths for key, paths in (("ground", ground), ("aerial", aerial)) if paths}
        facts |= {"command": asdict(commanding)} if commanding is not None else {}
        facts |= {} if detector is None else {"detector": detector.facts, "movers": movers}
        facts["settings"] = ready.settings.model_dump()
        log = SessionLog(folder, facts)
        stack.callback(log.close)
        shown = () if quiet else (_print_event, _print_snapshot)
        status = StatusWriter(health, log, streams, live.status_s, *shown)
        status.begin()
        watchdog.idle_s = lambda: 0.0 if source.seeking else health.idle_s
        patience_s = max(2 * live.stall_s, 30 / source.rate_hz)
        pages |= health_pages(health, watchdog, streams, lambda: status.state, name, VERSION, patience_s, view)

        feed = Feed(source, health, watchdog, flight)
        feed.clock_offset_s = nan if is_recording else offset_s
        if reports is not None and not is_recording:
            feed.live, reports.clock_offset_s = reports, offset_s
            feed.began = partial(_follow, reports, feed, given, settings, ready.notes)
        if marks is not None:
            feed.place_landmarks = lambda: marks.place(
                feed.locator, source.start_utc_s - feed.clock_offset_s, source.rate_hz
            )
        if server is not None:
            ground_site = None if ready.watch is None else map_site(ready.watch.locator, None)
            view.begin(interval, about, ground_site, zones.zones if zones else ())
            feed.seen = view.take

        def stop(number: int) -> None:
            """Take no further picture; the run ends when all taken pictures are finished."""
            feed.stop()
            source.stop()

        signals = stack.enter_context(StopSignals(stop))
        stack.enter_context(status)
        stack.enter_context(watchdog)
        if team is not None:
            team.begin(folder)
            stack.callback(team.finish)
        supervisor.say("READY=1", "STATUS=running")
        if not quiet:
            _print("{}, {}x{} at {:g} Hz; into {}".format(source.name, *source.size, source.rate_hz, folder))
            for note in ready.notes:
                _print(f"note: {note}")
        if server is not None and not wait and (not quiet or server.access.is_made):
            _print_page(server)
        failure, tally = "", _Located()
        counts = ZoneCounts(zones.zones if zones else ())
        if zones:
            facts["zones"] = deepcopy(counts.rows)
        try:
            for located, seen in results(begin, feed, health):
                located = located if team is None else team.add(located)
                located = located if commands is None else commands.update(located, feed)
                if events := (*located.events, *(zones.update(located) if zones else ())):
                    located = replace(located, events=events)
                    counts.add(events)
                    facts |= deepcopy({"zones": counts.rows, "crowd_events": counts.crowds})  # another thread writes it
                    for event in events:
                        health.event("zone" if event.zone else "crowd", event.describe(), event.frame)
                result = located, seen
                if cause := tally.add(result[0]):
                    health.event("locate", f"not located: {cause}", result[0].number)
                about.start_utc_s = source.start_utc_s if isnan(recorded_utc_s) else recorded_utc_s
                send_result(result, streams, health)
                record_result(result, feed, health, live.deadline_ms)
                if server is not None:
                    view.show(*result)
            status.state = "complete" if signals.signal is None else "stopped"
        except RepeatedFailure as error:
            failure, status.state = str(error), "failed"
            health.event("run", failure)
        facts["notes"] += zones.notes if zones else []
        facts["notes"] += team.finish() if team is not None else []
        if ready.watch is not None and not tally.located:
            facts["notes"].append(tally.describe())
            health.event("locate", tally.describe())
        supervisor.say("STOPPING=1")
        opened.close()
    if not quiet:
        _print(_summarize(health, folder, live.deadline_ms))
    elif failure:  # --quiet silences events, not errors
        _print(failure)
    lost = f"{RESULTS} lacks {streams[0].lost} lines" if streams[0].lost else ""
    if refused := "; ".join(filter(None, (status.refused, lost))):
        _print(f"{folder}: {refused}; free some space or choose another --out")
    if failure or refused:
        return HUNG if failure else UNWRITTEN
    return 0 if signals.signal in (None, signal.SIGTERM) else 128 + signals.signal


def _follow(
    reports: LiveTelemetry,
    feed: Feed,
    given: AerialInput | None,
    settings: Settings,
    notes: Sequence[str],
    pipeline: Pipeline,
) -> None:
    """Complete live reports for the site of the locator; estimate the clock offset, unless it is given or known."""
    if (locator := feed.locator) is None:
        reports.begin(lambda log: (log, []), notes)
        return
    reports.begin(completion(given, settings, locator), notes)
    if not is_set(settings, "aerial.clock_offset_s") and reports.name != KLV:
        reports.measure = lambda: reports.estimate_clock_offset(locator, pipeline.motions)


class _Located:
    """Count the located targets, and the reasons why others were not located."""

    def __init__(self) -> None:
        self.located = self._unplaced = 0
        self._causes, self._told = Counter[str](), set[str]()

    def add(self, result: FrameResult) -> str:
        """Count a frame. Return why it was not located if that reason, apart from its numbers, is new; else ""."""
        if (found := result.locations) is None:
            return ""
        self.located += len(found.positions)
        if found.fix.by:
            self._unplaced += len(found.box_px) - len(found.positions)
            return ""
        cause = found.fix.cause
        self._causes[cause] += 1
        if (kind := without_numbers(cause)) in self._told:
            return ""
        self._told.add(kind)
        return cause

    def describe(self) -> str:
        """Return why nothing was located."""
        return describe_nothing_located(self._causes, self._unplaced)


def build_path(
    ready: Assembly,
    source: LiveSource,
    people: bool,
    interval: int,
    backend: str,
    health: Health,
    prepare: Callable[[], Assembly],
    detector: OnnxDetector | None = None,
    movers: bool = False,
) -> Callable[[Feed], Iterator[Result]]:
    """Return the path from frames to results, which restarts at each call, and sheds load.

    prepare: makes `ready` again for pictures of another size.
    Raise InputError at once for pictures that are too small for people.
    """
    settings, scorer = ready.settings, None
    if people:
        # Searching the whole picture takes as long as many pictures take to arrive.
        share = min(settings.people.look_share, 0.1)
        settings = with_parameters(settings, {"people.search": "regions", "people.look_share": share})
        scorer = load_scorer(settings.people, backend)
    shedding = LoadShedding(source, settings, health, people)
    engines = iter([ready.engine])

    def build_person_tracker(size: tuple[int, int]) -> PersonTracker | None:
        if scorer is None:
            return None
        tracker = FrameTracker(shedding.settings, interval, size, pictures=False, rate_hz=source.rate_hz)
        return PersonTracker(scorer, shedding.settings, interval, size, tracker)

    watch, watch_size = ready.watch, source.size
    build_person_tracker(watch_size)

    def begin(feed: Feed) -> Iterator[Result]:
        # After an error, no object that remembers a frame is used again.
        nonlocal watch, watch_size
        if watch is not None and feed.size != watch_size:  # the camera model depends on the size
            watch, watch_size = prepare().watch, feed.size
        engine = next(engines, None) or load_engine(backend, shedding.settings)
        person_tracker = build_person_tracker(feed.size)

        def retune(frame: Frame) -> tuple[Settings, tuple[Adjustment, ...]]:
            settings, adjustments = shedding(frame)
            if person_tracker is not None and adjustments:
                person_tracker.retune(settings)
            return settings, adjustments

        running = None if watch is None else watch.restarted()
        feed.locator = None if running is None else running.locator
        if running is not None and feed.log is not None:
            locator = running.locator
            feed.aligned = lambda log: locator.set_site(replace(locator.site, telemetry=log))
            feed.aligned(feed.log)
        pipeline = Pipeline.from_assembly(
            Assembly(shedding.settings, engine, None, running),
            interval=interval,
            seen=None if person_tracker is None else person_tracker.update,
            retune=retune,
            pictures=False,
            detector=detector,
            movers=movers,
        )
        feed.began(pipeline)
        for result in pipeline(feed):
            yield result, None if person_tracker is None else person_tracker.people_of(result.number, feed.ended)

    return begin


def _open(
    opened: ExitStack, texts: Sequence[str], about: About, health: Health, live: LiveParameters, option: str
) -> list[Stream]:
    """Open streams that are closed when `opened` is. Raise InputError."""
    streams = open_streams(texts, about, health.event, live.retry_s, live.retry_most_s, option)
    for stream in streams:
        opened.callback(stream.close)
        health.ask(stream.trouble)
    return streams


# Messages go to stderr, because stdout is for streams.


def _print(text: str) -> None:
    clear = _CLEAR if sys.stderr.isatty() else ""
    sys.stderr.write(f"{clear}dddas: {printable(' '.join(text.split()))}\n")
    sys.stderr.flush()


def _print_page(server: HealthServer) -> None:
    _print(f"status page: {server.url}")


def _print_event(event: Event) -> None:
    _print(f"frame {event.frame}: {event.text}" if event.frame else event.text)


def _print_snapshot(now: Snapshot) -> None:
    """Replace the previous line by the state in one line; do nothing if stderr is not a terminal."""
    if not sys.stderr.isatty():
        return
    latency = f", latency {1000 * now.seconds['latency'][0]:.0f} ms" if "latency" in now.seconds else ""
    counts, gauges = now.counts, now.gauges
    line = (
        f"{gauges.get('rate_hz', 0.0):.1f} results/s{latency}, {gauges.get('targets', 0):g} targets, "
        f"{counts.get('dropped', 0)} of {counts.get('captured', 0)} pictures dropped"
    )
    sys.stderr.write(f"{_CLEAR}{line}")
    sys.stderr.flush()


def _summarize(health: Health, folder: Path, deadline_ms: float) -> str:
    now = health.snapshot()
    counts = {name: now.counts.get(name, 0) for name in ("results", "captured", "dropped", "late")}
    within = f", 99 % within {1000 * now.seconds['latency'][2]:.0f} ms" if "latency" in now.seconds else ""
    return (
        f"{counts['results']} results of {counts['captured']} pictures, {counts['dropped']} dropped, "
        f"{counts['late']} late (over {deadline_ms:g} ms){within}; {folder}"
    )
