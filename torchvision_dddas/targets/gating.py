"""What an association with nobody is worth: the source's threshold on entries with a dummy (appendix C, III-E)."""

from typing import Literal

import numpy as np

from torchvision_dddas.shapes import Float

Reading = Literal["one_dummy", "every_dummy", "off"]


def gate(score: Float[np.ndarray, "..."], threshold: float, reading: Reading) -> Float[np.ndarray, "..."]:
    """A copy in which an entry with a dummy is 1 - threshold where all real alternatives over that index are below it.

    score: two or three axes, index 0 of each the dummy. reading: one_dummy raises entries with exactly one dummy;
    every_dummy is the text to the letter, so that entries with two dummies are raised as well, by which the best
    assignment leaves everybody alone; off raises none. The entry of dummies alone is never touched.
    """
    gated = np.array(score, float)
    if reading == "off":
        return gated
    firsts = [tuple(0 if a == axis else slice(None) for a in range(gated.ndim)) for axis in range(gated.ndim)]
    dummies = np.zeros(gated.shape, np.int64)
    for first in firsts:
        dummies[first] += 1
    allowed = dummies == 1 if reading == "one_dummy" else dummies < gated.ndim
    for axis, first in enumerate(firsts):
        best = score.take(np.arange(1, score.shape[axis]), axis).max(axis=axis, initial=-np.inf)
        gated[first] = np.where(allowed[first] & (best < 1 - threshold), 1 - threshold, gated[first])
    return gated
