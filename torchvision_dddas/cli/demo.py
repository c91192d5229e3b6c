"""`dddas demo`: film, detect and score a small scene, without any input."""

from pathlib import Path
from typing import Annotated

import typer

from torchvision_dddas.cli.exits import noting
from torchvision_dddas.cli.options import Quiet, print_lines, report_errors
from torchvision_dddas.cli.progress import progress


@report_errors
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the clip and the results.")] = Path("demo-out"),
    quiet: Quiet = False,
) -> None:
    """Film a short scenario of walkers and cars from a moving camera, detect them, and compare them with the truth."""
    from torchvision_dddas.cli.detect import detect_clip
    from torchvision_dddas.cli.evaluate import score, show
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.output import DetectionRecorder
    from torchvision_dddas.lab.simulation import film_clip, load_scenario

    length = load_scenario("demo").clip
    kept = noting(lambda: f"the pictures up to here are kept in {out / 'clip'}", (out / "clip").exists)
    with kept, progress("filming", round(length.seconds * length.rate_hz), quiet) as tick:
        clip = film_clip(out / "clip", tick=tick)
    how = load_config(), "auto", DetectionRecorder.saved
    lines = detect_clip(str(clip / "frames"), out, *how, rate_hz=length.rate_hz, quiet=quiet)
    report = score(clip / "masks", out, out)
    if not quiet:
        show(report)
    lines.append(f"Look at {out / 'overlay.mp4'}; the clip and its true masks are in {clip}")
    print_lines(lines, quiet)
