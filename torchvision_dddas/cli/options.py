"""The options that several commands share, said once."""

from enum import StrEnum
from typing import Annotated

import typer

from torchvision_dddas.errors import InputError


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


def check_rate(rate_hz: float | None) -> None:
    """Raises InputError for a --rate that is none."""
    if rate_hz is not None and not 0 < rate_hz <= 1000:
        raise InputError(f"a frame rate of {rate_hz} per second will not do; wanted more than 0, at most 1000")
