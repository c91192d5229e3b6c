"""`dddas run --live`: the whole path on pictures as they come, for as long as they come."""

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchvision_dddas.cli import live_words
from torchvision_dddas.cli.live_path import path
from torchvision_dddas.cli.options import INTERRUPTED
from torchvision_dddas.runtime import VERSION

if TYPE_CHECKING:
    from torchvision_dddas.config import LiveParameters, Settings
    from torchvision_dddas.io.run_inputs import AerialInput, PreparedRun
    from torchvision_dddas.io.streams import About, Stream
    from torchvision_dddas.live import Health, LiveSource
    from torchvision_dddas.live.runner import Feed, Result
    from torchvision_dddas.live.server import HealthServer
    from torchvision_dddas.live.status import StatusWriter

_COUNTED = ("captured", "dropped", "looked_at", "undecoded", "reconnects", "results", "late", "begun_anew")


def run_live(
    out: Path,
    clip: str,
    given: "AerialInput | None",
    telemetry: Path | None,
    interval: int,
    settings: "Settings",
    backend: str = "auto",
    emit: Sequence[str] = (),
    serve: str | None = None,
    people: bool = False,
    rate_hz: float | None = None,
    quiet: bool = False,
) -> int:
    """Run until the pictures end or someone ends it; returns the exit code. Writes a folder of its own under out.

    Raises InputError for anything that is wrong at the start; what goes wrong later is an event.
    """
    from torchvision_dddas.detection import check_length
    from torchvision_dddas.io.output import RESULTS, make_session_folder
    from torchvision_dddas.io.run_inputs import prepare_run
    from torchvision_dddas.io.video import without_secrets
    from torchvision_dddas.live import LiveSource
    from torchvision_dddas.live.runner import Feed, RepeatedFailure
    from torchvision_dddas.live.server import HealthServer, Page, health_pages, parse_address
    from torchvision_dddas.live.watchdog import HUNG, StopSignals, Supervisor, Watchdog

    address = None if serve is None else parse_address(serve)
    health, supervisor, live = _health(), Supervisor(), settings.live
    with ExitStack() as stack:
        # What may be wrong at the start is found before the session has a folder.
        source = stack.enter_context(closing(LiveSource(clip, live, health, rate_hz=rate_hz)))
        if source.recorded is not None:
            check_length(source.recorded)
        ready = prepare_run(given, telemetry, settings, source, backend, clip)
        begin = path(ready, source, people, interval, backend, health)
        said, opened = _about(ready), stack.enter_context(ExitStack())
        streams = _opened(opened, emit, said, health, live, "--emit")
        pages = dict[str, Page]()
        serving = None if address is None else HealthServer(address, pages)

        folder = make_session_folder(out)
        streams = _opened(opened, [f"json:{folder / RESULTS}"], said, health, live, "--out") + streams
        facts = _facts(clip, ready, given, telemetry, source, interval, people)
        keeping = _kept(stack, folder, facts, health, streams, live.status_s, quiet)
        watchdog = Watchdog(health, live.watchdog_s, supervisor)
        patience_s = max(2 * live.stall_s, 30 / source.rate_hz)
        pages |= health_pages(health, watchdog, streams, keeping, without_secrets(clip), VERSION, patience_s)

        feed = Feed(source, health, watchdog, ready.flight)
        stopping = stack.enter_context(StopSignals(_ending(feed, source)))
        stack.enter_context(keeping)
        stack.enter_context(watchdog)
        if serving is not None:
            stack.enter_context(serving)
        supervisor.say("READY=1")
        if not quiet:
            _say_start(source, folder, serving, ready.notes)
        failed = ""
        try:
            _work(begin, feed, source, streams, said, health, live.deadline_ms)
            keeping.state = "complete" if stopping.signal is None else "stopped"
        except RepeatedFailure as error:
            failed, keeping.state = str(error), "failed"
            health.event("run", failed)
        supervisor.say("STOPPING=1")
        opened.close()
    if not quiet:
        live_words.say(live_words.summary(health, folder))
    elif failed:  # events are quiet, errors are not
        live_words.say(failed)
    if failed:
        return HUNG
    return INTERRUPTED if stopping.signal == signal.SIGINT else 0


def _health() -> "Health":
    from torchvision_dddas.live import Health

    health = Health()
    for name in _COUNTED:  # a count that is there from the start can be told from one that is missing
        health.count(name, 0)
    return health


def _about(ready: "PreparedRun") -> "About":
    """What streams need to know; the clock's time follows the source."""
    from torchvision_dddas.io.streams import About

    if ready.watch is None:
        return About(time.time())
    site = ready.watch.locator.site
    return About(time.time(), site.origin_deg is not None, site.landmarks.names)


def _opened(
    opened: ExitStack, texts: Sequence[str], said: "About", health: "Health", live: "LiveParameters", option: str
) -> "list[Stream]":
    """Streams that are closed when `opened` is. Raises InputError."""
    from torchvision_dddas.io.streams import open_streams

    streams = open_streams(texts, said, health.event, live.retry_s, live.retry_most_s, option)
    for stream in streams:
        opened.callback(stream.close)
    return streams


def _kept(
    stack: ExitStack,
    folder: Path,
    facts: dict[str, Any],
    health: "Health",
    streams: "Sequence[Stream]",
    status_s: float,
    quiet: bool,
) -> "StatusWriter":
    """What keeps the folder's record, written a first time. Raises InputError where that cannot be."""
    from torchvision_dddas.io.atomic_files import cannot_write
    from torchvision_dddas.io.output import SessionLog
    from torchvision_dddas.live.status import StatusWriter

    log = SessionLog(folder, facts)
    stack.callback(log.close)
    say, show = (live_words.say_nothing,) * 2 if quiet else (live_words.say_event, live_words.show)
    keeping = StatusWriter(health, log, streams, status_s, say, show)
    try:
        keeping.begin()
    except OSError as error:
        raise cannot_write(folder / "run.json", error) from None
    return keeping


def _facts(
    clip: str,
    ready: "PreparedRun",
    given: "AerialInput | None",
    telemetry: Path | None,
    source: "LiveSource",
    interval: int,
    people: bool,
) -> dict[str, Any]:
    """What run.json says beside how it goes."""
    from torchvision_dddas.io.run_inputs import locator_facts
    from torchvision_dddas.io.video import without_secrets

    located = {} if given is None or ready.watch is None else {**given.facts, **locator_facts(ready.watch.locator)}
    return {
        "input": without_secrets(clip),
        "telemetry": telemetry,
        "clip": {"name": source.name, "size": source.size, "rate_hz": source.rate_hz},
        "interval_frames": interval,
        "people": people,
        "backend": ready.engine.name,
        "notes": ready.notes,
        **located,
        "settings": ready.settings.model_dump(),
    }


def _ending(feed: "Feed", source: "LiveSource") -> Callable[[int], None]:
    """What a signal asks for: no further picture, and an end once those that were seen are settled."""

    def end(number: int) -> None:
        feed.stop()
        source.stop()

    return end


def _say_start(source: "LiveSource", folder: Path, serving: "HealthServer | None", notes: Sequence[str]) -> None:
    width, height = source.size
    live_words.say(f"{source.name}, {width}x{height} at {source.rate_hz:g} Hz; into {folder}")
    if serving is not None:
        live_words.say("how it goes: http://{}:{}/".format(*serving.address))
    for note in notes:
        live_words.say(f"note: {note}")


def _work(
    begin: "Callable[[Feed], Iterator[Result]]",
    feed: "Feed",
    source: "LiveSource",
    streams: "Sequence[Stream]",
    said: "About",
    health: "Health",
    deadline_ms: float,
) -> None:
    """Hand on results until the pictures end. Raises RepeatedFailure where none come any more."""
    from torchvision_dddas.live.runner import record_result, results, send_result

    for result in results(begin, feed, health):
        said.start_utc_s = source.start_utc_s
        send_result(result, streams, health)
        record_result(result, feed, health, deadline_ms)
