"""What an association with nobody is worth: the source's threshold on entries with a dummy (appendix C, III-E)."""

from typing import Any, Literal

import numpy as np

from torchvision_dddas.types import Float

Reading = Literal["one_dummy", "every_dummy", "off"]


def gate(score: Float[np.ndarray, "..."], threshold: float, reading: Reading) -> Float[np.ndarray, "..."]:
    """A copy in which an entry with a dummy is 1 - threshold where all real alternatives over that index are below it.

    score: two or three axes, index 0 of each the dummy. reading: one_dummy raises entries with exactly one dummy;
    every_dummy is the text to the letter, so that entries with two dummies are raised as well, by which the best
    assignment leaves everybody alone; off raises none. The entry of dummies alone is never touched.
    """
    score = np.array(score, float)
    return raised(score, (alternatives(score, reading) < 1 - threshold).astype(float), threshold)


def alternatives(score: Float[np.ndarray, "..."], reading: Reading) -> Float[np.ndarray, "..."]:
    """For each entry the best real alternative that must be below 1 - threshold for it to be raised; inf where never.

    Where two indices are dummies, that of either will do. score, reading: as `gate` takes them.
    """
    best = np.full(score.shape, np.inf)
    if reading == "off":
        return best
    firsts = [tuple(0 if a == axis else slice(None) for a in range(score.ndim)) for axis in range(score.ndim)]
    dummies = np.zeros(score.shape, np.int64)
    for first in firsts:
        dummies[first] += 1
    allowed = dummies == 1 if reading == "one_dummy" else dummies < score.ndim
    for axis, first in enumerate(firsts):
        real = score.take(np.arange(1, score.shape[axis]), axis).max(axis=axis, initial=-np.inf)
        best[first] = np.where(allowed[first], np.minimum(best[first], real), best[first])
    return best


def raised(score: Any, how_far: Any, threshold: Any) -> Any:
    """Entries raised to 1 - threshold: not where how_far is 0, wholly where it is 1. Arrays or tensors."""
    return how_far * (1 - threshold) + (1 - how_far) * score
