"""Writes whole lines into a file, a pipe or standard output, and never waits for a slow reader."""

import errno
import os
import select
import stat
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

KEPT_BYTES = 1 << 20
"""Lines that wait for a slow reader or for room on the disk; beyond this the oldest are lost."""

_AT_ONCE = 4096  # Linux: a pipe that is ready takes so much without waiting, and in one piece
_LAST_S = 1.0  # how long closing may wait for a reader
_WORDS = {errno.EPIPE: "nobody reads it", errno.ENXIO: "nobody reads it"}


class LineOutlet:
    """An Outlet of lines. path: None for standard output, which is never closed."""

    most_bytes = 0

    def __init__(self, path: Path | None) -> None:
        """Open for appending. Raises OSError if it cannot be opened."""
        self.lost, self.reason = 0, ""
        self._path = path
        self._kept: deque[bytes] = deque()
        self._kept_bytes = 0
        self._begun = 0  # bytes of the first line kept that are written already
        self._file, self._regular = -1, False
        try:
            self._open()
        except OSError:
            self._shut()
            raise

    def put(self, messages: Sequence[bytes]) -> None:
        """As in Outlet."""
        for message in messages:
            self._kept.append(message)
            self._kept_bytes += len(message)
        while self._kept_bytes > KEPT_BYTES and len(self._kept) > 1:
            # A line that is partly written stays, so that the next one does not begin in its middle.
            oldest = 1 if self._begun else 0
            self._kept_bytes -= len(self._kept[oldest])
            del self._kept[oldest]
            self.lost += 1
            self.reason = "it is read too slowly"

    def flush(self) -> None:
        """As in Outlet."""
        self._follow_path()
        while self._kept and self._ready():
            line = self._kept[0]
            # A file takes a line at once; a pipe no more than it surely has room for.
            end = len(line) if self._regular else self._begun + _AT_ONCE
            try:
                self._begun += os.write(self._file, line[self._begun : end])
            except BlockingIOError:
                return
            except OSError as error:
                self._take_back()
                raise _explained(error) from error
            if self._begun >= len(line):
                self._kept.popleft()
                self._kept_bytes -= len(line)
                self._begun = 0

    def mend(self) -> None:
        """As in Outlet."""
        if self._path is not None:
            self._shut()
            self._open()

    def handle(self) -> int | None:
        """As in Outlet."""
        return os.dup(self._file) if self._regular and self._file >= 0 else None

    def close(self) -> None:
        """As in Outlet."""
        until = time.monotonic() + _LAST_S
        with suppress(OSError):
            if self._file < 0:
                self.mend()
            self.flush()
            while self._kept and time.monotonic() < until:
                self._ready(until - time.monotonic())
                self.flush()
            if self._regular:
                os.fsync(self._file)
        if self._kept:
            self.lost += len(self._kept)
            self.reason = "it was not taken in time"
            self._kept.clear()
        self._shut()

    def _open(self) -> None:
        if self._path is None:
            self._file = 1
        else:
            # Without O_NONBLOCK a named pipe that nobody reads would be waited for.
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
            try:
                self._file = os.open(self._path, flags, 0o666)
            except OSError as error:
                raise _explained(error) from error
        self._regular = stat.S_ISREG(os.fstat(self._file).st_mode)
        self._begun = 0
        if self._regular and self._path is not None and _ends_within_a_line(self._path):
            os.write(self._file, b"\n")

    def _ready(self, wait_s: float = 0.0) -> bool:
        """Whether something can be written without waiting, or would fail at once."""
        if self._regular:
            return True
        poll = select.poll()
        poll.register(self._file, select.POLLOUT)
        return bool(poll.poll(max(wait_s, 0.0) * 1000))

    def _take_back(self) -> None:
        """Truncate the beginning of a line that a full disk cut off, if it is at the file's end."""
        if not (self._regular and self._begun):
            return
        with suppress(OSError):
            end = os.lseek(self._file, 0, os.SEEK_CUR)
            if end == os.fstat(self._file).st_size:
                os.ftruncate(self._file, end - self._begun)
                os.lseek(self._file, end - self._begun, os.SEEK_SET)
                self._begun = 0

    def _follow_path(self) -> None:
        """Open the file anew if it was renamed, as log rotation does."""
        if self._path is None or not self._regular or self._begun:
            return
        try:
            same = os.path.samestat(self._path.stat(), os.fstat(self._file))
        except FileNotFoundError:
            same = False
        if not same:
            self.mend()

    def _shut(self) -> None:
        if self._path is not None and self._file >= 0:
            with suppress(OSError):
                os.close(self._file)
        self._file = -1


def _ends_within_a_line(path: Path) -> bool:
    """Whether what wrote the file before was killed in the middle of a line."""
    try:
        with path.open("rb") as file:
            if file.seek(0, os.SEEK_END) == 0:
                return False
            file.seek(-1, os.SEEK_END)
            return file.read(1) != b"\n"
    except PermissionError:  # it may be written and not read
        return False


def _explained(error: OSError) -> OSError:
    return OSError(error.errno, _WORDS.get(error.errno or 0, error.strerror or str(error)))
