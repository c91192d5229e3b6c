"""The processes of a study, by Dask: private processes of this machine, or those of a scheduler.

Anyone who reaches a port of Dask can run code as the user who opened it. The processes of this machine therefore
communicate by TLS, and accept only connections with a key that is made for the run. None of them serves HTTP.
"""

import atexit
import logging
import multiprocessing
import signal
import time
from contextlib import ExitStack
from multiprocessing import resource_tracker
from tempfile import TemporaryDirectory
from typing import Any

import dask
from distributed import Client, Nanny, Scheduler, Security, SpecCluster, Worker
from distributed.comm.addressing import parse_address, parse_host_port
from distributed.comm.registry import get_backend
from distributed.deploy.spec import close_clusters

from torchvision_dddas.errors import InputError

CONNECT_S = 5.0
"""Time in which a scheduler must answer."""

_LATE_S = 0.5  # workers that were about to start at a signal have started after this time
_ONE_THREAD = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "OMP_WAIT_POLICY": "PASSIVE",
}


class _WithoutHttp:
    """A node of Dask without HTTP. Dask would open a port for HTTP even without a dashboard."""

    def start_http_server(self, *_: object, **__: object) -> None:
        """Start nothing."""


class LocalScheduler(_WithoutHttp, Scheduler):
    """The scheduler, as a thread of this process."""


class LocalWorker(_WithoutHttp, Worker):
    """A process that does jobs."""


def start_local(jobs: int, deaths: int, silent_s: float, stack: ExitStack) -> Client:
    """Return a client of new processes on this machine, which end with the stack.

    deaths: a job is given up after this many deaths of its process. silent_s: a process that gives no sign for this
    time is killed and replaced, which counts as a death.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    _start_tracker()
    security = Security.temporary()
    node = {"host": "127.0.0.1", "protocol": "tls://", "security": security}
    worker = {
        "worker_class": LocalWorker,
        "nthreads": 1,
        "memory_limit": None,
        "env": _ONE_THREAD,
        "silence_logs": logging.CRITICAL,
        **node,
    }
    settings = {
        "distributed.scheduler.allowed-failures": deaths - 1,
        "distributed.scheduler.worker-ttl": f"{silent_s} s",
        # Dask imports code from this folder. The default is in /tmp, where any user may have made it before.
        "temporary-directory": stack.enter_context(TemporaryDirectory(prefix="dddas-")),
    }
    with dask.config.set(settings):
        cluster = SpecCluster(
            workers={number: {"cls": Nanny, "options": worker} for number in range(jobs)},
            scheduler={"cls": LocalScheduler, "options": {"dashboard": False, **node}},
            security=security,
            silence_logs=logging.CRITICAL,
        )
    stack.enter_context(cluster)
    return stack.enter_context(Client(cluster, set_as_default=False))


def kill_local(client: Any) -> None:
    """End the processes of this machine at once. Finished results are in the cache; Dask would wait for the others.

    client: result of `start_local`; None if a signal came while the processes started. Dask's messages are not shown.
    """
    for name in ("asyncio", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    atexit.unregister(close_clusters)
    for nanny in client.cluster.workers.values() if client is not None else ():
        nanny.close_gracefully()  # otherwise it starts another process
    # Workers that were about to start would print a traceback after this process has ended.
    until_s = time.monotonic() + (_LATE_S if client is None else 0.0)
    while True:
        for child in multiprocessing.active_children():
            if child.name.startswith("Dask Worker"):
                child.kill()
        if time.monotonic() >= until_s:
            return
        time.sleep(0.01)


def _start_tracker() -> None:
    """Start the process that cleans up after workers, so that it ignores SIGHUP, as it ignores Ctrl-C and SIGTERM."""
    if hasattr(signal, "pthread_sigmask") and hasattr(signal, "SIGHUP"):
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
        try:
            resource_tracker.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def connect(scheduler: str) -> Client:
    """Return a client of a scheduler. The keys for a tls:// address are those of Dask's own settings.

    Raise InputError if the scheduler cannot be reached.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the study reports lost workers
    try:
        # Check the address first: a client would complain about a bad address again when it ends.
        scheme, host = parse_address(scheduler)
        get_backend(scheme)
        if scheme in ("tcp", "tls"):
            parse_host_port(host)
        return Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, ImportError, TypeError) as error:  # TypeError: tls:// without keys
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(
            f"no Dask scheduler answers at {scheduler} ({first}); wanted an address as tcp://host:8786, where "
            "`dask scheduler` runs, or tls://host:8786 and its keys in DASK_DISTRIBUTED__COMM__TLS__... "
            "(docs/datasets.md)"
        ) from None
