"""`dddas tune`: fit parameters by gradient on the clips of a study, and measure the gain on held-out clips."""

import time
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.evaluate import change_spec
from torchvision_dddas.cli.options import (
    CacheFolder,
    Clips,
    Config,
    Jobs,
    Overrides,
    Quiet,
    StudyBackend,
    check_jobs,
    echo,
    report_errors,
    split_patterns,
)
from torchvision_dddas.cli.progress import EVERY_S, open_console, print_now, progress, show_progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.lab.tuning import DescentStep, Tuned


@report_errors
def tune(
    study: Annotated[Path, typer.Argument(metavar="STUDY", help="The TOML of a study, as for dddas evaluate.")],
    parameters: Annotated[
        str, typer.Option(metavar="NAME,...", help="Parameters, such as difference.threshold or 'difference.*'.")
    ],
    steps: Annotated[int, typer.Option(metavar="N", help="Largest number of steps.")] = 100,
    holdout: Annotated[
        str | None,
        typer.Option(metavar="PATTERN,...", help="Held-out clips: not used for tuning, measured before and after."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed of the order of examples.")] = 0,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue from the checkpoint in --out, if there is one. Without it, the checkpoint of an unfinished "
            "descent is kept as checkpoint.old.pt.",
        ),
    ] = False,
    batch: Annotated[int, typer.Option(metavar="N", help="Examples per step.")] = 8,
    rate: Annotated[float, typer.Option(help="Step size; 0.05 is about 5 % of a parameter.")] = 0.05,
    pull: Annotated[
        float,
        typer.Option(
            help="Weight of half the squared distance from the first values in the loss; about 0.1 for few examples."
        ),
    ] = 0.0,
    watched: Annotated[
        float,
        typer.Option(help="Share of each clip's examples that choose the best step, and are not learned from."),
    ] = 0.25,
    patience: Annotated[
        int, typer.Option(metavar="N", help="Stop after N checks, one per 5 steps, without a gain.")
    ] = 10,
    minutes: Annotated[float | None, typer.Option(help="Start no step after this time.")] = None,
    device: Annotated[str, typer.Option(help="The device of the computation: cpu, cuda, cuda:1.")] = "cpu",
    measure: Annotated[
        str | None,
        typer.Option(metavar="TASK.GROUP.MEASURE", help="The measure to compare. [default: by the parameters' family]"),
    ] = None,
    clips: Clips = None,
    jobs: Jobs = None,
    cache: CacheFolder = None,
    config: Config = None,
    set_: Overrides = None,
    backend: StudyBackend = None,
    out: Annotated[Path, typer.Option(help="Folder for tuned.toml, report.html and run.json.")] = Path("dddas-tune"),
    quiet: Quiet = False,
) -> None:
    """Tune parameters by gradient on the clips of a study. Measure before and after, separately on held-out clips.

    Writes tuned.toml, which every command takes as --config, report.html and run.json.
    """
    if missing := [name for name in ("torch", "kornia") if find_spec(name) is None]:
        raise InputError(f"dddas tune needs {' and '.join(missing)}; pip install 'torchvision-dddas[torch]'")
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.lab.tuning import FILES, Display, Plan, Tuner

    check_jobs(jobs)
    if minutes is not None and not minutes > 0:
        raise InputError(f"--minutes must be more than 0, got {minutes:g}")
    longest_s = float("inf") if minutes is None else 60 * minutes
    plan = Plan(
        steps=steps, batch=batch, rate=rate, seed=seed, patience=patience, most_s=longest_s, pull=pull, watched=watched
    )
    spec = change_spec(study, config, set_ or [], backend and backend.value)
    # The measures before tuning read the settings files again, so tuned.toml must not overwrite one of them.
    read = [study, *([Path(spec.config)] if spec.config else [])]
    refuse_own_input(read, [out / name for name in FILES], "folder with --out")
    names, held = split_patterns(parameters, "--parameters", "parameter"), split_patterns(holdout, "--holdout")
    display = Display(study=partial(show_progress, quiet), progress=partial(progress, quiet=quiet))
    if not quiet:
        display = replace(display, message=print_now, step=_StepLines(steps))
    tuner = Tuner(out, plan, resume=resume, device=_device(device), jobs=jobs, cache=cache, display=display)
    tuned = tuner.run(spec, study.parent, names, held, split_patterns(clips, "--clips"), measure)
    if not quiet:
        _show(tuned, out)
    if tuned.failed:
        raise InputError(tuned.failed)


class _StepLines:
    """Prints a line for each check of the watched examples, and otherwise a line every few seconds."""

    def __init__(self, steps: int) -> None:
        self._steps, self._printed_s, self._least = steps, 0.0, (float("inf"), 0)

    def __call__(self, step: "DescentStep") -> None:
        now = time.monotonic()
        if step.watched is None and now - self._printed_s < EVERY_S:
            return
        self._printed_s = now
        line = f"step {step.step} of {self._steps}"
        line += f": loss {step.loss:.4f}" if step.step else ""
        if step.watched is not None:
            self._least = min(self._least, (step.watched, step.step))
            line += f"{',' if step.step else ':'} watched {step.watched:.4f}"
            line += f" (least {self._least[0]:.4f} at step {self._least[1]})"
        print_now(line)


def _show(tuned: "Tuned", folder: Path) -> None:
    """Print the parameters, the gain of tuning, and where further results are."""
    from rich.table import Table

    from torchvision_dddas.lab.tuning import REPORT, RUN, TUNED

    verdict = tuned.verdict
    console = open_console()
    table = Table(title=f"Tuned: {verdict.goal.name}, {'less' if verdict.goal.minimize else 'more'} is better")
    for column in ("parameter", "before", "after"):
        table.add_column(column, justify="left" if column == "parameter" else "right")
    for name, value in tuned.after.items():
        table.add_row(name, f"{tuned.before[name]:g}", f"{value:g}")
    console.print(table)
    notes = [f"note: {note}" for side in (verdict.tuned, verdict.held) if side is not None for note in side.notes]
    for line in (*verdict.lines(), *notes):
        console.print(line, markup=False, highlight=False)
    echo(f"{folder}: {TUNED} (for --config), {REPORT}, {RUN}")


def _device(name: str) -> Any:
    import torch

    try:
        device = torch.device(name)
        torch.zeros(1, dtype=torch.float64, device=device).item()
    except (RuntimeError, AssertionError, TypeError, NotImplementedError) as error:
        raise InputError(f"--device {name} cannot be used: {str(error).splitlines()[0]}; give cpu or cuda") from None
    return device
