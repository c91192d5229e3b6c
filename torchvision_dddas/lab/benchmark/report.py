"""Format the figures of a benchmark as Markdown tables."""

from collections.abc import Mapping, Sequence

import numpy as np

from torchvision_dddas.lab.benchmark.chains import STAGES, ChainFigures, Size
from torchvision_dddas.lab.benchmark.machine import format_table


def format_chains(figures: Sequence[ChainFigures], chains: Sequence[str], sizes: Sequence[Size]) -> str:
    """Return a table of frames per second and memory, and a table of the stages at the middle size.

    Cells without a measurement hold a dash.
    """
    cells = {(each.chain, each.size): each for each in figures}
    ordered = sorted(sizes)
    rows = [["plain OpenCV", *(_plain(figures, size) for size in ordered)]]
    rows += [[chain, *(_cell(cells.get((chain, size))) for size in ordered)] for chain in chains]
    speed = format_table(["frames/s (time by plain OpenCV), peak MB", *map(_name, ordered)], rows)
    middle = ordered[len(ordered) // 2]
    shown = [each for each in figures if each.size == middle]
    stages = [[each.chain, *(f"{ms:.1f}" for ms in each.stages_ms)] for each in shown]
    return f"{speed}\n\n{format_table([f'ms a frame at {_name(middle)}', *STAGES], stages)}"


def format_operations(found: Mapping[str, tuple[float, float]], size: Size, batch: int) -> str:
    """Return the table of our operations beside Kornia's."""
    rows = [[name, f"{ours:.2f}", f"{kornias:.2f}", f"{kornias / ours:.2f}"] for name, (ours, kornias) in found.items()]
    head = [f"ms a picture of {_name(size)}, batch {batch}", "ours", "Kornia", "Kornia by ours"]
    return format_table(head, rows)


def _plain(figures: Sequence[ChainFigures], size: Size) -> str:
    rates = [each.plain_hz for each in figures if each.size == size]
    return f"{np.median(rates):.1f}" if rates else "–"


def _cell(found: ChainFigures | None) -> str:
    if found is None:
        return "–"
    memory = "" if np.isnan(found.peak_mb) else f", {found.peak_mb:.0f} MB"
    return f"{found.rate_hz:.1f} ({found.ratio:.2f}){memory}"


def _name(size: Size) -> str:
    return f"{size[0]}x{size[1]}"
