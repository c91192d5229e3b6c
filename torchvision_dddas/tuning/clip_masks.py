"""Masks of what moves, as examples take them from clips; what lacks or does not fit is told in one line."""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import Truth, labels_of


def check_masks(clips: Sequence[Clip], still: bool = False) -> None:
    """Raises InputError for clips without masks. still: those in which nothing moves will do."""
    masked = [clip.truth is not None and bool(clip.truth.masks) for clip in clips]
    bare = [clip.name for clip, has in zip(clips, masked, strict=True) if not (has or (still and clip.still))]
    if bare:
        lack = "have" if len(bare) > 1 else "has"
        raise InputError(f"{', '.join(bare)} {lack} no masks of what moves; choose with --clips such as have")


def labels_at(truth: Truth, frame: int, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) as `labels_of`. shape: (H, W, ...) of the frame itself. Raises InputError where it is another."""
    labels = labels_of(truth, frame)
    if labels.shape != shape[:2]:
        mask, picture = (f"{width}x{height}" for height, width in (labels.shape, shape[:2]))
        raise InputError(f"{truth.masks[frame]} is {mask}, the frame itself {picture}")
    return labels
