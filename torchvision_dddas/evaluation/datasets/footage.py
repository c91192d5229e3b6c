"""The pictures of a clip whose truth is numbered by frame: they must be all there, and as many as is said."""

from collections.abc import Sequence
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.numbering import number_of
from torchvision_dddas.evaluation.datasets.pictures import frames_of


def whole(pictures: tuple[Path, ...], first: int) -> tuple[Path, ...]:
    """Pictures that are numbered without a gap. Raises InputError where the first one is not `first`, or one lacks."""
    for wanted, picture in enumerate(pictures, first):
        if number_of(picture) != wanted:
            raise InputError(
                f"{picture.parent} goes on with {picture.name} where frame {wanted} belongs; "
                "wanted the pictures of all frames"
            )
    return pictures


def agreed(pictures: Sequence[Path], said: int, by: str) -> int:
    """How many frames a clip has: as its pictures are, else as is said, by whom; 0 where nothing says.

    Raises InputError where the two differ, or the video cannot be opened.
    """
    there = frames_of(tuple(pictures)) if pictures else 0
    if there and said and there != said:
        where = pictures[0] if len(pictures) == 1 else pictures[0].parent
        raise InputError(f"{where} has {there} frames, but {by} says {said}; are they of the same clip?")
    return there or said
