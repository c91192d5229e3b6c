"""What every source of frames offers, and the record of what went wrong while reading."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

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

    Iterating yields frames in order, numbered from 1. A frame that cannot be decoded is left out and keeps its number.
    """

    @property
    def name(self) -> str:
        """What to call it in messages and tables."""
        ...

    @property
    def count(self) -> int | None:
        """Frames that it announces; None when unknown (a live stream)."""
        ...

    @property
    def exact(self) -> bool:
        """Whether count is more than a guess from the duration."""
        ...

    @property
    def rate_hz(self) -> float:
        """Frames a second."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px, the same for every frame."""
        ...

    @property
    def last(self) -> int:
        """Number of the last frame known to be in the clip, decoded or not, once it has been read to its end.

        Until then that of the last frame read.
        """
        ...

    @property
    def problems(self) -> list[Problem]:
        """Filled while reading; every new iteration starts from the first frame and empties it."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...

    def every(self, interval: int) -> Iterator[Frame]:
        """Frames 1, 1 + interval, ... alone: the others are not decoded as far as that can be had."""
        ...
