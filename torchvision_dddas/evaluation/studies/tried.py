"""The studies of a sweep: one data set and one goal, other parameters each time."""

import glob
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

from torchvision_dddas.config import with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import digests
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.goals import Goal, value_of
from torchvision_dddas.evaluation.studies.jobs import Event, cores, share
from torchvision_dddas.evaluation.studies.record import Spec
from torchvision_dddas.evaluation.studies.running import cache_folder, order, plan, run_study
from torchvision_dddas.evaluation.studies.sweep import Measured, written
from torchvision_dddas.evaluation.studies.working import kept


@dataclass
class Tried:
    """jobs, scheduler, cache: as of `running.run_study`. tell: is given how many clips of how many are done."""

    spec: Spec
    base: Path
    goal: Goal
    jobs: int | None
    scheduler: str | None
    cache: Path | None
    tell: Callable[[int, int], object] = lambda done, of: None

    def measured(self, parameters: Mapping[str, object], clips: Sequence[str]) -> Measured:
        """The goal's value over clips of these names, and if it has none why."""
        changed = tuple(f"{name}={written(value)}" for name, value in parameters.items())
        spec = replace(self.spec, overrides=(*self.spec.overrides, *changed))
        names = [glob.escape(name) for name in clips]
        done = 0

        def tell(event: Event) -> None:
            nonlocal done
            done += event.done is not None
            self.tell(done, len(clips))

        return value_of(self.goal, run_study(spec, self.base, self.jobs, self.scheduler, self.cache, names, tell).cases)

    def ahead(self, points: Sequence[Mapping[str, object]], clips: Sequence[str]) -> None:
        """Compute what the studies of several points will need, by one set of workers that none leaves idle."""
        if self.scheduler is not None or self.jobs == 0:  # its workers stand ready anyway, or there is none
            return
        planned = plan(self.spec, self.base, [glob.escape(name) for name in clips])
        store = Cache(self.cache or cache_folder())
        files = digests.Files(store.folder / "files", read=False)
        each = [
            replace(job, settings=with_parameters(job.settings, parameters))
            for parameters in points
            for job in planned.jobs
        ]
        jobs = order([replace(job, number=number) for number, job in enumerate(each)])
        waiting, done = [job for job in jobs if kept(job, store, files) is None], 0
        for event in share(waiting, self.jobs or cores(), store.folder):
            done += event.done is not None
            self.tell(done, len(waiting))


def parted(
    spec: Spec, base: Path, clips: Sequence[str], holdout: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the clips that have a say, and of those held out. Raises InputError where either is empty."""
    names = [job.clip.name for job in plan(spec, base, clips).jobs]
    held = tuple(name for name in names if any(fnmatchcase(name, pattern) for pattern in holdout))
    tuned = tuple(name for name in names if name not in held)
    if holdout and not held:
        raise InputError(f"--holdout {','.join(holdout)} fits no clip; there are {', '.join(names)}")
    if not tuned:
        raise InputError(f"--holdout {','.join(holdout)} leaves no clip to measure; there are {', '.join(names)}")
    return tuned, held
