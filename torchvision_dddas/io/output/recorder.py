"""The output folder of a run. It is claimed before any work, filled item by item, and valid whenever it is closed."""

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Generic, Self, TypeVar

from torchvision_dddas.errors import InputError, LostInputError
from torchvision_dddas.io.atomic_files import ClaimedFolder, OutputPart, cannot_write
from torchvision_dddas.io.images import NUMBERED
from torchvision_dddas.io.interrupts import KEPT, is_stop, rescued_by, uninterrupted
from torchvision_dddas.io.output.run_record import RUN_JSON, RunRecord, read_run_record

# Seconds after which a disk or an encoder that writes or closes counts as stuck.
_WRITING_S = 20.0

Item = TypeVar("Item")
Whole = TypeVar("Whole")


class PartOf(Generic[Whole, Item]):
    """A part that receives one field of each item."""

    def __init__(self, part: OutputPart[Item], field: Callable[[Whole], Item]) -> None:
        self._part, self._field = part, field
        self.close, self.discard = part.close, part.discard

    def write(self, item: Whole) -> None:
        """Add the field of an item."""
        self._part.write(self._field(item))


class _Picture(Generic[Item]):
    """A part that only shows results. If it fails, a problem of the run is recorded, and the other parts continue."""

    def __init__(self, name: str, part: OutputPart[Item], record: RunRecord) -> None:
        self.failure = ""
        self._name, self._part, self._record = name, part, record
        self.discard = part.discard

    def write(self, item: Item) -> None:
        if not self.failure:
            with self._noting():
                self._part.write(item)

    def close(self, complete: bool) -> None:
        if not self.failure:
            with self._noting():
                self._part.close(complete)

    @contextmanager
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # an encoder may raise anything
            self.failure = f"the {self._name} could not be written: {getattr(error, 'strerror', None) or error}"
            self._part.discard()
            self._record.problems.append(self.failure)
            outputs = self._record.facts.get("outputs", [])
            self._record.facts["outputs"] = [name for name in outputs if name != self._name]


class RunRecorder(Generic[Item]):
    """Record a run in a folder: begin, write items, and leave the context.

    Leaving the context normally, by a signal (see `interrupts`) or by LostInputError keeps the results. Any other
    exception discards unfinished files. The first item writes `running` into run.json and removes the files of an
    earlier run, so that all files in the folder belong to one run. Bad input before the first item changes nothing.
    files: names of the files that a run may leave in the folder. numbered: folders of its pictures, 000001.png and so
    on. Both may be patterns. saved: names that `--save` accepts.
    """

    files: ClassVar[tuple[str, ...]] = ()
    numbered: ClassVar[tuple[str, ...]] = ()
    saved: ClassVar[tuple[str, ...]] = ()
    pictures: ClassVar[tuple[str, ...]] = ("overlay", "video")
    """Parts that only show results. A run continues if they fail."""

    def __init__(self, folder: Path, save: Sequence[str] | None = None) -> None:
        """Claim a folder. save: which of `saved` to write, all by default.

        Raise InputError if another run writes into the folder, if it cannot be written, or if it holds files of these
        names from another program.
        """
        self.folder = folder
        self.save = self.saved if save is None else tuple(save)
        self._claim = _claim(folder, self.files, self.numbered)
        self._open = ExitStack()
        self._lock, self._is_closed = threading.RLock(), False
        self._parts: list[OutputPart[Item]] = []
        self._record: RunRecord | None = None

    @property
    def record(self) -> RunRecord:
        """The record of a run that has begun."""
        assert self._record is not None
        return self._record

    def start(self, facts: Mapping[str, Any], parts: Mapping[str, OutputPart[Item]]) -> RunRecord:
        """Begin the record with some facts, and set the parts, without parts that the user does not save.

        Parts are written in this order and closed in the reverse order. run.json is closed last.
        """
        self._record = RunRecord(self.folder, facts)
        wanted = {name: part for name, part in parts.items() if name in self.save or name not in self.saved}
        self._parts = [
            _Picture(name, part, self._record) if name in self.pictures else part for name, part in wanted.items()
        ]
        return self._record

    def _count(self, item: Item) -> None:
        """Count an item in the record."""
        raise NotImplementedError

    def _replace_earlier(self) -> None:
        """Write `running` to run.json and remove the files of an earlier run, once."""
        if not self.record.has_begun:
            self.record.begin()
            for path in _files_of_runs(self.folder, self.files, self.numbered):
                if path.name != RUN_JSON:
                    path.unlink(missing_ok=True)

    def write(self, item: Item) -> None:
        """Write an item to every part, or to no part after `_rescue`. Raise InputError if a file cannot be written."""
        with uninterrupted(), self._lock, self._refusals():
            if self._is_closed:  # closed by `_rescue`, because the process ends
                return
            self._replace_earlier()
            self._count(item)
            for part in self._parts:
                part.write(item)

    def close(self, complete: bool) -> None:
        """Move all files to their places, run.json last. Raise InputError if a file cannot be written."""
        with uninterrupted(), self._lock, self._refusals():
            if self._is_closed:
                return
            self._is_closed = True
            self._replace_earlier()
            for part in reversed(self._parts):
                part.close(complete)
            self.record.close(complete)

    def discard(self) -> None:
        """Remove unfinished files, and a folder that was created for a run without any item."""
        with uninterrupted(), self._lock:
            self._is_closed = True
            for part in reversed(self._parts):
                part.discard()
            if self._record is not None:
                self._record.discard()
            if self._record is None or self._record.frames == 0:
                self._claim.remove_made()

    def __enter__(self) -> Self:
        self._open.callback(self._claim.release)
        self._open.enter_context(rescued_by(self._rescue))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        with self._open:
            self._end(error)

    def _end(self, error: BaseException | None) -> None:
        record = self._record
        if record is not None and isinstance(error, InputError):
            record.problems.append(str(error))
        is_cut = is_stop(error) or isinstance(error, LostInputError)
        if record is None or not (error is None or (is_cut and record.frames > 0)):
            self.discard()
            return
        try:
            self.close(complete=error is None)
        except InputError as refusal:
            record.problems.append(str(refusal))
            self.discard()
            raise
        except KeyboardInterrupt as stop:  # a signal that came while files were closed
            stop.add_note(KEPT)
            raise
        if error is not None:
            error.add_note(KEPT)
        elif failed := [part.failure for part in self._parts if isinstance(part, _Picture) and part.failure]:
            raise InputError(f"{failed[0]}; all other results are in {self.folder}")

    def _rescue(self) -> bool:
        """Close the run from another thread, when the main thread is not writing."""
        if self._record is None or not self._record.frames or not self._lock.acquire(timeout=_WRITING_S):
            return False
        try:
            self.close(complete=False)
        except InputError:
            self.discard()
            return False
        finally:
            self._claim.release()
            self._lock.release()
        return True

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise cannot_write(Path(error.filename or self.folder), error) from error


def parse_save(names: str | None, known: Sequence[str]) -> tuple[str, ...]:
    """Return the names to save, from `masks,overlay`, `all` (or None) or `none`.

    Raise InputError for an unknown name, and if no name is given.
    """
    chosen = [n.strip() for n in ("all" if names is None else names).split(",") if n.strip()]
    if not chosen:
        raise InputError(f"--save must name some of {', '.join(known)}, all or none, got {names!r}")
    unknown = [n for n in chosen if n not in (*known, "all", "none")]
    if unknown:
        raise InputError(f"--save must name some of {', '.join(known)}, all or none, got {unknown[0]!r}")
    return tuple(known) if "all" in chosen else tuple(n for n in known if n in chosen)


def _files_of_runs(folder: Path, files: Iterable[str], numbered: Iterable[str]) -> list[Path]:
    """Return the files of earlier runs in a folder. files, numbered: as in RunRecorder."""
    pictures = [path for name in numbered for path in sorted(folder.glob(f"{name}/*")) if NUMBERED.fullmatch(path.name)]
    return [path for name in files for path in folder.glob(name)] + pictures


def _claim(folder: Path, files: Sequence[str], numbered: Sequence[str]) -> ClaimedFolder:
    """Claim a folder. Raise InputError if that fails, or if it holds files of these names from another program."""
    claim = ClaimedFolder(folder)
    foreign = _files_of_runs(folder, files, {"masks", *numbered})
    if foreign and read_run_record(folder) is None:
        claim.release()
        raise InputError(
            f"{foreign[0]} was not written by dddas and would be replaced. Choose another folder with --out"
        )
    return claim
