"""A clip's boxes look by look, with its pictures where it has some: what examples of identities are made of."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.studies.stages import opened


class Boxed(NamedTuple):
    """A look. identity: (n,). box_px: (n, 4) float. image: (H, W[, 3]) uint8, None of a clip without pictures."""

    number: int
    identity: np.ndarray
    box_px: np.ndarray
    image: np.ndarray | None


def boxed(clip: Clip, table: TrackTable, interval: int) -> Iterator[Boxed]:
    """Every `interval`-th frame to the last with boxes; from the first of the pictures, else from those with boxes."""

    def at(number: int, image: np.ndarray | None) -> Boxed:
        rows = table.frame == number
        return Boxed(number, table.identity[rows], np.asarray(table.box_px[rows], float), image)

    if not len(table.frame):
        return
    last = int(table.frame.max())
    if not clip.pictures:
        for number in range(int(table.frame.min()), last + 1, interval):
            yield at(number, None)
        return
    for frame in opened(clip).every(interval):
        if frame.number > last:
            return
        yield at(frame.number, frame.image)
