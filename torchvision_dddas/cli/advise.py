"""`dddas advise`: show what to expect of a clip, and advise options, before a run."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from torchvision_dddas.cli.options import (
    CLIP,
    Overrides,
    Rate,
    Telemetry,
    load_settings,
    print_lines,
    refuse_options,
    report_errors,
)
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

FRAMES = 60


@report_errors
def advise(
    clip: Annotated[str, typer.Argument(metavar="CLIP", help=CLIP)],
    telemetry: Telemetry = None,
    camera: Annotated[Path | None, typer.Option(metavar="FILE", help="Camera TOML, as for dddas run.")] = None,
    set_: Overrides = None,
    rate: Rate = None,
) -> None:
    """Look at the first frames of a clip and at its log: sizes, motion, delay, cost, and the command to run.

    Nothing is written. Later parts of the clip may differ from its beginning.
    """
    from torchvision_dddas import open_video
    from torchvision_dddas.io.output import NONE_LOCATED
    from torchvision_dddas.io.sources import stream_target
    from torchvision_dddas.pipeline import AerialInput, Assembly, advice, assemble_files
    from torchvision_dddas.types import Source

    if clip.startswith("sim:"):
        raise InputError(f"advise needs a clip with pictures, got {clip}; dddas simulate writes a scenario as a clip")
    if telemetry is None:
        refuse_options({"--camera": camera}, "is of no use without --telemetry FILE")
    given = None if telemetry is None else AerialInput(telemetry=telemetry, camera=camera)
    live = stream_target(clip) is not None

    def prepare(config: str | None) -> tuple[Source, Assembly]:
        settings = load_settings(config, set_)
        source = open_video(clip, rate_hz=rate, full_scale=settings.levels.given)
        return source, assemble_files(given, telemetry, settings, source, "auto", clip)

    def look(source: Source, ready: Assembly, name: str) -> advice.ClipSurvey:
        with progress(f"looking with {name}", min(FRAMES, source.count or FRAMES), False) as tick:
            return advice.look_at(source, ready, FRAMES, tick)

    source, ready = prepare(None)
    seen = look(source, ready, "the default")
    distances = advice.distances_over(ready, source, FRAMES)
    options, remarks = advice.choose_options(
        seen,
        ready,
        distances,
        rate_hz=source.rate_hz,
        live=live,
        look_with=lambda config: look(*prepare(config), config),
    )
    lines = advice.describe_sizes(seen, ready, distances) + advice.describe_clip(seen, source)
    notes = [note for note in ready.notes if telemetry is not None or not note.startswith(NONE_LOCATED)]
    lines += [f"note: {note}" for note in [*notes, *remarks]]
    lines += [f"{option}: {reason}" for option, reason in options.items()]
    if not options:
        needed = "no option is needed"
        if telemetry is not None and any(note.startswith(NONE_LOCATED) for note in notes):
            needed = "nothing is located without the data named above; otherwise no option is needed"
        lines.append(f"{needed}{'' if live else ' for this file'}, judging by these frames and the log")
    words = ["dddas", "run", clip]
    for name, value in {"--telemetry": telemetry, "--camera": camera, "--rate": rate}.items():
        words += [] if value is None else [name, f"{value:g}" if isinstance(value, float) else str(value)]
    words += [word for override in set_ or [] for word in ("--set", override)]
    words += [word for option in options for word in option.split()] + ["--live"] * live
    print_lines([*lines, shlex.join(words)])
