"""A worker: a process of one thread that does the jobs that it is sent, one after another, until nobody sends any."""

import os
import pickle
import queue
import struct
import sys
import threading
from pathlib import Path
from typing import IO, Any

LIMITS = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "OMP_WAIT_POLICY": "PASSIVE",
}
"""What the environment of a worker says: libraries read it as they load."""

_LENGTH = struct.Struct(">Q")


def send(pipe: IO[bytes], message: Any) -> None:
    """Write a message. Raises OSError where nobody reads any more."""
    content = pickle.dumps(message)
    pipe.write(_LENGTH.pack(len(content)) + content)
    pipe.flush()


def receive(pipe: IO[bytes]) -> Any | None:
    """The next message; None where the other end is gone. Only a process of one's own is at the other end."""
    head = pipe.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(head)
    content = pipe.read(length)
    return pickle.loads(content) if len(content) == length else None


def one_thread(backend: str = "") -> None:
    """Hold the libraries to one thread; torch where the back end is, or where it is loaded."""
    import cv2

    cv2.setNumThreads(1)
    if backend == "torch":
        import torch

        torch.set_num_threads(1)


def main() -> None:
    """Jobs come by the standard input, and what became of them goes to the standard output."""
    os.environ.update(LIMITS)
    # Whatever a library prints must not come between the messages.
    outlet = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def listen() -> None:
        while (message := receive(sys.stdin.buffer)) is not None:
            waiting.put(message)
        os._exit(0)  # whoever sent jobs is gone, perhaps killed: nobody would read what comes of this one

    threading.Thread(target=listen, daemon=True).start()
    from torchvision_dddas.evaluation.studies.cache import Cache
    from torchvision_dddas.evaluation.studies.digests import Files
    from torchvision_dddas.evaluation.studies.pace import Ticker
    from torchvision_dddas.evaluation.studies.working import work

    lock = threading.Lock()

    def say(*message: Any) -> None:
        with lock:
            send(outlet, message)

    folder: Path = waiting.get()
    cache = Cache(folder, lambda line: say("note", line))
    files = Files(folder / "files")
    say("ready", os.getpid())
    while True:
        job = waiting.get()
        one_thread(job.backend)
        ticker = Ticker(lambda frames: say("frames", frames))
        done = work(job, cache, files, tick=ticker)
        ticker.flush()
        say("done", done)


if __name__ == "__main__":
    main()
