"""Is the difference between two results of the same clips beyond noise? Paired resampling of what is independent."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from torchvision_dddas.evaluation.metrics import bootstrap
from torchvision_dddas.evaluation.metrics.bootstrap import RESAMPLES, Interval, Statistic, Stratum

EXCHANGES = 2000
"""Ways to exchange two results that are gone through."""

_ROUNDING = 1e-9


class Effect(NamedTuple):
    """How a measure differs, the second result less the first. interval: None where too little is there to tell one.

    p: how likely a difference as large is if the two results were exchangeable; NaN where that cannot be asked. least:
    the smallest p that so few blocks could give.
    """

    value: float
    interval: Interval | None
    p: float
    least: float


def effects(
    statistic: Statistic, strata: Sequence[Stratum], seed: int, resamples: int = RESAMPLES, most: int = EXCHANGES
) -> dict[str, Effect]:
    """The effect on each measure. strata: of the units of one result; blocks of them are drawn, or exchanged, together.

    statistic: of weights (2 U,): how often each unit of the first result counts, and then of the second.
    resamples: drawn for the interval; most: ways to exchange the results that are gone through, all where no more.
    """
    units = sum(stratum.units for stratum in strata)
    ones, none = np.ones(units), np.zeros(units)

    def apart(first: np.ndarray, second: np.ndarray) -> dict[str, float]:
        before, after = statistic(first), statistic(second)
        return {name: after[name] - before[name] for name in before}

    whole = apart(np.concatenate([ones, none]), np.concatenate([none, ones]))
    drawn: dict[str, list[float]] = {name: [] for name in whole}
    if bootstrap.parts(strata) >= bootstrap.FEWEST:
        for weight in bootstrap.weights(strata, seed, resamples):
            one = apart(np.concatenate([weight, none]), np.concatenate([none, weight]))
            for name, value in one.items():
                drawn[name].append(value)
    exchanged: dict[str, list[float]] = {name: [] for name in whole}
    for swap in exchanges(strata, seed, most):
        one = apart(np.concatenate([1 - swap, swap]), np.concatenate([swap, 1 - swap]))
        for name, value in one.items():
            exchanged[name].append(value)
    every = _all(strata, most)
    # Exchanging everything only turns the sign of the difference.
    least = 2 ** (1 - _blocks(strata)) if every else 1 / (most + 1)
    return {
        name: Effect(
            value,
            bootstrap.percentiles(np.array(drawn[name]), bootstrap.parts(strata)) if drawn[name] else None,
            _p(value, np.array(exchanged[name]), every),
            least,
        )
        for name, value in whole.items()
    }


def exchanges(strata: Sequence[Stratum], seed: int, most: int = EXCHANGES) -> Iterator[np.ndarray]:
    """(U,) 1.0 for units whose two results are exchanged, block by block: every way, or random ones of many."""
    count = _blocks(strata)
    rng = np.random.Generator(np.random.PCG64(seed))
    sides: Iterator[Sequence[int]] = (
        product((0, 1), repeat=count)
        if _all(strata, most)
        else (rng.integers(0, 2, count).tolist() for _ in range(most))
    )
    sizes = [size for stratum in strata for size in _sizes(stratum)]
    for side in sides:
        yield np.repeat(np.array(side, float), sizes)


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """The p values of several questions asked at once, each as sure as if it were the only one. NaN stays NaN.

    Source: Holm, 1979.
    """
    known = sorted((value, name) for name, value in p.items() if not math.isnan(value))
    adjusted, least = dict.fromkeys(p, math.nan), 0.0
    for rank, (value, name) in enumerate(known):
        least = max(least, min(1.0, (len(known) - rank) * value))
        adjusted[name] = least
    return adjusted


def _all(strata: Sequence[Stratum], most: int) -> bool:
    return 2 ** min(_blocks(strata), 60) <= most


def _blocks(strata: Sequence[Stratum]) -> int:
    return sum(len(_sizes(stratum)) for stratum in strata)


def _sizes(stratum: Stratum) -> list[int]:
    """Units of each block, none much shorter than the others."""
    count = max(1, stratum.units // stratum.block)
    return [len(part) for part in np.array_split(np.arange(stratum.units), count)]


def _p(value: float, exchanged: np.ndarray, every: bool) -> float:
    known = exchanged[np.isfinite(exchanged)]
    if not math.isfinite(value) or len(known) < 0.9 * len(exchanged) or not len(known):
        return math.nan
    as_large = int((np.abs(known) >= abs(value) * (1 - _ROUNDING) - _ROUNDING * 1e-3).sum())
    # What was seen is one of the ways itself; random ones may have missed it.
    return as_large / len(known) if every else (as_large + 1) / (len(known) + 1)
