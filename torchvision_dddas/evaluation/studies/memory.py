"""The most memory that this process held while something was done."""

import sys
from contextlib import suppress
from pathlib import Path

_MB = 2**20


class Peak:
    """Watches from where it is made. Where the system cannot forget an earlier peak, it counts from the beginning."""

    def __init__(self) -> None:
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")

    def mb(self) -> float:
        """The peak so far in units of 2**20 bytes; NaN where the system does not tell."""
        with suppress(OSError, ValueError, StopIteration):
            lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
            return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024 / _MB
        try:
            import resource
        except ImportError:
            return float("nan")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / _MB if sys.platform == "darwin" else peak * 1024 / _MB
