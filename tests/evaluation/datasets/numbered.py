"""Numbered pictures, and what a data set tells beside its clips."""

from pathlib import Path

from tests.evaluation.datasets.layouts import SIZE, pictures
from torchvision_dddas.evaluation.datasets.record import Dataset


def numbered(folder: Path, count: int, name: str = "{:06d}.png", first: int = 1, size: tuple[int, int] = SIZE) -> None:
    """Pictures named by their numbers from `first` on."""
    pictures(folder, [name.format(number) for number in range(first, first + count)], size)


def line_of(found: Dataset) -> str:
    """The one line that a data set tells beside its clips."""
    (line,) = (*found.missing, *found.notes)
    assert line.isprintable()
    return line
