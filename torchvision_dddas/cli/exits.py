"""How a command ends: its exit code, one line on stderr for an error, and a failing standard output."""

import io
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from signal import SIGINT, Signals
from typing import Any

from torchvision_dddas.errors import InputError, without_secrets
from torchvision_dddas.io.interrupts import is_stop

FAULT, BAD_INPUT, NOTHING_LOCATED, OUTPUT_FAILED = 1, 2, 3, 74
"""Exit codes: a fault of the program; bad input; a run with targets that located none of them; standard output that
cannot be written (EX_IOERR of sysexits.h).
"""


class Ended(int):
    """The exit code of a command that was ended by a signal and has reported it."""


def say(text: object) -> None:
    """Print a line on stderr, without passwords; do nothing if stderr is closed or full."""
    with suppress(OSError, ValueError):
        print(f"dddas: {' '.join(str(InputError(text)).split())}", file=sys.stderr, flush=True)


def say_fault() -> None:
    """Print the traceback of a fault of the program, without passwords."""
    with suppress(OSError, ValueError):
        print(without_secrets(traceback.format_exc()), file=sys.stderr, flush=True)


def say_stopped(number: int, kept: str) -> Ended:
    """Report which signal ended the command and what is kept, and return the exit code, as a shell does."""
    say(f"{'interrupted' if number == SIGINT else f'ended by {Signals(number).name}'}; {kept or 'nothing was kept'}")
    return Ended(128 + number)


def describe_kept(error: BaseException) -> str:
    """Return the notes of an exception, which say what is kept."""
    return "; ".join(getattr(error, "__notes__", ()))


@contextmanager
def noting(words: Callable[[], str], has: Callable[[], Any] = lambda: True) -> Iterator[None]:
    """Add a note to the exception if a signal ends the block and results are kept."""
    try:
        yield
    except BaseException as error:
        if is_stop(error) and has():
            error.add_note(words())
        raise


class StandardOutput(io.FileIO):
    """Standard output whose reader may disappear or whose disk may be full. Only its text is lost, not the results.

    failure: the first error, None if everything was written.
    """

    failure: OSError | None = None

    def write(self, content: Any) -> int:
        """Write, or record the failure."""
        try:
            return super().write(content)
        except OSError as error:
            self.failure = self.failure or error
            return len(content)


def open_output() -> StandardOutput:
    """Replace sys.stdout by a StandardOutput. A terminal that cannot show × or ≥ shows a question mark.

    A closed standard input or error is redirected to the null device, so that no other file gets its number.
    """
    if sys.stdin is None:
        sys.stdin = open(os.devnull)  # noqa: PTH123, SIM115 (open until the process ends)
    before = sys.stdout
    if before is None:  # stdout is closed: reserve its number, and let every write fail
        raw = StandardOutput(os.open(os.devnull, os.O_RDONLY), "w")
        encoding, is_terminal = "utf-8", False
    else:
        before.flush()
        raw = StandardOutput(before.fileno(), "w", closefd=False)
        encoding, is_terminal = before.encoding, before.isatty()
    buffer = io.BufferedWriter(raw)
    sys.stdout = io.TextIOWrapper(buffer, encoding, "replace", line_buffering=is_terminal)
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115
    return raw


def close_output(output: StandardOutput, code: int) -> int:
    """Write the rest, and return `code`, or OUTPUT_FAILED if only standard output failed."""
    sys.stdout.flush()
    if output.failure is None or code not in (0, NOTHING_LOCATED):
        return code
    say(f"standard output cannot be written: {output.failure.strerror}; printed text is lost, files are whole")
    return code or OUTPUT_FAILED
