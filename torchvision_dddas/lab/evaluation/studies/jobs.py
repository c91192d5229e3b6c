"""Jobs: compute the measures of one clip, stage by stage, with a cache. Dask shares jobs among processes.

One job at a time needs no Dask. The workers of a cluster must share the folders of clips and of the cache with this
machine.
"""

import os
import queue
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import chain, islice
from pathlib import Path
from typing import Any

import cv2

from torchvision_dddas.config import Group, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.interrupts import is_stop
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.studies.cache import Cache, code_digest, digest, files_digest
from torchvision_dddas.lab.evaluation.studies.records import Findings, Task
from torchvision_dddas.lab.evaluation.studies.scoring import score
from torchvision_dddas.lab.evaluation.studies.stages import (
    PARAMETER_GROUPS,
    OnFrame,
    allowed_tasks,
    files_of,
    find,
    labelled_frames,
    upstream_task,
)
from torchvision_dddas.runtime import VERSION

MAX_DEATHS = 3
"""The clip of a job is left out if this number of workers die over it, or give no sign."""

NO_WORKER_S = 30.0
"""Longest time that a scheduler may be without workers."""

SILENT_S = 60.0
"""A local worker that gives no sign for this time, for example a stopped worker, is replaced. Its clip starts again."""

_POLL_S = _REPORT_S = 0.25
_TOPIC = "dddas-frames"
_CLUSTER = "torchvision_dddas.lab.evaluation.studies.cluster"  # imported only when needed, because Dask is an extra
_INSTALL = "dask, distributed and cryptography; pip install 'torchvision-dddas[distributed]'"


@dataclass(frozen=True)
class Job:
    """A clip and its requested tasks. number: its place in the study. tasks: each after tasks that it depends on."""

    number: int
    clip: Clip
    tasks: tuple[Task, ...]
    settings: Settings
    backend: str
    interval: int


@dataclass(frozen=True)
class Done:
    """The outcome of a task. found, scored: keys in the cache, empty without a result. cause: why there is no result.

    computed: the stages that were not in the cache. trace: the traceback of an error in the program.
    """

    task: Task
    found: str = ""
    scored: str = ""
    cause: str = ""
    computed: tuple[str, ...] = ()
    trace: str = ""


@dataclass(frozen=True)
class JobEvent:
    """Progress of a job. done: its outcome, if it ended. frames: processed since the last event. note: for the user."""

    job: Job
    done: tuple[Done, ...] | None = None
    frames: int = 0
    note: str = ""


OnEvent = Callable[[JobEvent], object]
Keys = Mapping[Task, Done]
"""By task, the outcome that a job has when all its tasks are computed. The keys are known beforehand."""


def make_keys(job: Job, memory: Path | None = None) -> Keys:
    """Return the keys of a job's results: digests of everything that they depend on, and of nothing else.

    memory: as in `files_digest`.
    """
    clip, settings, keys = job.clip, job.settings, dict[Task, Done]()
    needed = [need for task in job.tasks if (need := upstream_task(clip, task)) is not None]
    for task in dict.fromkeys([*needed, *job.tasks]):
        need = upstream_task(clip, task)
        before = Done(task) if need is None else keys[need]
        truth: Any = sorted(labelled_frames(clip)) if task == "motion" else None
        if task == "association" and clip.truth is not None:
            truth = clip.truth.tracks
        files = files_of(clip, task)
        if "people" in PARAMETER_GROUPS[task]:
            for path in (Path(settings.people.classifier), Path(settings.people.graphs)):
                files += sorted(path.iterdir()) if path.is_dir() else [path] if path.is_file() else []
        try:
            if before.cause:
                raise InputError(before.cause)
            found = digest(
                ("found", task, code_digest(job.backend), job.backend),
                {group: _content(getattr(settings, group)) for group in PARAMETER_GROUPS[task]},
                files_digest(files, memory),
                clip.rate_hz,
                truth,
                None if task in ("motion", "people") else job.interval,
                before.found,
            )
            whole: Any = None  # the content of the truth, without its location
            if clip.truth is not None:
                numbers = sorted(clip.truth.masks)
                rest = {name: value for name, value in vars(clip.truth).items() if name not in ("masks", "place")}
                whole = (numbers, files_digest([clip.truth.masks[number] for number in numbers], memory), rest)
            known = (clip.still, clip.shows, whole)
            keys[task] = Done(task, found, digest("scored", task, found, job.interval, known))
        except InputError as error:
            keys[task] = Done(task, cause=str(error))
    return keys


def _content(group: Group) -> tuple[dict[str, Any], list[str]]:
    """Return the values of a group of settings, and the values that are set: these take precedence over a log's."""
    return group.model_dump(), sorted(group.model_fields_set)


def find_cached(job: Job, keys: Keys, cache: Cache) -> tuple[Done, ...] | None:
    """Return the outcome of a job if all of it is in the cache, else None."""
    done = tuple(keys[task] for task in job.tasks)
    return done if all(not d.cause and cache.has(d.found) and cache.has(d.scored) for d in done) else None


def do_job(job: Job, keys: Keys, store: Cache, on_frame: OnFrame = lambda: None) -> tuple[Done, ...]:
    """Do all tasks of a job. Bad input of one task does not stop the others. on_frame: called once for each frame."""

    def find_or_get(task: Task, on_frame: OnFrame, computed: list[str]) -> Findings:
        found: Findings | None = store.get(keys[task].found)
        if found is None:
            need = upstream_task(job.clip, task)
            before = None if need is None else find_or_get(need, lambda: None, computed)
            found = find(job.clip, task, job.settings, job.backend, job.interval, before, on_frame)
            store.put(keys[task].found, found)
            computed.append(task)
        return found

    def do_task(task: Task) -> Done:
        computed: list[str] = []
        try:
            if task not in allowed_tasks(job.clip):
                raise InputError(f"its pictures and truth do not allow {task}")
            if keys[task].cause:
                raise InputError(keys[task].cause)
            found = find_or_get(task, on_frame, computed)
            if store.get(keys[task].scored) is None:
                store.put(keys[task].scored, score(job.clip, task, found, job.interval))
                computed.append(f"{task}: score")
            return replace(keys[task], computed=tuple(computed))
        except InputError as error:
            return Done(task, cause=str(error), computed=tuple(computed))
        except Exception as error:
            if is_stop(error):
                raise
            cause = str(InputError(f"a fault of the program, {type(error).__name__}: {error}"))
            return Done(task, cause=cause, computed=tuple(computed), trace=traceback.format_exc())

    return tuple(map(do_task, job.tasks))


def _do_on_one_thread(job: Job, keys: Keys, store: Cache, report: OnEvent) -> tuple[tuple[Done, ...], str]:
    """Do a job and report the number of new frames a few times a second. Return its outcome and the store's notes."""
    frames, reported_s = 0, time.monotonic()

    def count_frame() -> None:
        nonlocal frames, reported_s
        frames += 1
        if time.monotonic() - reported_s >= _REPORT_S:
            report(JobEvent(job, frames=frames))
            frames, reported_s = 0, time.monotonic()

    with _one_thread(job.backend):
        done = do_job(job, keys, store, count_frame)
    if frames:
        report(JobEvent(job, frames=frames))
    notes = "; ".join(store.notes)
    store.notes.clear()
    return done, notes


class Workers:
    """The processes that do jobs, each on one thread. A context manager: they end with the block.

    jobs: their number; 1 is this process; None is one for each core, or 1 without Dask. scheduler: address of a Dask
    scheduler whose workers replace local workers. Local workers start when they are first needed. silent_s: a local
    worker that gives no sign for this time counts as dead; a scheduler has its own limit. Raise InputError if Dask is
    needed but not installed, or if the scheduler does not answer.
    """

    def __init__(self, jobs: int | None = None, scheduler: str | None = None, silent_s: float = SILENT_S) -> None:
        has_dask = all(find_spec(name) is not None for name in ("distributed", "cryptography"))
        if jobs is None:
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            jobs = cores if has_dask else 1
        if jobs < 1:
            raise InputError(f"--jobs must be 1 or more, got {jobs}")
        if not has_dask and (jobs > 1 or scheduler is not None):
            asked = f"--jobs {jobs}" if scheduler is None else "--scheduler"
            raise InputError(f"{asked} needs {_INSTALL}, or take --jobs 1")
        self._jobs, self._scheduler, self._silent_s, self._stack = jobs, scheduler, silent_s, ExitStack()
        self._client: Any = None

    def __enter__(self) -> "Workers":
        if self._scheduler is not None:
            from torchvision_dddas.lab.evaluation.studies.cluster import connect

            self._client = self._stack.enter_context(connect(self._scheduler))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and self._scheduler is None and (cluster := sys.modules.get(_CLUSTER)) is not None:
            cluster.kill_local(self._client)
        self._stack.close()

    def run(self, jobs: Iterable[tuple[Job, Keys]], cache: Cache, on_event: OnEvent) -> None:
        """Do jobs in the given order and report progress and outcome of each. The cache then contains the results.

        Results do not depend on the number of workers, except for the last digits if BLAS runs on several threads in
        this process. Raise InputError if no worker can do the jobs.
        """
        iterator = iter(jobs)
        if self._scheduler is None and self._jobs == 1:
            for job, keys in iterator:
                done, note = _do_on_one_thread(job, keys, cache, on_event)
                on_event(JobEvent(job, done, note=note))
        elif (first := next(iterator, None)) is not None:  # without jobs, no worker has to start
            self._share(chain([first], iterator), cache, on_event)

    def _share(self, jobs: Iterator[tuple[Job, Keys]], cache: Cache, on_event: OnEvent) -> None:
        if self._client is None:
            from torchvision_dddas.lab.evaluation.studies.cluster import start_local

            self._client = start_local(self._jobs, MAX_DEATHS, self._silent_s, self._stack)
        client, running, news = self._client, dict[Any, Job](), queue.SimpleQueue[Any]()
        client.subscribe_topic(_TOPIC, lambda event: news.put(event[1]))
        alone_since = time.monotonic()
        try:
            while True:
                # Submit no more jobs than threads: Dask also blames a worker's death on jobs that wait at this worker.
                threads = sum(client.nthreads().values())
                for job, keys in islice(jobs, max(threads - len(running), 0)):
                    code = "" if self._scheduler is None else code_digest(job.backend)
                    future = client.submit(_do_remotely, job, keys, cache, code, pure=False)
                    running[future] = job
                    future.add_done_callback(news.put)
                if threads and not running:
                    return
                if threads:
                    alone_since = time.monotonic()
                elif time.monotonic() - alone_since > NO_WORKER_S:
                    raise InputError(
                        f"the scheduler {self._scheduler} has had no worker for {NO_WORKER_S:g} s; {self._advice()}"
                    )
                with suppress(queue.Empty):
                    new = news.get(timeout=_POLL_S)
                    if new in running:
                        on_event(self._outcome(running.pop(new), new, cache))
                    elif isinstance(new, tuple):
                        for job in running.values():
                            if job.number == new[0]:
                                on_event(JobEvent(job, frames=new[1]))
        except OSError as error:
            raise InputError(f"the Dask scheduler has stopped ({error})") from None
        finally:
            client.unsubscribe_topic(_TOPIC)
            client.cancel(list(running), force=True)

    def _outcome(self, job: Job, future: Any, cache: Cache) -> JobEvent:
        from distributed import KilledWorker

        try:
            done, notes = future.result()
        except KilledWorker as error:
            cause = f"its worker died or gave no sign {error.allowed_failures + 1} times; "
            cause += f"is there memory enough for {job.clip.name} and {job.backend}?"
            return JobEvent(job, tuple(Done(task, cause=cause) for task in job.tasks))
        except InputError:
            raise
        except Exception as error:  # `do_job` raises no error, so the worker could not even start it
            raise InputError(f"a worker cannot do jobs ({type(error).__name__}: {error}); {self._advice()}") from None
        if not all(cache.path(key).exists() for d in done if not d.cause for key in (d.found, d.scored)):
            raise InputError(f"workers do not write to {cache.folder}; give a --cache that all machines share")
        return JobEvent(job, done, note=notes)

    def _advice(self) -> str:
        return (
            f"start `dask worker {self._scheduler} --nthreads 1` in this environment, with version {VERSION} of "
            "torchvision-dddas"
        )


def _do_remotely(job: Job, keys: Keys, cache: Cache, code: str) -> tuple[tuple[Done, ...], str]:
    """Do a job on a worker; return its outcome and notes. code: the digest that its package must have."""
    from distributed import get_worker

    if code and code_digest(job.backend) != code:
        raise InputError(f"a worker has another version of the package, its libraries or code; wanted {VERSION}")
    worker = get_worker()
    return _do_on_one_thread(job, keys, cache, lambda event: worker.log_event(_TOPIC, (job.number, event.frames)))


@contextmanager
def _one_thread(backend: str) -> Iterator[None]:
    """Limit OpenCV, and torch if it is the engine, to one thread: sums on several threads differ in last digits."""
    libraries: list[tuple[Callable[[int], object], int]] = [(cv2.setNumThreads, cv2.getNumThreads())]
    if backend == "torch":
        import torch

        libraries.append((torch.set_num_threads, torch.get_num_threads()))
    for set_threads, _ in libraries:
        set_threads(1)
    try:
        yield
    finally:
        for set_threads, before in libraries:
            set_threads(before)
