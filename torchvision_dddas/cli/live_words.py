"""What a person at the terminal is told of a live run; to stderr, as stdout is for streams."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from torchvision_dddas.io.output import Event
    from torchvision_dddas.live import Health, Snapshot

_CLEAR = "\r\x1b[K"


def say(text: str) -> None:
    """A line of its own."""
    clear = _CLEAR if sys.stderr.isatty() else ""
    typer.echo(f"{clear}dddas: {' '.join(text.split())}", err=True)


def say_event(event: "Event") -> None:
    """With the frame that it belongs to, if any."""
    say(f"frame {event.frame}: {event.text}" if event.frame else event.text)


def show(now: "Snapshot") -> None:
    """How it goes: one line on a terminal, in the place of the one before; nothing elsewhere."""
    if not sys.stderr.isatty():
        return
    late = f", {1000 * now.seconds['latency'][0]:.0f} ms late" if "latency" in now.seconds else ""
    counts, gauges = now.counts, now.gauges
    typer.echo(
        f"{_CLEAR}{gauges.get('rate_hz', 0.0):.1f} results/s{late}, {gauges.get('targets', 0):g} targets, "
        f"{counts.get('dropped', 0)} of {counts.get('captured', 0)} pictures dropped",
        err=True,
        nl=False,
    )


def say_nothing(what: object) -> None:
    """Where --quiet asks for it."""


def summary(health: "Health", folder: Path) -> str:
    """What came of it, in a line."""
    now = health.snapshot()
    counts = {name: now.counts.get(name, 0) for name in ("results", "captured", "dropped", "late")}
    late = f", {1000 * now.seconds['latency'][2]:.0f} ms at 99 %" if "latency" in now.seconds else ""
    return (
        f"{counts['results']} results of {counts['captured']} pictures, {counts['dropped']} dropped, "
        f"{counts['late']} late{late}; {folder}"
    )
