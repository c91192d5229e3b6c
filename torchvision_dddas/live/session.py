"""One session of `dddas run --live`: process live pictures for as long as they come."""

import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import partial
from math import inf, isnan, nan
from pathlib import Path
from typing import Any

from torchvision_dddas.config import LiveParameters, Settings, is_set, with_parameters
from torchvision_dddas.detection import OnnxDetector, check_length
from torchvision_dddas.errors import InputError, without_secrets
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
from torchvision_dddas.io.video_packets import check_encoder
from torchvision_dddas.live.access import choose_access
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.commanding import CommandOptions, LiveCommands, open_commands
from torchvision_dddas.live.frozen_camera import FrozenCamera
from torchvision_dddas.live.health import Health, StatusWriter
from torchvision_dddas.live.line_socket import LineSocket
from torchvision_dddas.live.operator_view import OperatorView
from torchvision_dddas.live.receiver import DeadCamera
from torchvision_dddas.live.recording import EventClips, OverlayFiles, PacketOutput, Recorder, SentPictures
from torchvision_dddas.live.result_writer import ResultWriter
from torchvision_dddas.live.run_inputs import RunInputs
from torchvision_dddas.live.run_path import build_path
from torchvision_dddas.live.runner import Feed, RepeatedFailure, results
from torchvision_dddas.live.server import HealthServer, Page, health_pages, parse_address
from torchvision_dddas.live.team import LiveTeam
from torchvision_dddas.live.terminal import print_event, print_line, print_page, print_snapshot, summarize
from torchvision_dddas.live.watchdog import HUNG, UNWRITTEN, Supervisor, Watchdog
from torchvision_dddas.pipeline import AerialInput, locator_facts, map_site, note_unused
from torchvision_dddas.runtime import VERSION
from torchvision_dddas.tracking import Tracker
from torchvision_dddas.types import Frame, FrameResult

_WAITING = "waiting for the camera"
# Parameters of the motion detector that landmarks and a commanded vehicle use too.
_SHARED = ("small.min_area_px", "gates.expected_size_m", "gates.focal_px")
_COUNTED = (
    *("captured", "dropped", "looked_at", "undecoded", "concealed", "reconnects", "clock_jumps"),
    *("results", "late", "begun_anew"),
)


@dataclass(frozen=True)
class LiveOptions:
    """Options of `run_live`. out: the folder that gets the session's folder.

    telemetry: the log beside `given`. emit: streams. serve: address of the page. wait: wait for an absent camera at the
    start. detector, movers: as for `Pipeline`. commanding: the link of a vehicle and the limits of its commands.
    serve_token: as `choose_access` takes it. save: some of RECORDED. lag: as for `Tracker`; provisional results go to
    the lines of JSON alone.
    """

    out: Path
    clip: str
    settings: Settings
    given: AerialInput | None = None
    telemetry: Path | None = None
    interval: int = 1
    backend: str = "auto"
    emit: Sequence[str] = ()
    serve: str | None = None
    people: bool = False
    rate_hz: float | None = None
    quiet: bool = False
    wait: bool = False
    zones: Zones | None = None
    ground: Sequence[Path] = ()
    aerial: Sequence[Path] = ()
    detector: OnnxDetector | None = None
    movers: bool = False
    commanding: CommandOptions | None = None
    serve_token: str | None = None
    save: Sequence[str] = ()
    lag: int | None = None


def run_live(options: LiveOptions) -> int:
    """Run until the pictures end or a signal ends the run, and return the exit code. Write a new folder under out.

    SIGTERM, by which a supervisor ends a session, gives 0; other signals give 128 plus their number. Raise InputError
    for a fault at the start; a later fault becomes an event.
    """
    if options.wait and stream_target(options.clip) is None:
        wanted = f"--wait is for a camera or a stream, but {options.clip} is neither; leave --wait out"
        raise InputError(wanted)
    with ExitStack() as stack:
        session = _Session(options, stack)
        session.open_page()
        if (code := session.open_camera()) is not None:
            return code
        session.open_inputs()
        session.open_outputs()
        session.begin()
        session.process()
        session.end()
    return session.tell_end()


class _Session:
    """The state of a session. `run_live` calls its methods in order. stack: closes what they open."""

    def __init__(self, options: LiveOptions, stack: ExitStack) -> None:
        self.options, self.stack = options, stack
        settings = options.settings
        is_network_alone = options.detector is not None and not options.movers
        # The torch engine finishes frames in batches, which would delay live results.
        self.backend = "onboard" if options.backend == "auto" else options.backend
        self.unused = note_unused(settings, _SHARED) if is_network_alone and not options.aerial else []
        # Measure O of the interval rule unless it is set; without a pace frames wait, so that every run gives the same.
        if settings.live.pace and not is_set(settings, "interval.cost"):
            settings = with_parameters(settings, {"interval.cost": 0.0})
        self.settings, self.live = settings, settings.live
        self.health, self.supervisor = Health(), Supervisor()
        for name in _COUNTED:  # readers can then tell a count of 0 from a missing count
            self.health.count(name, 0)
        self.watchdog = Watchdog(self.health, self.live.watchdog_s, self.supervisor)
        self.name = without_secrets(options.clip)
        self.failure, self.tally, self.frozen = "", _Located(), FrozenCamera()

    # -- the start: find possible faults before the session has a folder ----------------------------------------------

    def open_page(self) -> None:
        """Serve a page that says that the run waits for its camera."""
        options, address = self.options, None if self.options.serve is None else parse_address(self.options.serve)
        access = None if address is None else choose_access(address[0], options.serve_token)
        self.pages = dict[str, Page | LineSocket]()
        self.server: HealthServer | None = None
        if address is not None:
            self.server = self.stack.enter_context(HealthServer(address, self.pages, access))
        self.view = OperatorView(partial(self.health.event, "page"))
        self.stack.callback(self.view.close)
        self.health.trouble("waiting", _WAITING)
        self.pages |= self._health_pages(lambda: _WAITING)
        if options.wait:  # the service is up, but has no camera yet
            self.supervisor.say("READY=1", f"STATUS={_WAITING}")
            self._print_page()

    def _health_pages(
        self, state_now: Callable[[], str], streams: Sequence[Stream] = (), patience_s: float = inf
    ) -> dict[str, Page]:
        return health_pages(
            health=self.health,
            watchdog=self.watchdog,
            streams=streams,
            state_now=state_now,
            name=self.name,
            version=VERSION,
            patience_s=patience_s,
            view=self.view,
        )

    def open_camera(self) -> int | None:
        """Open the source. Return an exit code if the run ends while it waits for the camera, else None."""
        told: list[Event] = []

        def waiting() -> None:
            """Notify the supervisor, and report once why there is no camera yet."""
            self.watchdog.check()
            if not told and (events := self.health.snapshot().events):
                told.append(events[0])
                print_event(events[0])

        self.waiting: Callable[[], object] | None = waiting if self.options.wait else None
        scale, rate_hz = self.settings.levels.given, self.options.rate_hz
        try:
            self.source = LiveSource(
                self.options.clip, self.live, self.health, rate_hz=rate_hz, full_scale=scale, waiting=self.waiting
            )
        except DeadCamera as error:
            print_line(str(error))
            return HUNG
        except Stopped as stopped:
            if stopped.number == signal.SIGTERM:  # a supervisor ends a run that has no camera yet
                return 0
            raise
        self.stack.callback(self.source.close)
        self.health.trouble("waiting")
        self.health.begin()
        if self.source.recorded is not None:
            check_length(self.source.recorded)
        return None

    def open_inputs(self) -> None:
        """Open all other inputs and the command link, and build the path from frames to results."""
        options, health, source, stack = self.options, self.health, self.source, self.stack
        self.inputs = inputs = RunInputs(
            source=source,
            clip=options.clip,
            given=options.given,
            telemetry=options.telemetry,
            settings=self.settings,
            backend=self.backend,
            health=health,
            waiting=self.waiting,
            stack=stack,
        )
        self.ready = ready = inputs.assemble()
        ready.notes.extend([str(source.levels)] if source.levels else [])
        ready.notes.extend([*options.detector.notes, *self.unused] if options.detector is not None else ())
        locator = None if ready.watch is None else ready.watch.locator
        if options.zones is not None:
            options.zones.check(locator is not None, None if locator is None else locator.site.origin_deg)
        ready.notes.extend(inputs.describe(ready))
        Tracker(
            ready.settings, backend=ready.engine.name, lag=options.lag
        )  # raises InputError for settings that lag=0 cannot use
        if options.lag is not None and ready.settings.crowds.join_m and locator is not None:
            raise InputError(
                "--latency now cannot work with crowds.join_m, which gives crowds their identities later; leave one out"
            )
        platforms, self.team = (options.ground, options.aerial), None
        if any(platforms):
            self.team = LiveTeam(platforms, self.settings, self.backend, ready.watch, source, health)
        self.commands: LiveCommands | None = None
        if (commanding := options.commanding) is not None:
            if commanding.allow and inputs.is_recording:
                shown = f"--allow-commands is for a camera or a stream, but {self.name} shows another time"
                raise InputError(shown)
            opening = open_commands(commanding, ready.settings, source.size, source.rate_hz, locator, health)
            self.commands = stack.enter_context(opening)
        self.path = build_path(
            ready=ready,
            source=source,
            people=options.people,
            interval=options.interval,
            backend=self.backend,
            health=health,
            prepare=inputs.assemble,
            detector=options.detector,
            movers=options.movers,
            lag=options.lag,
        )

    def open_outputs(self) -> None:
        """Open the streams and the session's folder with its record."""
        options, health, ready = self.options, self.health, self.ready
        if options.save:
            check_encoder(f"--save {options.save[0]}")
        # Data that streams need; the time follows the source's clock.
        self.about = About(time.time())
        if ready.watch is not None:
            site, camera = ready.watch.locator.site, ready.watch.locator.camera
            sea_m = site.plane_above_sea_m
            self.about = About(
                start_utc_s=time.time(),
                geographic=site.origin_deg is not None,
                landmarks=site.landmarks.names,
                camera=camera,
                plane_above_ellipsoid_m=sea_m + site.geoid_m,
                plane_above_sea_m=sea_m,
            )
        self.pages["/stream"] = self.lines = LineSocket(self.about)
        self.opened = self.stack.enter_context(ExitStack())
        streams = _open(self.opened, options.emit, self.about, health, self.live, "--emit")
        self.folder = make_session_folder(options.out)
        own = _open(self.opened, [f"json:{self.folder / RESULTS}"], self.about, health, self.live, "--out")
        self.streams = [*own, *streams]
        self.facts = self._describe_run()
        log = SessionLog(self.folder, self.facts)
        self.stack.callback(log.close)
        shown = () if options.quiet else (print_event, print_snapshot)
        self.status = StatusWriter(health, log, self.streams, self.live.status_s, *shown)
        self.status.begin()

    def _describe_run(self) -> dict[str, Any]:
        options, ready, source = self.options, self.ready, self.source
        facts: dict[str, Any] = {
            "input": self.name,
            "telemetry": self.inputs.telemetry_name,
            "clip": {"name": source.name, "size": source.size, "rate_hz": source.rate_hz},
            "interval_frames": options.interval,
            "people": options.people,
            "backend": ready.engine.name,
            "notes": list(ready.notes),
        }
        if (given := self.inputs.given) is not None and ready.watch is not None:
            facts |= {**given.facts, **locator_facts(ready.watch.locator)}
        facts |= {key: paths for key, paths in (("ground", options.ground), ("aerial", options.aerial)) if paths}
        facts |= {"command": asdict(options.commanding)} if options.commanding is not None else {}
        if options.detector is not None:
            facts |= {"detector": options.detector.facts, "movers": options.movers}
        facts |= {"save": list(options.save)} if options.save else {}
        facts["settings"] = ready.settings.model_dump()
        return facts

    def _open_recorder(self) -> Recorder | None:
        """Return the recorder of the annotated pictures; None if no output takes them."""
        options, notify = self.options, self.health.event
        sent = [stream for stream in self.streams if stream.video is not None]
        about = replace(self.about)  # the thread of the recording sets the start time in it
        outputs: list[PacketOutput] = [SentPictures(stream, about) for stream in sent]
        for place in [stream.name.partition(":")[2].partition("?")[0] for stream in sent]:
            if self.commands is not None and place.startswith("udp:"):  # other streams go to a server of their own
                self.commands.component.video_uri = place
        outputs += [OverlayFiles(self.folder)] if "overlay" in options.save else []
        outputs += [EventClips(self.folder, self.live.clip_s, notify)] if "clips" in options.save else []
        zones = options.zones.zones if options.zones else ()
        waits = self.inputs.is_recording and not self.live.pace  # pictures wait then, so that none is left out
        if not outputs:
            return None
        return Recorder(
            outputs=outputs,
            rate_hz=self.source.rate_hz,
            interval=options.interval,
            about=about,
            zones=zones,
            notify=notify,
            waits=waits,
        )

    def begin(self) -> None:
        """Connect the source with the path and the page, and start the threads that supervise the run."""
        options, health, source, ready, stack = self.options, self.health, self.source, self.ready, self.stack
        self.watchdog.idle_s = lambda: 0.0 if source.seeking else health.idle_s
        patience_s = max(2 * self.live.stall_s, 30 / source.rate_hz)
        self.pages |= self._health_pages(lambda: self.status.state, self.streams, patience_s)
        self.feed = feed = Feed(source, health, self.watchdog, ready.telemetry)
        self.inputs.connect(feed, ready.notes)
        if self.server is not None:
            ground_site = None if ready.watch is None else map_site(ready.watch.locator, None)
            self.view.begin(options.interval, self.about, ground_site, options.zones.zones if options.zones else ())
            feed.seen = self.view.take
        self.recorder = recorder = self._open_recorder()
        if recorder is not None:
            stack.callback(recorder.close)
            takers: list[Callable[[Frame], object]] = [feed.seen, recorder.take]
            feed.seen = lambda frame: [take(frame) for take in takers]

        def stop(number: int) -> None:
            """Take no further picture; the run ends when all taken pictures are finished."""
            feed.stop()
            source.stop()

        self.signals = stack.enter_context(StopSignals(stop))
        stack.enter_context(self.status)
        stack.enter_context(self.watchdog)
        if self.team is not None:
            self.team.begin(self.folder)
            stack.callback(self.team.finish)
        self.supervisor.say("READY=1", "STATUS=running")
        if not options.quiet:
            print_line("{}, {}x{} at {:g} Hz; into {}".format(source.name, *source.size, source.rate_hz, self.folder))
            for note in ready.notes:
                print_line(f"note: {note}")
        if not options.wait:
            self._print_page()

    def _print_page(self) -> None:
        if self.server is not None and (not self.options.quiet or self.server.access.is_made):
            print_page(self.server)

    # -- the run ------------------------------------------------------------------------------------------------------

    def process(self) -> None:
        """Process pictures until they end, the run is stopped, or the work fails repeatedly."""
        zones = self.options.zones
        self.counts = ZoneCounts(zones.zones if zones else ())
        if zones:
            self.facts["zones"] = deepcopy(self.counts.rows)
        # For a recording, times of day come from its own log, if the log has a clock.
        flight = self.ready.telemetry
        recorded_utc_s = flight.start_utc_s if self.inputs.is_recording and flight is not None else nan
        try:
            written = [stream for stream in self.streams if stream.video is None]
            with ResultWriter(written, self.about, self.health, self.live.deadline_ms) as writer:
                for located, people in results(self.path, self.feed, self.health):
                    is_settled = not located.tracks.provisional
                    located = self._add_events(located) if is_settled else located
                    start_utc_s = self.feed.exposed_utc_s if isnan(recorded_utc_s) else recorded_utc_s
                    # The last results come after the end of the stream was noticed: this is no latency.
                    newest = None if self.feed.ended else self.feed.newest
                    writer.put((located, people), start_utc_s, nan if newest is None else newest.taken_s)
                    self.lines.write(located, people, start_utc_s)
                    if self.server is not None and is_settled:
                        self.view.show(located, people)
                    if self.recorder is not None and is_settled:
                        self.recorder.show(located, people, start_utc_s)
            self.status.state = "complete" if self.signals.signal is None else "stopped"
        except RepeatedFailure as error:
            self.failure, self.status.state = str(error), "failed"
            self.health.event("run", self.failure)

    def _add_events(self, located: FrameResult) -> FrameResult:
        """Return a result with the records of other platforms, of commands and of zones."""
        zones = self.options.zones
        located = located if self.team is None else self.team.add(located)
        located = located if self.commands is None else self.commands.update(located, self.feed)
        if events := (*located.events, *(zones.update(located) if zones else ())):
            located = replace(located, events=events)
            self.counts.add(events)
            # Another thread writes the record.
            self.facts |= deepcopy({"zones": self.counts.rows, "crowd_events": self.counts.crowds})
            for event in events:
                self.health.event("zone" if event.zone else "crowd", event.describe(), event.frame)
        self.frozen.add(located)
        self.health.trouble("frozen", self.frozen.describe())
        if cause := self.tally.add(located):
            self.health.event("locate", f"not located: {cause}", located.number)
        return located

    def end(self) -> None:
        """Complete the record, and close the streams."""
        zones = self.options.zones
        self.facts["notes"] += zones.notes if zones else []
        self.facts["notes"] += self.team.finish() if self.team is not None else []
        if self.ready.watch is not None and not self.tally.located:
            self.facts["notes"].append(self.tally.describe())
            self.health.event("locate", self.tally.describe())
        self.supervisor.say("STOPPING=1")
        self.lines.close()
        if self.recorder is not None:
            self.recorder.close()
        self.opened.close()

    def tell_end(self) -> int:
        """Print the last lines, and return the exit code."""
        if not self.options.quiet:
            print_line(summarize(self.health, self.folder, self.live.deadline_ms))
        elif self.failure:  # --quiet silences events, not errors
            print_line(self.failure)
        lost = f"{RESULTS} lacks {self.streams[0].lost} lines" if self.streams[0].lost else ""
        if refused := "; ".join(filter(None, (self.status.refused, lost))):
            print_line(f"{self.folder}: {refused}; free some space or choose another --out")
        if self.failure or refused:
            return HUNG if self.failure else UNWRITTEN
        return 0 if self.signals.signal in (None, signal.SIGTERM) else 128 + self.signals.signal


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


def _open(
    opened: ExitStack, texts: Sequence[str], about: About, health: Health, live: LiveParameters, option: str
) -> list[Stream]:
    """Open streams that are closed when `opened` is. Raise InputError."""
    streams = open_streams(texts, about, health.event, live.retry_s, live.retry_most_s, option)
    for stream in streams:
        opened.callback(stream.close)
        health.ask(stream.trouble)
    return streams
