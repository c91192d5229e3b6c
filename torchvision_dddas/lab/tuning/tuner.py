"""A whole tuning run on a study: examples, descent, measures before and after, and the files that record them."""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from torchvision_dddas.config import all_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import claimed, save_file
from torchvision_dddas.io.interrupts import is_stop
from torchvision_dddas.io.output import finite, versions
from torchvision_dddas.lab.evaluation.studies.records import Spec
from torchvision_dddas.lab.evaluation.studies.sweep import settings_toml
from torchvision_dddas.lab.tuning.checkpoint import set_aside
from torchvision_dddas.lab.tuning.descent import Descended, DescentStep, Plan, descend
from torchvision_dddas.lab.tuning.family import Prepared, prepare
from torchvision_dddas.lab.tuning.parameters import TUNABLE
from torchvision_dddas.lab.tuning.report import tuning_report
from torchvision_dddas.lab.tuning.verdict import Shown, Verdict, count_clips, judge

CHECKPOINT, OLD = "checkpoint.pt", "checkpoint.old.pt"
TUNED, REPORT, RUN = "tuned.toml", "report.html", "run.json"
FILES = (CHECKPOINT, OLD, TUNED, REPORT, RUN)


@dataclass(frozen=True)
class Display:
    """Callbacks during a run; by default nothing is shown.

    message: called with a line of text. step: called with every step. progress: called with a name and a count (None if
    unknown); returns a function to call after each item. study: as for `judge`.
    """

    message: Callable[[str], object] = lambda line: None
    step: Callable[[DescentStep], object] = lambda step: None
    progress: Callable[[str, int | None], AbstractContextManager[Callable[[], object]]] = lambda name, count: (
        nullcontext(lambda: None)
    )
    study: Shown = lambda: nullcontext((lambda plan: None, lambda event: None))


@dataclass(frozen=True)
class Tuned:
    """The result of a run. before, after: values of the tuned parameters.

    failed: the cause of an early stop in one line; empty without an early stop.
    """

    descended: Descended
    verdict: Verdict
    before: Mapping[str, Any]
    after: Mapping[str, Any]
    failed: str = ""


class Tuner:
    """Tune parameters on the clips of a study and write FILES into a folder.

    tuned.toml holds the settings for --config, report.html and run.json the results, checkpoint.pt the descent.
    """

    def __init__(
        self,
        folder: Path,
        plan: Plan | None = None,
        *,
        resume: bool = False,
        device: torch.device | str = "cpu",
        jobs: int | None = None,
        cache: Path | None = None,
        display: Display | None = None,
    ) -> None:
        """resume: continue from the folder's checkpoint if there is one. device: the device that computes the descent.

        jobs, cache: as for `judge`.
        """
        self._folder, self._plan, self._resume, self._device = folder, plan or Plan(), resume, device
        self._jobs, self._cache = jobs, cache
        self._display = display or Display()
        self._seconds: dict[str, float] = {}
        self._state: dict[str, str] = {}

    def run(
        self,
        study: Spec,
        base: Path,
        names: Sequence[str],
        holdout: Sequence[str] = (),
        clips: Sequence[str] = (),
        measure: str | None = None,
    ) -> Tuned:
        """Prepare, descend, measure before and after, and record the results. The arguments are those of `prepare`.

        Raise InputError as `prepare`, `descend` and `judge` do, and if the folder cannot be written. A loss that is not
        finite raises no error: `Tuned.failed` reports it, and the last good state is measured and written.
        """
        with claimed(self._folder):
            try:
                with self._timed("examples"), self._display.progress("examples", None) as tick:
                    ready = prepare(study, base, names, holdout, clips, measure, tick)
                return self._run(ready)
            except BaseException as error:
                if self._state:  # before that, the folder still holds the record of an earlier run
                    with suppress(InputError):
                        self._write_json(RUN, {**self._state, "state": "interrupted"})
                if is_stop(error) and (self._folder / CHECKPOINT).is_file():
                    error.add_note(f"the descent is kept in {self._folder / CHECKPOINT}; --resume continues from there")
                raise

    def _run(self, ready: Prepared) -> Tuned:
        ready.parameters.to(self._device)
        held = f", {count_clips(ready.held)} held out" if ready.held else ""
        self._display.message(
            f"{ready.family.name}: {len(ready.examples)} examples of {count_clips(ready.tuned)}{held}"
        )
        before, place = _values(ready), self._folder / CHECKPOINT
        if self._resume and not place.is_file():
            self._display.message(f"there is no checkpoint at {place}: the descent starts from the settings")

        def tell(step: DescentStep) -> None:
            if not self._state:
                self._begin_record(ready)
            self._display.step(step)

        with self._timed("descent"):
            found = descend(ready.family, ready.parameters, ready.examples, self._plan, tell, place, self._resume)
        after = _values(ready)
        about = f"dddas tune: {', '.join(after)} on {', '.join(ready.tuned)}, step {found.best}."
        self._write(TUNED, settings_toml(found.settings, [about]))
        with self._timed("before and after"):
            verdict = judge(
                ready.spec, ready.base, ready.goal, after, ready.tuned, ready.held, self._jobs, self._cache,
                self._display.study,
            )  # fmt: skip
        self._write(TUNED, settings_toml(found.settings, [about, *(f"{line}." for line in verdict.lines())]))
        record = self._record(ready, found, before, after, verdict)
        self._write(REPORT, tuning_report(finite(record)))
        self._write_json(RUN, record)
        last_good = f"{self._folder / TUNED} holds the last good state, from step {found.best}"
        return Tuned(found, verdict, before, after, f"{found.failed}; {last_good}" if found.failed else "")

    def _begin_record(self, ready: Prepared) -> None:
        """Begin the record at the first step, so that a refused run leaves the files of an earlier run unchanged."""
        if not self._resume:
            place, aside = self._folder / CHECKPOINT, self._folder / OLD
            if steps := set_aside(place, aside):
                self._display.message(f"{place} holds an unfinished descent of {steps} steps, now kept as {aside.name}")
        state = {"state": "running", "study": ready.spec.name}
        self._write_json(RUN, state)
        self._state = state

    def _record(
        self,
        ready: Prepared,
        found: Descended,
        before: Mapping[str, Any],
        after: Mapping[str, Any],
        verdict: Verdict,
    ) -> dict[str, Any]:
        """Return the content of run.json and of the report."""
        spec = ready.spec
        meaning = {parameter.name: parameter.meaning for parameter in all_parameters()}
        return {
            "state": "failed" if found.failed else "complete",
            "versions": versions(),
            "study": {"name": spec.name, "config": spec.config, "set": spec.overrides, "backend": spec.backend},
            "family": ready.family.name,
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
                for name in after
            },
            **{name: getattr(found, name) for name in ("best", "taken", "ended", "failed")},
            "history": [
                {"knobs" if name == "parameters" else name: value for name, value in asdict(step).items()}
                for step in found.history
            ],
            "verdict": verdict.as_json(),
            "seconds": {name: round(spent, 3) for name, spent in self._seconds.items()},
        }

    @contextmanager
    def _timed(self, what: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self._seconds[what] = time.perf_counter() - began

    def _write(self, name: str, text: str) -> None:
        save_file(self._folder / name, text.encode())

    def _write_json(self, name: str, content: Any) -> None:
        self._write(name, json.dumps(finite(content), indent=2) + "\n")


def _values(ready: Prepared) -> dict[str, Any]:
    """Return the parameters in the form of the settings."""
    settings = ready.parameters.settings()
    return {name: getattr(getattr(settings, name.split(".")[0]), name.split(".")[1]) for name in ready.parameters.names}
