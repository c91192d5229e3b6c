"""How far a command is, on stderr, and what it prints of its clips: folder names, closing lines."""

import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchvision_dddas.io.output import RunRecord, RunRecorder
    from torchvision_dddas.types import Source

EVERY_S = 5.0


@contextmanager
def progress(name: str, count: int | None, quiet: bool) -> Iterator[Callable[[], None]]:
    """Show a bar on a terminal, elsewhere a line every few seconds; yields a function to call after each frame.

    count: frames in all; None if the end is not known.
    """
    if quiet:
        yield lambda: None
    elif sys.stderr.isatty():
        with _bar(name, count) as tick:
            yield tick
    else:
        yield _lines(name, count)


def record_results(
    output: "RunRecorder[Any]",
    record: "RunRecord",
    results: Iterable[Any],
    name: str,
    count: int | None = None,
    quiet: bool = False,
    source: "Source | None" = None,
) -> None:
    """Write every result and show how far the clip is; the source's reading problems are recorded even if it fails."""
    try:
        with progress(name, count, quiet) as tick:
            for result in results:
                output.write(result)
                tick()
    finally:
        record.problems += [str(problem) for problem in source.problems] if source is not None else []


def folders_for(inputs: Sequence[str], out: Path) -> list[Path]:
    """Where the results of each input go: `out` itself, or one folder per input in it if there are several."""
    return [out] if len(inputs) == 1 else [out / name for name in clip_names(inputs)]


def clip_names(inputs: Sequence[str]) -> list[str]:
    """A different folder name for each input: its own name, or its parent's if it is only `frames` or a pattern."""
    names: list[str] = []
    for clip in inputs:
        path = Path(clip.rstrip("/"))
        plain = [
            p.name in ("", "frames", "images") or bool(re.search(r"[*?\[]", p.name)) for p in (path, *path.parents)
        ]
        named = path if all(plain) else (path, *path.parents)[plain.index(False)]
        name = named.stem if named == path and not path.is_dir() else named.name
        name = unique = re.sub(r"[^\w.-]+", "-", name).strip("-.") or "clip"
        for k in range(2, len(inputs) + 1):
            if unique not in names:
                break
            unique = f"{name}-{k}"
        names.append(unique)
    return names


def closing_lines(first: str | Sequence[str], record: "RunRecord", folder: Path, files: Sequence[str]) -> list[str]:
    """What a command prints at its end: counts, reading problems, notes, and the files that it wrote into a folder."""
    lines = [first] if isinstance(first, str) else list(first)
    if count := len(record.problems):
        lines.append(
            f"{count} problem{'s' * (count != 1)} while reading, the first: {record.problems[0]} (all in run.json)"
        )
    return [*lines, *(f"note: {note}" for note in record.notes), f"{folder}: {', '.join(files)}"]


@contextmanager
def _bar(name: str, count: int | None) -> Iterator[Callable[[], None]]:
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task, start, done = bar.add_task(escape(name), total=count, speed=""), time.monotonic(), 0

        def tick() -> None:
            nonlocal done
            done += 1
            bar.update(task, advance=1, speed=_format_speed(done / max(time.monotonic() - start, 1e-3)))

        yield tick


def _lines(name: str, count: int | None) -> Callable[[], None]:
    start = printed = time.monotonic()
    done = 0

    def tick() -> None:
        nonlocal printed, done
        done += 1
        now = time.monotonic()
        if now - printed >= EVERY_S:
            printed = now
            rate = done / (now - start)
            total = "" if count is None else f" of {count}"
            left = "" if count is None else f", {max(count - done, 0) / rate:.0f} s left"
            print(f"{name}: {done}{total} frames, {_format_speed(rate)}{left}", file=sys.stderr, flush=True)

    return tick


def _format_speed(rate_hz: float) -> str:
    return f"{rate_hz:.1f} frames/s" if rate_hz >= 0.2 else f"{1 / rate_hz:.0f} s per frame"
