"""The processes of a study, through Dask: those of this machine, which nobody else can reach, or a scheduler's.

Whoever reaches a port of Dask runs code as the user who opened it. The processes of this machine therefore talk by TLS,
and take only connections with a key that is made anew for them. None of them serves HTTP.
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
"""How long a scheduler may take to answer."""

_LATE_S = 0.5  # after a signal, workers that were about to start have started by then
_ONE_THREAD = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "OMP_WAIT_POLICY": "PASSIVE",
}


class _WithoutHttp:
    """A node of Dask that serves no HTTP: Dask opens a port for it even where no dashboard is wanted."""

    def start_http_server(self, *_: object, **__: object) -> None:
        """Start nothing."""


class LocalScheduler(_WithoutHttp, Scheduler):
    """The scheduler, a thread of this process."""


class LocalWorker(_WithoutHttp, Worker):
    """A process that does jobs."""


def start_local(jobs: int, deaths: int, silent_s: float, stack: ExitStack) -> Client:
    """A client of new processes on this machine, which end with the stack.

    deaths: after so many of a process over one job it is given up. silent_s: a process that gives no sign for so long
    is killed and replaced, which counts as a death.
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
        # Dask imports code from here. Its default is a folder in /tmp that any user may have made before, and it stays.
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
    """End the processes of this machine at once: what is finished is in the cache, and Dask would wait for the rest.

    client: of `start_local`; None if a signal came while they started. The user does not see what Dask says of it.
    """
    for name in ("asyncio", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    atexit.unregister(close_clusters)
    for nanny in client.cluster.workers.values() if client is not None else ():
        nanny.close_gracefully()  # else it starts another process
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


def connect(scheduler: str) -> Client:
    """A client of a scheduler; the keys for a tls:// address are those of Dask's own settings.

    Raises InputError if it cannot be reached.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # lost workers are reported by the study anyway
    try:
        # Checked before there is a client, which would complain about a bad address again as it ends.
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
