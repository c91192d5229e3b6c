"""Confidence intervals by resampling blocks of frames or whole clips, also of differences between results."""

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

RESAMPLES = 1000
LEVEL = 0.95

FEWEST = 5
"""Fewest independent blocks for an interval. The range of five values misses their median in 1 of 16 cases."""

LONGER = 2.0
"""Blocks are this much longer than blocks that estimate a variance best, which make intervals too short."""

Statistic = Callable[[np.ndarray], dict[str, float]]
"""A function from (U,) weights to measures by name, NaN if undefined. A weight is how often a unit counts."""


class ConfidenceInterval(NamedTuple):
    """The range that contains the figure in 95 of 100 such studies."""

    low: float
    high: float


class Stratum(NamedTuple):
    """Units that are drawn among themselves, in blocks of neighbours: the frames of a clip, or all clips (block 1)."""

    units: int
    block: int = 1


def intervals(
    statistic: Statistic, strata: Sequence[Stratum], seed: int, resamples: int = RESAMPLES
) -> dict[str, ConfidenceInterval | None]:
    """Return an interval for each measure; None with fewer than FEWEST blocks or too few samples with a figure.

    Source: Hesterberg, 2015, "expanded percentile interval".
    """
    whole = statistic(np.ones(sum(stratum.units for stratum in strata)))
    if parts(strata) < FEWEST:
        return dict.fromkeys(whole)
    drawn = _by_name(statistic(weight) for weight in weights(strata, seed, resamples))
    return {
        name: percentiles(drawn[name], parts(strata)) if math.isfinite(value) else None for name, value in whole.items()
    }


def _by_name(samples: Iterable[Mapping[str, float]]) -> dict[str, np.ndarray]:
    """Return each measure in each sample, (R,)."""
    found = list(samples)
    return {name: np.array([sample[name] for sample in found]) for name in found[0]}


def parts(strata: Sequence[Stratum]) -> float:
    """Return the number of blocks, which count as independent."""
    return sum(stratum.units / stratum.block for stratum in strata)


def weights(strata: Sequence[Stratum], seed: int, resamples: int = RESAMPLES) -> Iterator[np.ndarray]:
    """Yield how often each unit is in each sample, (U,): blocks of neighbours; the first unit follows the last.

    Source: Politis and Romano, 1992, the circular block bootstrap. Blocks of 1 give the plain bootstrap.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    for _ in range(resamples):
        drawn = []
        for units, block in strata:
            begins = rng.integers(0, units, -(-units // block))
            rows = ((begins[:, None] + np.arange(block)) % units).ravel()[:units]
            drawn.append(np.bincount(rows, minlength=units))
        yield np.concatenate(drawn).astype(float)


def percentiles(values: np.ndarray, count: float) -> ConfidenceInterval | None:
    """Return the interval of samples of `count` independent blocks; None if over a tenth of them are not finite."""
    known = values[np.isfinite(values)]
    if len(known) < 0.9 * len(values) or not len(known):
        return None
    # Expanded: for few blocks, wider by the ratio of the t distribution to the normal distribution.
    tail = float(ndtr(math.sqrt(count / (count - 1)) * stdtrit(count - 1, (1 - LEVEL) / 2)))
    low, high = np.quantile(known, [tail, 1 - tail])
    return ConfidenceInterval(float(low), float(high))


def block_length(series: np.ndarray) -> int:
    """Return how many units make a block, so that blocks are nearly independent: the largest need of all columns.

    series: (U, K), the contribution of each unit, in order, to each measure. The length is at most the units divided by
    FEWEST. Source: Politis and White, 2004, with the correction of 2009, for the circular block bootstrap.
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
    # The autocorrelation counts as zero after the first `quiet` lags in a row that chance explains.
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
    """Return a seed that depends only on the content, so that the same counts always give the same interval."""
    digest = hashlib.sha256()
    for part in parts:
        content = part.encode() if isinstance(part, str) else np.ascontiguousarray(part, float).tobytes()
        digest.update(len(content).to_bytes(8, "big") + content)
    return int.from_bytes(digest.digest()[:8], "big")


EXCHANGES = 2000
"""Largest number of ways to exchange two results that are tried."""

_ROUNDING = 1e-9


class Effect(NamedTuple):
    """The difference of a measure, the second result minus the first. interval: None if there are too few blocks.

    p: probability of a difference this large if the two results were exchangeable; NaN if it cannot be computed. least:
    the smallest p that this number of blocks can give.
    """

    value: float
    interval: ConfidenceInterval | None
    p: float
    least: float


def effects(
    statistic: Statistic, strata: Sequence[Stratum], seed: int, resamples: int = RESAMPLES, most: int = EXCHANGES
) -> dict[str, Effect]:
    """Return the effect on each measure. strata: groups of one result's units, in which blocks are drawn together.

    statistic: function of weights (2 U,), which state how often each unit of the first and then of the second result
    counts. resamples: number of samples for the interval. most: largest number of ways to exchange the results; if
    there are fewer, all are tried.
    """
    units = sum(stratum.units for stratum in strata)
    ones, none = np.ones(units), np.zeros(units)

    def difference(weight: np.ndarray, other: np.ndarray) -> dict[str, float]:
        before, after = (statistic(np.concatenate(pair)) for pair in ((weight, other), (other, weight)))
        return {name: after[name] - before[name] for name in before}

    whole, drawn = difference(ones, none), None
    if parts(strata) >= FEWEST:
        drawn = _by_name(difference(weight, none) for weight in weights(strata, seed, resamples))
    # Try every way to exchange the two results of blocks of about equal length, or random ways if there are too many.
    sizes: list[int] = []
    for stratum in strata:
        count = max(1, stratum.units // stratum.block)
        sizes += [len(part) for part in np.array_split(np.arange(stratum.units), count)]
    every = 2 ** min(len(sizes), 60) <= most
    rng = np.random.Generator(np.random.PCG64(seed))
    sides: Iterable[Sequence[int]] = (
        product((0, 1), repeat=len(sizes)) if every else (rng.integers(0, 2, len(sizes)).tolist() for _ in range(most))
    )
    swaps = (np.repeat(np.array(side, float), sizes) for side in sides)
    exchanged = _by_name(difference(1 - swap, swap) for swap in swaps)
    # Exchanging all blocks only changes the sign of the difference.
    least = 2 ** (1 - len(sizes)) if every else 1 / (most + 1)
    return {
        name: Effect(
            value,
            None if drawn is None else percentiles(drawn[name], parts(strata)),
            _p(value, exchanged[name], every),
            least,
        )
        for name, value in whole.items()
    }


def _p(value: float, exchanged: np.ndarray, every: bool) -> float:
    known = exchanged[np.isfinite(exchanged)]
    if not math.isfinite(value) or len(known) < 0.9 * len(exchanged) or not len(known):
        return math.nan
    as_large = int((np.abs(known) >= abs(value) * (1 - _ROUNDING) - _ROUNDING * 1e-3).sum())
    # The observed result is one of the ways. Random ways may have missed it.
    return as_large / len(known) if every else (as_large + 1) / (len(known) + 1)


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """Correct the p values of several questions, so that each is as reliable as a single question. NaN stays NaN.

    Source: Holm, 1979.
    """
    known = sorted((value, name) for name, value in p.items() if not math.isnan(value))
    adjusted, least = dict.fromkeys(p, math.nan), 0.0
    for rank, (value, name) in enumerate(known):
        least = max(least, min(1.0, (len(known) - rank) * value))
        adjusted[name] = least
    return adjusted
