"""Three-frame assignment of a dense score tensor by Lagrangian relaxation, with a certified gap (appendix C, eq. 1-3).

A target that is in no chosen triplet stays alone: it takes the dummy, index 0, on both other axes. The gain of a
triplet is its score minus the scores of its targets alone. The problem is to choose triplets that share no target and
have the largest total gain.

Targets have prices, the Lagrange multipliers of "every target at most once". If the prices of every triplet sum to at
least its gain, the sum of all prices is an upper bound of the total gain. The loss of a triplet is the sum of its
prices minus its gain. A triplet with a loss above (bound - value) cannot be in a choice with a gain above `value`. The
solver

1. finds prices by two-frame assignments, derives a choice from them, and improves it by further two-frame assignments;
2. while the gap is too wide, lowers the prices by subgradient steps over the triplets with small losses, and rounds a
   linear programme over the targets for which the steps do not agree;
3. if the gap stays too wide, passes the triplets that can be in a better choice, if they are few enough, to the exact
   solver: a search by the prices, then HiGHS. This may take seconds for 20 to 30 targets if the programme is not
   integral.

HiGHS alone, with its linear programme solved by column generation, takes 1 to 5 s for 30 targets and 8 to 16 s for 100.
This solver takes 0.1 s and 0.2 s.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import load_assignment_solver
from torchvision_dddas.tracking.assignment import choose_triplets, least_loss, relaxed_shares
from torchvision_dddas.types import Bool, Float, Int

Gain = Float[np.ndarray, "N1 M1 L1"]
Triplets = Int[np.ndarray, "C 3"]
# One array of prices for each layer. The price of the dummy, index 0, is 0.
Prices = Sequence[np.ndarray]

_OTHERS = ((1, 2), (0, 2), (0, 1))  # the other two layers of each layer
_TURNS = 3  # how often prices are lowered and a choice is rounded before the exact solver runs
_STEPS = 20  # subgradient steps of the first turn; the next turns have twice and three times as many
# Roundings in each turn after the first. With one rounding, 9 of 20 simulated windows of 30 targets end with a gap
# above 0.5 %; with twenty, 1 of 20.
_DRAWS = 20
_SHORTLIST = 60  # triplets per target, those with the smallest losses, that the subgradient steps use
# Steps of the search before HiGHS. The search reduces the time of windows of 10 targets from 85 to 36 ms (75th
# percentile).
_SEARCH_STEPS = 20_000
_SAME = 1e-9  # bound and value count as equal if they differ by less, in units of the largest gain
# Length of subgradient steps as a share of Polyak's. It is multiplied by _SHRINK after _PATIENCE steps without a lower
# bound. _MOMENTUM is the share of the last direction in the next direction; it reduces zigzags.
_STEP, _SHRINK, _PATIENCE, _MOMENTUM = 0.4, 0.7, 4, 0.4
# Triplets per target that enter the rounding: whole triplets, and pairs with each other layer. They are counted
# separately, because triplets with equal dummies would crowd out whole triplets.
_PER_TARGET = np.array([4, 2, 2])
_LOWERINGS = 4  # number of two-frame assignments that lower the first prices


@dataclass(frozen=True)
class Solution:
    """Triplets, and an upper bound of the best solution.

    triplets: (Z, 3) int64; every real target of each frame is in exactly one triplet; rows are sorted by i, j, k.
    value: the sum of their scores. bound: upper bound of the sum for any solution. gap: (bound - value) / max(|bound|,
    1e-9). exact: whether the exact solver was needed and finished.
    """

    triplets: Int[np.ndarray, "Z 3"]
    value: float
    bound: float
    gap: float
    exact: bool


def assign_triplets(score: Gain, gap: float = 0.005, most_exact: int | None = 4000) -> Solution:
    """Choose triplets with the largest sum of scores, to within `gap`; every real target is in exactly one triplet.

    score: (N + 1, M + 1, L + 1), zero and negative values allowed. Index 0 of each axis is the dummy, which may be used
    any number of times. (0, 0, 0) is never used, and its score is not read. gap: relative gap at which to stop.
    most_exact: run the exact solver only if at most this many triplets can be in a better solution, with at most a
    tenth as many branches; otherwise the gap may stay wider. With gap = 0 and most_exact = None the solution is exact,
    but the time is unlimited.
    Raises InputError if the score is not a finite 3-D tensor with a dummy on each axis.
    """
    tensor = np.asarray(score, float)
    if tensor.ndim != 3 or 0 in tensor.shape:
        raise InputError(
            f"triplets need scores (N + 1, M + 1, L + 1), index 0 the dummy; got shape {tensor.shape}. "
            "Put a dummy first on each axis."
        )
    finite = np.isfinite(tensor)
    finite[0, 0, 0] = True
    if not finite.all():
        raise InputError("triplets need finite scores; got NaN or infinity. Give an impossible triplet a low score.")
    # Gain of each triplet: its score minus the scores of its targets alone. It is 0 for lone targets and (0, 0, 0).
    first, second, third = (single.copy() for single in (tensor[:, 0, 0], tensor[0, :, 0], tensor[0, 0, :]))
    first[0] = second[0] = third[0] = 0.0
    gain = tensor - (second[:, None] + third)
    gain -= first[:, None, None]
    gain[0, 0, 0] = 0.0
    alone = float(tensor[1:, 0, 0].sum() + tensor[0, 1:, 0].sum() + tensor[0, 0, 1:].sum())
    chosen, bound, exact, scale = np.zeros((0, 3), np.int64), alone, False, float(gain.max())
    if scale > 0:
        gain /= scale
        relaxed = _Relaxation(gain, gap, alone / scale)
        chosen, bound = relaxed.chosen, alone + scale * _bound(relaxed.prices)
        if not relaxed.is_near():
            nodes = relaxed.candidates()
            if most_exact is None or len(nodes) <= most_exact:
                better, exact = _solve_exactly(nodes, gain, relaxed.prices, _gained(gain, chosen), most_exact)
                chosen = max(chosen, better, key=lambda choice: _gained(gain, choice))
    triplets = add_lone_targets(chosen, tensor.shape).astype(np.int64)
    triplets = triplets[np.lexsort(triplets.T[::-1])]
    value = float(tensor[tuple(triplets.T)].sum())
    bound = value if exact else max(bound, value)  # rounding may make the bound smaller than the value
    return Solution(triplets, value, bound, (bound - value) / max(abs(bound), 1e-9), exact)


def add_lone_targets(chosen: Int[np.ndarray, "C K"], sizes: Sequence[int]) -> Int[np.ndarray, "Z K"]:
    """Append a row with dummies for each target that is in no row. sizes: length of each axis, including the dummy."""
    rows = [chosen]
    for axis, size in enumerate(sizes):
        rest = np.setdiff1d(np.arange(1, size), chosen[:, axis])
        alone = np.zeros((len(rest), len(sizes)), np.int64)
        alone[:, axis] = rest
        rows.append(alone)
    return np.concatenate(rows)


def _gained(gain: Gain, chosen: Triplets) -> float:
    return float(gain[tuple(chosen.T)].sum())


def _bound(prices: Prices) -> float:
    return float(sum(price.sum() for price in prices))


def _cheap(gain: Gain, prices: Prices, most: float) -> Int[np.ndarray, "C"]:
    """Return the flat indices, ascending, of the triplets with a loss of at most `most` and a gain above 0."""
    across = prices[1][:, None] + prices[2]
    spare, index = np.empty_like(across), []
    for i, block in enumerate(gain):
        lost = np.subtract(across, block, out=spare).ravel()
        index.append(np.flatnonzero(lost <= most - prices[0][i]) + i * spare.size)
    found = np.concatenate(index)
    return found[gain.ravel()[found] > 0]


class _Relaxation:
    """Computes a choice of triplets and prices, in a few turns, until their gap is small enough.

    gain: gains in units of the largest gain. gap: relative gap to reach. alone: the sum of the scores of all targets
    alone, in these units.
    """

    def __init__(self, gain: Gain, gap: float, alone: float) -> None:
        self.gain, self.gap, self.alone = gain, gap, alone
        here = _low_prices(gain)
        self.prices = here  # the prices with the lowest bound so far
        self.chosen = _improve(gain, _reassign(gain, _settle(gain, here, 0)[1], 0))
        for turn in range(1, _TURNS + 1):
            if self.is_near():
                break
            shortlist = _Shortlist(self._some_cheap(here), gain)
            first, share = shortlist.descend(here[0], _gained(gain, self.chosen), _STEPS * turn)
            here, _ = _settle(gain, (first, *here[1:]), 0)
            self.prices = min(self.prices, here, key=_bound)
            if self.is_near():
                break
            for other in _round(gain, shortlist.nodes, share, here, _DRAWS if turn > 1 else 1):
                self.chosen = max(self.chosen, _improve(gain, other), key=lambda choice: _gained(gain, choice))
                if self.is_near():
                    break

    def is_near(self) -> bool:
        """Return whether the gap is small enough."""
        bound = _bound(self.prices)
        return bound - _gained(self.gain, self.chosen) <= max(self.gap * abs(bound + self.alone), _SAME)

    def candidates(self) -> Triplets:
        """Return the triplets that can be in a better choice."""
        index = _cheap(self.gain, self.prices, _bound(self.prices) - _gained(self.gain, self.chosen) + _SAME)
        return np.stack(np.unravel_index(index, self.gain.shape), axis=1)

    def _some_cheap(self, prices: Prices) -> Int[np.ndarray, "C"]:
        """Return flat indices of the triplets with the smallest losses, at most twice _SHORTLIST per target."""
        gain = self.gain
        wanted, limit = _SHORTLIST * (sum(gain.shape) - 3), np.inf
        random = np.random.default_rng(0)  # a fixed seed, so that equal scores give equal triplets in every run
        if gain.size > wanted:
            sample = random.integers(0, gain.size, 4000)
            i, j, k = np.unravel_index(sample, gain.shape)
            loss = prices[0][i] + prices[1][j] + prices[2][k] - gain.ravel()[sample]
            limit = max(float(np.quantile(loss, wanted / gain.size)), _SAME)
        index = _cheap(gain, prices, limit)
        # If all dummies have equal scores, very many triplets tie: take a random part of them.
        return index if len(index) <= 2 * wanted else np.sort(random.permutation(index)[: 2 * wanted])


def _solve_exactly(
    nodes: Triplets, gain: Gain, prices: Prices, value: float, most_exact: int | None
) -> tuple[Triplets, bool]:
    """Return the best choice of these triplets, if it gains more than `value`, and whether it is certainly the best."""
    worth, price = gain[tuple(nodes.T)], np.concatenate(prices)
    named = nodes + np.cumsum([0, *gain.shape[:2]])
    # Targets that occur in none of the triplets stay alone. Their prices are lost whatever is chosen.
    spare = float(price.sum() - price[np.unique(named[nodes > 0])].sum())
    held = [row[real].tolist() for row, real in zip(named, nodes > 0, strict=True)]
    limit = price.sum() - value - spare + _SAME
    found = least_loss(held, worth.tolist(), price.tolist(), _SEARCH_STEPS, limit)
    if found is not None:
        return nodes[found], True
    kept, certain = choose_triplets(nodes - 1, worth, None if most_exact is None else most_exact // 10)
    return nodes[kept], certain


# -- prices ------------------------------------------------------------------------------------------------------------


def _low_prices(gain: Gain) -> Prices:
    """Return valid prices (their sum over each triplet is at least its gain) with a nearly minimal total.

    Even shares of the gains are valid prices. Starting from them, and from 0.9 times them, set the prices of two layers
    in turn to the smallest that the third layer allows. If all triplets are similar, the first start is better, else
    the second. Return the result with the lower total.
    """
    # For each target: the largest even share of the gain of one of its triplets.
    real = gain[1:, 1:, 1:]
    over_first, over_last = real.max(axis=0, initial=0.0), real.max(axis=(1, 2), initial=0.0)
    triple = over_last, over_first.max(axis=1, initial=0.0), over_first.max(axis=0, initial=0.0)
    shares = []
    for layer, (a, b) in enumerate(_OTHERS):
        # Gains of pairs of this layer and another layer, with the dummy (index 0) in the third layer.
        faces = [np.moveaxis(gain.take(0, axis=third), layer - (third < layer), 0)[1:] for third in (a, b)]
        pair = np.maximum(*(face.max(axis=1, initial=0.0) for face in faces))
        shares.append(np.concatenate([[0.0], np.maximum(triple[layer] / 3, pair / 2)]))
    ends: list[Prices] = [shares]
    for start in (1.0, 0.9):
        prices: Prices = [share * start for share in shares]
        for step in range(_LOWERINGS):
            prices, _ = _settle(gain, prices, step % 3)
        ends.append(prices)
    return min(ends, key=_bound)


def _settle(gain: Gain, prices: Prices, layer: int) -> tuple[Prices, Int[np.ndarray, "P 2"]]:
    """Minimize the prices of the two layers other than `layer`. Return all prices, and the assigned pairs.

    The new prices are the mean of the two extreme dual solutions of the assignment, because an extreme solution would
    leave no freedom to the next layer.
    """
    # For each pair of the other two layers: the largest gain with one target of `layer`, minus that target's price.
    spare, price = np.empty(gain.shape[1:]), prices[layer]
    if layer == 0:
        best = gain[0].copy()
        for block, cost in zip(gain[1:], price[1:], strict=True):
            np.maximum(best, np.subtract(block, cost, out=spare), out=best)
    else:
        best = np.empty((len(gain), gain.shape[3 - layer]))
        across = price[:, None] if layer == 1 else price
        # Work block by block, because a block fits into the cache and the tensor does not.
        for block, row in zip(gain, best, strict=True):
            np.subtract(block, across, out=spare).max(axis=layer - 1, out=row)
    first, second, excess, row, column = _match(best)
    worth = excess[row, column]
    low, high = _least_potential(excess, row, column), _least_potential(excess.T, column, row)
    first[row] += worth / 2
    first[row] += (high[row] - low[column]) / 2
    second[column] += worth / 2
    second[column] += (low[column] - high[row]) / 2
    settled = list(prices)
    for other, low_price in zip(_OTHERS[layer], (first, second), strict=True):
        settled[other] = np.concatenate([[0.0], low_price])
    used = worth > 0
    return settled, np.stack([row[used] + 1, column[used] + 1], axis=1)


def _match(best: Float[np.ndarray, "A B"]) -> tuple[np.ndarray, ...]:
    """Return gains of lone targets (A,) and (B,), the extra gains of pairs (A, B), and the best pairs (P,), (P,)."""
    first, second = np.maximum(best[1:, 0], 0.0), np.maximum(best[0, 1:], 0.0)
    excess = np.maximum(best[1:, 1:] - first[:, None] - second, 0.0)
    return first, second, excess, *load_assignment_solver()(excess, maximize=True)


def _least_potential(excess: np.ndarray, row: np.ndarray, column: np.ndarray) -> Float[np.ndarray, "B"]:
    """Return the smallest dual prices of the columns of an optimal assignment of non-negative scores (Bellman-Ford)."""
    above = excess[row] - excess[row, column][:, None]
    potential = least = np.delete(excess, row, axis=0).max(axis=0, initial=0.0)
    for _ in range(len(row) + 1):
        raised = np.maximum((above + potential[column][:, None]).max(axis=0, initial=0.0), least)
        if (raised <= potential + 1e-12).all():
            break
        potential = raised
    return potential


class _Shortlist:
    """Some triplets of a tensor, sorted by their pair of the last two layers. The subgradient steps run over them.

    index: (C,) flat indices into `gain`, at least one. nodes: (C, 3) their targets. If only the first layer has prices,
    the best choice of the other two layers is a two-frame assignment. A target of the first layer may then be used more
    than once, if its price is too low, or never, if its price is too high.
    """

    def __init__(self, index: Int[np.ndarray, "C"], gain: Gain) -> None:
        self.shape = gain.shape[1:]
        pairs = self.shape[0] * self.shape[1]
        cell = index % pairs
        # 16-bit integers are sorted in linear time. They can number the pairs of up to 255 targets.
        order = np.argsort(cell.astype(np.uint16) if pairs <= 2**16 else cell, kind="stable")
        index, cell = index[order], cell[order]
        self.nodes = np.stack(np.unravel_index(index, gain.shape), axis=1)
        self.first, self.gain = self.nodes[:, 0], gain.ravel()[index]
        self.start = np.flatnonzero(np.diff(cell, prepend=-1))
        self.cell, self.count = cell[self.start], np.diff(self.start, append=len(cell))
        self.place = np.full(pairs, -1)
        self.place[self.cell] = np.arange(len(self.cell))
        self.best = np.full(self.shape, -1.0)

    def _answer(self, price: Float[np.ndarray, "N1"]) -> tuple[float, Int[np.ndarray, "P"]]:
        """Return the bound of these prices over the shortlist, and the indices of the triplets that attain it."""
        left = self.gain - price[self.first]
        most = np.maximum.reduceat(left, self.start)
        self.best.ravel()[self.cell] = most
        second, third, excess, row, column = _match(self.best)
        worth = excess[row, column]
        pairs = add_lone_targets(np.stack([row, column], axis=1)[worth > 0] + 1, self.shape)
        pair = pairs[:, 0] * self.shape[1] + pairs[:, 1]
        place = self.place[pair[self.best.ravel()[pair] > 0]]
        # For each pair, take the first triplet with the best value.
        top = np.flatnonzero(left == np.repeat(most, self.count))
        reached = top[np.searchsorted(top, self.start[place])]
        return float(worth.sum() + second.sum() + third.sum() + price.sum()), reached

    def descend(
        self, price: Float[np.ndarray, "N1"], value: float, steps: int
    ) -> tuple[Float[np.ndarray, "N1"], Float[np.ndarray, "C"]]:
        """Run subgradient steps, and return the prices with the lowest bound and the shares of triplets.

        The share of a triplet is how often it was in the answers of the later half of the steps. value: the gain of
        some choice, which is the target value of Polyak's step length.
        """
        lowest, best, direction, length, idle = np.inf, price, np.zeros(len(price)), _STEP, 0
        share, answers = np.zeros(len(self.gain)), 0
        for step in range(steps):
            here, reached = self._answer(price)
            if 2 * step >= steps:
                share[reached] += 1
                answers += 1
            idle = 0 if here < lowest - _SAME else idle + 1
            if here < lowest:
                lowest, best = here, price
            if idle == _PATIENCE:
                length, idle = length * _SHRINK, 0
            uses = np.bincount(self.first[reached], minlength=len(price))
            slope = np.where((price <= 0) & (uses < 1), 0.0, 1.0 - uses)
            slope[0] = 0.0
            direction = slope + _MOMENTUM * direction
            steepness = float(direction @ direction)
            if steepness == 0.0 or lowest - value < _SAME:
                # Every target is used at most once, so this answer is the best choice.
                share[:] = 0
                share[reached], answers = 1, 1
                break
            price = np.maximum(price - length * (here - value) / steepness * direction, 0.0)
            price[0] = 0.0
        return best, share / max(answers, 1)


# -- choices -----------------------------------------------------------------------------------------------------------


def _round(
    gain: Gain, nodes: Triplets, share: Float[np.ndarray, "C"], prices: Prices, draws: int
) -> Iterator[Triplets]:
    """Yield choices of triplets, given the share of each triplet in the answers of a descent.

    Triplets that are in every answer are taken. A linear programme gives the shares of the other triplets, and triplets
    are taken by decreasing share, which is randomised after the first draw.
    """
    agreed = nodes[share > 1 - 1e-9]
    uses = np.bincount(agreed[:, 0], minlength=gain.shape[0])
    agreed = agreed[(agreed[:, 0] == 0) | (uses[agreed[:, 0]] == 1)]
    taken = ((nodes[:, layer] > 0) & np.isin(nodes[:, layer], agreed[:, layer]) for layer in range(3))
    nodes = nodes[~np.logical_or.reduce(list(taken))]
    loss = prices[0][nodes[:, 0]] + prices[1][nodes[:, 1]] + prices[2][nodes[:, 2]] - gain[tuple(nodes.T)]
    # Order ties randomly, because otherwise the first triplets of all targets would have the same partners.
    nodes = nodes[np.argsort(loss + _SAME * np.random.default_rng(0).random(len(loss)))]
    nodes = nodes[_first_of_each_kind(nodes)]
    parts = relaxed_shares(nodes - 1, gain[tuple(nodes.T)])
    random = np.random.default_rng(0)
    for draw in range(draws):
        # The first draw orders by shares. The others add random numbers, so that a triplet with share .5 may come late.
        order = np.argsort(-(parts + random.random(len(parts)) if draw else parts), kind="stable")
        used: set[tuple[int, int]] = set()
        fitting = []
        for column in order[parts[order] > 1e-6].tolist():
            held = {(layer, node) for layer, node in enumerate(nodes[column].tolist()) if node}
            if not held & used:
                fitting.append(column)
                used |= held
        yield np.concatenate([agreed, nodes[fitting]])


def _first_of_each_kind(nodes: Triplets) -> Bool[np.ndarray, "C"]:
    """Return (C,) whether a triplet is among the first of a target's whole triplets, or of its pairs with a layer."""
    wanted, present = np.zeros(len(nodes), bool), nodes > 0
    for layer, (other, _) in enumerate(_OTHERS):
        kind = np.where(present.all(axis=1), 0, np.where(present[:, other], 1, 2))
        key = nodes[:, layer] * 3 + kind
        order = np.argsort(key, kind="stable")
        start = np.flatnonzero(np.diff(key[order], prepend=-1))
        rank = np.arange(len(nodes)) - np.repeat(start, np.diff(start, append=len(nodes)))
        wanted[order[(rank < _PER_TARGET[kind[order]]) & present[order, layer]]] = True
    return wanted


def _improve(gain: Gain, chosen: Triplets) -> Triplets:
    """Improve a choice by reassigning the targets of one layer at a time until no layer gives a better choice."""
    value, idle, layer = _gained(gain, chosen), 0, 0
    while idle < 3:
        other = _reassign(gain, chosen[:, _OTHERS[layer]], layer)
        idle += 1
        if _gained(gain, other) > value + _SAME:
            chosen, value, idle = other, _gained(gain, other), 0
        layer = (layer + 1) % 3
    return chosen


def _reassign(gain: Gain, pairs: Int[np.ndarray, "P 2"], layer: int) -> Triplets:
    """Return the best choice of triplets that keeps the given pairs, or lone targets, of the other two layers."""
    pairs = add_lone_targets(pairs[(pairs > 0).all(axis=1)], [gain.shape[other] for other in _OTHERS[layer]])
    group = np.insert(pairs, layer, 0, axis=1)
    where = list(group.T)
    where[layer] = np.arange(gain.shape[layer])[:, None]
    worth = gain[tuple(where)]
    without = np.maximum(worth[0], 0.0)
    target, place = load_assignment_solver()(np.maximum(worth[1:] - without, 0.0), maximize=True)
    better = worth[1 + target, place] > without[place]
    group[place[better], layer] = target[better] + 1
    return group[gain[tuple(group.T)] > 0]
