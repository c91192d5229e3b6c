"""The command line, `dddas`: one file a command. Heavy imports wait until a command needs them."""

import io
import sys
from typing import Annotated

import typer

from torchvision_dddas.cli.calibrate import calibrate
from torchvision_dddas.cli.colours import colours
from torchvision_dddas.cli.compare import compare
from torchvision_dddas.cli.confirm import confirm
from torchvision_dddas.cli.demo import demo
from torchvision_dddas.cli.detect import detect
from torchvision_dddas.cli.evaluate import evaluate
from torchvision_dddas.cli.export import export
from torchvision_dddas.cli.locate import locate
from torchvision_dddas.cli.options import BAD_INPUT, INTERRUPTED
from torchvision_dddas.cli.people import people
from torchvision_dddas.cli.run import run
from torchvision_dddas.cli.settings import settings
from torchvision_dddas.cli.simulate import simulate
from torchvision_dddas.cli.sweep import sweep
from torchvision_dddas.cli.track import track
from torchvision_dddas.cli.tune import tune
from torchvision_dddas.runtime import VERSION

app = typer.Typer(
    name="dddas",
    help="Moving targets from a moving camera, steered by what the data show.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    *(run, detect, people, track, confirm, calibrate, colours),
    *(evaluate, compare, sweep, tune, simulate, export, demo, settings),
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


def main() -> None:
    """Entry point. Exit code 0: done; 2: bad input, one line on stderr; 130: stopped by Ctrl-C, outputs valid."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that cannot show × or ≥ shows a question mark
    try:
        sys.exit(app(standalone_mode=False))
    except (KeyboardInterrupt, typer.Abort):  # outside a command, while Python still loads
        sys.exit(INTERRUPTED)
    except Exception as error:
        # A word of the command line that will not do; Typer keeps the class of these errors to itself.
        if not hasattr(error, "format_message"):
            raise
        if len(sys.argv) < 2 or not error.format_message():  # a group of commands, none of which was named
            error.show()  # type: ignore[attr-defined]
        else:
            typer.echo(f"dddas: {' '.join(error.format_message().split()).rstrip('.')}; see dddas --help", err=True)
        sys.exit(BAD_INPUT)
