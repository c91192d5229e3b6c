"""The memory that an input may take. Every reader asks here before it makes room for what a header announces.

A file of some bytes can announce billions of pixels or numbers. Such a file is small, so small files have the smaller
budget. The costs are the most that any command was measured to take (docs/limitations.md).
"""

import os

from torchvision_dddas.errors import InputError

SMALL_FILE = 5_000_000
"""Files of fewer bytes have the smaller budget."""

SMALL_MB, LARGE_MB = 1100, 6000
"""Megabytes (10^6 bytes) that a small file may take, and a larger one or what comes from no file."""

VARIABLE = "DDDAS_MEMORY_MB"
"""The environment variable that sets another budget for all files."""

PHOTO, PICTURE, VIDEO, MASK = 30, 52, 100, 40
"""Bytes for each pixel: of a clip of one picture, of one of a few, of a frame of a video, and of a mask."""


def cost_of_pictures(count: int) -> int:
    """Bytes for each pixel of a clip of so many pictures: detection holds up to 14 of them."""
    return PHOTO if count == 1 else min(max(PICTURE, 16 + 6 * count), VIDEO)


def check_memory(needed: float, what: str, size: int | None = None, advice: str = "make it smaller") -> None:
    """Raise InputError if an input would take more than its budget.

    needed: bytes. what: the input and what it announces, for the message. size: bytes of the file, None without one.
    advice: what the user can do.
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
