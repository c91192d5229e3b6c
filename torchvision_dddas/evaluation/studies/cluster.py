"""Jobs shared among the workers of a Dask cluster: one that dies costs the time of its clips, others go on.

Workers read the clips' files where this machine has them, so that folders must be shared; results come back and are
kept here. A worker whose package is not this one, by its code, gets no job.
"""

import logging
import queue
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import digests
from torchvision_dddas.evaluation.studies.cache import Cache, Carried
from torchvision_dddas.evaluation.studies.jobs import TRIES, Event
from torchvision_dddas.evaluation.studies.working import Done, Job, Keys, work
from torchvision_dddas.runtime import VERSION

CONNECT_S = 5.0
"""So long a scheduler may take to answer."""

ALONE_S = 30.0
"""So long it may be without a worker that can take jobs."""

_LOOK_S = 0.5

Identity = tuple[str, str]
"""Version and digest of the code of a package."""


def spread(jobs: Sequence[Job], client: Any, cache: Cache, alone_s: float = ALONE_S) -> Iterator[Event]:
    """Do jobs in the order given on the workers of a scheduler; events as they come. client: as `connected` gives it.

    Raises InputError where no worker can take jobs for alone_s.
    """
    yield from _Cluster(client, client.scheduler.address, jobs, cache, alone_s).events()


def identity(backend: str) -> Identity:
    """What this package is: workers that say the same find the same."""
    return VERSION, digests.of(digests.code(digests.FINDS, backend), digests.code(digests.SCORES))


def remote(job: Job, known: dict[str, bytes]) -> tuple[list[Done], dict[str, bytes]]:
    """A job on a worker: what became of it, and all that is to be kept. known: what is kept already."""
    from torchvision_dddas.evaluation.studies.worker import one_thread

    one_thread(job.backend)
    store = Carried(known)
    return work(job, store, digests.Files(None)), store.made


@contextmanager
def connected(scheduler: str) -> Iterator[Any]:
    """A client of a scheduler. Raises InputError where Dask is missing, or the scheduler cannot be reached."""
    client = _client(scheduler)
    try:
        yield client
    finally:
        client.close()


def _client(scheduler: str) -> Any:
    if find_spec("distributed") is None:
        raise InputError("--scheduler needs dask and distributed; pip install 'torchvision-dddas[distributed]'")
    from distributed import Client
    from distributed.comm.addressing import parse_address, parse_host_port
    from distributed.comm.registry import get_backend

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it tells of each worker that goes; so do we
    try:
        # Seen before there is a client: one of what is no address complains again when it goes.
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


@dataclass
class _Cluster:
    client: Any
    scheduler: str
    jobs: Sequence[Job]
    cache: Cache
    alone_s: float
    ours: dict[str, int] = field(default_factory=dict)  # workers that may have jobs, and how many threads each has
    seen: set[str] = field(default_factory=set)
    told: list[str] = field(default_factory=list)
    running: dict[Any, tuple[Job, str]] = field(default_factory=dict)
    tries: dict[int, int] = field(default_factory=dict)
    ended: "queue.SimpleQueue[Any]" = field(default_factory=queue.SimpleQueue)

    def events(self) -> Iterator[Event]:
        """Until all is done."""
        waiting, files = deque(self.jobs), digests.Files(self.cache.folder / "files")
        since = time.monotonic()
        while waiting or self.running:
            self._look()
            job = waiting[0] if waiting else next(iter(self.running.values()))[0]
            while self.told:
                yield Event(job, note=self.told.pop(0))
            yield from self._lost(waiting)
            if self.ours:
                since = time.monotonic()
            elif time.monotonic() - since > self.alone_s:
                raise InputError(
                    f"{self.scheduler} has had no worker with this version of the package ({VERSION}) for "
                    f"{self.alone_s:g} s; start `dask worker {self.scheduler} --nthreads 1` in this environment"
                )
            while waiting and (worker := self._free()):
                self._submit(waiting.popleft(), worker, files)
            yield from self._gathered(waiting)

    def _look(self) -> None:
        """See which workers there are; those that came are asked what they are."""
        info = self.client.scheduler_info(n_workers=-1)["workers"]
        self.ours = {address: threads for address, threads in self.ours.items() if address in info}
        new = [address for address in info if address not in self.seen]
        if not new:
            return
        wanted = identity(self.jobs[0].backend)
        # Sent by value: a worker without the package, or with another, must be able to answer.
        asked = self.client.run(_probe(self.jobs[0].backend), workers=new, on_error="return")
        self.seen |= set(new)
        for address, answer in asked.items():
            if answer == wanted:
                self.ours[address] = info[address]["nthreads"]
            else:
                has = f"version {answer[0]}" if isinstance(answer, tuple) else "none that can be used"
                same = isinstance(answer, tuple) and answer[0] == wanted[0]
                other = f"{has}, but other code or libraries" if same else has
                self.told.append(f"{address} gets no clip: of this package it has {other}; here is {wanted[0]}")

    def _free(self) -> str:
        """The worker with the most threads that have nothing to do; empty where none has."""
        busy = dict.fromkeys(self.ours, 0)
        for _, address in self.running.values():
            busy[address] = busy.get(address, 0) + 1
        idle = {address: threads - busy[address] for address, threads in self.ours.items()}
        best = max(idle, key=lambda address: (idle[address], address), default="")
        return best if best and idle[best] > 0 else ""

    def _submit(self, job: Job, worker: str, files: digests.Files) -> None:
        known: dict[str, bytes] = {}
        keys = Keys(job, files)
        for task in ("motion", *job.tasks):
            try:
                wanted = (keys.found(task), keys.scored(task))
            except InputError:
                continue  # the worker will say so
            known |= {key: content for key in wanted if (content := self.cache.content(key)) is not None}
        future = self.client.submit(
            remote, job, known, workers=[worker], allow_other_workers=False, pure=False, retries=0
        )
        self.running[future] = job, worker
        future.add_done_callback(self.ended.put)

    def _lost(self, waiting: deque[Job]) -> Iterator[Event]:
        """Take back the jobs of workers that are gone."""
        for future, (job, worker) in list(self.running.items()):
            if worker not in self.ours and not future.done():
                del self.running[future]
                future.cancel()
                yield from self._again(job, waiting, f"its worker {worker} is gone")

    def _again(self, job: Job, waiting: deque[Job], why: str) -> Iterator[Event]:
        self.tries[job.number] = self.tries.get(job.number, 0) + 1
        if self.tries[job.number] < TRIES:
            waiting.appendleft(job)
            yield Event(job, note=f"{job.clip.name}: {why}; it is tried again")
        else:
            cause = f"{why}, {TRIES} times; is there memory enough for it?"
            yield Event(job, tuple(Done(task, cause=cause) for task in job.tasks))

    def _gathered(self, waiting: deque[Job]) -> Iterator[Event]:
        """What has ended, or nothing after a moment."""
        try:
            future = self.ended.get(timeout=_LOOK_S)
        except queue.Empty:
            return
        if future not in self.running:
            return
        job, worker = self.running.pop(future)
        error = future.exception() if future.status != "cancelled" else None
        if future.status == "finished":
            done, made = future.result()
            for key, content in made.items():
                self.cache.keep(key, content)
            yield Event(job, tuple(done))
        else:
            said = f"{type(error).__name__}: {error}" if error is not None else f"its worker {worker} is gone"
            yield from self._again(job, waiting, said)


def _probe(backend: str) -> Any:
    def identity_there() -> Any:
        from importlib import import_module

        found: Any = import_module("torchvision_dddas.evaluation.studies.cluster").identity(backend)
        return found

    return identity_there
