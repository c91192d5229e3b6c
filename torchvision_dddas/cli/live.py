"""`dddas run --live`: the whole path on pictures as they come, for as long as they come."""

import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from torchvision_dddas import __version__
from torchvision_dddas.cli.aerial import AerialInput, about
from torchvision_dddas.cli.mistakes import INTERRUPTED
from torchvision_dddas.cli.prepared import Prepared, prepared

if TYPE_CHECKING:
    from torchvision_dddas.live import Event, Health, LiveSource, Snapshot
    from torchvision_dddas.live.runner import Feed, Result
    from torchvision_dddas.live.serving import Page
    from torchvision_dddas.live.watchdog import Watchdog
    from torchvision_dddas.settings import Settings
    from torchvision_dddas.sinks.streams import Stream
    from torchvision_dddas.types import Adjustment, Frame

_CLEAR = "\r\x1b[K"
_COUNTED = ("captured", "dropped", "looked_at", "undecoded", "reconnects", "results", "late", "begun_anew")
_SECRET = re.compile(r"(?<=://)[^/@\s]*@")


def run_live(
    out: Path,
    clip: str,
    given: AerialInput | None,
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
    from torchvision_dddas.live import Health, LiveSource
    from torchvision_dddas.live.keeping import Keeping
    from torchvision_dddas.live.runner import Failing, Feed, hand_on, results, told
    from torchvision_dddas.live.serving import Page, Serving, address_of
    from torchvision_dddas.live.stopping import Stopping
    from torchvision_dddas.live.watchdog import HUNG, Supervisor, Watchdog
    from torchvision_dddas.sinks.session import RESULTS, SessionLog, claim
    from torchvision_dddas.sinks.streams import About, open_streams
    from torchvision_dddas.sinks.whole import cannot_write

    address = None if serve is None else address_of(serve)
    health, supervisor, live = Health(), Supervisor(), settings.live
    for name in _COUNTED:  # a count that is there from the start can be told from one that is missing
        health.count(name, 0)
    with ExitStack() as stack:
        source = stack.enter_context(closing(LiveSource(clip, live, health, rate_hz=rate_hz)))
        ready = prepared(given, telemetry, settings, source, backend, clip)
        begin = _path(ready, source, people, interval, backend, health)
        site = None if ready.watch is None else ready.watch.locator.site
        said = About(
            time.time(), *((False, ()) if site is None else (site.origin_deg is not None, site.landmarks.names))
        )
        opened = stack.enter_context(ExitStack())
        streams = _closing(opened, open_streams(emit, said, health.event, live.retry_s, live.retry_most_s))
        watchdog = Watchdog(health, live.watchdog_s, supervisor)
        pages = dict[str, Page]()
        serving = None if address is None else Serving(address, pages)
        folder = claim(out)
        own = [f"json:{folder / RESULTS}"]
        streams = (
            _closing(opened, open_streams(own, said, health.event, live.retry_s, live.retry_most_s, "--out")) + streams
        )
        log = SessionLog(folder, _facts(clip, ready, given, telemetry, source, interval, people))
        stack.callback(log.close)
        keeping = Keeping(
            health,
            log,
            streams,
            live.status_s,
            (lambda event: None) if quiet else _say,
            _show if sys.stderr.isatty() and not quiet else (lambda now: None),
        )
        try:
            keeping.begin()
        except OSError as error:
            raise cannot_write(folder / "run.json", error) from None
        pages |= _pages(
            health, watchdog, keeping, streams, _SECRET.sub("", clip), max(2 * live.stall_s, 30 / source.rate_hz)
        )
        feed = Feed(source, health, watchdog, ready.flight)
        stopping = stack.enter_context(Stopping(lambda number: (feed.stop(), source.stop())))
        for context in (keeping, watchdog, *([serving] if serving is not None else [])):
            stack.enter_context(context)
        supervisor.say("READY=1")
        if not quiet:
            width, height = source.size
            _say_line(f"{_SECRET.sub('', source.name)}, {width}x{height} at {source.rate_hz:g} Hz; into {folder}")
            if serving is not None:
                _say_line("how it goes: http://{}:{}/".format(*serving.address))
        code = 0
        try:
            for result in results(begin, feed, health):
                said.start_utc_s = source.start_utc_s
                hand_on(result, streams, health)
                told(result, feed, health, live.deadline_ms)
            keeping.state = "complete" if stopping.signal is None else "stopped"
        except Failing as error:
            health.event("run", str(error))
            keeping.state, code = "failed", HUNG
            if quiet:  # which errors are not
                _say_line(str(error))
        supervisor.say("STOPPING=1")
        opened.close()
    if not quiet:
        _say_line(_summary(health, folder))
    return INTERRUPTED if stopping.signal == signal.SIGINT and not code else code


def _path(
    ready: Prepared, source: "LiveSource", people: bool, interval: int, backend: str, health: "Health"
) -> "Callable[[Feed], Iterator[Result]]":
    """The path from pictures to results, begun anew each time that it is called. Raises InputError at once."""
    from torchvision_dddas.live.shedding import Shedding
    from torchvision_dddas.settings import with_knobs
    from torchvision_dddas.surveying import survey
    from torchvision_dddas.vision import load

    settings, recognizer = ready.settings, None
    if people:
        from torchvision_dddas.recognizing import recognizer_of
        from torchvision_dddas.spotting import Spotter

        settings = with_knobs(settings, {"people.search": "regions"})
        recognizer = recognizer_of(settings.people, backend)
        Spotter(recognizer, settings, interval, source.size)  # pictures that are too small are told now
    shedding = Shedding(source, settings, health, people)

    visions = iter([ready.vision])

    def begin(feed: "Feed") -> "Iterator[Result]":
        # After an error nothing that remembers a frame is trusted.
        vision = next(visions, None) or load(backend, shedding.settings)
        spotter = None if recognizer is None else Spotter(recognizer, shedding.settings, interval, source.size)
        watch = None if ready.watch is None else ready.watch.anew()

        def retune(frame: "Frame") -> "tuple[Settings, tuple[Adjustment, ...]]":
            settings, moved = shedding(frame)
            if spotter is not None and moved:
                spotter.use(settings)
            return settings, moved

        seen = None if spotter is None else spotter.see
        path = survey(feed, vision, shedding.settings, None, watch, interval, seen=seen, retune=retune)
        for surveyed in path:
            yield surveyed, None if spotter is None else spotter.of(surveyed.followed.number, feed.ended)

    return begin


def _facts(
    clip: str,
    ready: Prepared,
    given: AerialInput | None,
    telemetry: Path | None,
    source: "LiveSource",
    interval: int,
    people: bool,
) -> dict[str, Any]:
    """What run.json says beside how it goes."""
    located = {} if given is None or ready.watch is None else {**given.facts, **about(ready.watch.locator)}
    return {
        "input": _SECRET.sub("", clip),
        "telemetry": telemetry,
        "clip": {"name": _SECRET.sub("", source.name), "size": source.size, "rate_hz": source.rate_hz},
        "interval_frames": interval,
        "people": people,
        "backend": ready.vision.name,
        "notes": ready.notes,
        **located,
        "settings": ready.settings.model_dump(),
    }


def _pages(
    health: "Health", watchdog: "Watchdog", keeping: Any, streams: "Sequence[Stream]", name: str, patience_s: float
) -> "dict[str, Page]":
    """What is served, by path."""
    from torchvision_dddas.live.keeping import now_of
    from torchvision_dddas.live.pages import health_json, html_page, metrics, trouble_of

    links = ("/metrics", "/health.json")

    def human() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble = trouble_of(now, patience_s, watchdog.hung)
        return 200, "text/html", html_page(now, name, keeping.state, trouble, links)

    def prometheus() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble, lost = trouble_of(now, patience_s, watchdog.hung), {stream.name: stream.lost for stream in streams}
        return 200, "text/plain; version=0.0.4", metrics(now, __version__, trouble, lost)

    def program() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble = trouble_of(now, patience_s, watchdog.hung)
        state = {"state": keeping.state, "input": name, "version": __version__, **now_of(now)}
        return (503 if trouble else 200), "application/json", health_json(state, trouble)

    return {"/": human, "/metrics": prometheus, "/health.json": program}


def _closing(opened: ExitStack, streams: "list[Stream]") -> "list[Stream]":
    for stream in streams:
        opened.callback(stream.close)
    return streams


def _say(event: "Event") -> None:
    _say_line(f"frame {event.frame}: {event.text}" if event.frame else event.text)


def _say_line(text: str) -> None:
    """To stderr: stdout is for streams."""
    clear = _CLEAR if sys.stderr.isatty() else ""
    typer.echo(f"{clear}dddas: {' '.join(text.split())}", err=True)


def _show(now: "Snapshot") -> None:
    """One line on a terminal, in the place of the one before."""
    late = f", {1000 * now.seconds['latency'][0]:.0f} ms late" if "latency" in now.seconds else ""
    counts, gauges = now.counts, now.gauges
    typer.echo(
        f"{_CLEAR}{gauges.get('rate_hz', 0.0):.1f} results/s{late}, {gauges.get('targets', 0):g} targets, "
        f"{counts.get('dropped', 0)} of {counts.get('captured', 0)} pictures dropped",
        err=True,
        nl=False,
    )


def _summary(health: "Health", folder: Path) -> str:
    now = health.snapshot()
    counts = {name: now.counts.get(name, 0) for name in ("results", "captured", "dropped", "late")}
    late = f", {1000 * now.seconds['latency'][2]:.0f} ms at 99 %" if "latency" in now.seconds else ""
    return (
        f"{counts['results']} results of {counts['captured']} pictures, {counts['dropped']} dropped, "
        f"{counts['late']} late{late}; {folder}"
    )
