"""The options that several commands share, said once."""

from enum import StrEnum
from typing import Annotated

import typer


class Backend(StrEnum):
    """The engines that --backend names."""

    auto = "auto"
    torch = "torch"
    onboard = "onboard"


Config = Annotated[str | None, typer.Option(metavar="FILE|NAME", help="A TOML file or a shipped configuration.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KNOB=VALUE", help="Change a knob; may be repeated.")
]
Engine = Annotated[Backend, typer.Option(help="The engine; auto takes onboard for one stream on a CPU.")]
Rate = Annotated[float | None, typer.Option(metavar="HZ", help="Frames a second, where the input does not say.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Say nothing but errors.")]
