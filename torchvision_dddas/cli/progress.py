"""Progress of a command on stderr, and its output on clips: folder names, closing lines."""

import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchvision_dddas.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from torchvision_dddas.io.output import RunRecord, RunRecorder
    from torchvision_dddas.lab.evaluation.studies.jobs import JobEvent
    from torchvision_dddas.lab.evaluation.studies.runner import StudyPlan
    from torchvision_dddas.types import Source

    Hooks = tuple[Callable[[StudyPlan], None], Callable[[JobEvent], None]]

EVERY_S = 5.0


@contextmanager
def progress(name: str, count: int | None, quiet: bool) -> Iterator[Callable[[], None]]:
    """Show a bar on a terminal, or a line every few seconds elsewhere; yield a function to call after each frame.

    count: number of all frames; None if unknown.
    """
    if quiet:
        yield lambda: None
        return
    start = printed = time.monotonic()
    done = 0

    def speed() -> tuple[float, str]:
        rate_hz = done / max(time.monotonic() - start, 1e-3)
        return rate_hz, f"{rate_hz:.1f} frames/s" if rate_hz >= 0.2 else f"{1 / rate_hz:.0f} s per frame"

    if sys.stderr.isatty():
        with _bar("{task.fields[speed]}", "TimeRemainingColumn") as bar:
            task = bar.add_task(name, total=count, speed="")

            def tick() -> None:
                nonlocal done
                done += 1
                bar.update(task, advance=1, speed=speed()[1])

            yield tick
    else:

        def tick() -> None:
            nonlocal done, printed
            done += 1
            if time.monotonic() - printed >= EVERY_S:
                printed = time.monotonic()
                rate_hz, text = speed()
                total = "" if count is None else f" of {count}"
                left = "" if count is None else f", {max(count - done, 0) / rate_hz:.0f} s left"
                print_now(f"{name}: {done}{total} frames, {text}{left}")

        yield tick


@contextmanager
def show_progress(quiet: bool) -> "Iterator[Hooks]":
    """Show the progress of a study: a bar on a terminal, or elsewhere a line for each clip and every few seconds.

    Yield functions to call with the plan of the study, and with each of its events.
    """
    total = done = frames = 0
    start = printed = time.monotonic()

    def say(text: str) -> None:
        nonlocal printed
        printed = time.monotonic()
        print_now(text)

    def begin(plan: "StudyPlan") -> None:
        nonlocal total
        total = len(plan.jobs)
        say(f"{total} clip{'s' * (total != 1)}, {plan.frames} frames to process over all tasks")

    def advance(event: "JobEvent") -> None:
        nonlocal done, frames
        frames += event.frames
        if event.note:
            say(event.note)
        if event.done is not None:
            done += 1
            words = ((d.task, " left out" if d.cause else "" if d.computed else " kept") for d in event.done)
            say(f"{done} of {total}: {event.job.clip.name} ({', '.join(map(''.join, words))})")
        elif time.monotonic() - printed >= EVERY_S:
            say(f"{done} of {total} clips, {frames} frames, {frames / (time.monotonic() - start):.1f} frames/s")

    if quiet:
        yield lambda plan: None, lambda event: None
    elif sys.stderr.isatty():
        with _bar("clips, {task.fields[frames]} frames", "TimeElapsedColumn") as bar:
            task = bar.add_task("study", total=None, frames=0)

            def update(event: "JobEvent") -> None:
                nonlocal frames
                frames += event.frames
                bar.update(task, advance=event.done is not None, frames=frames, description=event.job.clip.name)
                if event.note:
                    bar.console.print(event.note, markup=False, highlight=False, soft_wrap=True)

            yield lambda plan: bar.update(task, total=len(plan.jobs)), update
    else:
        yield begin, advance


def _bar(text: str, clock: str) -> "Progress":
    """Make a bar with a text and a clock behind it. clock: the name of a column of rich."""
    from rich import progress

    columns = (
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TextColumn(text),
        getattr(progress, clock)(),
    )
    return progress.Progress(*columns, console=open_console(stderr=True), transient=True)


def print_now(line: str) -> None:
    """Print a line on stderr at once; do nothing if stderr is closed or full."""
    with suppress(OSError, ValueError):
        print(printable(line), file=sys.stderr, flush=True)


def open_console(width: int = 120, stderr: bool = False) -> "Console":
    """Open standard output or error, of the given width if it is no terminal. Names cannot control the terminal."""
    from rich.console import Console
    from rich.segment import Segment

    class PrintableConsole(Console):
        def render(self, *args: Any, **options: Any) -> Iterator[Segment]:
            for text, style, control in super().render(*args, **options):
                yield Segment(text if control else printable(text), style, control)

    stream = sys.stderr if stderr else sys.stdout
    return PrintableConsole(stderr=stderr, width=None if stream.isatty() else width)


def record_results(
    output: "RunRecorder[Any]",
    record: "RunRecord",
    results: Iterable[Any],
    name: str,
    count: int | None = None,
    quiet: bool = False,
    source: "Source | None" = None,
) -> None:
    """Write every result and show progress. The source's reading problems are recorded even if the run fails."""
    repeats = 0
    try:
        with progress(name, count, quiet) as tick:
            for result in results:
                output.write(result)
                repeats += getattr(result, "repeats", 0) > 0
                tick()
    finally:
        record.problems += [str(problem) for problem in source.problems] if source is not None else []
        record.notes += getattr(source, "notes", [])
        if concealed := getattr(source, "concealed", 0):
            record.counts["concealed"] = concealed
            record.notes.append(f"the decoder concealed errors in {concealed} frames; detections there may be damage")
        if levels := getattr(source, "levels", None):
            record.notes.append(str(levels))
    if repeats:
        record.notes.append(f"{repeats} of {record.frames} frames repeat the previous picture, and have its result")


def folders_for(inputs: Sequence[str], out: Path) -> list[Path]:
    """Return the folder for each input: `out` itself, or one folder for each of several inputs inside it."""
    return [out] if len(inputs) == 1 else [out / name for name in clip_names(inputs)]


def clip_names(inputs: Sequence[str]) -> list[str]:
    """Return a unique folder name for each input: its name, or the name of its parent for `frames` or a pattern."""
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
    """Return a command's closing lines: counts, reading problems, notes, and the files written into a folder."""
    lines = [first] if isinstance(first, str) else list(first)
    if count := len(record.problems):
        lines.append(
            f"{count} problem{'s' * (count != 1)} while reading, the first: {record.problems[0]} (all in run.json)"
        )
    if record.scale is not None:
        lines.append(record.scale.line())
    last = f"{folder}: {', '.join(files)}"
    if missing := record.counts.get("frames_without_position"):
        last += f"; {missing} of {record.frames} frames without a position; run.json lists the causes"
    return [*lines, *(f"note: {note}" for note in record.notes), last]
