"""One clip from its files to its measures: each stage is taken from what is kept, or computed and kept."""

import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies import digests
from torchvision_dddas.evaluation.studies.cache import Cache, Store
from torchvision_dddas.evaluation.studies.record import Found, Task
from torchvision_dddas.evaluation.studies.rows import Tick
from torchvision_dddas.evaluation.studies.stages import KNOBS, allowed, files_of, find, labelled, upstream


@dataclass(frozen=True)
class Job:
    """A clip and what is asked of it. number: its place in the study. tasks: each after what it is done upon."""

    number: int
    clip: Clip
    tasks: tuple[Task, ...]
    settings: Settings
    backend: str
    interval: int


@dataclass(frozen=True)
class Done:
    """What became of a task. found, scored: keys of what is kept, empty where there is none; cause: why there is none.

    computed: the stages that were not taken from what was kept. trace: where a fault of the program was.
    """

    task: Task
    found: str = ""
    scored: str = ""
    cause: str = ""
    computed: tuple[str, ...] = ()
    trace: str = ""


class Keys:
    """The keys of a job's tasks, each made once."""

    def __init__(self, job: Job, files: digests.Files) -> None:
        self._job, self._files = job, files
        self._found: dict[Task, str] = {}

    def found(self, task: Task) -> str:
        """That of what a task finds. Raises InputError where a file cannot be read."""
        if task not in self._found:
            self._found[task] = self._of(task)
        return self._found[task]

    def scored(self, task: Task) -> str:
        """That of how right it is. Raises InputError where a file cannot be read."""
        job, clip = self._job, self._job.clip
        known = (clip.still, clip.shows, _truth(clip, self._files))
        return digests.of("scored", task, digests.code(digests.SCORES), self.found(task), job.interval, known)

    def _of(self, task: Task) -> str:
        job, clip, before = self._job, self._job.clip, upstream(self._job.clip, task)
        truth: Any = sorted(labelled(clip)) if task == "motion" else None
        if task == "association" and clip.truth is not None:
            truth = clip.truth.tracks
        return digests.of(
            ("found", task, digests.code(digests.FINDS, job.backend), job.backend),
            {group: getattr(job.settings, group).model_dump() for group in KNOBS[task]},
            self._files.digest([*files_of(clip, task), *_named_by(job.settings, task)]),
            clip.rate_hz,
            truth,
            None if task in ("motion", "people") else job.interval,
            "" if before is None else self.found(before),
        )


def _named_by(settings: Settings, task: Task) -> list[Path]:
    """Files that parameters name."""
    if "people" not in KNOBS[task]:
        return []
    named: list[Path] = []
    for text in (settings.people.classifier, settings.people.graphs):
        path = Path(text)
        named += sorted(path.iterdir()) if path.is_dir() else [path] if path.is_file() else []
    return named


def _truth(clip: Clip, files: digests.Files) -> Any:
    """What is true of the clip, without where that is written."""
    truth = clip.truth
    if truth is None:
        return None
    masks = files.digest([truth.masks[frame] for frame in sorted(truth.masks)])
    rest = {name: value for name, value in vars(truth).items() if name not in ("masks", "place")}
    return (sorted(truth.masks), masks, rest)


def work(job: Job, store: Store, files: digests.Files, tick: Tick = lambda: None) -> list[Done]:
    """Do a job; one task's bad input does not hinder the others. tick: called once a frame."""
    keys = Keys(job, files)
    return [_Work(job, keys, store, tick).done(task) for task in job.tasks]


def kept(job: Job, cache: Cache, files: digests.Files) -> list[Done] | None:
    """What became of a job where all of it is kept; None where something is not, or its files have to be read."""
    keys = Keys(job, files)
    try:
        done = [Done(task, keys.found(task), keys.scored(task)) for task in job.tasks]
    except (InputError, digests.UnreadError):
        return None
    return done if all(cache.has(d.found) and cache.has(d.scored) for d in done) else None


class _Work:
    """A job under way."""

    def __init__(self, job: Job, keys: Keys, store: Store, tick: Tick) -> None:
        self._job, self._keys, self._store, self._tick = job, keys, store, tick
        self._computed: list[str] = []

    def done(self, task: Task) -> Done:
        """Do a task."""
        try:
            if task not in allowed(self._job.clip):
                raise InputError(f"its pictures and truth do not allow {task}")
            found_key, scored_key = self._keys.found(task), self._keys.scored(task)
            found = self._found(task, self._tick)
            if self._store.get(scored_key) is None:
                from torchvision_dddas.evaluation.studies.scoring import score

                self._store.put(scored_key, score(self._job.clip, task, found, self._job.interval))
                self._computed.append(f"{task}: score")
        except InputError as error:
            return Done(task, cause=str(error), computed=tuple(self._computed))
        except Exception as error:
            cause = str(InputError(f"a fault of the program, {type(error).__name__}: {error}"))
            return Done(task, cause=cause, computed=tuple(self._computed), trace=traceback.format_exc())
        return Done(task, found_key, scored_key, computed=tuple(self._computed))

    def _found(self, task: Task, tick: Tick) -> Found:
        """What a task finds, kept or computed."""
        key, job = self._keys.found(task), self._job
        known: Found | None = self._store.get(key)
        if known is not None:
            return known
        need = upstream(job.clip, task)
        before = None if need is None else self._found(need, lambda: None)
        found = find(job.clip, task, job.settings, job.backend, job.interval, before, tick)
        self._store.put(key, found)
        self._computed.append(task)
        return found
