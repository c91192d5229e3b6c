"""True boxes with their histograms, windows of frames, and the affinities of all windows as one padded batch.

A sequence is one of MOTChallenge (see `datasets.motchallenge`), with pictures of all frames, or single ones in folders
`img1*`, named by their frame.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from footage import frames_of, truth_of

from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.functional import affinity
from torchvision_dddas.tracking import source_affinity
from torchvision_dddas.tracking.appearance import rgb_histograms
from torchvision_dddas.tracking.source_affinity import dispersion


@dataclass(frozen=True)
class Truth:
    """The true boxes of a sequence, a row a box, and the frames whose pictures there are.

    box_px: (R, 4) as the file has them, pixels from 1. histogram: (R, 768), zeros where there is no picture.
    """

    name: str
    frame: np.ndarray
    identity: np.ndarray
    box_px: np.ndarray
    histogram: np.ndarray
    seen: frozenset[int]

    def rows(self, frame: int) -> np.ndarray:
        """Where the boxes of a frame are."""
        return np.flatnonzero(self.frame == frame)


def read(place: Path, pictures: str, histograms: str = "channel", ignored: bool = False) -> Truth:
    """Read a sequence. pictures: video or images. histograms: count, or channel, which adds up to 1 in each.

    ignored: with the rows that are marked to be left out.
    """
    truth = truth_of(place)
    table = truth.tracks
    assert table is not None
    if ignored and truth.ignored is not None:
        parts = zip(table, truth.ignored, strict=True)
        table = TrackTable(*(np.concatenate(pair) for pair in parts))
        table = table.at(np.lexsort([table.identity, table.frame]))
    histogram, seen = np.zeros((len(table.frame), 768)), set()
    for number, image in frames_of(place, pictures):
        rows = np.flatnonzero(table.frame == number)
        # MOTChallenge counts pixels from 1.
        histogram[rows] = rgb_histograms(image, table.box_px[rows] - (1, 1, 0, 0))
        seen.add(number)
    if histograms == "channel":
        histogram = source_affinity.normalize_channels(histogram)
    return Truth(place.name, table.frame, table.identity, table.box_px, histogram, frozenset(seen))


@dataclass(frozen=True)
class Windows:
    """All windows of a sequence: `frames` (W, K), newest first, and what a study needs of each.

    identities: per window those of its frames. location, appearance: per window the affinities with a dummy at index 0.
    dispersions: (W, K, 2), of locations and of histograms, of each frame.
    """

    frames: np.ndarray
    identities: list[list[np.ndarray]]
    location: list[np.ndarray]
    appearance: list[np.ndarray]
    dispersions: np.ndarray


def windows(truth: Truth, count: int, interval: int, cuts: tuple[float, float], every: int = 1) -> Windows:
    """The windows of `count` frames, one ending at each frame that has its older ones, with any target in it.

    cuts: the dissimilarities at which clusters of locations and of histograms end. every: take one
    window in so many.
    """
    last = max(int(truth.frame.max()), max(truth.seen, default=1))
    rows = {number: truth.rows(number) for number in range(1, last + 1)}
    ends = [[t - interval * n for n in range(count)] for t in range(1 + interval * (count - 1), last + 1)]
    whole = [f for f in ends if truth.seen.issuperset(f) and any(len(rows[t]) for t in f)]
    frames = np.array(whole[::every], int).reshape(-1, count)
    centre, shares = source_affinity.centres(truth.box_px), truth.histogram
    most = max(len(r) for r in rows.values())
    valid = np.arange(most) < np.array([0, *(len(rows[t]) for t in range(1, last + 1))])[:, None]
    parts = []
    for feature in (centre, shares):
        padded = np.zeros((last + 1, most, feature.shape[1]))
        for number, which in rows.items():
            padded[number, : len(which)] = feature[which]
        parts.append(_affinities(torch.from_numpy(padded), torch.from_numpy(valid), torch.from_numpy(frames)))
    sizes = [tuple(len(rows[t]) for t in f) for f in frames]
    location, appearance = ([_with_dummies(part[w], sizes[w]) for w in range(len(frames))] for part in parts)
    return Windows(
        frames,
        [[truth.identity[rows[t]] for t in f] for f in frames],
        location,
        appearance,
        dispersions(truth, frames, cuts),
    )


def dispersions(truth: Truth, frames: np.ndarray, cuts: tuple[float, float]) -> np.ndarray:
    """(W, K, 2) of the locations and of the histograms of each frame of the windows, at these cuts."""
    centre, shares = source_affinity.centres(truth.box_px), truth.histogram
    rows = {number: truth.rows(number) for number in np.unique(frames).tolist()}
    found = {t: (dispersion(centre[rows[t]], cuts[0]), dispersion(shares[rows[t]], cuts[1])) for t in rows}
    return np.array([[found[t] for t in f] for f in frames.tolist()]).reshape(*frames.shape, 2)


def _affinities(feature: torch.Tensor, valid: torch.Tensor, frames: torch.Tensor) -> np.ndarray:
    """(W, N, M) or (W, N, M, L) of all windows at once."""
    tables = [feature[column] for column in frames.T] + [valid[column] for column in frames.T]
    return (affinity.pairs(*tables) if frames.shape[1] == 2 else affinity.triplets(*tables)).numpy()


def _with_dummies(padded: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    return np.pad(padded[tuple(slice(n) for n in size)], ((1, 0),) * len(size))
