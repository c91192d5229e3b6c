"""One clip from its files to its measures: each stage is taken from the cache, or computed and kept."""

import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.fingerprints import FileDigests, code_digest
from torchvision_dddas.evaluation.studies.results import Found
from torchvision_dddas.evaluation.studies.scoring import score
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.evaluation.studies.stages import (
    PARAMETER_GROUPS,
    STAGES,
    OnFrame,
    allowed_tasks,
    files_of,
    find,
    labelled_frames,
    upstream_task,
)
from torchvision_dddas.evaluation.studies.storage import Cache, Store, digest

_REPORT_S = 0.25


@dataclass(frozen=True)
class Job:
    """A clip and what is asked of it. number: its place in the study. tasks: each after those it builds upon."""

    number: int
    clip: Clip
    tasks: tuple[Task, ...]
    settings: Settings
    backend: str
    interval: int


@dataclass(frozen=True)
class Keys:
    """The keys of a job's results in the cache, by task. causes: why a task has none."""

    found: dict[Task, str] = field(default_factory=dict)
    scored: dict[Task, str] = field(default_factory=dict)
    causes: dict[Task, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Done:
    """The outcome of a task. found, scored: keys in the cache, empty if there is no result; cause: why there is none.

    computed: the stages that were not in the cache. trace: the traceback of a fault of the program.
    """

    task: Task
    found: str = ""
    scored: str = ""
    cause: str = ""
    computed: tuple[str, ...] = ()
    trace: str = ""


@dataclass(frozen=True)
class Event:
    """Progress of a job. done: its outcome once it ends. frames: processed since the last event. note: for the user."""

    job: Job
    done: tuple[Done, ...] | None = None
    frames: int = 0
    note: str = ""


OnEvent = Callable[[Event], object]


class FrameCounter:
    """Called once per frame; reports the number of new frames a few times a second, and the rest by `flush`."""

    def __init__(self, report: Callable[[int], object]) -> None:
        self._report, self._count, self._reported_s = report, 0, time.monotonic()

    def __call__(self) -> None:
        """Count another frame."""
        self._count += 1
        if time.monotonic() - self._reported_s >= _REPORT_S:
            self.flush()

    def flush(self) -> None:
        """Report the rest."""
        if self._count:
            self._report(self._count)
        self._count, self._reported_s = 0, time.monotonic()


def make_keys(job: Job, files: FileDigests) -> Keys:
    """The keys of a job's tasks and of the tasks they build upon: all that a result depends on, and nothing else."""
    keys, clip = Keys(), job.clip
    needed = [need for task in job.tasks if (need := upstream_task(clip, task)) is not None]
    for task in dict.fromkeys([*needed, *job.tasks]):
        try:
            keys.found[task] = _found_key(job, task, keys, files)
            known = (clip.still, clip.shows, _truth_content(clip, files))
            keys.scored[task] = digest("scored", task, code_digest(score), keys.found[task], job.interval, known)
        except InputError as error:
            keys.causes[task] = str(error)
    return keys


def code_identity(backend: str) -> str:
    """The digest of all code that finds and scores. Machines where it is the same get the same results."""
    return digest(code_digest(score), *(code_digest(stage, backend) for stage in STAGES.values()))


def find_cached(job: Job, keys: Keys, cache: Cache) -> tuple[Done, ...] | None:
    """The outcome of a job if all of it is in the cache, else None."""
    if any(task not in keys.scored for task in job.tasks):
        return None
    done = tuple(Done(task, keys.found[task], keys.scored[task]) for task in job.tasks)
    return done if all(cache.has(d.found) and cache.has(d.scored) for d in done) else None


def do_job(job: Job, keys: Keys, store: Store, on_frame: OnFrame = lambda: None) -> tuple[Done, ...]:
    """Do all tasks of a job. Bad input of one does not stop the others. on_frame: called once per frame."""
    return tuple(_do_task(job, task, keys, store, on_frame) for task in job.tasks)


def _do_task(job: Job, task: Task, keys: Keys, store: Store, on_frame: OnFrame) -> Done:
    computed: list[str] = []
    try:
        if task not in allowed_tasks(job.clip):
            raise InputError(f"its pictures and truth do not allow {task}")
        if task in keys.causes:
            raise InputError(keys.causes[task])
        found = _find(job, task, keys, store, on_frame, computed)
        if store.get(keys.scored[task]) is None:
            store.put(keys.scored[task], score(job.clip, task, found, job.interval))
            computed.append(f"{task}: score")
    except InputError as error:
        return Done(task, cause=str(error), computed=tuple(computed))
    except Exception as error:
        cause = str(InputError(f"a fault of the program, {type(error).__name__}: {error}"))
        return Done(task, cause=cause, computed=tuple(computed), trace=traceback.format_exc())
    return Done(task, keys.found[task], keys.scored[task], computed=tuple(computed))


def _find(job: Job, task: Task, keys: Keys, store: Store, on_frame: OnFrame, computed: list[str]) -> Found:
    known: Found | None = store.get(keys.found[task])
    if known is not None:
        return known
    need = upstream_task(job.clip, task)
    before = None if need is None else _find(job, need, keys, store, lambda: None, computed)
    found = find(job.clip, task, job.settings, job.backend, job.interval, before, on_frame)
    store.put(keys.found[task], found)
    computed.append(task)
    return found


def _found_key(job: Job, task: Task, keys: Keys, files: FileDigests) -> str:
    clip, before = job.clip, upstream_task(job.clip, task)
    if before in keys.causes:
        raise InputError(keys.causes[before])
    truth: Any = sorted(labelled_frames(clip)) if task == "motion" else None
    if task == "association" and clip.truth is not None:
        truth = clip.truth.tracks
    return digest(
        ("found", task, code_digest(STAGES[task], job.backend), job.backend),
        {group: getattr(job.settings, group).model_dump() for group in PARAMETER_GROUPS[task]},
        files.digest([*files_of(clip, task), *_files_in_settings(job.settings, task)]),
        clip.rate_hz,
        truth,
        None if task in ("motion", "people") else job.interval,
        "" if before is None else keys.found[before],
    )


def _files_in_settings(settings: Settings, task: Task) -> list[Path]:
    """Files that parameters name."""
    if "people" not in PARAMETER_GROUPS[task]:
        return []
    places = [Path(settings.people.classifier), Path(settings.people.graphs)]
    return [
        file
        for path in places
        for file in (sorted(path.iterdir()) if path.is_dir() else [path] if path.is_file() else [])
    ]


def _truth_content(clip: Clip, files: FileDigests) -> Any:
    """The truth of a clip, without where it is written."""
    truth = clip.truth
    if truth is None:
        return None
    masks = files.digest([truth.masks[frame] for frame in sorted(truth.masks)])
    rest: Mapping[str, Any] = {name: value for name, value in vars(truth).items() if name not in ("masks", "place")}
    return (sorted(truth.masks), masks, rest)
