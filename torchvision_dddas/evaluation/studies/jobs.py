"""Jobs: one clip from its files to its measures, each stage from the cache or computed; shared among processes by Dask.

One job at a time needs no Dask. Workers of a cluster read the clips' files where this machine has them, so that folders
must be shared. Their results come back, and this machine keeps them.
"""

import atexit
import logging
import multiprocessing
import os
import queue
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import chain, islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import cv2

from torchvision_dddas.config import Group, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.cache import Cache, CarriedRecords, code_digest, digest, files_digest
from torchvision_dddas.evaluation.studies.records import Found, Task
from torchvision_dddas.evaluation.studies.scoring import score
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
from torchvision_dddas.io.interrupts import is_stop
from torchvision_dddas.runtime import VERSION

MAX_DEATHS = 3
"""If so many workers die over a job, its clip is left out."""

CONNECT_S = 5.0
"""How long a scheduler may take to answer."""

NO_WORKER_S = 30.0
"""How long a scheduler may be without any worker."""

SILENT_S = 60.0
"""A local worker that has given no sign for so long, as one that was stopped, is replaced; its clip is left out."""

_POLL_S = _REPORT_S = 0.25
_LATE_S = 0.5  # after a signal, workers that were about to start have started by then
_LONGEST_STEP_S = 1.0  # counted of the time between two polls: longer, and this process was stopped, too
_TOPIC = "dddas-frames"
_ONE_THREAD = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "OMP_WAIT_POLICY": "PASSIVE",
}
_INSTALL = "dask and distributed; pip install 'torchvision-dddas[distributed]'"


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
class Done:
    """The outcome of a task. found, scored: keys in the cache, empty without a result; cause: why there is none.

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
Keys = Mapping[Task, Done]
"""The outcomes of a job's tasks, and of those they build upon, once all of it is computed."""


def make_keys(job: Job, memory: Path | None = None) -> Keys:
    """The keys of a job's results: digests of all that they depend on, and of nothing else.

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
                ("found", task, code_digest(STAGES[task], job.backend), job.backend),
                {group: _content(getattr(settings, group)) for group in PARAMETER_GROUPS[task]},
                files_digest(files, memory),
                clip.rate_hz,
                truth,
                None if task in ("motion", "people") else job.interval,
                before.found,
            )
            whole: Any = None  # the content of the truth, without where it is written
            if clip.truth is not None:
                numbers = sorted(clip.truth.masks)
                rest = {name: value for name, value in vars(clip.truth).items() if name not in ("masks", "place")}
                whole = (numbers, files_digest([clip.truth.masks[number] for number in numbers], memory), rest)
            known = (clip.still, clip.shows, whole)
            keys[task] = Done(task, found, digest("scored", task, code_digest(score), found, job.interval, known))
        except InputError as error:
            keys[task] = Done(task, cause=str(error))
    return keys


def _content(group: Group) -> tuple[dict[str, Any], list[str]]:
    """The values of a group of settings, and which of them are set: a value that is set wins over a log's."""
    return group.model_dump(), sorted(group.model_fields_set)


def code_identity(backend: str) -> str:
    """The digest of all code that finds and scores. Machines where it is the same get the same results."""
    return digest(code_digest(score), *(code_digest(stage, backend) for stage in STAGES.values()))


def find_cached(job: Job, keys: Keys, cache: Cache) -> tuple[Done, ...] | None:
    """The outcome of a job if all of it is in the cache, else None."""
    done = tuple(keys[task] for task in job.tasks)
    return done if all(not d.cause and cache.has(d.found) and cache.has(d.scored) for d in done) else None


def do_job(job: Job, keys: Keys, store: Cache, on_frame: OnFrame = lambda: None) -> tuple[Done, ...]:
    """Do all tasks of a job. Bad input of one does not stop the others. on_frame: called once per frame."""

    def find_or_get(task: Task, on_frame: OnFrame, computed: list[str]) -> Found:
        found: Found | None = store.get(keys[task].found)
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
    """Do a job and report the number of new frames a few times a second; its outcome, and the store's notes."""
    frames, reported_s = 0, time.monotonic()

    def count_frame() -> None:
        nonlocal frames, reported_s
        frames += 1
        if time.monotonic() - reported_s >= _REPORT_S:
            report(Event(job, frames=frames))
            frames, reported_s = 0, time.monotonic()

    with _one_thread(job.backend):
        done = do_job(job, keys, store, count_frame)
    if frames:
        report(Event(job, frames=frames))
    notes = "; ".join(store.notes)
    store.notes.clear()
    return done, notes


class Workers:
    """The processes that do jobs, each on one thread. A context manager: they end with the block.

    jobs: how many; 1 is this process itself; None is one per core, or 1 without Dask. scheduler: the address of a Dask
    scheduler, whose workers are taken instead. Local workers start when they are first needed. silent_s: a local worker
    that gives no sign for so long is replaced, and its clip is left out; a scheduler has its own limit. Raises
    InputError if Dask is needed and not installed, or the scheduler does not answer.
    """

    def __init__(self, jobs: int | None = None, scheduler: str | None = None, silent_s: float = SILENT_S) -> None:
        has_dask = find_spec("distributed") is not None
        if scheduler is not None and not has_dask:
            raise InputError(f"--scheduler needs {_INSTALL}")
        if jobs is None:
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            jobs = cores if has_dask else 1
        if jobs < 1:
            raise InputError(f"--jobs must be 1 or more, got {jobs}")
        if jobs > 1 and not has_dask:
            raise InputError(f"--jobs {jobs} needs {_INSTALL}, or take --jobs 1")
        self._jobs, self._scheduler, self._silent_s, self._stack = jobs, scheduler, silent_s, ExitStack()
        self._client: Any = None
        self._silence: _Silence | None = None

    def __enter__(self) -> "Workers":
        if self._scheduler is not None:
            self._client = self._stack.enter_context(_connect(self._scheduler))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and self._scheduler is None:
            _kill_local(self._client)
        self._stack.close()

    def run(self, jobs: Iterable[tuple[Job, Keys]], cache: Cache, on_event: OnEvent) -> None:
        """Do jobs in the order given; report each one's progress and outcome. Results are in the cache afterwards.

        Results do not depend on the number of workers, but for the last digits where BLAS runs on several threads in
        this process. Raises InputError if no worker can do them.
        """
        iterator = iter(jobs)
        if self._scheduler is None and self._jobs == 1:
            for job, keys in iterator:
                done, note = _do_on_one_thread(job, keys, cache, on_event)
                on_event(Event(job, done, note=note))
        elif (first := next(iterator, None)) is not None:  # otherwise no worker has to start
            self._share(chain([first], iterator), cache, on_event)

    def _share(self, jobs: Iterator[tuple[Job, Keys]], cache: Cache, on_event: OnEvent) -> None:
        if self._client is None:
            self._client = _start_local(self._jobs, self._stack)
            self._silence = _Silence(self._client.cluster, self._silent_s)
        client, running, news = self._client, dict[Any, Job](), queue.SimpleQueue[Any]()
        client.subscribe_topic(_TOPIC, lambda event: news.put(event[1]))
        alone_since = time.monotonic()
        try:
            while True:
                # No more jobs than threads: Dask blames a worker's death on the jobs that wait there, too.
                threads = sum(client.nthreads().values())
                for job, keys in islice(jobs, max(threads - len(running), 0)):
                    store: Cache = cache
                    if self._scheduler is not None:
                        wanted = {key: cache.read(key) for done in keys.values() for key in (done.found, done.scored)}
                        store = CarriedRecords({key: known for key, known in wanted.items() if known is not None})
                    code = "" if self._scheduler is None else code_identity(job.backend)
                    future = client.submit(_do_remotely, job, keys, store, code, pure=False)
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
                for key in self._silence.end_workers() if self._silence else ():
                    for future in [future for future in running if future.key == key]:
                        client.cancel([future], force=True)
                        on_event(_left_out(running.pop(future), f"its worker gave no sign for {self._silent_s:g} s"))
                with suppress(queue.Empty):
                    new = news.get(timeout=_POLL_S)
                    if new in running:
                        on_event(self._outcome(running.pop(new), new, cache))
                    elif isinstance(new, tuple):
                        for job in running.values():
                            if job.number == new[0]:
                                on_event(Event(job, frames=new[1]))
        except OSError as error:
            raise InputError(f"the Dask scheduler is gone ({error})") from None
        finally:
            client.unsubscribe_topic(_TOPIC)
            client.cancel(list(running), force=True)

    def _outcome(self, job: Job, future: Any, cache: Cache) -> Event:
        from distributed import KilledWorker

        try:
            done, notes, made = future.result()
        except KilledWorker as error:
            deaths = error.allowed_failures + 1
            return _left_out(
                job, f"its worker died {deaths} times; is there memory enough for {job.clip.name} and {job.backend}?"
            )
        except InputError:
            raise
        except Exception as error:  # `do_job` raises none: the worker cannot even start it
            raise InputError(f"a worker cannot do jobs ({type(error).__name__}: {error}); {self._advice()}") from None
        for key, content in made.items():
            cache.write(key, content)
        return Event(job, done, note=notes)

    def _advice(self) -> str:
        return (
            f"start `dask worker {self._scheduler} --nthreads 1` in this environment, with version {VERSION} of "
            "torchvision-dddas"
        )


def _left_out(job: Job, cause: str) -> Event:
    return Event(job, tuple(Done(task, cause=cause) for task in job.tasks))


class _Silence:
    """How long each worker of a local cluster has given no sign: its process is stopped, or hangs in a library."""

    def __init__(self, cluster: Any, limit_s: float) -> None:
        self._cluster, self._limit_s, self._polled_s = cluster, limit_s, time.monotonic()
        self._silent: dict[str, tuple[float, float]] = {}  # by address: the time of the last sign, the silence since

    def end_workers(self) -> list[str]:
        """End workers that were silent for longer than the limit; the keys of their jobs. Dask starts others."""
        now_s, keys = time.monotonic(), list[str]()
        step_s, self._polled_s = min(now_s - self._polled_s, _LONGEST_STEP_S), now_s
        known, self._silent = self._silent, {}
        for address, worker in list(self._cluster.scheduler.workers.items()):
            seen, silent_s = known.get(address, (worker.last_seen, 0.0))
            silent_s = silent_s + step_s if seen == worker.last_seen else 0.0
            self._silent[address] = (worker.last_seen, silent_s)
            if silent_s > self._limit_s:
                keys += [task.key for task in list(worker.processing)]
                for nanny in list(self._cluster.workers.values()):
                    if nanny.worker_address == address and nanny.pid:
                        self._silent.pop(address, None)
                        with suppress(ProcessLookupError):
                            os.kill(nanny.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        return keys


def _do_remotely(job: Job, keys: Keys, store: Cache, code: str) -> tuple[tuple[Done, ...], str, dict[str, bytes]]:
    """A job on a worker: its outcome, notes, and records that have to travel back. code: what its package must be."""
    from distributed import get_worker

    if code and code_identity(job.backend) != code:
        raise InputError(f"a worker has another version of the package, its libraries or code; wanted {VERSION}")
    worker = get_worker()
    done, notes = _do_on_one_thread(
        job, keys, store, lambda event: worker.log_event(_TOPIC, (job.number, event.frames))
    )
    return done, notes, store.made if isinstance(store, CarriedRecords) else {}


@contextmanager
def _one_thread(backend: str) -> Iterator[None]:
    """Hold OpenCV, and torch if it is the engine, to one thread: sums on several differ in their last digits."""
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


def _start_local(jobs: int, stack: ExitStack) -> Any:
    """A client of new processes on this machine, which end with the stack."""
    import dask
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    _start_tracker()
    limits = {"allowed-failures": MAX_DEATHS - 1, "worker-ttl": None}  # silent workers are ended here
    with dask.config.set({f"distributed.scheduler.{name}": limit for name, limit in limits.items()}):
        cluster = LocalCluster(
            n_workers=jobs,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            memory_limit=None,
            silence_logs=logging.CRITICAL,
            env=_ONE_THREAD,
        )
    stack.enter_context(cluster)
    return stack.enter_context(Client(cluster, set_as_default=False))


def _kill_local(client: Any) -> None:
    """End the workers of this machine at once: what is finished is in the cache, and Dask would wait for the rest.

    client: None if a signal came while they started; what Dask says of that is no concern of the user's.
    """
    if "distributed" not in sys.modules:
        return
    from distributed.deploy.spec import close_clusters

    for name in ("asyncio", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    atexit.unregister(close_clusters)
    for nanny in client.cluster.workers.values() if client is not None else ():
        nanny.close_gracefully()  # else it starts another worker
    # Those that were about to start would write a traceback once this process has gone.
    until_s = time.monotonic() + (_LATE_S if client is None else 0.0)
    while True:
        for child in multiprocessing.active_children():
            if child.name.startswith("Dask Worker"):
                child.kill()
        if time.monotonic() >= until_s:
            return
        time.sleep(0.01)


def _start_tracker() -> None:
    """Start the process that cleans up behind workers: it heeds no SIGHUP, as it heeds no Ctrl-C and no SIGTERM."""
    if hasattr(signal, "pthread_sigmask") and hasattr(signal, "SIGHUP"):
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
        try:
            resource_tracker.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _connect(scheduler: str) -> Any:
    """A client of a scheduler. Raises InputError if it cannot be reached."""
    from distributed import Client
    from distributed.comm.addressing import parse_address, parse_host_port
    from distributed.comm.registry import get_backend

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # lost workers are reported here anyway
    try:
        # Checked before there is a client, which would complain about a bad address again as it ends.
        scheme, host = parse_address(scheduler)
        get_backend(scheme)
        if scheme in ("tcp", "tls"):
            parse_host_port(host)
        return Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, ImportError) as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(
            f"no Dask scheduler answers at {scheduler} ({first}); wanted an address as tcp://host:8786, where "
            "`dask scheduler` runs"
        ) from None
