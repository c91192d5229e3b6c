"""Jobs shared among worker processes of one thread each: one that dies costs the time of its clip, and no more."""

import os
import queue
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.worker import LIMITS, receive, send
from torchvision_dddas.evaluation.studies.working import Done, Job

TRIES = 3
"""So often a job is given to a worker; if it dies each time, the clip is left out."""


@dataclass(frozen=True)
class Event:
    """Something that happened. done: what became of a job, else None. frames: looked at since the last such event.

    note: a line that the user should read.
    """

    job: Job
    done: tuple[Done, ...] | None = None
    frames: int = 0
    note: str = ""


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share(jobs: Sequence[Job], workers: int, cache: Path) -> Generator[Event, None, None]:
    """Do jobs in the order given, so many at once, each in a process of its own; events as they come.

    cache: the folder where results are kept, and taken from. The results do not depend on the number of workers.
    Leaving the iterator early ends the workers. Raises InputError where no process can be started.
    """
    if not jobs:
        return
    waiting, events = deque(jobs), queue.SimpleQueue[Event | BaseException | None]()
    team = [_Worker(waiting, events, cache) for _ in range(min(workers, len(jobs)))]
    try:
        running = len(team)
        while running:
            event = events.get()
            if event is None:
                running -= 1
            elif isinstance(event, BaseException):
                raise event
            else:
                yield event
    finally:
        waiting.clear()
        for worker in team:
            worker.end()


class _Worker(threading.Thread):
    """Takes jobs that wait and has a process do them; starts another process where one died."""

    def __init__(self, waiting: deque[Job], events: "queue.SimpleQueue[Any]", cache: Path) -> None:
        super().__init__(daemon=True)
        self._waiting, self._events, self._cache = waiting, events, cache
        self._child: subprocess.Popen[bytes] | None = None
        self._over = False
        self.start()

    def run(self) -> None:
        """Until no job waits."""
        try:
            while not self._over:
                try:
                    job = self._waiting.popleft()
                except IndexError:
                    break
                self._do(job)
        except BaseException as error:
            self._events.put(error)
        finally:
            self._stopped()
            self._events.put(None)

    def end(self) -> None:
        """End the process at once, and this thread with it."""
        self._over = True
        process = self._child
        if process is not None:
            process.kill()
        self.join()

    def _do(self, job: Job) -> None:
        how = ""
        for attempt in range(TRIES):
            if self._over:
                return
            process = self._running()
            assert process.stdin is not None and process.stdout is not None
            with suppress(OSError):  # it died already: told below
                send(process.stdin, job)
                while (message := receive(process.stdout)) is not None:
                    what, content = message
                    if what == "frames":
                        self._events.put(Event(job, frames=content))
                    elif what == "note":
                        self._events.put(Event(job, note=content))
                    elif what == "done":
                        self._events.put(Event(job, tuple(content)))
                        return
            how = self._stopped()
            if not self._over and attempt + 1 < TRIES:
                self._events.put(Event(job, note=f"{job.clip.name}: its worker {how}; it is tried again"))
        cause = f"its worker {how}, {TRIES} times; is there memory enough for {job.clip.name} and {job.backend}?"
        self._events.put(Event(job, tuple(Done(task, cause=cause) for task in job.tasks)))

    def _running(self) -> subprocess.Popen[bytes]:
        if self._child is not None and self._child.poll() is None:
            return self._child
        self._stopped()
        command = [sys.executable, "-m", "torchvision_dddas.evaluation.studies.worker"]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        try:
            # A session of its own: Ctrl-C is for whoever shares the jobs, who then ends the workers.
            self._child = subprocess.Popen(command, env={**os.environ, **LIMITS}, start_new_session=True, **pipes)
        except OSError as error:
            raise InputError(f"no worker can be started: {error.strerror}") from None
        assert self._child.stdin is not None
        with suppress(OSError):
            send(self._child.stdin, self._cache)
        return self._child

    def _stopped(self) -> str:
        """End the process, and say how it ended."""
        process, self._child = self._child, None
        if process is None:
            return "is gone"
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            with suppress(OSError):
                pipe.close()
        try:
            code = process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        if code < 0:
            with suppress(ValueError):
                return f"was killed ({signal.Signals(-code).name})"
        return f"ended with {code}"
