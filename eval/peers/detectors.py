"""Made-up detectors: tables of detections made from the truth of a sequence, with errors of known size.

Scores are drawn as a real detector gives them: of true boxes from Beta(9, 1.5), mean .86; of false ones from
Beta(2, 3), mean .4. Which target a box shows is known, so that identities are scored on the boxes that were given.
"""

import zlib
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable

TRUE_SCORES, FALSE_SCORES = (9.0, 1.5), (2.0, 3.0)
FALSE = -1
"""The identity of a false box."""


@dataclass(frozen=True)
class Detector:
    """dropped: share of true boxes that are missed. jitter: sd of each edge, in sides of the box. false: boxes a frame.

    scores: whether boxes have scores; else all are 1. renumbered: whether the frames that were looked at are numbered
    1, 2, 3, ..., as by a program that knows no frame rate.
    """

    dropped: float = 0.0
    jitter: float = 0.0
    false: float = 0.0
    scores: bool = False
    renumbered: bool = False


DETECTORS = {
    "true": Detector(),
    "true, unknown rate": Detector(renumbered=True),
    "noisy": Detector(0.2, 0.05, 1.0, scores=True),
    "slightly noisy": Detector(0.1, 0.025, 0.5, scores=True),
    "very noisy": Detector(0.3, 0.1, 2.0, scores=True),
    "noisy, flat scores": Detector(0.2, 0.05, 1.0),
    "noisy, unknown rate": Detector(0.2, 0.05, 1.0, scores=True, renumbered=True),
}


@dataclass(frozen=True)
class Looks:
    """What a detector gives at each look: (N,) frames, identities (FALSE: none) and scores, and (N, 4) boxes.

    The table is sorted by frame and shuffled within a frame. interval: frames from one look to the next, as told.
    length: number of the last frame. size: width and height of the picture in pixels.
    """

    table: TrackTable
    score: np.ndarray
    interval: int
    length: int
    size: tuple[float, float]

    @property
    def truth(self) -> TrackTable:
        """The rows that show a target."""
        return self.table.at(np.flatnonzero(self.table.identity != FALSE))


def look(
    name: str,
    truth: TrackTable,
    length: int,
    size: tuple[float, float],
    interval: int,
    detector: Detector,
    seed: int = 0,
) -> Looks:
    """The table that a detector makes of every interval-th frame of a sequence of this name, the same at every call."""
    rng = np.random.default_rng([seed, interval, zlib.crc32(name.encode())])
    table = truth.every(interval)
    frame, identity, box = table.frame, table.identity, np.array(table.box_px, float)
    kept = rng.random(len(frame)) >= detector.dropped
    frame, identity, box = frame[kept], identity[kept], box[kept]
    if detector.jitter:
        near, far = box[:, :2], box[:, :2] + box[:, 2:]
        near, far = (edge + detector.jitter * rng.normal(size=edge.shape) * box[:, 2:] for edge in (near, far))
        box = np.c_[near, np.maximum(far - near, 1.0)]
    looks = np.arange(1, length + 1, interval)
    count = rng.poisson(detector.false, len(looks)) if detector.false % 1 else np.full(len(looks), int(detector.false))
    where = np.repeat(looks, count)
    if len(where) and len(box):
        side = box[rng.integers(len(box), size=len(where)), 2:]
        corner = rng.random((len(where), 2)) * np.maximum(np.array(size) - side, 1.0)
        frame, box = np.r_[frame, where], np.r_[box, np.c_[corner, side]]
        identity = np.r_[identity, np.full(len(where), FALSE)]
    score = np.ones(len(frame))
    if detector.scores:
        true = identity != FALSE
        score[true] = rng.beta(*TRUE_SCORES, true.sum())
        score[~true] = rng.beta(*FALSE_SCORES, (~true).sum())
    order = rng.permutation(len(frame))
    order = order[np.argsort(frame[order], kind="stable")]
    frame, told = frame[order], interval
    if detector.renumbered:
        frame, length, told = (frame - 1) // interval + 1, len(looks), 1
    return Looks(TrackTable(frame, identity[order], box[order]), score[order], told, length, size)
