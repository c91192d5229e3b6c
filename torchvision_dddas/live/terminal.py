"""Lines of a live run on the terminal. They go to stderr, because stdout is for streams."""

import sys
from pathlib import Path

from torchvision_dddas.errors import printable
from torchvision_dddas.io.output import Event
from torchvision_dddas.live.health import Health, Snapshot
from torchvision_dddas.live.server import HealthServer

_CLEAR = "\r\x1b[K"


def print_line(text: str) -> None:
    """Print a line, in place of the line of the state."""
    clear = _CLEAR if sys.stderr.isatty() else ""
    sys.stderr.write(f"{clear}dddas: {printable(' '.join(text.split()))}\n")
    sys.stderr.flush()


def print_page(server: HealthServer) -> None:
    """Print the address of the page."""
    print_line(f"status page: {server.url}")


def print_event(event: Event) -> None:
    """Print an event."""
    print_line(f"frame {event.frame}: {event.text}" if event.frame else event.text)


def print_snapshot(now: Snapshot) -> None:
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


def summarize(health: Health, folder: Path, deadline_ms: float) -> str:
    """Return the last line of a run: the numbers of results, pictures and losses, the latency, and the folder."""
    now = health.snapshot()
    counts = {name: now.counts.get(name, 0) for name in ("results", "captured", "dropped", "late")}
    within = f", 99 % within {1000 * now.seconds['latency'][2]:.0f} ms" if "latency" in now.seconds else ""
    return (
        f"{counts['results']} results of {counts['captured']} pictures, {counts['dropped']} dropped, "
        f"{counts['late']} late (over {deadline_ms:g} ms){within}; {folder}"
    )
