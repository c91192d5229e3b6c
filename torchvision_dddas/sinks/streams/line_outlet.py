"""Lines into a file, a pipe or standard output: whole lines only, and never waiting for a slow reader."""

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
"""Of lines that wait for a slow reader or a full disk; of more the oldest are lost."""

_AT_ONCE = 4096  # a pipe that is ready takes so much without waiting, by POSIX at least 512
_LAST_S = 1.0  # how long closing may wait for a reader


class LineOutlet:
    """An Outlet of lines. path: None for standard output."""

    most_bytes = 0

    def __init__(self, path: Path | None) -> None:
        """Open for appending. Raises OSError if it cannot be opened."""
        self.lost = 0
        self._path = path
        self._kept: deque[bytes] = deque()
        self._kept_bytes = 0
        self._begun = 0  # bytes of the first line kept that are out already
        self._file = -1
        self._open()

    def put(self, messages: Sequence[bytes]) -> None:
        """As in Outlet."""
        for message in messages:
            self._kept.append(message)
            self._kept_bytes += len(message)
        while self._kept_bytes > KEPT_BYTES and len(self._kept) > 1:
            # A line that is half out stays: the next one must not begin in its middle.
            dropped = self._kept[1] if self._begun else self._kept[0]
            del self._kept[1 if self._begun else 0]
            self._kept_bytes -= len(dropped)
            self.lost += 1

    def flush(self) -> None:
        """As in Outlet."""
        self._follow_path()
        while self._kept:
            line = self._kept[0]
            if self._begun < len(line) and not self._ready():
                return
            try:
                # A file takes a line at once; a pipe no more than it surely has room for.
                end = len(line) if self._regular else self._begun + _AT_ONCE
                self._begun += os.write(self._file, line[self._begun : end])
            except BlockingIOError:
                return
            except OSError:
                self._take_back()
                raise
            if self._begun >= len(line):
                self._kept.popleft()
                self._kept_bytes -= len(line)
                self._begun = 0

    def mend(self) -> None:
        """As in Outlet."""
        if self._path is not None:
            self._shut()
            self._open()

    def sync(self) -> None:
        """As in Outlet."""
        if self._regular:
            os.fsync(self._file)

    def close(self) -> None:
        """As in Outlet."""
        until = time.monotonic() + _LAST_S
        with suppress(OSError):
            self.flush()
            while self._kept and time.monotonic() < until:
                self._ready(until - time.monotonic())
                self.flush()
        self.lost += len(self._kept)
        self._kept.clear()
        with suppress(OSError):
            self.sync()
        if self._path is not None:
            self._shut()

    def _open(self) -> None:
        if self._path is None:
            self._file = 1
        else:
            # Without O_NONBLOCK a named pipe that nobody reads would be waited for.
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
            self._file = os.open(self._path, flags, 0o666)
        self._regular = stat.S_ISREG(os.fstat(self._file).st_mode)
        self._begun = 0
        if self._regular and self._path is not None and _ends_within_a_line(self._path):
            os.write(self._file, b"\n")

    def _ready(self, wait_s: float = 0.0) -> bool:
        """Whether something can be written without waiting."""
        if self._regular:
            return True
        poll = select.poll()
        poll.register(self._file, select.POLLOUT)
        return bool(poll.poll(max(wait_s, 0.0) * 1000))

    def _take_back(self) -> None:
        """Take the beginning of a line that a full disk broke off out of the file again."""
        if self._regular and self._begun:
            with suppress(OSError):
                os.ftruncate(self._file, os.fstat(self._file).st_size - self._begun)
                self._begun = 0

    def _follow_path(self) -> None:
        """Open the file anew where its name was given to another, as those do that keep logs short."""
        if self._path is None or not self._regular or self._begun:
            return
        try:
            there = self._path.stat()
        except FileNotFoundError:
            there = None
        if there is None or not os.path.samestat(there, os.fstat(self._file)):
            self.mend()

    def _shut(self) -> None:
        with suppress(OSError):
            os.close(self._file)
        self._file = -1


def _ends_within_a_line(path: Path) -> bool:
    """Whether what wrote the file was killed in the middle of a line."""
    try:
        with path.open("rb") as file:
            if file.seek(0, os.SEEK_END) == 0:
                return False
            file.seek(-1, os.SEEK_END)
            return file.read(1) != b"\n"
    except OSError as error:
        if error.errno == errno.EACCES:  # may be written and not read
            return False
        raise
