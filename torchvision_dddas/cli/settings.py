"""`dddas settings`: print the table of parameters."""

from typing import Annotated

import typer

from torchvision_dddas.cli.options import report_errors
from torchvision_dddas.cli.progress import open_console
from torchvision_dddas.errors import InputError

_SCENARIO = "scenario"


@report_errors
def settings(
    group: Annotated[
        str | None,
        typer.Argument(
            metavar="GROUP", help="Only this group, such as track; scenario: parameters of --scene. [default: all]"
        ),
    ] = None,
    backends: Annotated[
        bool, typer.Option("--backends", help="List which implementation computes each operation on which device.")
    ] = False,
) -> None:
    """List the parameters that --set and a configuration can change: default, unit, range and meaning.

    `dddas settings scenario` lists the parameters of scenarios, for `dddas run sim:NAME --scene` and `dddas simulate`.
    """
    from rich.table import Table

    from torchvision_dddas.config import Settings, all_parameters, config_names, nearest

    if backends:
        _print_backends()
        return
    groups = [*Settings.model_fields, _SCENARIO]
    if group is not None and group not in groups:
        raise InputError(
            f"no group of parameters is named '{group}'; {nearest(group, groups, 'wanted one of ' + ', '.join(groups))}"
        )
    table = Table("parameter", "default", "unit", "range", "meaning")
    rows = [row for row in all_parameters() if group is None or row.name.startswith(f"{group}.")]
    if group == _SCENARIO:
        from torchvision_dddas.lab.simulation import scenario_parameters

        rows = scenario_parameters()
    for parameter in rows:
        table.add_row(parameter.name, str(parameter.default), parameter.unit, parameter.range, parameter.meaning)
    # A file or a pipe gets one line per parameter, so that it can be searched.
    console = open_console(width=240)
    console.print(table, markup=False)
    if group is None:
        console.print(
            f"Shipped configurations for --config: {', '.join(config_names())}", markup=False, highlight=False
        )


def _print_backends() -> None:
    from rich.table import Table

    from torchvision_dddas.chain import IMPLEMENTATIONS

    table = Table("operation", "device", "form", "Kornia's time / ours", "reason")
    for line in IMPLEMENTATIONS:
        ratio = "" if line.ratio != line.ratio else f"{line.ratio:.2g}"
        reason = line.reason or ("more than twice the time" if line.ratio > 2 else "")
        table.add_row(line.operation, line.device, line.form, ratio, reason)
    open_console(width=160).print(table, markup=False)
