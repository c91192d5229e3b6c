"""Describe the machine of a measurement, and format tables of results."""

import functools
import os
import platform
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "onnxruntime", "torch", "kornia")


@functools.cache
def describe_machine() -> dict[str, Any]:
    """Return the processor, the cores that this process may use, and the versions of Python and of libraries."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    versions = {}
    for name in LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "processor": model or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "python": platform.python_version(),
        **versions,
    }


def machine_words() -> str:
    """Return the machine in words, for the first line of a table."""
    about = describe_machine()
    libraries = ", ".join(f"{name} {about[name]}" for name in LIBRARIES[2:] if name in about)
    return f"{about['processor']}, {about['cores']} cores, {libraries}"


def format_table(head: Sequence[str], rows: Iterable[Sequence[object]], words: int = 1) -> str:
    """Return a Markdown table. The first `words` columns are text; the others are right-aligned numbers."""
    align = ["---"] * words + ["---:"] * (len(head) - words)
    return "\n".join("| " + " | ".join(map(str, cells)) + " |" for cells in (head, align, *rows))
