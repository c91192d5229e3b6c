"""Three-frame assignment of a dense score tensor by Lagrangian relaxation, with a certified gap (appendix C, eq. 1-3).

A target that no triplet holds stays alone: it takes the dummy, index 0, on both other axes. What a triplet scores above
its targets alone is its gain, and the problem is to choose triplets that share no target and gain the most.

Prices of targets (Lagrange multipliers of "every target at most once") that pay for every triplet's gain bound what any
choice can gain by their sum. What they exceed a triplet's gain by is its loss: a triplet that loses more than
bound - value is in no better choice than one of that value. The solver

1. finds prices by two-frame assignments, reads a choice off them, and improves it by further two-frame assignments;
2. while the gap is too wide, lowers the prices by subgradient steps over the triplets that lose little, and rounds a
   linear programme over the targets on which the steps do not agree;
3. if it stays too wide, gives the triplets that can be in a better choice, if they are few enough, to the exact solver:
   a search by the prices, then HiGHS. This may take seconds for 20 to 30 targets, where the programme is not integral.

HiGHS alone, with its linear programme solved by column generation, takes 1 to 5 s for 30 targets and 8 to 16 s for 100;
this takes 0.1 s and 0.2 s.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking.assignment import choose_triplets, least_loss, relaxed_shares
from torchvision_dddas.types import Bool, Float, Int

Gain = Float[np.ndarray, "N1 M1 L1"]
Triplets = Int[np.ndarray, "C 3"]
# Of each layer. The dummy, index 0, costs nothing.
Prices = Sequence[np.ndarray]

_OTHERS = ((1, 2), (0, 2), (0, 1))  # the other two layers of each
_TURNS = 3  # how often prices are lowered and a choice is rounded before the exact solver is asked
_STEPS = 20  # subgradient steps of the first turn; the next turns have twice and three times as many
# Roundings in each turn after the first: with one, 9 of 20 simulated windows of 30 targets end above a gap of 0.5 %,
# with twenty one does.
_DRAWS = 20
_SHORTLIST = 60  # triplets a target that the subgradient steps look at, of those that lose least
# Steps of the search before HiGHS: windows of 10 targets fall from 85 to 36 ms (75th percentile).
_SEARCH_STEPS = 20_000
_SAME = 1e-9  # bound and value that differ by less, in units of the largest gain, are equal
# Subgradient steps as a share of Polyak's, shrunk after so many steps without a lower bound; share of the last
# direction in the next one, against zigzag.
_STEP, _SHRINK, _PATIENCE, _MOMENTUM = 0.4, 0.7, 4, 0.4
# Triplets a target that are rounded: whole ones, and pairs with each other layer, apart because equal dummies would
# crowd out the whole ones.
_PER_TARGET = np.array([4, 2, 2])
_LOWERINGS = 4  # two-frame assignments that lower the first prices


@dataclass(frozen=True)
class Solution:
    """Triplets and how far from the best they can be at most.

    triplets: (Z, 3) int64; every real target of each frame is in exactly one; rows are sorted by i, then j, then k.
    value: the sum of their scores. bound: no solution scores more. gap: (bound - value) / max(|bound|, 1e-9).
    exact: whether the exact solver was needed and finished.
    """

    triplets: Int[np.ndarray, "Z 3"]
    value: float
    bound: float
    gap: float
    exact: bool


def assign_triplets(score: Gain, gap: float = 0.005, most_exact: int | None = 4000) -> Solution:
    """The triplets with the largest sum of scores, to within `gap` of it, every real target in exactly one.

    score: (N + 1, M + 1, L + 1); index 0 of each axis is the dummy, used any number of times; (0, 0, 0) is never used
    and its score not read. Scores may be zero or negative. gap: the gap to stop at. most_exact: the exact solver is
    asked only if at most so many triplets can be in a better solution, and branches at most a tenth as often; otherwise
    the gap stays wider than asked for. With gap = 0 and most_exact = None the solution is exact, however long it takes.
    Raises InputError if the score is no 3-D tensor with a dummy on each axis, or not finite.
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
    # What each triplet scores above its targets alone: 0 for those, and for (0, 0, 0).
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
    bound = value if exact else max(bound, value)  # a bound below the value is rounding
    return Solution(triplets, value, bound, (bound - value) / max(abs(bound), 1e-9), exact)


def add_lone_targets(chosen: Int[np.ndarray, "C K"], sizes: Sequence[int]) -> Int[np.ndarray, "Z K"]:
    """The rows, and one more for each target that none of them holds, with dummies. sizes: of each axis, and dummy."""
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
    """Flat indices, ascending, of the triplets that lose no more than `most` and gain something."""
    across = prices[1][:, None] + prices[2]
    spare, index = np.empty_like(across), []
    for i, block in enumerate(gain):
        lost = np.subtract(across, block, out=spare).ravel()
        index.append(np.flatnonzero(lost <= most - prices[0][i]) + i * spare.size)
    found = np.concatenate(index)
    return found[gain.ravel()[found] > 0]


class _Relaxation:
    """A choice of triplets, and prices, near enough to each other if a few turns suffice.

    gain: in units of the largest. gap: wanted. alone: what all targets score alone, in these units.
    """

    def __init__(self, gain: Gain, gap: float, alone: float) -> None:
        self.gain, self.gap, self.alone = gain, gap, alone
        here = _low_prices(gain)
        self.prices = here  # of the lowest bound
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
        """Whether the gap is as small as wanted."""
        bound = _bound(self.prices)
        return bound - _gained(self.gain, self.chosen) <= max(self.gap * abs(bound + self.alone), _SAME)

    def candidates(self) -> Triplets:
        """The triplets that can be in a better choice."""
        index = _cheap(self.gain, self.prices, _bound(self.prices) - _gained(self.gain, self.chosen) + _SAME)
        return np.stack(np.unravel_index(index, self.gain.shape), axis=1)

    def _some_cheap(self, prices: Prices) -> Int[np.ndarray, "C"]:
        """Flat indices of the triplets that lose least, at most about twice as many as wanted."""
        gain = self.gain
        wanted, limit = _SHORTLIST * (sum(gain.shape) - 3), np.inf
        random = np.random.default_rng(0)  # a fixed seed: the same scores give the same triplets in every run
        if gain.size > wanted:
            sample = random.integers(0, gain.size, 4000)
            i, j, k = np.unravel_index(sample, gain.shape)
            loss = prices[0][i] + prices[1][j] + prices[2][k] - gain.ravel()[sample]
            limit = max(float(np.quantile(loss, wanted / gain.size)), _SAME)
        index = _cheap(gain, prices, limit)
        # Dummies that all score the same leave very many ties.
        return index if len(index) <= 2 * wanted else np.sort(random.permutation(index)[: 2 * wanted])


def _solve_exactly(
    nodes: Triplets, gain: Gain, prices: Prices, value: float, most_exact: int | None
) -> tuple[Triplets, bool]:
    """The best choice of these triplets, if it gains more than `value`, and whether that is certain."""
    worth, price = gain[tuple(nodes.T)], np.concatenate(prices)
    named = nodes + np.cumsum([0, *gain.shape[:2]])
    # Targets that none of the triplets holds stay alone, and lose their prices in any case.
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
    """Prices that pay for every triplet, not far above the lowest sum there is.

    Even shares of the gains pay for every triplet. From them, and from nine tenths of them, two layers at a time get
    the least prices that the third's allow. Where all triplets are alike the shares are the best start, elsewhere the
    lower one: the better end is returned.
    """
    # For each target the largest even share of the gain of one of its triplets.
    real = gain[1:, 1:, 1:]
    over_first, over_last = real.max(axis=0, initial=0.0), real.max(axis=(1, 2), initial=0.0)
    triple = over_last, over_first.max(axis=1, initial=0.0), over_first.max(axis=0, initial=0.0)
    shares = []
    for layer, (a, b) in enumerate(_OTHERS):
        # The pairs of this layer and another: the third index is the dummy's.
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
    """The least prices of the other two layers that go with those of `layer`, and the pairs that are worth them.

    The prices are the mean of the assignment's two extreme dual solutions: extremes leave no room for the next layer.
    """
    # For each pair of the other two layers the most that it gains with one target of `layer`, less its price.
    spare, price = np.empty(gain.shape[1:]), prices[layer]
    if layer == 0:
        best = gain[0].copy()
        for block, cost in zip(gain[1:], price[1:], strict=True):
            np.maximum(best, np.subtract(block, cost, out=spare), out=best)
    else:
        best = np.empty((len(gain), gain.shape[3 - layer]))
        across = price[:, None] if layer == 1 else price
        # Block by block: a block fits the cache, the tensor does not.
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
    """Gains (A,) and (B,) of targets without each other, what pairs gain above (A, B), and the best pairs (P,) (P,)."""
    from scipy.optimize import linear_sum_assignment  # here, as it takes half a second and 45 MB

    first, second = np.maximum(best[1:, 0], 0.0), np.maximum(best[0, 1:], 0.0)
    excess = np.maximum(best[1:, 1:] - first[:, None] - second, 0.0)
    return first, second, excess, *linear_sum_assignment(excess, maximize=True)


def _least_potential(excess: np.ndarray, row: np.ndarray, column: np.ndarray) -> Float[np.ndarray, "B"]:
    """The least dual prices of the columns of an optimal assignment of non-negative scores (Bellman-Ford)."""
    above = excess[row] - excess[row, column][:, None]
    potential = least = np.delete(excess, row, axis=0).max(axis=0, initial=0.0)
    for _ in range(len(row) + 1):
        raised = np.maximum((above + potential[column][:, None]).max(axis=0, initial=0.0), least)
        if (raised <= potential + 1e-12).all():
            break
        potential = raised
    return potential


class _Shortlist:
    """Some triplets of a tensor, sorted by their pair of the last two layers, over which the prices are lowered.

    index: (C,) flat indices into `gain`, at least one. nodes: (C, 3) their targets. With prices for the first layer
    alone, the best choice of the other two is a two-frame assignment, in which a target of the first layer may be used
    more than once, or never: it is then too cheap, or too dear.
    """

    def __init__(self, index: Int[np.ndarray, "C"], gain: Gain) -> None:
        self.shape = gain.shape[1:]
        pairs = self.shape[0] * self.shape[1]
        cell = index % pairs
        # Two bytes sort in linear time, and number the pairs of up to 255 targets.
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
        """The bound that these prices make over the shortlist, and which of its triplets reach it."""
        left = self.gain - price[self.first]
        most = np.maximum.reduceat(left, self.start)
        self.best.ravel()[self.cell] = most
        second, third, excess, row, column = _match(self.best)
        worth = excess[row, column]
        pairs = add_lone_targets(np.stack([row, column], axis=1)[worth > 0] + 1, self.shape)
        pair = pairs[:, 0] * self.shape[1] + pairs[:, 1]
        place = self.place[pair[self.best.ravel()[pair] > 0]]
        # The first of the triplets that reach their pair's best.
        top = np.flatnonzero(left == np.repeat(most, self.count))
        reached = top[np.searchsorted(top, self.start[place])]
        return float(worth.sum() + second.sum() + third.sum() + price.sum()), reached

    def descend(
        self, price: Float[np.ndarray, "N1"], value: float, steps: int
    ) -> tuple[Float[np.ndarray, "N1"], Float[np.ndarray, "C"]]:
        """The prices of the lowest bound in so many steps, and each triplet's share of the answers in the later half.

        value: the gain of some choice, which the steps of Polyak's length aim at.
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
                # Every target is used as often as it should be: this answer is the best choice.
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
    """Choices from some triplets, each with its share of the answers of a descent.

    Those in every answer are taken. Of the rest a linear programme says how much of each triplet to take, and the
    largest shares go first, in several draws.
    """
    agreed = nodes[share > 1 - 1e-9]
    uses = np.bincount(agreed[:, 0], minlength=gain.shape[0])
    agreed = agreed[(agreed[:, 0] == 0) | (uses[agreed[:, 0]] == 1)]
    taken = ((nodes[:, layer] > 0) & np.isin(nodes[:, layer], agreed[:, layer]) for layer in range(3))
    nodes = nodes[~np.logical_or.reduce(list(taken))]
    loss = prices[0][nodes[:, 0]] + prices[1][nodes[:, 1]] + prices[2][nodes[:, 2]] - gain[tuple(nodes.T)]
    # Ties in random order: the first of each target would all want the same partners.
    nodes = nodes[np.argsort(loss + _SAME * np.random.default_rng(0).random(len(loss)))]
    nodes = nodes[_first_of_each_kind(nodes)]
    parts = relaxed_shares(nodes - 1, gain[tuple(nodes.T)])
    random = np.random.default_rng(0)
    for draw in range(draws):
        # The first draw as the programme says, the others shaken: a triplet of which it takes half may go either way.
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
    """Which triplets are among the first of some target: of its whole ones, or of its pairs with another layer."""
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
    """A choice that reassigning one layer's targets to what is left of the triplets does not improve."""
    value, idle, layer = _gained(gain, chosen), 0, 0
    while idle < 3:
        other = _reassign(gain, chosen[:, _OTHERS[layer]], layer)
        idle += 1
        if _gained(gain, other) > value + _SAME:
            chosen, value, idle = other, _gained(gain, other), 0
        layer = (layer + 1) % 3
    return chosen


def _reassign(gain: Gain, pairs: Int[np.ndarray, "P 2"], layer: int) -> Triplets:
    """The best choice of triplets that holds these pairs of the other two layers, or their targets alone."""
    from scipy.optimize import linear_sum_assignment  # here, as it takes half a second and 45 MB

    pairs = add_lone_targets(pairs[(pairs > 0).all(axis=1)], [gain.shape[other] for other in _OTHERS[layer]])
    group = np.insert(pairs, layer, 0, axis=1)
    where = list(group.T)
    where[layer] = np.arange(gain.shape[layer])[:, None]
    worth = gain[tuple(where)]
    without = np.maximum(worth[0], 0.0)
    target, place = linear_sum_assignment(np.maximum(worth[1:] - without, 0.0), maximize=True)
    better = worth[1 + target, place] > without[place]
    group[place[better], layer] = target[better] + 1
    return group[gain[tuple(group.T)] > 0]
