"""Windows of two or three frames of a sequence, and the links of their targets by the source's association."""

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import bench
import clips
import cv2
import numpy as np

from torchvision_dddas.config import PaperParameters
from torchvision_dddas.lab.evaluation.metrics import tracking
from torchvision_dddas.tracking import rgb_histograms
from torchvision_dddas.tracking.source_tracker import (
    Feature,
    affinity,
    assign,
    centres,
    dispersion,
    frames_considered,
    histogram_cut,
    location_weight,
    normalize_channels,
    real_pairs,
)

ZERO = PaperParameters(dummy="zero")


@dataclass(frozen=True)
class Sequence:
    """True boxes (pixels from 1) with identities and histograms (R, 768), one row per box; the frames with pictures."""

    frame: np.ndarray
    identity: np.ndarray
    box_px: np.ndarray
    histogram: np.ndarray
    seen: frozenset[int]

    def rows(self, frame: int) -> np.ndarray:
        """Return the rows of the boxes of a frame."""
        return np.flatnonzero(self.frame == frame)


@dataclass(frozen=True)
class Windows:
    """All windows of a sequence: frames (W, K), newest first, and the association's inputs for each window.

    location, appearance: affinities with a dummy at index 0. dispersions: (W, K, 2), of locations and histograms.
    pairs: argument of `assign` for `paper.dummy` = real_pair; empty for each feature with other readings.
    """

    frames: np.ndarray
    identities: list[list[np.ndarray]]
    location: list[np.ndarray]
    appearance: list[np.ndarray]
    dispersions: np.ndarray
    pairs: list[dict[Feature, list[np.ndarray]]]


def read_sequence(place: Path) -> Sequence:
    """Read the true boxes of a sequence and their histograms. Each channel sums to 1."""
    table = clips.truth_of(place).tracks
    histogram, seen = np.zeros((len(table.frame), 768)), set()
    for number, image in clips.frames_of(place, "video"):
        rows = np.flatnonzero(table.frame == number)
        histogram[rows] = rgb_histograms(image, table.box_px[rows] - (1, 1, 0, 0))
        seen.add(number)
    return Sequence(table.frame, table.identity, table.box_px, normalize_channels(histogram), frozenset(seen))


def build_windows(
    sequence: Sequence, count: int, interval: int, every: int = 1, readings: PaperParameters = ZERO
) -> Windows:
    """Build the windows of `count` frames. A window ends at each frame with enough older frames; keep 1 in `every`.

    readings: values of dummies. They do not change the affinities of real targets.
    """
    last = int(sequence.frame.max())
    rows = {number: sequence.rows(number) for number in range(1, last + 1)}
    ends = [[t - interval * n for n in range(count)] for t in range(1 + interval * (count - 1), last + 1)]
    whole = [f for f in ends if sequence.seen.issuperset(f) and any(len(rows[t]) for t in f)]
    if not whole:
        raise SystemExit(f"no {count} frames {interval} apart with boxes; give a shorter --interval")
    frames = np.array(whole[::every], int)
    values: dict[Feature, np.ndarray] = {"location": centres(sequence.box_px), "appearance": sequence.histogram}
    tables = [{name: [of[rows[t]] for t in f] for name, of in values.items()} for f in frames.tolist()]
    location, appearance = ([affinity(of[name], readings) for of in tables] for name in values)
    pairs = [{name: real_pairs(of[name], readings, name) for name in values} for of in tables]
    identities = [[sequence.identity[rows[t]] for t in f] for f in frames.tolist()]
    spread = measure_dispersions(sequence, frames, readings.location_cut, histogram_cut(readings))
    return Windows(frames, identities, location, appearance, spread, pairs)


def measure_dispersions(
    sequence: Sequence, frames: np.ndarray, location_cut: float, histogram_cut: float
) -> np.ndarray:
    """Return (W, K, 2) dispersions of locations and histograms in each frame of the windows, for cuts of the clusters.

    histogram_cut: cut of the dissimilarities as printed.
    """
    centre, found = centres(sequence.box_px), {}
    for t in np.unique(frames).tolist():
        rows = sequence.rows(t)
        found[t] = dispersion(centre[rows], location_cut), dispersion(sequence.histogram[rows], histogram_cut)
    return np.array([[found[t] for t in f] for f in frames.tolist()]).reshape(*frames.shape, 2)


def window_ratios(windows: Windows, parameters: PaperParameters, weight: float | None) -> np.ndarray:
    """Return AR_K of every window. weight: None to choose it by the dispersions."""
    chosen = choose_weights(windows, parameters) if weight is None else np.full(len(windows.frames), weight)
    parts = zip(windows.location, windows.appearance, windows.pairs, windows.identities, chosen, strict=True)
    found = []
    for location, appearance, pairs, identities, w in parts:
        used = location if w > 0 else None, appearance if w < 1 else None
        found.append(tracking.accuracy_ratio(assign(*used, float(w), parameters, pairs), identities))
    return np.array(found)


def choose_weights(windows: Windows, parameters: PaperParameters) -> np.ndarray:
    """Return the weight of location by the source's rule for each window."""
    found = []
    for row in range(len(windows.frames)):
        location, appearance = considered_dispersions(windows, row, parameters)
        found.append(location_weight(location, lambda a=appearance: a, parameters.lowest_dispersion)[0])
    return np.array(found)


def considered_dispersions(windows: Windows, row: int, parameters: PaperParameters) -> tuple[float, float]:
    """Return the dispersions of locations and of histograms that the rule uses in a window."""
    counts = [len(known) for known in windows.identities[row]]
    location, appearance = windows.dispersions[row, : frames_considered(counts, parameters)].min(axis=0).tolist()
    return location, appearance


def select_windows(windows: Windows, rows: list[int]) -> Windows:
    """Return the windows of some rows."""
    lists = (windows.identities, windows.location, windows.appearance, windows.pairs)
    identities, location, appearance, pairs = ([of[row] for row in rows] for of in lists)
    return Windows(windows.frames[rows], identities, location, appearance, windows.dispersions[rows], pairs)


def open_sequences(options: bench.Options) -> Iterable[tuple[str, Sequence]]:
    """Return the sequences of the data that have pictures and `--only` in their names."""
    cv2.setNumThreads(1)
    places = [place for place in clips.sequences(options.data) if options.only in place.name]
    places = [place for place in places if clips.has_pictures(place, "video")]
    if not places:
        named = f" whose name holds {options.only}" if options.only else ""
        sys.exit(f"{options.data} holds no sequence with a video{named}; nothing was measured")
    for place in places:
        yield place.name, read_sequence(place)


def mean_sd(values: np.ndarray) -> str:
    """Format mean / standard deviation in percent."""
    return f"{100 * values.mean():.1f}/{100 * values.std(ddof=1):.1f}"
