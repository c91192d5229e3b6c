"""What the user sees of an error: one line and an exit code, never a traceback for a mistake of theirs."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import typer

from torchvision_dddas.errors import InputError

BAD_INPUT, INTERRUPTED = 2, 130

_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def explained(command: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """A command whose InputError becomes `dddas: ...` on stderr and exit code 2, and Ctrl-C exit code 130."""

    @functools.wraps(command)
    def guarded(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        try:
            return command(*args, **kwargs)
        except InputError as error:
            typer.echo(f"dddas: {' '.join(str(error).split())}", err=True)
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt:
            typer.echo("dddas: stopped; what was done until then is kept", err=True)
            raise typer.Exit(INTERRUPTED) from None

    return guarded
