"""The output folder of a run: claimed before any work, filled item by item, valid whenever it is closed."""

import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, remove, temporary
from torchvision_dddas.io.images import MASK_NAME
from torchvision_dddas.io.output.run_record import RunRecord, read_run_record

Item = TypeVar("Item")
Whole = TypeVar("Whole")
_Taken = TypeVar("_Taken", contravariant=True)


class Part(Protocol[_Taken]):
    """A part of a run's output: tables, masks, an overlay, maps, the log."""

    def write(self, item: _Taken, /) -> None:
        """Add an item. Raises OSError if it cannot be kept."""

    def close(self, complete: bool) -> None:
        """Make the files valid and put them in their places. complete: False if the user cut the run short."""

    def discard(self) -> None:
        """Leave nothing behind that looks whole and is not. Never raises."""


class PartOf(Generic[Whole, Item]):
    """A part that is given one field of each item."""

    def __init__(self, part: Part[Item], field: Callable[[Whole], Item]) -> None:
        self._part, self._field = part, field
        self.close, self.discard = part.close, part.discard

    def write(self, item: Whole) -> None:
        """Add the field of an item."""
        self._part.write(self._field(item))


class RunRecorder(Generic[Item]):
    """Records a run in a folder: begin, write items, and leave the context.

    Leaving it normally or by Ctrl-C keeps what there is; any other exception discards what is not whole. Files begin
    with the first item, so bad input changes nothing.
    files: names of the files that a run may leave in the folder. saved: what `--save` may name.
    """

    files: ClassVar[tuple[str, ...]] = ()
    saved: ClassVar[tuple[str, ...]] = ()

    def __init__(self, folder: Path, save: Sequence[str] | None = None) -> None:
        """Claim a folder. save: which of `saved` to write, all by default.

        Raises InputError if the folder cannot be written or holds such files of another program.
        """
        self.folder = folder
        self.save = self.saved if save is None else tuple(save)
        self._made = _claim(folder, self.files)
        self._parts: list[Part[Item]] = []
        self._record: RunRecord | None = None

    @property
    def record(self) -> RunRecord:
        """The record of a run that has begun."""
        assert self._record is not None
        return self._record

    def start(self, facts: Mapping[str, Any], parts: Mapping[str, Part[Item]]) -> RunRecord:
        """Begin the record with some facts, and the parts, except those in `saved` that are not to be saved.

        Parts are written in this order and closed in the reverse; run.json is closed last.
        """
        self._record = RunRecord(self.folder, facts)
        self._parts = [part for name, part in parts.items() if name in self.save or name not in self.saved]
        return self._record

    def _count(self, item: Item) -> None:
        """Note an item in the record."""
        raise NotImplementedError

    def write(self, item: Item) -> None:
        """Write an item to every part, or to none if Ctrl-C came before. Raises InputError if the disk refuses."""
        with uninterrupted(), self._refusals():
            self._count(item)
            for part in self._parts:
                part.write(item)

    def close(self, complete: bool) -> None:
        """Put everything in its place, run.json last. Raises InputError if the disk refuses."""
        with uninterrupted(), self._refusals():
            for part in reversed(self._parts):
                part.close(complete)
            self.record.close(complete)

    def discard(self) -> None:
        """Leave only what is whole, and no folder that was made for a run that never began."""
        with uninterrupted():
            for part in reversed(self._parts):
                part.discard()
            if self._record is not None:
                self._record.discard()
            if self._record is None or self._record.frames == 0:
                for folder in self._made:
                    try:
                        folder.rmdir()
                    except OSError:  # not empty: someone else uses it
                        break

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        record = self._record
        if record is not None and isinstance(error, InputError):
            record.problems.append(str(error))
        interrupted = kind is not None and issubclass(kind, KeyboardInterrupt)
        if record is None or not (kind is None or (interrupted and record.frames > 0)):
            self.discard()
            return
        try:
            self.close(complete=not interrupted)
        except InputError as refusal:
            record.problems.append(str(refusal))
            self.discard()
            raise

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise cannot_write(Path(error.filename or self.folder), error) from error


def parse_save(names: str | None, known: Sequence[str]) -> tuple[str, ...]:
    """What to save, from `masks,overlay`, `all` (or None) or `none`. Raises InputError on a name that is not known."""
    chosen = [n.strip() for n in (names or "all").split(",") if n.strip()]
    unknown = [n for n in chosen if n not in (*known, "all", "none")]
    if unknown:
        raise InputError(f"--save must name some of {', '.join(known)}, all or none, got {unknown[0]!r}")
    return tuple(known) if "all" in chosen else tuple(n for n in known if n in chosen)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back until the block is done, so that an item is written to every file or to none."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[tuple[int, FrameType | None]] = []
    before: Any = signal.signal(signal.SIGINT, lambda number, frame: held.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if held and callable(before):
        before(*held[0])


def _claim(folder: Path, files: Sequence[str]) -> list[Path]:
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
    foreign = [folder / name for name in files if (folder / name).exists()]
    foreign += [p for p in sorted((folder / "masks").glob("*.png")) if MASK_NAME.fullmatch(p.name)]
    if foreign and read_run_record(folder) is None:
        raise InputError(
            f"{foreign[0]} was not written by dddas and would be replaced. Choose another folder with --out"
        )
    return made
