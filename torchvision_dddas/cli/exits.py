"""How a command ends: its exit code, one line on stderr for what went wrong, and a standard output that fails."""

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
"""Exit codes: a fault of the program; bad input; targets and no place of any, though all else is done; standard output
that cannot be written (EX_IOERR of sysexits.h).
"""


class Ended(int):
    """The exit code of a command that a signal ended, and that said so."""


def say(text: object) -> None:
    """Print a line on stderr, without passwords; nothing where that is closed or full."""
    with suppress(OSError, ValueError):
        print(f"dddas: {' '.join(str(InputError(text)).split())}", file=sys.stderr, flush=True)


def say_fault() -> None:
    """Print the traceback of a fault of the program, without passwords."""
    with suppress(OSError, ValueError):
        print(without_secrets(traceback.format_exc()), file=sys.stderr, flush=True)


def say_stopped(number: int, kept: str) -> Ended:
    """Say which signal ended the command and what is kept; the exit code, as a shell has it."""
    say(f"{'interrupted' if number == SIGINT else f'ended by {Signals(number).name}'}; {kept or 'nothing was kept'}")
    return Ended(128 + number)


def describe_kept(error: BaseException) -> str:
    """What the notes of an exception say of what is kept."""
    return "; ".join(getattr(error, "__notes__", ()))


@contextmanager
def noting(words: Callable[[], str], has: Callable[[], Any] = lambda: True) -> Iterator[None]:
    """Note on a signal that ends the block what is kept of it, if there is anything."""
    try:
        yield
    except BaseException as error:
        if is_stop(error) and has():
            error.add_note(words())
        raise


class StandardOutput(io.FileIO):
    """Standard output whose reader may go away, or whose disk may be full: that costs its text and not the results.

    failure: the first error, None if all was written.
    """

    failure: OSError | None = None

    def write(self, content: Any) -> int:
        """Write, or note that it cannot be."""
        try:
            return super().write(content)
        except OSError as error:
            self.failure = self.failure or error
            return len(content)


def open_output() -> StandardOutput:
    """Put a StandardOutput in the place of sys.stdout. A terminal that cannot show × or ≥ shows a question mark.

    A closed standard input or error leads to nowhere: no other file may be opened with its number.
    """
    if sys.stdin is None:
        sys.stdin = open(os.devnull)  # noqa: PTH123, SIM115 (open until the process ends)
    before = sys.stdout
    if before is None:  # closed: nothing else may be opened with its number, and all that is written fails
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
    """Write what is left; the exit code, which says so if standard output failed and nothing worse happened."""
    sys.stdout.flush()
    if output.failure is None or code not in (0, NOTHING_LOCATED):
        return code
    say(f"standard output cannot be written: {output.failure.strerror}; what was printed is lost, files are whole")
    return code or OUTPUT_FAILED
