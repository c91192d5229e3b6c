"""Jobs shared among the processes of a Dask cluster, on this machine or elsewhere; one job at a time needs no Dask.

Workers of a cluster read the clips' files where this machine has them, so that folders must be shared. Their results
come back, and this machine keeps them.
"""

import logging
import os
import queue
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from itertools import chain, islice
from typing import Any

import cv2

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.jobs import (
    Done,
    Event,
    FrameCounter,
    Job,
    Keys,
    OnEvent,
    code_identity,
    do_job,
)
from torchvision_dddas.evaluation.studies.storage import Cache, CarriedRecords, Store
from torchvision_dddas.runtime import VERSION

MAX_DEATHS = 3
"""If so many workers die over a job, its clip is left out."""

CONNECT_S = 5.0
"""How long a scheduler may take to answer."""

NO_WORKER_S = 30.0
"""How long a scheduler may be without any worker."""

_POLL_S = 0.25
_TOPIC = "dddas-frames"
_ONE_THREAD = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "OMP_WAIT_POLICY": "PASSIVE",
}
_INSTALL = "dask and distributed; pip install 'torchvision-dddas[distributed]'"


class Workers:
    """The processes that do jobs, each on one thread. A context manager: they end with the block.

    jobs: how many; 1 is this process itself; None is one per core, or 1 without Dask. scheduler: the address of a Dask
    scheduler, whose workers are taken instead. Local workers start when they are first needed. Raises InputError if
    Dask is needed and not installed, or the scheduler does not answer.
    """

    def __init__(self, jobs: int | None = None, scheduler: str | None = None) -> None:
        has_dask = find_spec("distributed") is not None
        if scheduler is not None and not has_dask:
            raise InputError(f"--scheduler needs {_INSTALL}")
        if jobs is None:
            jobs = available_cores() if has_dask else 1
        if jobs < 1:
            raise InputError(f"--jobs must be 1 or more, got {jobs}")
        if jobs > 1 and not has_dask:
            raise InputError(f"--jobs {jobs} needs {_INSTALL}, or take --jobs 1")
        self._jobs, self._scheduler, self._stack = jobs, scheduler, ExitStack()
        self._client: Any = None

    def __enter__(self) -> "Workers":
        if self._scheduler is not None:
            self._client = self._stack.enter_context(_connect(self._scheduler))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def run(self, jobs: Iterable[tuple[Job, Keys]], cache: Cache, on_event: OnEvent) -> None:
        """Do jobs in the order given; report each one's progress and outcome. Results are in the cache afterwards.

        Results do not depend on the number of workers, but for the last digits where BLAS runs on several threads in
        this process. Raises InputError if no worker can do them.
        """
        if self._scheduler is None and self._jobs == 1:
            for job, keys in jobs:
                counter = FrameCounter(partial(_report_frames, on_event, job))
                with _one_thread(job.backend):
                    done = do_job(job, keys, cache, counter)
                counter.flush()
                on_event(Event(job, done, note=_take_notes(cache)))
            return
        iterator = iter(jobs)
        if (first := next(iterator, None)) is not None:  # otherwise no worker has to start
            self._share(chain([first], iterator), cache, on_event)

    def _share(self, jobs: Iterator[tuple[Job, Keys]], cache: Cache, on_event: OnEvent) -> None:
        if self._client is None:
            self._client = _start_local(self._jobs, self._stack)
        client, running, news = self._client, dict[Any, Job](), queue.SimpleQueue[Any]()
        client.subscribe_topic(_TOPIC, lambda event: news.put(event[1]))
        alone_since = time.monotonic()
        try:
            while True:
                # No more jobs than threads: Dask blames a worker's death on the jobs that wait there, too.
                threads = sum(client.nthreads().values())
                for job, keys in islice(jobs, max(threads - len(running), 0)):
                    store = cache if self._scheduler is None else _carried(keys, cache)
                    code = "" if self._scheduler is None else code_identity(job.backend)
                    future = client.submit(_remote, job, keys, store, code, pure=False)
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
            cause = f"its worker died {deaths} times; is there memory enough for {job.clip.name} and {job.backend}?"
            return Event(job, tuple(Done(task, cause=cause) for task in job.tasks))
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


def available_cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _remote(
    job: Job, keys: Keys, store: Cache | CarriedRecords, code: str
) -> tuple[tuple[Done, ...], str, dict[str, bytes]]:
    """A job on a worker: its outcome, notes, and records that have to travel back. code: what its package must be."""
    from distributed import get_worker

    if code and code_identity(job.backend) != code:
        raise InputError(f"a worker has another version of the package, its libraries or code; wanted {VERSION}")
    worker = get_worker()
    counter = FrameCounter(lambda frames: worker.log_event(_TOPIC, (job.number, frames)))
    with _one_thread(job.backend):
        done = do_job(job, keys, store, counter)
    counter.flush()
    return done, _take_notes(store), store.made


def _report_frames(on_event: OnEvent, job: Job, frames: int) -> None:
    on_event(Event(job, frames=frames))


def _take_notes(store: Store) -> str:
    """The notes of a store as one line; it has none afterwards."""
    line = "; ".join(store.notes)
    store.notes.clear()
    return line


@contextmanager
def _one_thread(backend: str) -> Iterator[None]:
    """Hold OpenCV, and torch if it is the engine, to one thread: sums on several differ in their last digits."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    torch_before = 0
    if backend == "torch":
        import torch

        torch_before = torch.get_num_threads()
        torch.set_num_threads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
        if torch_before:
            torch.set_num_threads(torch_before)


def _carried(keys: Keys, cache: Cache) -> CarriedRecords:
    wanted = (*keys.found.values(), *keys.scored.values())
    return CarriedRecords({key: content for key in wanted if (content := cache.read(key)) is not None})


def _start_local(jobs: int, stack: ExitStack) -> Any:
    """A client of new processes on this machine, which end with the stack."""
    import dask
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with dask.config.set({"distributed.scheduler.allowed-failures": MAX_DEATHS - 1}):
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


def _connect(scheduler: str) -> Any:
    """A client of a scheduler. Raises InputError if it cannot be reached."""
    from distributed import Client
    from distributed.comm.addressing import parse_address, parse_host_port
    from distributed.comm.registry import get_backend

    logging.getLogger("distributed").setLevel(
        logging.CRITICAL
    )  # it logs each lost worker, which is reported here anyway
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
