"""`dddas settings`: the table of knobs."""

import sys

from torchvision_dddas.cli.mistakes import explained


@explained
def settings() -> None:
    """List every knob that --set and a configuration can change: default, unit, range and meaning."""
    from rich.console import Console
    from rich.table import Table

    from torchvision_dddas.config import all_knobs, config_names

    table = Table("knob", "default", "unit", "range", "meaning")
    for knob in all_knobs():
        table.add_row(knob.name, str(knob.default), knob.unit, knob.range, knob.meaning)
    # Into a file or a pipe, one line a knob, so that it can be searched.
    console = Console() if sys.stdout.isatty() else Console(width=240)
    console.print(table, markup=False)
    console.print(f"Shipped configurations for --config: {', '.join(config_names())}", markup=False, highlight=False)
