"""Common parts of all commands: options, their checks, exit codes, and errors as one line on stderr."""

import functools
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from signal import SIGINT
from typing import TYPE_CHECKING, Annotated, ParamSpec, TypeVar

import typer

from torchvision_dddas.cli.exits import BAD_INPUT, describe_kept, say, say_stopped
from torchvision_dddas.errors import InputError, printable

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.detection import OnnxDetector

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


class Backend(StrEnum):
    """The values of --backend."""

    auto = "auto"
    torch = "torch"
    onboard = "onboard"


class BoxOrder(StrEnum):
    """The values of --box-format: the order of a box's columns."""

    xywh = "xywh"
    xyxy = "xyxy"
    yolo = "yolo"


CLIP = "A video file, a folder or glob of images, camera:0 or rtsp://..."

Config = Annotated[
    str | None,
    typer.Option(metavar="FILE|NAME", help="A TOML file or a shipped configuration; separate several by commas."),
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="PARAMETER=VALUE", help="Change a parameter; may be repeated.")
]
EngineOption = Annotated[Backend, typer.Option(help="The engine. auto: torch with a CUDA device, else onboard.")]
StudyBackend = Annotated[Backend | None, typer.Option(help="The engine. [default: as in the study's file]")]
Rate = Annotated[float | None, typer.Option(metavar="HZ", help="Frames per second, if the input does not state it.")]
REPORTS = "The vehicle's log: CSV, .SRT, .tlog, .ulg, .bin, KLV, NMEA."
Telemetry = Annotated[Path | None, typer.Option("--telemetry", metavar="FILE", help=REPORTS)]
Ignore = Annotated[
    Path | None,
    typer.Option("--ignore", metavar="MASK", help="A picture of the frames' size; areas not black are left out."),
]
BoxFormat = Annotated[
    BoxOrder | None,
    typer.Option(help="Columns of a box: left, top, size; corners; centre, size. [default: by the table]"),
]
Detector = Annotated[
    Path | None,
    typer.Option(metavar="MODEL", help="An ONNX file of a YOLO or DETR: its boxes and classes in place of movers."),
]
Provider = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Execution provider of --detector: cpu, cuda, openvino, ... [default: cpu]"),
]
LeastScore = Annotated[float | None, typer.Option(help="Lowest score of --detector's boxes. [default: 0.25]")]
ClassFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help="A line for each class of --detector. [default: as in MODEL]")
]
Movers = Annotated[
    bool, typer.Option("--movers", help="Also detect motion beside --detector or --detections; boxes get speeds.")
]
Poses = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="A CSV of each moving camera's poses, in the cameras' order."),
]
Clips = Annotated[str | None, typer.Option(metavar="PATTERN,...", help="Only these clips, such as 'bms_*'.")]
Jobs = Annotated[
    int | None, typer.Option(metavar="N", help="Processes of one thread. [default: one per core; 1 without Dask]")
]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler such as tls://host:8786, instead of --jobs.")
]
WorkerSilent = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        min=1,
        help="Replace a process of --jobs after this silence, and restart its clip. [default: 60]",
    ),
]
CacheFolder = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder of cached results. [default: in the user's cache folder]")
]
Out = Annotated[Path, typer.Option(help="Folder for the results.")]
OutPerInput = Annotated[Path, typer.Option(help="Folder for the results; several inputs get a folder each in it.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]


def echo(text: str, err: bool = False) -> None:
    """Print text on stdout or stderr. Control characters, which names may contain, are shown by their codes."""
    typer.echo(printable(text), err=err)


def report_errors(command: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Report a command's InputError on stderr with exit code 2, and a signal with exit code 128 plus its number."""

    @functools.wraps(command)
    def guarded(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        try:
            return command(*args, **kwargs)
        except InputError as error:
            kept = describe_kept(error)
            say(f"{error}; {kept}" if kept else error)
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt as error:
            raise typer.Exit(say_stopped(getattr(error, "number", SIGINT), describe_kept(error))) from None

    return guarded


def print_lines(lines: Sequence[str], quiet: bool = False) -> None:
    """Print the lines that end a command, unless --quiet was given."""
    for line in () if quiet else lines:
        echo(line)


def refuse_options(options: Mapping[str, object], why: str) -> None:
    """Raise InputError for the first option that was given."""
    for option, given in options.items():
        if given is not None and given != []:
            raise InputError(f"{option} {why}")


def check_rate(rate_hz: float | None) -> None:
    """Raise InputError for a --rate out of range."""
    if rate_hz is not None and not 0 < rate_hz <= 1000:
        raise InputError(f"--rate must be a frame rate above 0 and at most 1000 per second, got {rate_hz}")


def check_interval(interval: int | None, most: int | None = None) -> None:
    """Raise InputError for an --interval out of range."""
    if interval is not None and not 1 <= interval <= (most or interval):
        limit = "1 or more" if most is None else f"1 to {most}"
        raise InputError(f"--interval must be {limit} frames, got {interval}")


def check_jobs(jobs: int | None, scheduler: str | None = None) -> None:
    """Raise InputError for --jobs below 1 and for --jobs together with --scheduler."""
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs must be 1 or more processes, got {jobs}")
    if jobs is not None and scheduler is not None:
        raise InputError("--jobs and --scheduler were both given; a scheduler has its own workers; give only one")


def parse_size(text: str, low: int, high: int) -> tuple[int, int]:
    """Return (width, height) of `640x480`. Raise InputError for anything else."""
    width, _, height = text.lower().partition("x")
    if not all(side.isdecimal() and len(side) < 7 and low <= int(side) <= high for side in (width, height)):
        raise InputError(f"--size must be WIDTHxHEIGHT in pixels from {low} to {high}, such as 640x480, got '{text}'")
    return int(width), int(height)


def split_patterns(text: str | None, option: str, what: str = "clip") -> list[str]:
    """Return the patterns of names in an option, separated by commas. Raise InputError if there are none."""
    words = [word.strip() for word in (text or "").split(",") if word.strip()]
    if text is not None and not words:
        example = "'bms_*'" if what == "clip" else "'difference.*'"
        raise InputError(f"{option} '{text}' names no {what}; give patterns of names, such as {example}")
    return words


def note_patrol(config: str | None, quiet: bool) -> None:
    """Explain when the default equals the configuration `patrol`. Raise InputError if `patrol` has no effect."""
    names = (config or "").split(",")
    if "patrol" in names and (plain := {"fast", "half", "source", "two_frames"}.intersection(names)):
        raise InputError(
            f"patrol has no effect beside {min(plain)}, which has no settings for tiny people; leave it out"
        )
    if "patrol" in names and not quiet:
        words = "with telemetry, which determines the size of people, patrol equals the default"
        echo(f"dddas: --config patrol assumes people of about 4 px (gates.person_px); {words}", err=True)


def open_detector(
    detector: Path | None, provider: str | None, score: float | None, classes: Path | None
) -> "OnnxDetector | None":
    """Return the network of --detector, None without one. Raise InputError for its other options alone."""
    if detector is None:
        of_detector = {"--provider": provider, "--score": score, "--classes": classes}
        refuse_options(of_detector, "is for --detector MODEL; give it too")
        return None
    from torchvision_dddas.detection import OnnxDetector

    return OnnxDetector(detector, provider=provider or "cpu", score=0.25 if score is None else score, classes=classes)


def check_movers(network: "OnnxDetector | None", movers: bool, of_movers: Mapping[str, object]) -> None:
    """Raise InputError for --movers without --detector, and for options `of_movers` that have no effect."""
    if network is None:
        refuse_options({"--movers": movers or None}, "is for --detector; the command finds what moves by itself")
    elif not movers:
        refuse_options(of_movers, "is for the search for what moves; give --movers too, or leave it out")


def load_settings(
    config: str | None,
    overrides: Sequence[str] | None,
    ignore: Path | None = None,
    quiet: bool = False,
    geoid: Path | None = None,
) -> "Settings":
    """Return the settings of --config, --set, --ignore and --geoid. Raise InputError for faults in them."""
    from torchvision_dddas.config import load_config, with_parameters

    note_patrol(config, quiet)
    files = {"difference.ignore": ignore, "aerial.geoid": geoid}
    given = {name: str(path) for name, path in files.items() if path is not None}
    return with_parameters(load_config(config, overrides or []), given)
