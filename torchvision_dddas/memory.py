"""The memory budget of an input. Every reader calls `check_memory` before it allocates memory for the size in a header.

A file of a few bytes can announce billions of pixels or numbers. Small files therefore have a smaller budget. The costs
are the largest that were measured for any command (docs/limitations.md).
"""

import os
import sys
from contextlib import suppress
from pathlib import Path

from torchvision_dddas.errors import InputError

SMALL_FILE = 5_000_000
"""Files with fewer bytes have the smaller budget."""

SMALL_MB, LARGE_MB = 1100, 6000
"""Budget in megabytes (10^6 bytes) of a small file, and of a larger file or an input without a file."""

VARIABLE = "DDDAS_MEMORY_MB"
"""The environment variable that sets another budget for all files."""

PHOTO, PICTURE, VIDEO, MASK = 30, 52, 100, 40
"""Bytes per pixel: a clip of one picture, a clip of a few pictures, a frame of a video, and a mask."""


def cost_of_pictures(count: int) -> int:
    """Return the bytes per pixel of a clip with this number of pictures: detection keeps up to 14 of them."""
    return PHOTO if count == 1 else min(max(PICTURE, 16 + 6 * count), VIDEO)


def check_memory(needed: float, what: str, size: int | None = None, advice: str = "make it smaller") -> None:
    """Raise InputError if an input would take more than its budget.

    needed: bytes. what: the input and the size in its header, for the message. size: bytes of the file, if any.
    advice: advice to the user.
    """
    given = os.environ.get(VARIABLE, "")
    if given and not (given.isascii() and given.isdigit() and len(given) < 12 and int(given)):
        raise InputError(f"{VARIABLE} is '{given}'; wanted a whole number of megabytes")
    is_small = size is not None and size < SMALL_FILE
    budget_mb = int(given) if given else SMALL_MB if is_small else LARGE_MB
    if needed > budget_mb * 1e6:
        about = " for a file of less than 5 MB" if is_small and not given else ""
        raise InputError(
            f"{what}; that takes {needed / 1e6:,.0f} MB of memory, wanted at most {budget_mb:,} MB{about}: {advice}, "
            f"or set {VARIABLE} in the environment"
        )


def reset_peak_memory() -> None:
    """Restart the measurement of peak memory now, if the system supports that."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_mb() -> float:
    """Return the process's peak memory in units of 2**20 bytes, NaN if unknown. Some systems cannot reset the peak."""
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1024
    try:
        import resource
    except ImportError:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 1024
