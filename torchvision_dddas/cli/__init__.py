"""The command line, `dddas`: one file per command. This file imports nothing slow, so that signals work early."""

import os
import signal
from contextlib import suppress
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchvision_dddas.cli.commands import app as app


def main() -> None:
    """Entry point. Exit codes: see docs/commands.md."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _end)  # until the commands are loaded and set their own handlers
    from torchvision_dddas.cli.commands import run_command_line

    run_command_line()


def _end(number: int, frame: FrameType | None) -> None:
    """Report a signal as `say_stopped` does, which is not loaded yet."""
    how = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
    with suppress(OSError):
        os.write(2, f"dddas: {how}; nothing was kept\n".encode())
    os._exit(128 + number)


def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from torchvision_dddas.cli.commands import app

    return app
