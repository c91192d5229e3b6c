"""People seen from the ground, and the classifier that finds them."""

from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.types.frames import Adjustment, Frame
from torchvision_dddas.types.record import Record
from torchvision_dddas.types.table import Table


@dataclass(frozen=True)
class LinearSvm(Record):
    """A person classifier: score = weights . descriptor + bias.

    weights: (F,) float32 in OpenCV's order: blocks and cells column by column, bins fastest. origin: file or name.

    >>> td.LinearSvm(np.zeros(3780, np.float32), bias=-1.5, origin="mine.npz")
    LinearSvm(weights: 3780 0, bias=-1.5, origin='mine.npz')
    """

    weights: np.ndarray
    bias: float
    origin: str = ""


@dataclass(frozen=True)
class Part(Record):
    """A rectangle of a pyramid level whose windows are scored, in that level's pixels.

    level: (width, height) of the resized picture. x, y: top left pixel, multiples of the window stride from -padding.

    >>> types.Part(level=(320, 240), x=0, y=16, width=128, height=128)
    Part(level=(320, 240), x=0, y=16, width=128, height=128)
    """

    level: tuple[int, int]
    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class People(Table):
    """The people recognized in one frame, one row per person.

    box_px: (N, 4) float64 of the body: x, y of the top left pixel, width, height. score: (N,) probability.
    margin: (N,) the classifier's score. cut: (N,) bool, the border cuts the body: its height is unreliable.
    window_px: (N, 4) the classifier's window around the body.

    >>> people = td.People(np.array([[310.0, 220, 20, 80]]), np.ones(1), np.ones(1), np.array([False]))
    >>> people.feet_px
    array([[319.5, 299.5]])
    """

    box_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    score: np.ndarray = field(default_factory=lambda: np.zeros(0))
    margin: np.ndarray = field(default_factory=lambda: np.zeros(0))
    cut: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    window_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    @property
    def feet_px(self) -> np.ndarray:
        """The point between the feet, (N, 2) u, v from the first pixel's centre: the middle of the lower edge."""
        return self.box_px[:, :2] + self.box_px[:, 2:] * (0.5, 1.0) - 0.5


@dataclass(frozen=True)
class PeopleFrame(Record):
    """The result of searching one frame for people.

    regions_px: (R, 4) the regions searched in addition to the scheduled pyramid levels; None: the whole picture.
    share: scored windows, relative to a full search. cause: why there is no result. adjustments, seconds: as in Scene.

    >>> types.PeopleFrame(td.Frame(1, 0.0, np.zeros((48, 64), np.uint8)), td.People(), share=0.25)
    PeopleFrame(frame=Frame(...), people=People(0 rows), share=0.25)
    """

    frame: Frame
    people: People
    regions_px: np.ndarray | None = None
    share: float = 1.0
    cause: str = ""
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
