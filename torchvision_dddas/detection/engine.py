"""The seam between pixels and targets: what a back end offers. Everything is in lists, so that an engine may batch."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.runtime import wants_torch
from torchvision_dddas.types import Registration

# Evidence crosses the seam as 8-bit maps: in sixteenths of the local noise, cut off at 15 noise units.
EVIDENCE_SCALE = 16.0
EVIDENCE_CAP = 240
# From this grey level on a pixel may be cut off.
WHITE = 248


@dataclass
class View:
    """One frame as the back end holds it. Made by `Engine.prepare`.

    image: uint8 (H, W) or (H, W, 3) BGR. grey: uint8 (H, W).
    kept: what the engine computed for this frame and will want again (pyramid, tensor, keypoints); its own affair.
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
    wide, small: a pair further apart that fills the inside of large targets, and one that shows small slow ones.
    close_px: ellipse that closes gaps between fragments of a target; 0: as the settings have it.
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

    scale: pixels of the frame to one of the maps', along either side; above 1 only where nothing but blobs is asked of
    the maps.
    core: 255 where a target is certain, cleaned by morphology.
    evidence: 16 x the difference in units of the local noise, the largest over the near pairs; `wide` the same for the
    wide pair. texture: mean gradient, 4 x grey levels a pixel.
    small: 255 where something small may move; None when not asked for.
    warped: the two neighbours of the widest near pair, in the reference's frame and exposure; `offsets` their frames.
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
    """A back end. parameters: the settings in force; others may be put in their place between two frames."""

    name: str
    parameters: Settings

    def prepare(self, image: np.ndarray) -> View:
        """Whatever is computed once per frame."""
        ...

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """The background's motion from the first to the second frame of each pair."""
        ...

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """What moves in each window's reference frame."""
        ...


def load_engine(backend: str, settings: Settings) -> Engine:
    """The back end `torch` or `onboard`; `auto` takes onboard, the quicker one for a single stream on a CPU.

    Raises InputError for another name, and for `torch` where the extra is not installed.
    """
    if not wants_torch(backend):
        from torchvision_dddas.detection.opencv_engine import OpenCVEngine

        return OpenCVEngine(settings)
    from torchvision_dddas.detection.torch_engine import TorchEngine

    return TorchEngine(settings)
