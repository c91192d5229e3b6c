"""A clip in which nothing moves: whatever is found there is false."""

from typing import NamedTuple

from torchvision_dddas.evaluation.metrics.segmentation import ratio


class Still(NamedTuple):
    """Frames that were looked at, those with any blob, and the blobs."""

    frames: int = 0
    alarmed: int = 0
    blobs: int = 0

    def plus(self, other: "Still") -> "Still":
        """The counts of both."""
        return Still(*(a + b for a, b in zip(self, other, strict=True)))


def measures(counts: Still) -> dict[str, float]:
    """False blobs a frame, and the share of frames with any."""
    return {
        "false_blobs_per_frame": ratio(counts.blobs, counts.frames),
        "alarmed": ratio(counts.alarmed, counts.frames),
    }
