"""One clip from its files to its measures: each stage is taken from what is kept, or computed and kept."""

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchvision_dddas.datasets.record import Clip
from torchvision_dddas.errors import InputError
from torchvision_dddas.settings import Settings
from torchvision_dddas.studies import digests
from torchvision_dddas.studies.cache import Store
from torchvision_dddas.studies.record import Found, Task
from torchvision_dddas.studies.scored import Scored
from torchvision_dddas.studies.stages import KNOBS, Tick, allowed, files_of, find, labelled, upstream


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


def keys(job: Job, task: Task, files: digests.Files) -> tuple[str, str]:
    """The keys of what a task finds, and of how right that is. Raises InputError where a file cannot be read."""
    clip, before = job.clip, upstream(job.clip, task)
    knobs = {group: getattr(job.settings, group).model_dump() for group in KNOBS[task]}
    truth: Any = sorted(labelled(clip)) if task == "motion" else None
    if task == "association" and clip.truth is not None:
        truth = clip.truth.tracks
    found = digests.of(
        ("found", task, digests.code(digests.FINDS, job.backend), job.backend),
        knobs,
        files.digest([*files_of(clip, task), *_named_by(job.settings, task)]),
        clip.rate_hz,
        truth,
        None if task in ("motion", "people") else job.interval,
        "" if before is None else keys(job, before, files)[0],
    )
    scored = digests.of(
        "scored", task, digests.code(digests.SCORES), found, job.interval, clip.still, clip.shows, _truth(clip, files)
    )
    return found, scored


def _named_by(settings: Settings, task: Task) -> list[Path]:
    """Files that knobs name."""
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
    rest = (truth.kind, truth.boxes, truth.tracks, truth.ignored, truth.length, truth.labels, truth.positions)
    return (sorted(truth.masks), masks, rest)


def work(
    job: Job,
    store: Store,
    files: digests.Files,
    tell: Callable[[Done], object] = lambda done: None,
    tick: Tick = lambda: None,
) -> list[Done]:
    """Do a job; one task's bad input does not hinder the others. tell: is given each task as it is done."""
    done: list[Done] = []
    for task in job.tasks:
        done.append(_one(job, task, store, files, tick))
        tell(done[-1])
    return done


def _one(job: Job, task: Task, store: Store, files: digests.Files, tick: Tick) -> Done:
    computed: list[str] = []
    try:
        if task not in allowed(job.clip):
            raise InputError(f"its pictures and truth do not allow {task}")
        found_key, scored_key = keys(job, task, files)
        scored = store.get(scored_key)
        found = _found(job, task, store, files, computed, tick) if scored is None else store.get(found_key)
        if found is None:  # damaged
            found = _found(job, task, store, files, computed, tick)
        if scored is None:
            store.put(scored_key, _score(job, task, found))
            computed.append(f"{task}: scored")
    except InputError as error:
        return Done(task, cause=str(error), computed=tuple(computed))
    except Exception as error:
        cause = str(InputError(f"a fault of the program, {type(error).__name__}: {error}"))
        return Done(task, cause=cause, computed=tuple(computed), trace=traceback.format_exc())
    return Done(task, found_key, scored_key, computed=tuple(computed))


def _score(job: Job, task: Task, found: Found) -> Scored:
    if find_spec("torchvision_dddas.studies.scoring") is None:
        return Scored(found.looked, {})
    from torchvision_dddas.studies.scoring import score

    return score(job.clip, task, found, job.interval)


def _found(job: Job, task: Task, store: Store, files: digests.Files, computed: list[str], tick: Tick) -> Found:
    """What a task finds, kept or computed."""
    key = keys(job, task, files)[0]
    kept: Found | None = store.get(key)
    if kept is not None:
        return kept
    need = upstream(job.clip, task)
    before = None if need is None else _found(job, need, store, files, computed, lambda: None)
    found = find(job.clip, task, job.settings, job.backend, job.interval, before, tick)
    store.put(key, found)
    computed.append(task)
    return found
