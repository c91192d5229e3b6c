"""`dddas demo`: a small scene end to end, no input needed."""

from pathlib import Path
from typing import Annotated

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.progress import progress


@explained
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the clip and everything found in it.")] = Path("demo-out"),
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing but errors.")] = False,
) -> None:
    """Film a short scenario of walkers and cars from a moving camera, detect them, and compare with the truth."""
    from torchvision_dddas.cli.detect import detect_clip, summary
    from torchvision_dddas.cli.evaluate import score, show
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.output import DetectionRecorder
    from torchvision_dddas.simulation import film_clip, load_scenario

    length = load_scenario("demo").clip
    with progress("filming", round(length.seconds * length.rate_hz), quiet) as tick:
        clip = film_clip(out / "clip", tick=tick)
    journal = detect_clip(str(clip / "frames"), out, load_config(), "auto", DetectionRecorder.saved, quiet=quiet)
    report = score(clip / "masks", out, None, out)
    if not quiet:
        show(report)
        for line in summary(journal, out, DetectionRecorder.saved):
            typer.echo(line)
        typer.echo(f"Look at {out / 'overlay.mp4'}; the clip and its true masks are in {clip}")
