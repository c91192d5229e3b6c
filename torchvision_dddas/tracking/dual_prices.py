"""Prices of targets that bound a three-frame assignment: no choice of triplets gains more than all prices together.

Prices are right when each triplet's targets pay at least for what it gains (linear-programming duality; the Lagrange
multipliers of "every target at most once"). The dummy, index 0 of each layer, costs nothing. What the prices exceed
a triplet's gain by is its loss: a choice falls short of the bound by the losses of its triplets and by the prices of
the targets left alone. So a triplet that loses more than bound - value is in no better choice than one of that value.
"""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.types import Float, Int

Prices = tuple[Float[np.ndarray, "N1"], Float[np.ndarray, "M1"], Float[np.ndarray, "L1"]]
# The two layers beside each.
OTHERS = ((1, 2), (0, 2), (0, 1))


def low_prices(gain: Float[np.ndarray, "N1 M1 L1"], rounds: int = 4) -> Prices:
    """Right prices, not far above the lowest sum there is.

    Even shares of the gains pay for every triplet. From them, and from nine tenths of them, two layers at a time are
    given the least prices that the third's allow, each a two-frame assignment. Where all triplets are alike the shares
    themselves are the best start, elsewhere the lower one: the better end is returned.
    """
    shares = shared_prices(gain)
    ends = [shares]
    for start in (1.0, 0.9):
        prices = (shares[0] * start, shares[1] * start, shares[2] * start)
        for step in range(rounds):
            layer = step % 3
            prices, _ = settle(best_over(gain, prices[layer], layer), prices, layer)
        ends.append(prices)
    return min(ends, key=bound)


def bound(prices: Sequence[np.ndarray]) -> float:
    """More than this no choice of triplets can gain."""
    return float(sum(price.sum() for price in prices))


def shared_prices(gain: Float[np.ndarray, "N1 M1 L1"]) -> Prices:
    """For each target the largest even share of what one of its triplets gains."""
    real = gain[1:, 1:, 1:]
    over_first = real.max(axis=0, initial=0.0)
    triple = (
        real.max(axis=(1, 2), initial=0.0),
        over_first.max(axis=1, initial=0.0),
        over_first.max(axis=0, initial=0.0),
    )
    prices = []
    for layer, (a, b) in enumerate(OTHERS):
        # The pairs of this layer and another: the third index is the dummy's.
        faces = [np.moveaxis(gain.take(0, axis=third), layer - (third < layer), 0)[1:] for third in (a, b)]
        pair = np.maximum(*(face.max(axis=1, initial=0.0) for face in faces))
        prices.append(np.concatenate([[0.0], np.maximum(triple[layer] / 3, pair / 2)]))
    return prices[0], prices[1], prices[2]


def best_over(
    gain: Float[np.ndarray, "N1 M1 L1"], price: Float[np.ndarray, "P"], layer: int
) -> Float[np.ndarray, "A B"]:
    """For each pair of the other two layers the most that it gains with one target of `layer`, less its price."""
    spare = np.empty(gain.shape[1:])
    if layer == 0:
        best = gain[0].copy()
        for block, cost in zip(gain[1:], price[1:], strict=True):
            np.maximum(best, np.subtract(block, cost, out=spare), out=best)
        return best
    best = np.empty((len(gain), gain.shape[3 - layer]))
    across = price[:, None] if layer == 1 else price
    # Block by block: a block fits the cache, the tensor does not.
    for block, row in zip(gain, best, strict=True):
        np.subtract(block, across, out=spare).max(axis=layer - 1, out=row)
    return best


def settle(best: Float[np.ndarray, "A B"], prices: Prices, layer: int) -> tuple[Prices, Int[np.ndarray, "P 2"]]:
    """The least prices of the other two layers that go with those of `layer`, and the pairs that are worth them.

    best: as `best_over` gives it for the layer and its prices. The prices are the mean of the assignment's two extreme
    dual solutions: extremes leave no room for the next layer.
    """
    first, second, excess, row, column = matched(best)
    worth = excess[row, column]
    low, high = _least_potential(excess, row, column), _least_potential(excess.T, column, row)
    first[row] += worth / 2
    first[row] += (high[row] - low[column]) / 2
    second[column] += worth / 2
    second[column] += (low[column] - high[row]) / 2
    settled = list(prices)
    for other, price in zip(OTHERS[layer], (first, second), strict=True):
        settled[other] = np.concatenate([[0.0], price])
    used = worth > 0
    return (settled[0], settled[1], settled[2]), np.stack([row[used] + 1, column[used] + 1], axis=1)


def matched(
    best: Float[np.ndarray, "A B"],
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "A0 B0"], Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """What the targets of two layers gain without each other, what pairs gain above that, and the best pairs."""
    from scipy.optimize import linear_sum_assignment  # here, as it takes half a second and 45 MB

    first, second = np.maximum(best[1:, 0], 0.0), np.maximum(best[0, 1:], 0.0)
    excess = np.maximum(best[1:, 1:] - first[:, None] - second, 0.0)
    row, column = linear_sum_assignment(excess, maximize=True)
    return first, second, excess, row, column


def _least_potential(
    excess: Float[np.ndarray, "A B"], row: Int[np.ndarray, "P"], column: Int[np.ndarray, "P"]
) -> Float[np.ndarray, "B"]:
    """The least dual prices of the columns of an optimal assignment of what is nowhere negative (Bellman-Ford)."""
    above = excess[row] - excess[row, column][:, None]
    unmatched = np.ones(len(excess), bool)
    unmatched[row] = False
    least = excess[unmatched].max(axis=0, initial=0.0)
    potential = least
    for _ in range(len(row) + 1):
        raised = np.maximum((above + potential[column][:, None]).max(axis=0, initial=0.0), least)
        if (raised <= potential + 1e-12).all():
            break
        potential = raised
    return potential


def cheap(gain: Float[np.ndarray, "N1 M1 L1"], prices: Prices, most: float) -> tuple[np.ndarray, np.ndarray]:
    """The triplets that lose no more than `most`: flat indices, ascending, and losses."""
    across = prices[1][:, None] + prices[2]
    spare, index, loss = np.empty_like(across), [], []
    for i, block in enumerate(gain):
        lost = np.subtract(across, block, out=spare).ravel()
        here = np.flatnonzero(lost <= most - prices[0][i])
        index.append(here + i * spare.size)
        loss.append(lost[here] + prices[0][i])
    return np.concatenate(index), np.concatenate(loss)
