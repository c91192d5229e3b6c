"""Write files completely or not at all, and let only one run at a time write into a folder.

A file is written under a hidden name beside its final place, then renamed. The writing process holds a system lock on
it, which ends with the process in every case: a hidden file without a lock was left by a killed process.
"""

import errno
import os
import re
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Protocol, TextIO, TypeVar

from torchvision_dddas.errors import InputError

with suppress(ImportError):  # without system locks, nothing is refused and no file counts as left behind
    import fcntl

LOCK = ".dddas.lock"
"""The name of the lock file that a run keeps in its folder."""

_PART = re.compile(r"\.(.+)\.[0-9a-f]{16}\.part(\.\w+)?")
_PATTERN = ".*.part*"
# The folders inside a run's folder that the run writes into.
_INNER = ("", "masks", "frames", "ground/*", "truth", "truth/masks")


_Taken = TypeVar("_Taken", contravariant=True)


class OutputPart(Protocol[_Taken]):
    """A part of a run's output: tables, masks, an overlay, maps, the log."""

    def write(self, item: _Taken, /) -> None:
        """Add an item. Raise OSError if it cannot be stored."""

    def close(self, complete: bool) -> None:
        """Make the files valid and move them to their places. complete: False if the user ended the run early."""
        return

    def discard(self) -> None:
        """Remove files that look complete but are not. Never raise."""
        return


class PartFile:
    """A file that is being written. path: its hidden name, unique to this process, with the final file's suffix.

    Raise OSError if it cannot be created.
    """

    def __init__(self, place: Path) -> None:
        self.place = place
        while True:
            name = f".{place.stem}.{secrets.token_hex(8)}.part{place.suffix}"
            self.path = place.with_name(name)
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            # Until it is locked, another process may mistake the file for one left by a killed process.
            has_lock = _lock(self._file)
            if has_lock is None or (has_lock and _is_at(self._file, self.path)):
                return
            os.close(self._file)

    def write(self, content: bytes) -> None:
        """Add bytes. Raise OSError if the disk refuses."""
        rest = memoryview(content)
        with self.naming():
            while rest:
                rest = rest[os.write(self._file, rest) :]

    def open_text(self) -> TextIO:
        """Return a text file that writes here; close it before `keep`."""
        return open(self._file, "w", encoding="utf-8", newline="", closefd=False)

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Add this file's name to an OSError of the block, if the error has no file name."""
        try:
            yield
        except OSError as error:
            error.filename = error.filename or str(self.path)
            raise

    def keep(self) -> None:
        """Move the file to its place. Raise OSError if this fails."""
        self.path.replace(self.place)
        self._close()

    def discard(self) -> None:
        """Remove the file, unless it was kept. Never raise."""
        if self._file >= 0:
            remove(self.path)
            self._close()

    def _close(self) -> None:
        file, self._file = self._file, -1
        os.close(file)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file in one step. Raise OSError if the disk refuses; then no new or temporary file remains."""
    part = PartFile(path)
    try:
        part.write(content)
        part.keep()
    except BaseException:
        part.discard()
        raise


def save_file(path: Path, content: bytes) -> None:
    """Write a file in one step, and create the folders above it. Raise InputError if the disk refuses."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)
    except OSError as error:
        raise cannot_write(path, error) from error


def remove(path: Path) -> None:
    """Remove a file if it exists and can be removed. Callers use this while they report another error to the user."""
    with suppress(OSError):
        path.unlink(missing_ok=True)


def remove_left_behind(folder: Path) -> None:
    """Remove the hidden files that killed processes left in a folder. Never raise."""
    with suppress(OSError):
        for path in folder.glob(_PATTERN):
            if _PART.fullmatch(path.name) is not None:
                with suppress(OSError), _opened(path, os.O_RDWR | os.O_NOFOLLOW) as file:
                    if stat.S_ISREG(os.fstat(file).st_mode) and _lock(file):
                        path.unlink()


class ClaimedFolder:
    """A folder that only this process writes into, until `release` or the end of the process.

    Unfinished files of killed runs are removed. made: the folders that were created, innermost first.
    Raise InputError if another run writes into the folder, or if it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.made: list[Path] = []
        self._lock = -1
        try:
            for place in (folder, *folder.parents):
                if place.exists():
                    break
                self.made.append(place)
            self._lock = self._taken()
        except OSError as error:
            self.remove_made()
            raise InputError(
                f"cannot write into {folder}: {error.strerror or error}. Choose another folder with --out"
            ) from error
        for inner in _INNER:
            for place in folder.glob(inner) if inner else [folder]:
                remove_left_behind(place)

    def _taken(self) -> int:
        path = self.folder / LOCK
        while True:
            self.folder.mkdir(parents=True, exist_ok=True)
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            if (has_lock := _lock(file)) is False:
                os.close(file)
                raise InputError(
                    f"another run is writing into {self.folder}: wait for its end, or choose another folder with --out"
                )
            if has_lock is None or _is_at(file, path):  # otherwise the previous run has removed this file
                return file
            os.close(file)

    def release(self) -> None:
        """Let other runs write into the folder. Never raise."""
        if self._lock >= 0:
            remove(self.folder / LOCK)
            file, self._lock = self._lock, -1
            os.close(file)

    def remove_made(self) -> None:
        """Release the folder, and remove the folders that were created if they are empty."""
        self.release()
        for folder in self.made:
            try:
                folder.rmdir()
            except OSError:  # not empty: someone else uses it
                break

    def __del__(self) -> None:
        self.release()


@contextmanager
def claimed(folder: Path) -> Iterator[ClaimedFolder]:
    """Claim a folder for the block, and remove it afterwards if it is empty. Raise InputError as ClaimedFolder does."""
    claim = ClaimedFolder(folder)
    try:
        yield claim
    finally:
        claim.remove_made()


def _lock(file: int) -> bool | None:
    """Lock an open file. Return False if another process has locked it, None if the system has no such locks."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except NameError:
        return None
    except OSError as error:
        return False if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


def _is_at(file: int, path: Path) -> bool:
    """Return whether an open file is still the file at a path."""
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except OSError:
        return False


def utf8_name(path: str | Path) -> str:
    """Return a name that FFmpeg can open: UTF-8, without `word:` at the beginning, which FFmpeg reads as a protocol.

    Other encodings may crash FFmpeg. For such a name, return a link to the file, which exists until the process ends.
    Raise InputError if the link cannot be made.
    """
    name = os.path.abspath(path) if ":" in str(path) else str(path)  # noqa: PTH100 (a link is not followed)
    if name.isascii():
        return name
    try:
        folder, file = os.path.split(os.fsencode(os.path.abspath(name)))  # noqa: PTH100 (a link is not followed)
        if sys.getfilesystemencoding() == "utf-8" and _is_utf8(folder + file):
            return name
        if not file.isascii():
            return _link(folder + b"/" + file)
        return f"{_link(folder)}/{file.decode()}"
    except (OSError, UnicodeEncodeError) as error:
        raise InputError(f"{name} cannot be opened under that name ({error}); give it a plain name") from None


def _is_utf8(name: bytes) -> bool:
    try:
        name.decode()
    except UnicodeDecodeError:
        return False
    return True


@cache
def _link(target: bytes) -> str:
    """Return the path of a link to a file or folder. The path is ASCII and keeps the suffix."""
    ending = re.sub(r"[^\w.]", "", Path(os.fsdecode(target)).suffix, flags=re.ASCII)
    link = Path(_links().name) / f"{secrets.token_hex(8)}{ending}"
    link.symlink_to(os.fsdecode(target))
    return str(link)


@cache
def _links() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="dddas-")


@contextmanager
def _opened(path: Path, flags: int) -> Iterator[int]:
    file = os.open(path, flags | os.O_CLOEXEC)
    try:
        yield file
    finally:
        os.close(file)


def refuse_own_input(given: Iterable[Path], written: Iterable[Path], option: str) -> None:
    """Raise InputError if a file that is read would also be written. option: the option that chooses another place."""
    places = {os.path.realpath(path) for path in written}  # unlike Path.resolve, it accepts circular links
    for path in given:
        if os.path.realpath(path) in places:
            raise InputError(f"{path} is a file that this run writes; choose another {option}")


def refuse_folder(path: Path) -> None:
    """Raise InputError if a folder is in the place of a file to be written, or if the file name is impossible."""
    try:
        folder = path.is_dir()
    except OSError as error:
        raise cannot_write(path, error) from None
    if folder:
        raise InputError(f"--out {path} is a folder; give the name of a file")


def cannot_write(path: Path, error: OSError) -> InputError:
    """Return the InputError for a file that could not be written."""
    part = _PART.fullmatch(path.name)
    place = path if part is None else path.with_name(f"{part[1]}{part[2] or ''}")
    return InputError(
        f"cannot write {place}: {error.strerror or error}. Unfinished files, such as tables being written, "
        "are removed; free some space or choose another --out"
    )
