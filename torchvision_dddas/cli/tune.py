"""`dddas tune`: parameters fitted by gradient on the clips of a study, and what that was worth on clips held out."""

import json
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Backend, CacheFolder, Clips, Config, Jobs, Overrides, Quiet, check_jobs
from torchvision_dddas.cli.progress import EVERY_S
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.tuning.costing import TimeCost
    from torchvision_dddas.tuning.descent import Descended, Plan, Step
    from torchvision_dddas.tuning.family import Prepared
    from torchvision_dddas.tuning.verdict import Side, Verdict

CHECKPOINT, COST, TUNED, REPORT, RUN = "checkpoint.pt", "cost.json", "tuned.toml", "report.html", "run.json"
OLD, OLD_COST = "checkpoint.old.pt", "cost.old.json"
FILES = (CHECKPOINT, OLD, COST, OLD_COST, TUNED, REPORT, RUN)


@explained
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
            help=f"Go on from the checkpoint in --out; begin where there is none. Without it an unfinished one is kept "
            f"as {OLD}.",
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
    from torchvision_dddas.cli.study import asked, patterns
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.tuning.descent import Plan

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
    _Tuning(out, plan, quiet, jobs, cache).run(
        partial(
            _prepared,
            spec,
            study.parent,
            patterns(parameters, "--knobs", "knob"),
            patterns(holdout, "--holdout"),
            patterns(clips, "--clips"),
            measure,
            loss,
            _device(device),
            quiet,
        ),
        cost,
        resume,
        spec.backend,
    )


class _Tuning:
    """A run of the command, and its files."""

    def __init__(self, folder: Path, plan: "Plan", quiet: bool, jobs: int | None, cache: Path | None) -> None:
        self._folder, self._plan, self._quiet, self._jobs, self._cache = folder, plan, quiet, jobs, cache
        self._seconds: dict[str, float] = {}
        self._said, self._least = 0.0, (float("inf"), 0)
        self._state: dict[str, str] = {}

    def run(self, prepared: Any, weight: float | None, resume: bool, backend: str) -> None:
        """All of it. Raises InputError, at the end too where a loss was no number."""
        self._write(None)
        try:
            found = self._run(prepared, weight, resume, backend)
        except BaseException:
            if self._state:  # else the record of an earlier run in this folder is still there
                with suppress(InputError):
                    self._write(RUN, _json({**self._state, "state": "interrupted"}))
            raise
        if found.failed:
            raise InputError(f"{found.failed}; {self._folder / TUNED} holds the last good state, of step {found.best}")

    def _run(self, prepared: Any, weight: float | None, resume: bool, backend: str) -> "Descended":
        from torchvision_dddas.tuning.descent import descend

        began = time.perf_counter()
        ready: Prepared = prepared()
        self._clock("examples", began)
        self._begin(ready)
        cost = None if weight is None else self._cost(ready, weight, backend, resume)
        before = _values(ready)
        began = time.perf_counter()
        place = self._folder / CHECKPOINT
        if resume and not place.is_file():
            self._say(f"there is no checkpoint at {place}: it begins anew")
        tell = partial(self._tell, {"state": "running", "study": ready.spec.name}, resume, cost)
        found = descend(ready.family, ready.parameters, ready.examples, self._plan, cost, tell, place, resume)
        self._clock("descent", began)
        self._toml(ready, found, None)
        verdict = self._judged(ready)
        self._toml(ready, found, verdict)
        record = self._record(ready, found, cost, before, verdict)
        self._report(record)
        self._write(RUN, _json(record))
        if not self._quiet:
            show(verdict, self._folder, before, _values(ready))
        return found

    def _begin(self, ready: "Prepared") -> None:
        told = f"{ready.family.name}: {len(ready.examples)} examples of {_clips(len(ready.tuned))}"
        held = f", {_clips(len(ready.held))} held out" if ready.held else ""
        self._say(told + held)

    def _say(self, line: str) -> None:
        if not self._quiet:
            print(line, file=sys.stderr, flush=True)

    def _cost(self, ready: "Prepared", weight: float, backend: str, resume: bool) -> "TimeCost":
        """What the knobs cost, measured on the shortest clip; of a descent that is taken up, as it was measured."""
        from torchvision_dddas.cli.progress import progress
        from torchvision_dddas.tuning import costing

        place = self._folder / COST
        if resume and place.is_file() and (self._folder / CHECKPOINT).is_file():
            # Another weight is another descent, which the checkpoint refuses.
            return replace(costing.read(place), weight=weight)
        began = time.perf_counter()
        clip = min(ready.clips, key=lambda clip: clip.frames or len(clip.pictures) or 10**9)
        names, settings = ready.parameters.names, ready.parameters.base
        count = costing.REPEATS * len(costing.points(settings, names))
        with progress("what time costs", count, self._quiet) as tick:
            cost = costing.measured(clip, ready.goal.task, settings, names, weight, backend, tick=tick)
        self._clock("cost", began)
        return cost

    def _tell(self, state: dict[str, str], resume: bool, cost: "TimeCost | None", step: "Step") -> None:
        """A line for each look, and every few seconds; with the first step the run has begun."""
        from torchvision_dddas.tuning import costing

        if not self._state:
            if not resume:
                self._set_aside()
            if cost is not None:  # not before: that of an earlier descent is needed to go on with it
                costing.write(self._folder / COST, cost)
            self._write(RUN, _json(state))
            self._state = state
        if self._quiet:
            return
        now = time.monotonic()
        if step.watched is None and now - self._said < EVERY_S:
            return
        self._said = now
        told = f"step {step.step} of {self._plan.steps}"
        told += f": loss {step.loss:.4f}" if step.step else ""
        if step.watched is not None:
            self._least = min(self._least, (step.watched, step.step))
            told += f"{',' if step.step else ':'} watched {step.watched:.4f}"
            told += f" (least {self._least[0]:.4f} at step {self._least[1]})"
        self._say(told)

    def _set_aside(self) -> None:
        """A checkpoint that could be gone on with is not written over, nor what was measured for it."""
        from torchvision_dddas.tuning.checkpoint import set_aside

        place, aside = self._folder / CHECKPOINT, self._folder / OLD
        if steps := set_aside(place, aside, {self._folder / COST: self._folder / OLD_COST}):
            self._say(f"{place} is of an unfinished descent, of {steps} steps; kept as {aside.name}")

    def _judged(self, ready: "Prepared") -> "Verdict":
        from torchvision_dddas.cli.study import shown
        from torchvision_dddas.tuning.verdict import judge

        began, hidden = time.perf_counter(), partial(shown, self._quiet)
        jobs, cache = self._jobs, self._cache
        after = _values(ready)
        found = judge(ready.spec, ready.base, ready.goal, after, ready.tuned, ready.held, jobs, cache, hidden)
        self._clock("before and after", began)
        return found

    def _toml(self, ready: "Prepared", found: "Descended", verdict: "Verdict | None") -> None:
        from torchvision_dddas.evaluation.studies.sweep import settings_toml

        about = [f"dddas tune: {', '.join(ready.parameters.names)} on {', '.join(ready.tuned)}, step {found.best}."]
        if verdict is not None:
            about += [f"{line}." for line in _told(verdict)]
        self._write(TUNED, settings_toml(found.settings, about))

    def _record(
        self,
        ready: "Prepared",
        found: "Descended",
        cost: "TimeCost | None",
        before: Mapping[str, Any],
        verdict: "Verdict",
    ) -> dict[str, Any]:
        """What run.json holds, and the page shows."""
        from torchvision_dddas.config import all_parameters
        from torchvision_dddas.io.output.run_record import versions
        from torchvision_dddas.tuning.family import loss_of
        from torchvision_dddas.tuning.parameters import TUNABLE

        spec, after = ready.spec, _values(ready)
        meaning = {parameter.name: parameter.meaning for parameter in all_parameters()}
        charged = None
        if cost is not None:
            expected = float(cost.expected({name: value.detach() for name, value in ready.parameters.values().items()}))
            charged = {**cost.as_json(), "expected": expected}
        return {
            "state": "failed" if found.failed else "complete",
            "versions": versions(),
            "study": {"name": spec.name, "config": spec.config, "set": spec.overrides, "backend": spec.backend},
            "family": ready.family.name,
            "loss": loss_of(ready.family) or None,
            "plan": asdict(self._plan),
            "examples": len(ready.examples),
            "knobs": {
                name: {
                    "before": before[name],
                    "after": after[name],
                    "unit": TUNABLE[name].unit,
                    "range": TUNABLE[name].range,
                    "meaning": meaning[name],
                    "idle": name in found.idle,
                }
                for name in ready.parameters.names
            },
            "best": found.best,
            "taken": found.taken,
            "ended": found.ended,
            "failed": found.failed,
            "history": [
                {"knobs" if name == "parameters" else name: value for name, value in asdict(step).items()}
                for step in found.history
            ],
            "cost": charged,
            "verdict": verdict.told(),
            "seconds": {name: round(spent, 3) for name, spent in self._seconds.items()},
        }

    def _report(self, record: dict[str, Any]) -> None:
        from torchvision_dddas.io.output.run_record import finite
        from torchvision_dddas.tuning.report import tuning_report

        self._write(REPORT, tuning_report(finite(record)))

    def _clock(self, what: str, began: float) -> None:
        self._seconds[what] = time.perf_counter() - began

    def _write(self, name: str | None, text: str = "") -> None:
        """Write a file; without a name, only see that some can be written. Raises InputError."""
        from torchvision_dddas.io.atomic_files import cannot_write, write_whole

        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            if name is None:
                tempfile.TemporaryFile(dir=self._folder).close()
            else:
                write_whole(self._folder / name, text.encode())
        except OSError as error:
            raise cannot_write(self._folder / (name or RUN), error) from error


def show(verdict: "Verdict", folder: Path, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
    """Print the parameters, what they were worth, and where the rest is."""
    from rich.console import Console
    from rich.table import Table

    console = Console() if sys.stdout.isatty() else Console(width=120)
    table = Table(title=f"Tuned: {verdict.goal.name}, {'less' if verdict.goal.minimize else 'more'} is better")
    for column in ("knob", "before", "after"):
        table.add_column(column, justify="left" if column == "knob" else "right")
    for name in after:
        table.add_row(name, f"{before[name]:g}", f"{after[name]:g}")
    console.print(table)
    for line in _told(verdict):
        console.print(line, markup=False, highlight=False)
    for side in (verdict.tuned, verdict.held):
        for note in () if side is None else side.notes:
            console.print(f"note: {note}", markup=False, highlight=False)
    typer.echo(f"{folder}: {TUNED} (for --config), {REPORT}, {RUN}")


def _told(verdict: "Verdict") -> list[str]:
    """What tuning was worth, a line for each set of clips."""
    lines = [_line("Tuned on", verdict.tuned, verdict)]
    return lines if verdict.held is None else [*lines, _line("Held out", verdict.held, verdict)]


def _line(what: str, side: "Side", verdict: "Verdict") -> str:
    from torchvision_dddas.evaluation.studies.sweep import format_value

    goal = verdict.goal
    pooled, mean = (" -> ".join(map(format_value, pair)) for pair in (side.pooled, side.mean))
    told = f"{what} ({_clips(len(side.clips))}): {goal.measure} {pooled}"
    mean = f", mean of clips {mean}" if len(side.clips) > 1 else ""
    return told + mean + (f": {side.says}" if side.says else "")


def _prepared(
    spec: Any,
    base: Path,
    names: list[str],
    holdout: list[str],
    clips: list[str],
    measure: str | None,
    loss: str | None,
    device: Any,
    quiet: bool,
) -> "Prepared":
    from torchvision_dddas.cli.progress import progress
    from torchvision_dddas.tuning.family import prepare

    with progress("examples", None, quiet) as tick:
        ready = prepare(spec, base, names, holdout, clips, measure, loss, tick)
    ready.parameters.to(device)
    return ready


def _values(ready: "Prepared") -> dict[str, Any]:
    """The parameters as settings have them."""
    dumped = ready.parameters.settings().model_dump()
    return {name: dumped[name.split(".")[0]][name.split(".")[1]] for name in ready.parameters.names}


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


def _clips(count: int) -> str:
    return f"{count} clip{'s' * (count != 1)}"


def _json(content: Any) -> str:
    from torchvision_dddas.io.output.run_record import finite

    return json.dumps(finite(content), indent=2) + "\n"
