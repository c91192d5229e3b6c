"""Three-frame assignment of many targets by Lagrangian relaxation, with a certified gap (appendix C).

1. Prices that pay for every triplet bound what any choice gains (`prices`).
2. A choice is read off the prices and improved by two-frame assignments (`rounding`): the gap is bound - value.
3. While it is too wide: the prices are lowered by subgradient steps over the triplets that lose little (`descent`), and
   a choice is rounded from a linear programme over the targets on which the steps do not agree.
4. If it stays too wide: only triplets that lose no more than the gap can be in a better choice. The exact solver gets
   those, if they are few enough: a search by the prices, then HiGHS. That takes seconds in some windows of 20 to 30
   targets, where the linear programme is not integral. If they are too many, or it gives up, the gap is told as it is.
"""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.tracking.dual_ascent import Shortlist
from torchvision_dddas.tracking.dual_prices import Prices, best_over, bound, cheap, low_prices, settle
from torchvision_dddas.tracking.primal_rounding import gained, improved, reassigned, rounded
from torchvision_dddas.tracking.triplet_scores import checked_scores, gain_over_alone, with_the_rest_alone
from torchvision_dddas.tracking.triplets import good_columns, least_loss
from torchvision_dddas.types import Float, Int

# How often prices are lowered and a choice rounded from them before the exact solver is asked.
TURNS = 3
# Roundings a turn after the first: with one, 9 of 20 simulated windows of 30 targets end above a gap of 0.5 %, with
# twenty one does.
DRAWS = 20
# Triplets a target that the subgradient steps look at, of those that lose least.
SHORTLIST = 60
# Steps of the search with those prices before the integer programme: windows of 10 targets fall from 85 to 36 ms (75th
# percentile).
SEARCHED = 20_000
# Bound and value closer than this, in units of the largest gain, are the same.
SAME = 1e-9


@dataclass(frozen=True)
class Solution:
    """Triplets, and how far from the best they can be at most.

    triplets: (Z, 3) int64 as `assignment.triplets_exact` gives them. value: the sum of their scores. bound: no solution
    scores more. gap: (bound - value) / max(|bound|, 1e-9). exact: whether the exact solver had the last word,
    because the bound stayed above the gap that was asked for.
    """

    triplets: Int[np.ndarray, "Z 3"]
    value: float
    bound: float
    gap: float
    exact: bool


def triplets(
    score: Float[np.ndarray, "N1 M1 L1"], gap: float = 0.005, steps: int = 20, most_exact: int | None = 4000
) -> Solution:
    """The triplets with the largest sum of scores, to within `gap` of it, every real target in exactly one.

    score: (N + 1, M + 1, L + 1), index 0 of each axis the dummy, as for `assignment.triplets_exact`.
    gap: the gap to stop at. steps: subgradient steps of the first turn; the next have twice and three times as many.
    most_exact: the exact solver is asked only if no more triplets than this can be in a better solution, and branches
    no more than a tenth as often (None: however many and often, and however long it takes). Otherwise the gap stays as
    it is, wider than was asked for: `gap` tells.
    Raises InputError if the score is no 3-D tensor with a dummy on each axis, or holds what is not finite.
    """
    tensor = checked_scores(score)
    gain = gain_over_alone(tensor)
    alone = float(tensor[1:, 0, 0].sum() + tensor[0, 1:, 0].sum() + tensor[0, 0, 1:].sum())
    scale = float(gain.max())
    if scale <= 0:
        return _solution(tensor, np.zeros((0, 3), np.int64), alone, exact=False)
    gain /= scale
    chosen, prices = _relaxed(gain, gap, alone / scale, steps)
    if not _near_enough(gain, chosen, prices, gap, alone / scale):
        index, _ = cheap(gain, prices, bound(prices) - gained(gain, chosen) + SAME)
        index = index[gain.ravel()[index] > 0]
        if most_exact is None or len(index) <= most_exact:
            nodes = np.stack(np.unravel_index(index, gain.shape), axis=1)
            better, certain = _best_of(nodes, gain, prices, gained(gain, chosen), most_exact)
            chosen = max(chosen, better, key=lambda choice: gained(gain, choice))
            if certain:
                return _solution(tensor, chosen, -np.inf, exact=True)
    return _solution(tensor, chosen, alone + scale * bound(prices), exact=False)


def _solution(tensor: np.ndarray, chosen: Int[np.ndarray, "C 3"], most: float, exact: bool) -> Solution:
    """The chosen triplets with all other targets alone. most: a bound; one below the value is rounding, or absent."""
    whole = with_the_rest_alone(chosen, tensor.shape)
    value = float(tensor[tuple(whole.T)].sum())
    most = max(most, value)
    return Solution(whole, value, most, (most - value) / max(abs(most), 1e-9), exact)


def _relaxed(
    gain: Float[np.ndarray, "N1 M1 L1"], gap: float, alone: float, steps: int
) -> tuple[Int[np.ndarray, "C 3"], Prices]:
    """A choice of triplets and prices, near enough to each other if that can be had in a few turns."""
    lowest = here = low_prices(gain)
    _, pairs = settle(best_over(gain, here[0], 0), here, 0)
    chosen = improved(gain, reassigned(gain, pairs, 0))
    for turn in range(1, TURNS + 1):
        if _near_enough(gain, chosen, lowest, gap, alone):
            break
        shortlist = Shortlist(_some_cheap(gain, here), gain)
        first, share = shortlist.descend(here[0], gained(gain, chosen), steps * turn)
        here, _ = settle(best_over(gain, first, 0), (first, here[1], here[2]), 0)
        lowest = min(lowest, here, key=bound)
        if _near_enough(gain, chosen, lowest, gap, alone):
            break
        draws = DRAWS if turn > 1 else 1
        for other in rounded(gain, shortlist.nodes, share, here, draws):
            chosen = max(chosen, improved(gain, other), key=lambda choice: gained(gain, choice))
            if _near_enough(gain, chosen, lowest, gap, alone):
                break
    return chosen, lowest


def _best_of(
    nodes: Int[np.ndarray, "C 3"],
    gain: Float[np.ndarray, "N1 M1 L1"],
    prices: Prices,
    value: float,
    most_exact: int | None,
) -> tuple[Int[np.ndarray, "Z 3"], bool]:
    """The best choice of these triplets, if it gains more than `value`, and whether that is certain."""
    worth = gain[tuple(nodes.T)]
    price = np.concatenate(prices)
    named = nodes + np.cumsum([0, *gain.shape[:2]])
    # Targets that none of the triplets holds stay alone, and lose their prices in any case.
    spare = float(price.sum() - price[np.unique(named[nodes > 0])].sum())
    held = [
        [name for name, node in zip(*row, strict=True) if node]
        for row in zip(named.tolist(), nodes.tolist(), strict=True)
    ]
    found = least_loss(held, worth.tolist(), price.tolist(), SEARCHED, price.sum() - value - spare + SAME)
    if found is not None:
        return nodes[found], True
    kept, certain = good_columns(nodes - 1, worth, None if most_exact is None else most_exact // 10)
    return nodes[kept], certain


def _near_enough(
    gain: Float[np.ndarray, "N1 M1 L1"], chosen: Int[np.ndarray, "C 3"], prices: Prices, gap: float, alone: float
) -> bool:
    most = bound(prices)
    return most - gained(gain, chosen) <= max(gap * abs(most + alone), SAME)


def _some_cheap(gain: Float[np.ndarray, "N1 M1 L1"], prices: Prices) -> Int[np.ndarray, "C"]:
    """Flat indices of the triplets that lose least, at most about twice as many as wanted, and gain something."""
    wanted, limit = SHORTLIST * (sum(gain.shape) - 3), np.inf
    # A fixed seed: the same scores give the same triplets in every run.
    random = np.random.default_rng(0)
    if gain.size > wanted:
        sample = random.integers(0, gain.size, 4000)
        i, j, k = np.unravel_index(sample, gain.shape)
        loss = prices[0][i] + prices[1][j] + prices[2][k] - gain.ravel()[sample]
        limit = max(float(np.quantile(loss, wanted / gain.size)), SAME)
    index, _ = cheap(gain, prices, limit)
    index = index[gain.ravel()[index] > 0]
    # Dummies that all score the same leave ties without number.
    return index if len(index) <= 2 * wanted else np.sort(random.permutation(index)[: 2 * wanted])
