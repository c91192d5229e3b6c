"""The options that several commands share, said once."""

from enum import StrEnum
from pathlib import Path
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
    list[str] | None, typer.Option("--set", metavar="KNOB=VALUE", help="Change a parameter; may be repeated.")
]
EngineOption = Annotated[Backend, typer.Option(help="The engine; auto takes onboard for one stream on a CPU.")]
Rate = Annotated[float | None, typer.Option(metavar="HZ", help="Frames a second, where the input does not say.")]
Clips = Annotated[str | None, typer.Option(metavar="PATTERN,...", help="These clips alone, such as 'bms_*'.")]
Jobs = Annotated[
    int | None, typer.Option(metavar="N", help="Processes of one thread. [default: one per core; 1 without Dask]")
]
CacheFolder = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Where results are kept. [default: in the user's cache folder]")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Say nothing but errors.")]


def check_rate(rate_hz: float | None) -> None:
    """Raises InputError for a --rate that is none."""
    if rate_hz is not None and not 0 < rate_hz <= 1000:
        raise InputError(f"a frame rate of {rate_hz} per second will not do; wanted more than 0, at most 1000")


def check_jobs(jobs: int | None, scheduler: str | None = None) -> None:
    """Raises InputError for a --jobs that is none, and for one beside a --scheduler."""
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs is {jobs}; wanted 1 or more processes")
    if jobs is not None and scheduler is not None:
        raise InputError("--jobs and --scheduler were both given; a scheduler has workers of its own, wanted one")
