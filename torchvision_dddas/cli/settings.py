"""`dddas settings`: the table of parameters."""

import sys

from torchvision_dddas.cli.options import report_errors


@report_errors
def settings() -> None:
    """List every parameter that --set and a configuration can change: default, unit, range and meaning."""
    from rich.console import Console
    from rich.table import Table

    from torchvision_dddas.config import all_parameters, config_names

    table = Table("parameter", "default", "unit", "range", "meaning")
    for parameter in all_parameters():
        table.add_row(parameter.name, str(parameter.default), parameter.unit, parameter.range, parameter.meaning)
    # A file or a pipe gets one line per parameter, so that it can be searched.
    console = Console() if sys.stdout.isatty() else Console(width=240)
    console.print(table, markup=False)
    console.print(f"Shipped configurations for --config: {', '.join(config_names())}", markup=False, highlight=False)
