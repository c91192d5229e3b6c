"""A study from its file to its results: clips are read, jobs shared, results gathered in the study's order."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies import digests
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.jobs import Event, cores, share
from torchvision_dddas.evaluation.studies.record import TASKS, Case, Results, Spec, Task
from torchvision_dddas.evaluation.studies.stages import allowed
from torchvision_dddas.evaluation.studies.working import Done, Job, kept, work

Tell = Callable[[Event], object]


def cache_folder() -> Path:
    """Where results are kept unless another folder is named."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "torchvision_dddas" / "studies"


@dataclass(frozen=True)
class Plan:
    """What a study will do. left_out: in words, what it will not; notes: what lacks beside. facts: of the data sets."""

    settings: Settings
    jobs: tuple[Job, ...]
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Frames of all tasks, as far as it is known how many there are."""
        return sum(_length(job.clip) * len(job.tasks) for job in self.jobs)


def plan(spec: Spec, base: Path, clips: Sequence[str] = ()) -> Plan:
    """Read a study's data sets. base: what their folders are relative to. clips: patterns of names, none for all.

    Raises InputError for wrong settings, an unknown kind or back end, and where no clip is left.
    """
    from torchvision_dddas.detection import load_engine
    from torchvision_dddas.evaluation.datasets.kinds import read

    settings = load_config(spec.config, spec.overrides)
    backend = "onboard" if spec.backend == "auto" else spec.backend
    load_engine(backend, settings)
    if spec.interval < 1:
        raise InputError(f"the interval is {spec.interval} frames; wanted 1 or more")
    jobs: list[Job] = []
    left_out: list[str] = []
    notes: list[str] = []
    there: list[str] = []
    sets: list[dict[str, Any]] = []
    taken: set[str] = set()
    for source in spec.sources:
        found = read(source, base)
        left_out += found.missing
        notes += found.notes
        there += [clip.name for clip in found.clips]
        sets.append({"kind": found.kind, "folder": found.folder, "terms": found.terms, "clips": len(found.clips)})
        for clip in found.clips:
            if clips and not any(fnmatchcase(clip.name, pattern) for pattern in clips):
                continue
            if clip.name in taken:
                left_out.append(f"{clip.name} of {found.folder}: a clip of that name is in the study already")
                continue
            taken.add(clip.name)
            tasks, words = _tasks(spec, clip)
            left_out += words
            if tasks:
                jobs.append(Job(len(jobs), clip, tasks, settings, backend, spec.interval))
    if not jobs:
        raise InputError(f"no clip is left to evaluate by {spec.name}{_why_none(clips, there, left_out)}")
    facts = {"datasets": sets, "backend": backend, "code": digests.code(digests.FINDS, backend)}
    return Plan(settings, tuple(jobs), tuple(left_out), tuple(notes), facts)


def _why_none(clips: Sequence[str], there: Sequence[str], left_out: Sequence[str]) -> str:
    """Why no clip is left. clips: patterns that were asked for; there: names of the clips that could be read."""
    if clips and there and not any(fnmatchcase(name, pattern) for name in there for pattern in clips):
        more = f" and {len(there) - 9} more" if len(there) > 10 else ""
        names = ", ".join(there[:9] if more else there)
        return f": {' and '.join(clips)} {'fits' if len(clips) == 1 else 'fit'} none; there are {names}{more}"
    more = f" (and {len(left_out) - 1} more)" if len(left_out) > 1 else ""
    return f": {left_out[0]}{more}" if left_out else ""


def _tasks(spec: Spec, clip: Clip) -> tuple[tuple[Task, ...], list[str]]:
    """The tasks of a clip in the order of TASKS, and in words why it has none."""
    can = allowed(clip)
    tasks = tuple(task for task in TASKS if task in can and (not spec.tasks or task in spec.tasks))
    if tasks:
        return tasks, []
    if clip.truth is None and not clip.still:
        return (), [f"{clip.name}: it has no truth ({clip.place})"]
    return (), [f"{clip.name}: it allows {', '.join(can) or 'no task'}, and {', '.join(spec.tasks)} was asked for"]


def _length(clip: Clip) -> int:
    if clip.frames:
        return clip.frames
    if len(clip.pictures) > 1:
        return len(clip.pictures)
    return clip.truth.frames[-1] if clip.truth is not None and clip.truth.frames else 0


def _gathered(
    planned: Plan, spec: Spec, events: Iterator[Event], cache: Cache, tell: Tell, notes: list[str]
) -> Results:
    """The results of the jobs' events, each of which is told. notes: what the user should know, added to."""
    became: dict[int, tuple[Done, ...]] = {}
    for event in events:
        if event.note:
            notes.append(event.note)
        if event.done is not None:
            became[event.job.number] = event.done
        tell(event)
    cases: list[Case] = []
    left_out = list(planned.left_out)
    faults, computed = [], 0
    for job in planned.jobs:
        for done in became[job.number]:
            computed += len(done.computed)
            found = cache.get(done.found) if done.found else None
            scored = cache.get(done.scored) if done.scored else None
            cause = done.cause
            if found is not None:
                notes += [str(InputError(f"{job.clip.name}, {done.task}: {note}")) for note in found.notes]
            if not cause and (found is None or scored is None):
                cause = "what was kept of it is gone or damaged; run the study again"
            cases.append(Case(job.clip, done.task, found, scored, cause))
            if cause:
                left_out.append(f"{job.clip.name}, {done.task}: {cause}")
            if done.trace:
                faults.append({"clip": job.clip.name, "task": done.task, "trace": done.trace})
    facts = {**planned.facts, "computed": computed, "notes": notes, "faults": faults}
    return Results(spec, planned.settings, tuple(cases), tuple(left_out), facts)


def order(jobs: Sequence[Job]) -> list[Job]:
    """The longest first: what is long at the end leaves the other workers idle."""
    return sorted(jobs, key=lambda job: (-_length(job.clip) * len(job.tasks), job.number))


def run_study(
    spec: Spec,
    base: Path,
    jobs: int | None = None,
    scheduler: str | None = None,
    cache: Path | None = None,
    clips: Sequence[str] = (),
    tell: Tell = lambda event: None,
    begun: Callable[[Plan], object] = lambda planned: None,
) -> Results:
    """Run a study. base: what its folders are relative to; jobs: worker processes, 0 for none but this one.

    scheduler: the address of a Dask scheduler, whose workers do the work. cache: the folder where results are kept.
    clips: patterns of names. begun: is told what will be done. The results depend on none of these but the clips.
    Raises InputError as `plan` does, and where the scheduler cannot be reached.
    """
    count = cores() if jobs is None else jobs
    if count < 0:
        raise InputError(f"--jobs is {count}; wanted 1 or more processes")
    planned = plan(spec, base, clips)
    notes = list(planned.notes)
    store = Cache(cache or cache_folder(), notes.append)
    ordered = order(planned.jobs)
    if scheduler is None:
        begun(planned)
        events = _events(ordered, count, store)
        return _gathered(planned, spec, events, store, tell, notes)
    from torchvision_dddas.evaluation.studies.cluster import connected, spread

    with connected(scheduler) as client:
        begun(planned)
        waiting: list[Job] = []
        # What came from workers is known by this machine's own look at the files.
        known = _known(ordered, store, digests.Files(store.folder / "files"), waiting)
        return _gathered(planned, spec, chain(known, spread(waiting, client, store)), store, tell, notes)


def _events(jobs: Sequence[Job], count: int, store: Cache) -> Iterator[Event]:
    """What becomes of the jobs on this machine. Files that were never read are read by the workers, which are many."""
    waiting: list[Job] = []
    yield from _known(jobs, store, digests.Files(store.folder / "files", read=False), waiting)
    if count:
        yield from share(waiting, count, store.folder)
    else:
        files = digests.Files(store.folder / "files")
        yield from (Event(job, tuple(work(job, store, files))) for job in waiting)


def _known(jobs: Sequence[Job], store: Cache, files: digests.Files, waiting: list[Job]) -> Iterator[Event]:
    """The jobs of which all is kept: they need no worker. The others are added to `waiting`."""
    for job in jobs:
        done = kept(job, store, files)
        if done is None:
            waiting.append(job)
        else:
            yield Event(job, tuple(done))
