"""What is served of a live run, by path: each page is made of the run's health as it is when it is asked for."""

from collections.abc import Sequence
from typing import Protocol

from torchvision_dddas.live.health import Health
from torchvision_dddas.live.pages import health_json, html_page, metrics, trouble_of
from torchvision_dddas.live.server import Page
from torchvision_dddas.live.status import now_of
from torchvision_dddas.live.watchdog import Watchdog

_LINKS = ("/metrics", "/health.json")


class Losing(Protocol):
    """A stream that counts what nobody will get, as sinks.streams.Stream."""

    @property
    def name(self) -> str:
        """As the user wrote it."""
        ...

    @property
    def lost(self) -> int:
        """Messages that nobody will get."""
        ...


class Going(Protocol):
    """What tells how far the run is, as live.Keeping: running, complete, stopped or failed."""

    @property
    def state(self) -> str:
        """One word."""
        ...


def served(
    health: Health,
    watchdog: Watchdog,
    streams: Sequence[Losing],
    run: Going,
    name: str,
    version: str,
    patience_s: float,
) -> dict[str, Page]:
    """The pages. patience_s: no result for longer is trouble."""

    def human() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble = trouble_of(now, patience_s, watchdog.hung)
        return 200, "text/html", html_page(now, name, run.state, trouble, _LINKS)

    def prometheus() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble, lost = trouble_of(now, patience_s, watchdog.hung), {stream.name: stream.lost for stream in streams}
        return 200, "text/plain; version=0.0.4", metrics(now, version, trouble, lost)

    def program() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble = trouble_of(now, patience_s, watchdog.hung)
        facts = {"state": run.state, "input": name, "version": version, **now_of(now)}
        return (503 if trouble else 200), "application/json", health_json(facts, trouble)

    return {"/": human, "/metrics": prometheus, "/health.json": program}
