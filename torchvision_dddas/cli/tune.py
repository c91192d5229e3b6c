"""`dddas tune`: parameters fitted by gradient on the clips of a study, and what that was worth on clips held out."""

import sys
import time
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.options import (
    Backend,
    CacheFolder,
    Clips,
    Config,
    Jobs,
    Overrides,
    Quiet,
    check_jobs,
    report_errors,
)
from torchvision_dddas.cli.progress import EVERY_S
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.tuning.descent import Step
    from torchvision_dddas.tuning.tuner import Tuned


@report_errors
def tune(
    study: Annotated[Path, typer.Argument(metavar="STUDY", help="The TOML of a study, as of dddas evaluate.")],
    parameters: Annotated[
        str,
        typer.Option(
            "--parameters",
            "--knobs",
            metavar="NAME,...",
            help="What to tune, such as difference.threshold or 'difference.*'.",
        ),
    ],
    steps: Annotated[int, typer.Option(metavar="N", help="Steps at most.")] = 100,
    holdout: Annotated[
        str | None,
        typer.Option(metavar="PATTERN,...", help="Clips that nothing is learned from, measured before and after."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the order in which examples are learned from.")] = 0,
    cost: Annotated[
        float | None,
        typer.Option(metavar="WEIGHT", help="The loss that a frame of twice the time is worth. [default: none]"),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on from the checkpoint in --out; begin where there is none. Without it an unfinished one is kept "
            "as checkpoint.old.pt.",
        ),
    ] = False,
    batch: Annotated[int, typer.Option(metavar="N", help="Examples of a step.")] = 8,
    rate: Annotated[float, typer.Option(help="Of a step: 0.05 is about 5 % of a parameter.")] = 0.05,
    pull: Annotated[
        float,
        typer.Option(
            help="To where the parameters began, 0.1 or so where examples are few: a factor e costs half of it."
        ),
    ] = 0.0,
    watched: Annotated[
        float,
        typer.Option(help="Share of each clip's examples that nothing is learned from: they tell which step is best."),
    ] = 0.25,
    patience: Annotated[int, typer.Option(metavar="N", help="Looks, one every 5 steps, without a gain.")] = 10,
    minutes: Annotated[float | None, typer.Option(help="No step is begun after so many.")] = None,
    device: Annotated[str, typer.Option(help="Where the steps are computed: cpu, cuda, cuda:1.")] = "cpu",
    measure: Annotated[
        str | None,
        typer.Option(metavar="TASK.GROUP.MEASURE", help="Told before and after. [default: that of the knobs' family]"),
    ] = None,
    loss: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Of the family's losses: f, dice or focal of motion. [default: the first]"),
    ] = None,
    clips: Clips = None,
    jobs: Jobs = None,
    cache: CacheFolder = None,
    config: Config = None,
    set_: Overrides = None,
    backend: Annotated[
        Backend | None, typer.Option(help="The engine that measures before and after. [default: as STUDY says]")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for tuned.toml, report.html and run.json.")] = Path("dddas-tune"),
    quiet: Quiet = False,
) -> None:
    """Tune parameters by gradient on the clips of a study, and measure before and after, held-out clips apart.

    Writes tuned.toml, which every command takes as --config, report.html and run.json.
    """
    _need_torch()
    from torchvision_dddas.cli.progress import progress
    from torchvision_dddas.cli.study import asked, patterns, shown
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.tuning.descent import Plan
    from torchvision_dddas.tuning.tuner import FILES, Display, Tuner

    check_jobs(jobs)
    if minutes is not None and not minutes > 0:
        raise InputError(f"--minutes is {minutes:g}; wanted more than 0")
    if cost is not None and not 0 <= cost < float("inf"):
        raise InputError(f"--cost is {cost:g}; wanted 0 or more: the loss that a frame of twice the time is worth")
    longest_s = float("inf") if minutes is None else 60 * minutes
    plan = Plan(
        steps=steps, batch=batch, rate=rate, seed=seed, patience=patience, most_s=longest_s, pull=pull, watched=watched
    )
    spec = asked(study, config, set_ or [], backend and backend.value, None)
    # The settings are read again for the figures before: tuned.toml may not have taken their place by then.
    read = [study, *([Path(spec.config)] if spec.config else [])]
    refuse_own_input(read, [out / name for name in FILES], "folder with --out")
    names, held = patterns(parameters, "--knobs", "knob"), patterns(holdout, "--holdout")
    display = Display(study=partial(shown, quiet), progress=partial(progress, quiet=quiet))
    if not quiet:
        display = replace(display, message=_print, step=_StepLines(steps))
    tuner = Tuner(
        out, plan, time_weight=cost, resume=resume, device=_device(device), jobs=jobs, cache=cache, display=display
    )
    tuned = tuner.run(spec, study.parent, names, held, patterns(clips, "--clips"), measure, loss)
    if not quiet:
        _show(tuned, out)
    if tuned.failed:
        raise InputError(tuned.failed)


class _StepLines:
    """Prints a line for each look at the watched examples, and otherwise one every few seconds."""

    def __init__(self, steps: int) -> None:
        self._steps, self._printed_s, self._least = steps, 0.0, (float("inf"), 0)

    def __call__(self, step: "Step") -> None:
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
        _print(line)


def _print(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _show(tuned: "Tuned", folder: Path) -> None:
    """Print the parameters, what tuning was worth, and where the rest is."""
    from rich.console import Console
    from rich.table import Table

    from torchvision_dddas.tuning.tuner import REPORT, RUN, TUNED

    verdict = tuned.verdict
    console = Console() if sys.stdout.isatty() else Console(width=120)
    table = Table(title=f"Tuned: {verdict.goal.name}, {'less' if verdict.goal.minimize else 'more'} is better")
    for column in ("parameter", "before", "after"):
        table.add_column(column, justify="left" if column == "parameter" else "right")
    for name, value in tuned.after.items():
        table.add_row(name, f"{tuned.before[name]:g}", f"{value:g}")
    console.print(table)
    notes = [f"note: {note}" for side in (verdict.tuned, verdict.held) if side is not None for note in side.notes]
    for line in (*verdict.lines(), *notes):
        console.print(line, markup=False, highlight=False)
    typer.echo(f"{folder}: {TUNED} (for --config), {REPORT}, {RUN}")


def _device(name: str) -> Any:
    import torch

    try:
        device = torch.device(name)
        torch.zeros(1, dtype=torch.float64, device=device).item()
    except (RuntimeError, AssertionError, TypeError, NotImplementedError) as error:
        raise InputError(f"--device {name} will not do: {str(error).splitlines()[0]}; wanted cpu or cuda") from None
    return device


def _need_torch() -> None:
    if missing := [name for name in ("torch", "kornia") if find_spec(name) is None]:
        raise InputError(f"dddas tune needs {' and '.join(missing)}; pip install 'torchvision-dddas[torch]'")
