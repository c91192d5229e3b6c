"""A study from its specification to its results: data sets are read, jobs shared, results gathered in order."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.detection import load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.kinds import read
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.fingerprints import FileDigests
from torchvision_dddas.evaluation.studies.jobs import (
    Done,
    Event,
    Job,
    Keys,
    OnEvent,
    code_identity,
    find_cached,
    make_keys,
)
from torchvision_dddas.evaluation.studies.results import Case, Results
from torchvision_dddas.evaluation.studies.spec import TASKS, Spec, Task
from torchvision_dddas.evaluation.studies.stages import allowed_tasks
from torchvision_dddas.evaluation.studies.storage import Cache
from torchvision_dddas.evaluation.studies.workers import Workers


def cache_folder() -> Path:
    """The default folder of cached results."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "torchvision_dddas" / "studies"


@dataclass(frozen=True)
class Plan:
    """What a study will do. left_out: what it will not; notes: what else is missing. facts: of the data sets."""

    settings: Settings
    jobs: tuple[Job, ...]
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Frames of all tasks, as far as their number is known."""
        return sum(_length(job.clip) * len(job.tasks) for job in self.jobs)


def run_study(
    spec: Spec,
    base: Path,
    workers: Workers | None = None,
    cache: Path | None = None,
    clips: Sequence[str] = (),
    on_event: OnEvent = lambda event: None,
    on_start: Callable[[Plan], object] = lambda planned: None,
) -> Results:
    """Run a study.

    base: what its folders are relative to. workers: by default this process alone. cache: the folder of results.
    clips: patterns of names, none for all. on_start: called with the plan before the first job. The results depend on
    none of these but the clips. Raises InputError as `plan_study` does, and if the workers cannot do the jobs.
    """
    planned = plan_study(spec, base, clips)
    store = Cache(cache or cache_folder())
    notes = list(planned.notes)

    def collect_note(event: Event) -> None:
        if event.note:
            notes.append(event.note)
        on_event(event)

    on_start(planned)
    outcomes = run_jobs(planned.jobs, workers or Workers(1), store, collect_note)
    cases: list[Case] = []
    left_out = list(planned.left_out)
    faults, computed = [], 0
    for job in planned.jobs:
        for done in outcomes[job.number]:
            computed += len(done.computed)
            found = store.get(done.found) if done.found else None
            scored = store.get(done.scored) if done.scored else None
            cause = done.cause
            if found is not None:
                notes += [str(InputError(f"{job.clip.name}, {done.task}: {note}")) for note in found.notes]
            if not cause and (found is None or scored is None):
                cause = "its entry in the cache is gone or damaged; run the study again"
            cases.append(Case(job.clip, done.task, found, scored, cause))
            if cause:
                left_out.append(f"{job.clip.name}, {done.task}: {cause}")
            if done.trace:
                faults.append({"clip": job.clip.name, "task": done.task, "trace": done.trace})
    notes = list(dict.fromkeys([*notes, *store.notes]))
    facts = {**planned.facts, "computed": computed, "notes": notes, "faults": faults}
    return Results(spec, planned.settings, tuple(cases), tuple(left_out), facts)


def run_jobs(
    jobs: Sequence[Job], workers: Workers, cache: Cache, on_event: OnEvent = lambda event: None
) -> dict[int, tuple[Done, ...]]:
    """Do jobs, the longest first; their outcomes by number. What is in the cache needs no worker."""
    outcomes: dict[int, tuple[Done, ...]] = {}

    def collect_outcome(event: Event) -> None:
        if event.done is not None:
            outcomes[event.job.number] = event.done
        on_event(event)

    def list_missing() -> Iterator[tuple[Job, Keys]]:
        files = FileDigests(cache.folder / "files")
        for job in sorted(jobs, key=lambda job: (-_length(job.clip) * len(job.tasks), job.number)):
            keys = make_keys(job, files)
            if (done := find_cached(job, keys, cache)) is not None:
                collect_outcome(Event(job, done))
            else:
                yield job, keys

    workers.run(list_missing(), cache, collect_outcome)
    return outcomes


def plan_study(spec: Spec, base: Path, clips: Sequence[str] = ()) -> Plan:
    """Read the data sets of a study. base: what their folders are relative to. clips: patterns of names.

    Raises InputError for wrong settings, an unknown kind of data set or engine, and if no clip is left.
    """
    settings = load_config(spec.config, spec.overrides)
    backend = "onboard" if spec.backend == "auto" else spec.backend
    load_engine(backend, settings)
    if spec.interval < 1:
        raise InputError(f"the interval must be 1 or more frames, got {spec.interval}")
    jobs: list[Job] = []
    left_out: list[str] = []
    notes: list[str] = []
    names: list[str] = []
    sets: list[dict[str, Any]] = []
    for source in spec.sources:
        found = read(source, base)
        left_out += found.missing
        notes += found.notes
        names += [clip.name for clip in found.clips]
        sets.append({"kind": found.kind, "folder": found.folder, "terms": found.terms, "clips": len(found.clips)})
        for clip in found.clips:
            if clips and not any(fnmatchcase(clip.name, pattern) for pattern in clips):
                continue
            allowed = allowed_tasks(clip)
            tasks = tuple(task for task in TASKS if task in allowed and (not spec.tasks or task in spec.tasks))
            if any(job.clip.name == clip.name for job in jobs):
                left_out.append(f"{clip.name} of {found.folder}: a clip of that name is in the study already")
            elif tasks:
                jobs.append(Job(len(jobs), clip, tasks, settings, backend, spec.interval))
            else:
                left_out.append(f"{clip.name}: {_why_no_task(spec, clip, allowed)}")
    if not jobs:
        raise InputError(f"no clip is left to evaluate by {spec.name}{_why_no_clip(clips, names, left_out)}")
    facts = {"datasets": sets, "backend": backend, "code": code_identity(backend)}
    return Plan(settings, tuple(jobs), tuple(left_out), tuple(notes), facts)


def _why_no_task(spec: Spec, clip: Clip, allowed: Sequence[Task]) -> str:
    if clip.truth is None and not clip.still:
        return f"it has no truth ({clip.place})"
    return f"it allows {', '.join(allowed) or 'no task'}, and {', '.join(spec.tasks)} was asked for"


def _why_no_clip(patterns: Sequence[str], names: Sequence[str], left_out: Sequence[str]) -> str:
    if patterns and names and not any(fnmatchcase(name, pattern) for name in names for pattern in patterns):
        more = f" and {len(names) - 9} more" if len(names) > 10 else ""
        listed = ", ".join(names[:9] if more else names)
        return f": {' and '.join(patterns)} {'fits' if len(patterns) == 1 else 'fit'} none; there are {listed}{more}"
    more = f" (and {len(left_out) - 1} more)" if len(left_out) > 1 else ""
    return f": {left_out[0]}{more}" if left_out else ""


def _length(clip: Clip) -> int:
    if clip.frames:
        return clip.frames
    if len(clip.pictures) > 1:
        return len(clip.pictures)
    return clip.truth.frames[-1] if clip.truth is not None and clip.truth.frames else 0
