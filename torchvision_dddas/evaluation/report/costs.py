"""What a study cost: time of each clip and stage, pictures a second, memory, and how time goes with resolution."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.report.words import TITLES
from torchvision_dddas.evaluation.studies.results import Case
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.io.images import IMAGE_SUFFIXES, read_image
from torchvision_dddas.io.report import Axis, Cell, Column, Dots, chart, format_number, number_cell, table, text_cell
from torchvision_dddas.io.sources import open_source

MOST_STAGES = 8


class Cost(NamedTuple):
    """Of a case: seconds in all and by stage, pictures looked at, megabytes, megapixels of a picture (NaN: unknown)."""

    case: Case
    seconds: float
    stages: dict[str, float]
    images: int
    peak_mb: float
    megapixels: float


def costs_of(cases: Sequence[Case]) -> list[Cost]:
    """What each case that has times cost; the size of a clip's pictures is read off the first of them."""
    sizes: dict[str, float] = {}
    costs = []
    for case in cases:
        if case.found is None or not case.found.seconds:
            continue
        name = str(case.clip.place) + case.clip.name
        if name not in sizes:
            sizes[name] = _megapixels(case)
        stages = dict(case.found.seconds)
        costs.append(Cost(case, sum(stages.values()), stages, len(case.found.looked), case.found.peak_mb, sizes[name]))
    return costs


def summed(costs: Sequence[Cost], task: Task | None = None) -> str:
    """In words: images a second, and the memory, of one task or all."""
    mine = [cost for cost in costs if task is None or cost.case.task == task]
    seconds, images = sum(cost.seconds for cost in mine), sum(cost.images for cost in mine)
    if not seconds or not images:
        return ""
    peaks = [cost.peak_mb for cost in mine if np.isfinite(cost.peak_mb)]
    memory = f", at most {format_number(round(max(peaks)))} MB" if peaks else ""
    return f"{_rate(images / seconds)} frames/s ({format_number(seconds, 1)} s){memory}"


def cost_table(costs: Sequence[Cost]) -> str:
    """A row a case: time, rate, memory, and the time of its longest stages a frame."""
    total: dict[str, float] = {}
    for cost in costs:
        for stage, spent in cost.stages.items():
            total[stage] = total.get(stage, 0.0) + spent
    stages = sorted(total, key=lambda stage: -total[stage])[:MOST_STAGES]
    columns = [
        Column("clip", text=True),
        Column("task", text=True),
        Column("frames", "pictures looked at"),
        Column("Mpx", "millions of pixels of a picture"),
        Column("s", "seconds in all"),
        Column("frames/s", "pictures looked at in a second"),
        Column("MB", "the most memory that the process held"),
        *(Column(f"{stage}, ms", "milliseconds a frame") for stage in stages),
    ]
    rows = []
    for cost in costs:
        each = max(cost.images, 1)
        rows.append(
            [
                text_cell(cost.case.clip.name),
                text_cell(TITLES[cost.case.task]),
                number_cell(cost.images),
                number_cell(cost.megapixels, 2),
                number_cell(cost.seconds, 2),
                Cell(_rate(cost.images / cost.seconds), cost.images / cost.seconds) if cost.seconds else Cell("–"),
                number_cell(cost.peak_mb, 0),
                *(number_cell(1000 * cost.stages[s] / each if s in cost.stages else None, 2) for s in stages),
            ]
        )
    return table("what each clip cost", columns, rows)


def cost_charts(costs: Sequence[Cost]) -> list[str]:
    """Milliseconds a frame against the size of the pictures, of each task that looks at pictures."""
    dots = []
    for k, task in enumerate(TITLES):
        mine = [c for c in costs if c.case.task == task and np.isfinite(c.megapixels) and c.images]
        if mine:
            each_ms = [1000 * c.seconds / c.images for c in mine]
            said = [
                f"{c.case.clip.name}: {format_number(c.megapixels, 2)} Mpx, {format_number(ms, 1)} ms"
                for c, ms in zip(mine, each_ms, strict=True)
            ]
            dots.append(Dots(TITLES[task], np.array([c.megapixels for c in mine]), np.array(each_ms), k % 6 + 1, said))
    if not dots:
        return []
    return [chart("Time and resolution", Axis("megapixels of a picture", 0), Axis("ms a frame", log=True), dots=dots)]


def _rate(each_second: float) -> str:
    return format_number(each_second, 0 if each_second >= 100 else 1)


def _megapixels(case: Case) -> float:
    files = case.clip.pictures
    if not files:
        return float("nan")
    try:
        if files[0].suffix.lower() in IMAGE_SUFFIXES:
            picture = read_image(files[0])
            return float("nan") if picture is None else picture.shape[0] * picture.shape[1] / 1e6
        width, height = open_source(files[0]).size
    except InputError:
        return float("nan")
    return width * height / 1e6
