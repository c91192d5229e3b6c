"""The source's six pixel measures, from counts that may be pooled (appendix B, eq. 10 and 11)."""

import math
from typing import Any, NamedTuple

import numpy as np


class Pixels(NamedTuple):
    """True and false positives, false and true negatives."""

    tp: int = 0
    fp: int = 0
    fn: int = 0
    tn: int = 0


def add_counts(one: Any, other: Any) -> Any:
    """Add two NamedTuples of counts of one kind, whose fields are numbers, arrays or counts again."""
    if isinstance(one, tuple):
        return type(one)(*map(add_counts, one, other))
    return one + other


def count(found: np.ndarray, truth: np.ndarray) -> Pixels:
    """Compare two masks of one shape: values above 0 are foreground. Pixels with a truth below 0 do not count."""
    if truth.min(initial=0) < 0:
        known = truth >= 0
        found, truth = found[known], truth[known]
    f, t = found > 0, truth > 0
    tp, positives, labelled = (int(np.count_nonzero(x)) for x in (f & t, f, t))
    return Pixels(tp, positives - tp, labelled - tp, f.size - positives - labelled + tp)


def measures(pixels: Pixels) -> dict[str, float]:
    """Return accuracy, specificity, precision, recall, F and Gmean; NaN for 0/0, as for recall if nothing moves.

    Source: appendix B, eq. 10 and 11.
    """
    tp, fp, fn, tn = pixels
    specificity, recall = ratio(tn, tn + fp), ratio(tp, tp + fn)
    return {
        "accuracy": ratio(tp + tn, tp + fp + fn + tn),
        "specificity": specificity,
        "precision": ratio(tp, tp + fp),
        "recall": recall,
        "f": ratio(2 * tp, 2 * tp + fp + fn),
        "gmean": math.sqrt(specificity * recall),
    }


def ratio(part: float, whole: float) -> float:
    """Return part / whole, NaN for 0/0."""
    return part / whole if whole else math.nan


class Still(NamedTuple):
    """Numbers of processed frames of a clip without motion, of those with any blob, and of blobs."""

    frames: int = 0
    alarmed: int = 0
    blobs: int = 0


def still_measures(counts: Still) -> dict[str, float]:
    """Return the false blobs for each frame, and the share of frames with any."""
    return {
        "false_blobs_per_frame": ratio(counts.blobs, counts.frames),
        "alarmed": ratio(counts.alarmed, counts.frames),
    }
