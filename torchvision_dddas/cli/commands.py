"""All commands of `dddas`, and their exit codes. Slow imports are postponed until a command needs them."""

import atexit
import io
import os
import signal
import sys
from typing import Annotated

import typer

from torchvision_dddas.cli.advise import advise
from torchvision_dddas.cli.bench import bench
from torchvision_dddas.cli.calibrate import calibrate
from torchvision_dddas.cli.calibrate_flight import calibrate_flight
from torchvision_dddas.cli.citation import citation
from torchvision_dddas.cli.colours import colours
from torchvision_dddas.cli.compare import compare
from torchvision_dddas.cli.confirm import confirm
from torchvision_dddas.cli.convert import convert
from torchvision_dddas.cli.demo import demo
from torchvision_dddas.cli.detect import detect
from torchvision_dddas.cli.evaluate import evaluate
from torchvision_dddas.cli.exits import (
    BAD_INPUT,
    FAULT,
    Ended,
    close_output,
    describe_kept,
    open_output,
    say,
    say_fault,
    say_stopped,
)
from torchvision_dddas.cli.export import export
from torchvision_dddas.cli.locate import locate
from torchvision_dddas.cli.people import people
from torchvision_dddas.cli.run import run
from torchvision_dddas.cli.settings import settings
from torchvision_dddas.cli.simulate import simulate
from torchvision_dddas.cli.sweep import sweep
from torchvision_dddas.cli.track import track
from torchvision_dddas.cli.tune import tune
from torchvision_dddas.cli.views import views
from torchvision_dddas.io.interrupts import KEPT, StopSignals, ignore_signals, is_stop, raising_signals
from torchvision_dddas.runtime import VERSION

app = typer.Typer(
    name="dddas",
    help="Detect, track and locate moving targets from a moving camera, steered by the data.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    *(advise, run, detect, people, track, views, confirm, calibrate, calibrate_flight, colours),
    *(convert, evaluate, compare, sweep, tune, simulate, export, demo, bench, settings, citation),
):
    app.command()(command)
app.add_typer(locate, name="locate")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dddas {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def run_command_line() -> None:
    """Run the command that sys.argv names, and end the process with its exit code."""
    output = open_output()
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr.reconfigure(errors="replace")

    def end(number: int, kept: bool) -> None:
        os._exit(say_stopped(number, KEPT if kept else ""))

    signals = raising_signals(end)
    atexit.register(ignore_signals)  # Python removes the signal handlers before it ends
    try:
        code = close_output(output, _run(signals))
    except KeyboardInterrupt:  # after the end of the command
        code = say_stopped(signals.noticed or signal.SIGINT, KEPT)
    sys.exit(code)


def _run(signals: StopSignals) -> int:
    try:
        signals.__enter__()  # never exited, because a second signal may come while Python ends
        code = app(standalone_mode=False) or 0
        # Before the command begins, Typer treats any signal as Ctrl-C and prints nothing.
        is_said = code != 128 + signal.SIGINT or isinstance(code, Ended)
        return int(code) if is_said else say_stopped(signals.noticed or signal.SIGINT, "")
    except (KeyboardInterrupt, typer.Abort) as error:  # outside a command, for example while Python loads
        return say_stopped(signals.noticed or signal.SIGINT, describe_kept(error))
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else FAULT
    except Exception as error:
        if is_stop(error):
            return say_stopped(signals.noticed or signal.SIGINT, describe_kept(error))
        # A wrong argument. Typer does not export the class of these errors.
        if not hasattr(error, "format_message"):
            say_fault()
            return FAULT
        if len(sys.argv) < 2 or not error.format_message():  # a group of commands without a command
            error.show()  # type: ignore[attr-defined]
        else:
            say(f"{' '.join(error.format_message().split()).rstrip('.')}; see dddas --help")
        return BAD_INPUT
