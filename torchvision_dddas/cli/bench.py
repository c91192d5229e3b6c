"""`dddas bench`: measure the speed of the package on this machine, and print tables to paste."""

import os
import time
from importlib.util import find_spec
from typing import Annotated

import typer

from torchvision_dddas.cli.options import parse_size, print_lines, report_errors
from torchvision_dddas.cli.progress import print_now

_SIZES = ["640x480", "1280x720", "1920x1080"]
_SHARE, _BATCH = 0.15, 4  # share of the time for Kornia's operations, and pictures per batch


@report_errors
def bench(
    seconds: Annotated[float, typer.Option(min=5, max=3600, help="Approximate duration.")] = 120.0,
    size: Annotated[list[str] | None, typer.Option(metavar="WxH", help=f"May be repeated. [default: {_SIZES}]")] = None,
) -> None:
    """Measure this machine: frames per second, memory and stages of each engine and configuration, beside plain OpenCV.

    If torch is installed, Kornia's operations are measured beside ours. Prints Markdown tables; nothing is written.
    Frames are synthetic and made in memory. A dash marks a measurement for which there was no time.
    """
    sizes = [parse_size(text, 120, 8192) for text in dict.fromkeys(size or _SIZES)]
    from torchvision_dddas.lab.benchmark import CHAINS, format_chains, format_operations, machine_words, measure_chains
    from torchvision_dddas.runtime import torch_device, wants_torch

    has_torch = all(find_spec(name) is not None for name in ("torch", "kornia")) and wants_torch("torch")
    chains, start = [name for name in CHAINS if has_torch or not name.startswith("torch")], time.perf_counter()
    figures = list(measure_chains(chains, sizes, seconds * (1 - _SHARE * has_torch), print_now))
    lines = [format_chains(figures, chains, sizes), ""]
    where = "CPU"
    if has_torch:
        from torchvision_dddas.lab.benchmark.torch_operations import measure_operations

        device = torch_device()
        where = f"torch on {device}"
        print_now(f"Kornia's operations beside ours on {device}")
        found = measure_operations(min(sizes), _BATCH, _SHARE * seconds, device)
        lines += [format_operations(found, min(sizes), _BATCH), ""]
    load = f", {os.getloadavg()[0]:.1f} processes running on average" if hasattr(os, "getloadavg") else ""
    lines.append(f"{machine_words()}; {where}{load}; {time.perf_counter() - start:.0f} s; dddas bench")
    print_lines("\n".join(lines).split("\n"))
