"""What every source of frames offers, and the record of what went wrong while reading."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, overload

import numpy as np

from torchvision_dddas.types import Frame


@dataclass(frozen=True)
class Problem:
    """Something that reading got over: the 1-based number of the first frame it touches, and what it was, in words."""

    frame: int
    what: str

    def __str__(self) -> str:
        return self.what


class Source(Protocol):
    """A clip, read one frame at a time.

    name: what to call it in messages and tables. count: frames that it announces, None when unknown (a live stream).
    exact: whether count is more than a guess from the duration.
    rate_hz: frames a second. size: (width, height) in px, the same for every frame.
    last: number of the last frame known to be in the clip, decoded or not, once it has been read to its end; until then
    that of the last frame read.
    problems: filled while reading; every new iteration starts from the first frame and empties it.
    Iterating yields frames in order, numbered from 1. A frame that cannot be decoded is left out and keeps its number.
    """

    name: str
    count: int | None
    exact: bool
    rate_hz: float
    size: tuple[int, int]
    last: int
    problems: list[Problem]

    def __iter__(self) -> Iterator[Frame]: ...

    def every(self, interval: int) -> Iterator[Frame]:
        """Frames 1, 1 + interval, ... alone: the others are not decoded as far as that can be had."""
        ...


@overload
def looked_at(frame: int, interval: int) -> bool: ...
@overload
def looked_at(frame: np.ndarray, interval: int) -> np.ndarray: ...
def looked_at(frame: int | np.ndarray, interval: int) -> bool | np.ndarray:
    """Whether a frame, or which of several, is one of 1, 1 + interval, 1 + 2 interval, ..."""
    return (frame - 1) % interval == 0
