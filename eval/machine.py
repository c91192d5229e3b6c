"""The machine that figures are taken on, and how much of it other programs took meanwhile."""

import os
import platform
import resource
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

TICKS = os.sysconf("SC_CLK_TCK")


def about() -> dict[str, Any]:
    """Processor, cores and versions."""
    model = ""
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return {
        "processor": model or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "opencv": cv2.__version__,
        "numpy": np.__version__,
    }


def in_words(machine: dict[str, Any]) -> str:
    """For a table's first line."""
    return f"{machine['processor']}, {machine['cores']} cores, OpenCV {machine['opencv']}"


class Others:
    """How many cores others kept busy since this was made, on average: 0 on a quiet machine.

    What the machine did in all, less what this process and those that it started and waited for did.
    """

    def __init__(self) -> None:
        self.start, self.busy, self.own = time.monotonic(), _busy_s(), _own_s()

    def cores(self) -> float:
        """So many cores' worth."""
        taken = (_busy_s() - self.busy) - (_own_s() - self.own)
        return max(taken / max(time.monotonic() - self.start, 1e-3), 0.0)


def load_in_words(cores: float) -> str:
    """What stands beside figures."""
    return f"other programs took {cores:.1f} of {len(os.sched_getaffinity(0))} cores meanwhile"


def _busy_s() -> float:
    """Seconds that all cores together were busy, stolen ones (of other guests on the same machine) included."""
    try:
        user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    except OSError:
        return 0.0
    return (user + nice + system + irq + soft + steal) / TICKS


def _own_s() -> float:
    uses = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(use.ru_utime + use.ru_stime for use in uses)


def first_in_line() -> None:
    """This process goes before all that are not real-time, whatever their niceness. Raises PermissionError."""
    os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def ran_and_waited_ns(pid: int) -> dict[str, tuple[int, int]]:
    """How long each living thread of a process ran, and was ready to but had no core; OSError where it is over."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            ran, waited, _ = map(int, (task / "schedstat").read_text().split())
        except (OSError, ValueError):  # a thread that ended, or a kernel that keeps no such account
            continue
        found[task.name] = ran, waited
    return found


def copied_gb_s(megabytes: float, seconds: float = 0.05) -> float:
    """How many gigabytes a second one core reads and writes when it copies a block of so many megabytes.

    By the processor's time, which waiting for memory is a part of, and waiting for a core is not.
    """
    block = np.zeros(int(megabytes * 1e6), np.uint8)
    other = np.ones_like(block)
    np.copyto(other, block)
    times = 0
    start = time.thread_time()
    while (spent := time.thread_time() - start) < seconds or not times:
        np.copyto(other, block)
        times += 1
    return 2 * times * block.size / max(spent, 1e-9) / 1e9
