"""The tracks that are remembered: parallel arrays, one row a track."""

from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas.tracking import kalman


@dataclass(frozen=True)
class Roster:
    """Tracks, seen lately or not.

    state: (N, kalman.COLUMNS) as last seen. signature: (N, D) histograms, zeros where unknown; D is 0 until one is
    known. at_border: whether last seen at the picture's border. number: of the track, among all that were ever begun.
    hits: detections so far.
    """

    state: np.ndarray = field(default_factory=lambda: np.zeros((0, kalman.COLUMNS)))
    signature: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    at_border: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    number: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    hits: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.number)

    def plus(self, other: "Roster") -> "Roster":
        """The tracks of both, those of the other last."""
        if not len(other):
            return self
        width = max(self.signature.shape[1], other.signature.shape[1])
        return Roster(
            np.concatenate([self.state, other.state]),
            np.concatenate([widened(self.signature, width), widened(other.signature, width)]),
            np.concatenate([self.at_border, other.at_border]),
            np.concatenate([self.number, other.number]),
            np.concatenate([self.hits, other.hits]),
        )

    def only(self, keep: np.ndarray) -> "Roster":
        """The tracks that a mask keeps."""
        if keep.all():
            return self
        return Roster(self.state[keep], self.signature[keep], self.at_border[keep], self.number[keep], self.hits[keep])

    def carried(self, now_from_before: np.ndarray) -> "Roster":
        """The tracks after the camera has moved."""
        return replace(self, state=kalman.carried(self.state, now_from_before))


def widened(signature: np.ndarray, width: int) -> np.ndarray:
    """Unknown histograms (N, 0) as zeros (N, width); others as they are."""
    return signature if signature.shape[1] == width else np.zeros((len(signature), width), np.float32)
