"""How sure a figure is: intervals by resampling what may be taken as independent, blocks of frames or whole clips.

Frames that follow each other are alike, so that single frames, drawn anew, would seem to tell more than they do.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

RESAMPLES = 1000
LEVEL = 0.95

FEWEST = 5
"""Independent blocks below which nothing is said: the range of five values misses their median in 1 of 16 cases."""

LONGER = 2.0
"""Blocks that tell a variance best are short for an interval: of alike frames it then holds the truth more seldom."""

Statistic = Callable[[np.ndarray], dict[str, float]]
"""Weights (U,) of units, how often each counts, to measures by name; NaN where one is undefined."""


class Interval(NamedTuple):
    """Within which the figure lies in 95 of 100 such studies."""

    low: float
    high: float


class Stratum(NamedTuple):
    """Units that are drawn among themselves, in blocks of neighbours: the frames of a clip, or all clips (block 1)."""

    units: int
    block: int = 1


def intervals(
    statistic: Statistic, strata: Sequence[Stratum], seed: int, resamples: int = RESAMPLES
) -> dict[str, Interval | None]:
    """An interval for each measure; None where there are fewer than FEWEST blocks or too few samples gave a figure.

    Percentiles of the resampled figures, widened for few blocks as a t distribution is against the normal one. Source:
    Hesterberg, 2015, "expanded percentile interval".
    """
    whole = statistic(np.ones(sum(stratum.units for stratum in strata)))
    if parts(strata) < FEWEST:
        return dict.fromkeys(whole)
    drawn = samples(statistic, strata, seed, resamples)
    return {
        name: percentiles(values, parts(strata)) if math.isfinite(whole[name]) else None
        for name, values in drawn.items()
    }


def parts(strata: Sequence[Stratum]) -> float:
    """How many blocks there are, what may be taken as independent."""
    return sum(stratum.units / stratum.block for stratum in strata)


def samples(
    statistic: Statistic, strata: Sequence[Stratum], seed: int, resamples: int = RESAMPLES
) -> dict[str, np.ndarray]:
    """(R,) each measure in each sample."""
    found = [statistic(weight) for weight in weights(strata, seed, resamples)]
    return {name: np.array([one[name] for one in found]) for name in found[0]}


def weights(strata: Sequence[Stratum], seed: int, resamples: int = RESAMPLES) -> Iterator[np.ndarray]:
    """How often each unit is in each sample, (U,): blocks of neighbours, after the last comes the first.

    Source: Politis and Romano, 1992, the circular block bootstrap. A block of 1: the plain bootstrap.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    for _ in range(resamples):
        drawn = []
        for units, block in strata:
            begins = rng.integers(0, units, -(-units // block))
            rows = ((begins[:, None] + np.arange(block)) % units).ravel()[:units]
            drawn.append(np.bincount(rows, minlength=units))
        yield np.concatenate(drawn).astype(float)


def percentiles(values: np.ndarray, count: float, level: float = LEVEL) -> Interval | None:
    """The interval that samples of so many independent blocks tell; None if a tenth of them are no number."""
    known = values[np.isfinite(values)]
    if len(known) < 0.9 * len(values) or not len(known):
        return None
    tail = expanded(count, level)
    low, high = np.quantile(known, [tail, 1 - tail])
    return Interval(float(low), float(high))


def expanded(count: float, level: float = LEVEL) -> float:
    """The share of samples beyond either end, for so many independent blocks."""
    return float(ndtr(math.sqrt(count / (count - 1)) * stdtrit(count - 1, (1 - level) / 2)))


def block_length(series: np.ndarray) -> int:
    """How many neighbours a block needs so that blocks may be taken as independent: the most that a column asks for.

    series: (U, K), what each unit in turn adds to each of some measures. At most a FEWEST-th of the units.
    Source: Politis and White, 2004, with the correction of 2009, for the circular block bootstrap.
    """
    units = len(series)
    most = max(1, min(math.ceil(3 * math.sqrt(units)), units // FEWEST))
    asked = [_asked(column) for column in series.T if np.isfinite(column).all()]
    asked = [LONGER * length if length > 1.5 else length for length in asked]
    return min(max(1, math.ceil(max(asked, default=1.0))), most)


def _asked(column: np.ndarray) -> float:
    count, apart = len(column), column - column.mean()
    if count < 2 * FEWEST or not apart.any():
        return 1.0
    # The autocorrelation counts as gone after the first `quiet` lags in a row that chance explains.
    quiet, farthest = max(5, math.ceil(math.sqrt(math.log10(count)))), math.ceil(math.sqrt(count)) + 5
    lags = min(count - 1, 2 * (farthest + quiet))
    shared = np.array([apart[: count - lag] @ apart[lag:] for lag in range(lags + 1)]) / count
    alike = np.abs(shared / shared[0]) >= 2 * math.sqrt(math.log10(count) / count)
    last = 0
    for lag in range(1, min(farthest, lags) + 1):
        if alike[lag]:
            last = lag
        elif lag - last >= quiet:
            break
    window = min(2 * max(last, 1), lags)
    steps = np.arange(1, window + 1)
    taper = np.clip(2 * (1 - steps / window), 0, 1)
    spread = shared[0] + 2 * float(taper @ shared[1 : window + 1])
    pull = 2 * float(taper @ (steps * shared[1 : window + 1]))
    if spread <= 0:
        return 1.0
    return float((2 * pull**2 / (4 / 3 * spread**2)) ** (1 / 3) * count ** (1 / 3))


def seed_of(*parts: str | np.ndarray) -> int:
    """A seed that is told by the content alone, so that the same counts give the same interval wherever they stand."""
    digest = hashlib.sha256()
    for part in parts:
        content = part.encode() if isinstance(part, str) else np.ascontiguousarray(part, float).tobytes()
        digest.update(len(content).to_bytes(8, "big") + content)
    return int.from_bytes(digest.digest()[:8], "big")
