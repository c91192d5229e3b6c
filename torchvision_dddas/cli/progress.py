"""How far a clip is, on stderr: a bar on a terminal, a plain line every few seconds elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

EVERY_S = 5.0


@contextmanager
def progress(name: str, count: int | None, quiet: bool) -> Iterator[Callable[[], None]]:
    """Yield a function to call once a frame. count is None where the end is not known."""
    if quiet:
        yield lambda: None
    elif sys.stderr.isatty():
        with _bar(name, count) as tick:
            yield tick
    else:
        yield _lines(name, count)


@contextmanager
def _bar(name: str, count: int | None) -> Iterator[Callable[[], None]]:
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[pace]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task, start, done = bar.add_task(escape(name), total=count, pace=""), time.monotonic(), 0

        def tick() -> None:
            nonlocal done
            done += 1
            bar.update(task, advance=1, pace=_pace(done / max(time.monotonic() - start, 1e-3)))

        yield tick


def _lines(name: str, count: int | None) -> Callable[[], None]:
    start = told = time.monotonic()
    done = 0

    def tick() -> None:
        nonlocal told, done
        done += 1
        now = time.monotonic()
        if now - told >= EVERY_S:
            told = now
            rate = done / (now - start)
            total = "" if count is None else f" of {count}"
            left = "" if count is None else f", {max(count - done, 0) / rate:.0f} s left"
            print(f"{name}: {done}{total} frames, {_pace(rate)}{left}", file=sys.stderr, flush=True)

    return tick


def _pace(rate_hz: float) -> str:
    """Frames a second, or where that is little seconds a frame."""
    return f"{rate_hz:.1f} frames/s" if rate_hz >= 0.2 else f"{1 / rate_hz:.0f} s a frame"
