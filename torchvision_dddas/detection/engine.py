"""The protocol of engines, which do the pixel work, and the records that they exchange with the detector."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.types import Registration

# Evidence is kept in 8-bit maps: in sixteenths of the local noise, clipped at 15 noise units.
EVIDENCE_SCALE = 16.0
EVIDENCE_CAP = 240
# From this grey level on a pixel may be clipped.
WHITE = 248


@dataclass
class View:
    """One frame as an engine holds it, made by `Engine.prepare`.

    image: uint8 (H, W) or (H, W, 3) BGR. grey: uint8 (H, W).
    kept: what the engine computed for this frame and will use again (pyramid, tensor, keypoints).
    """

    image: np.ndarray
    grey: np.ndarray
    kept: dict[str, Any] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.grey.shape[1], self.grey.shape[0]


@dataclass(frozen=True)
class Window:
    """A reference frame and its neighbours in time.

    neighbour_from_reference: (K, 3, 3). offsets: (K,) frames from the reference, negative = past.
    near: pairs of indices of neighbours whose evidence is combined; the last one is the widest and shows the motion.
    wide: a pair further apart, which fills the inside of large targets. small: one that shows small slow targets.
    close_px: side of the ellipse that closes gaps between fragments of a target; 0: that of the settings.
    """

    reference: View
    neighbours: tuple[View, ...]
    neighbour_from_reference: np.ndarray
    offsets: tuple[int, ...]
    near: tuple[tuple[int, int], ...]
    wide: tuple[int, int] | None = None
    small: tuple[int, int] | None = None
    close_px: int = 0


@dataclass(frozen=True)
class Foreground:
    """What differs from the background at the reference frame; all maps (H, W) uint8 in its pixel coordinates.

    core: 255 where a target is certain, cleaned by morphology.
    evidence: 16 x the difference in units of the local noise, the largest over the near pairs; `wide` the same for the
    wide pair. texture: mean gradient, 4 x grey levels a pixel.
    small: 255 where something small may move; None when it is not wanted.
    warped: the two neighbours of the widest near pair, in the reference's frame and exposure; `offsets` their frames.
    scale: side of a map's pixel in pixels of the frame; above 1 only where the maps are used for nothing but blobs.
    """

    core: np.ndarray
    evidence: np.ndarray
    wide: np.ndarray
    texture: np.ndarray
    small: np.ndarray | None
    warped: tuple[np.ndarray, np.ndarray]
    offsets: tuple[int, int]
    scale: int = 1


class Engine(Protocol):
    """What an engine offers. Lists go in and out, so that it may batch.

    parameters: the settings in force; they may be replaced between two frames.
    """

    name: str
    parameters: Settings

    def prepare(self, image: np.ndarray) -> View:
        """The view of a frame, with what is computed once per frame."""
        ...

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """The background's motion from the first to the second frame of each pair."""
        ...

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """What moves in each window's reference frame."""
        ...
