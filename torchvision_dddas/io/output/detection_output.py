"""A run's output folder: claimed before any work, filled frame by frame, valid whenever it is closed."""

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, remove, temporary
from torchvision_dddas.io.images import MASK_NAME, Masks
from torchvision_dddas.io.output import run_record as journal
from torchvision_dddas.io.output.run_record import Journal, Record
from torchvision_dddas.io.overlay import OverlayVideo, draw_scene
from torchvision_dddas.io.tables import detection_tables
from torchvision_dddas.types import Scene

SAVED = ("masks", "overlay")
"""What --save may name. The tables and run.json are always written."""

Item = TypeVar("Item")
_Taken = TypeVar("_Taken", contravariant=True)


class Sink(Protocol[_Taken]):
    """A place where scenes, or followed frames, go one after another."""

    def write(self, item: _Taken, /) -> None:
        """Take a scene. Raises OSError if it cannot be kept."""

    def close(self, complete: bool) -> None:
        """Make the output valid and put it in its place; complete is False if the clip was cut short by the user."""

    def discard(self) -> None:
        """Leave nothing behind that looks whole and is not. Never raises."""


def saved(names: str | None, known: Sequence[str] = SAVED) -> tuple[str, ...]:
    """What to save, from `masks,overlay`, `all` (or None) or `none`. Raises InputError on a name that is not known."""
    chosen = [n.strip() for n in (names or "all").split(",") if n.strip()]
    unknown = [n for n in chosen if n not in (*known, "all", "none")]
    if unknown:
        raise InputError(f"--save does not know {unknown[0]!r}; there are {', '.join(known)}, all and none")
    return tuple(known) if "all" in chosen else tuple(n for n in known if n in chosen)


class RunFolder(Generic[Item]):
    """Everything that one run writes. A context manager: leaving it normally or by Ctrl-C keeps what there is.

    Any other exception discards what is not whole. Files are begun with the first item, so bad input changes nothing.
    files: the names of those that a run may leave in the folder.
    """

    files: ClassVar[tuple[str, ...]] = ("overlay.mp4", journal.NAME)

    def __init__(self, folder: Path, save: Sequence[str]) -> None:
        """Claim a folder. Raises InputError if it cannot be written, or holds such files of someone else."""
        self.folder = folder
        self._save = tuple(save)
        self._made = _claim(folder, self.files)
        self._sinks: list[Sink[Item]] = []
        self.journal: Record | None = None

    def write(self, item: Item) -> None:
        """Write an item to every sink, or to none if Ctrl-C came before. Raises InputError if the disk refuses."""
        with uninterrupted(), self._refusals():
            for sink in self._sinks:
                sink.write(item)

    def close(self, complete: bool) -> None:
        """Put everything in its place, run.json last. Raises InputError if the disk refuses."""
        with uninterrupted(), self._refusals():
            for sink in reversed(self._sinks):
                sink.close(complete)

    def discard(self) -> None:
        """Leave only what is whole; and no folder, if it was made for a run that never began."""
        with uninterrupted():
            for sink in reversed(self._sinks):
                sink.discard()
            if self.journal is None or self.journal.frames == 0:
                for folder in self._made:
                    try:
                        folder.rmdir()
                    except OSError:  # not empty: someone else uses it
                        break

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self.journal is not None and isinstance(error, InputError):
            self.journal.problems = [*self.journal.problems, str(error)]
        interrupted = kind is not None and issubclass(kind, KeyboardInterrupt)
        begun = self.journal is not None and (self.journal.frames > 0 or kind is None)
        if self.journal is not None and begun and (kind is None or interrupted):
            try:
                self.close(complete=not interrupted)
            except InputError as refusal:
                self.journal.problems = [*self.journal.problems, str(refusal)]
                self.discard()
                raise
        else:
            self.discard()

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise cannot_write(Path(error.filename or self.folder), error) from error


class Output(RunFolder[Scene]):
    """The folder of a run that gives scenes: tables, masks, overlay."""

    files = ("detections.txt", "detections.csv", *RunFolder.files)

    def __init__(self, folder: Path, save: Sequence[str] = SAVED) -> None:
        """Claim a folder, as in RunFolder."""
        super().__init__(folder, save)

    def begin(self, facts: dict[str, Any], rate_hz: float) -> Journal:
        """Say what the run is, for run.json, and how fast the overlay plays. Returns the journal that keeps count."""
        self.journal = kept = Journal(self.folder, {**facts, "outputs": ["tables", *self._save]})
        self._sinks = [kept, detection_tables(self.folder)]
        if "masks" in self._save:
            self._sinks.append(Masks(self.folder))
        if "overlay" in self._save:
            self._sinks.append(OverlayVideo(self.folder, rate_hz, draw_scene))
        return kept


def _claim(folder: Path, ours: Sequence[str]) -> list[Path]:
    """Make the folder and try to write there. Returns the folders made, innermost first."""
    made: list[Path] = []
    probe = temporary(folder / "probe")
    try:
        for place in (folder, *folder.parents):
            if place.exists():
                break
            made.append(place)
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        remove(probe)
        raise InputError(
            f"cannot write into {folder}: {error.strerror or error}. Choose another folder with --out"
        ) from error
    foreign = [folder / name for name in ours if (folder / name).exists()]
    foreign += [p for p in sorted((folder / "masks").glob("*.png")) if MASK_NAME.fullmatch(p.name)]
    if foreign and journal.read(folder) is None:
        raise InputError(
            f"{foreign[0]} was not written by dddas and would be replaced. Choose another folder with --out"
        )
    return made


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back until the block is done, so that a frame is written to every file or to none."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[tuple[int, FrameType | None]] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: held.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if held and callable(before):
        before(*held[0])
