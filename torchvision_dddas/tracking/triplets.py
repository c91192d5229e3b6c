"""Disjoint columns of the largest total score: three-frame assignment over the triplets that a gate left.

A column (i, j, k) names a node of each of three layers, -1 for none. Columns that share no node, not even through
others, fall into groups that are solved one by one: small ones by trying, with a bound; all large ones at once by
linear programming, and where that leaves fractions by integer programming (HiGHS).
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Bool, Float, Int

if TYPE_CHECKING:
    from scipy.sparse import csc_array

# A group with no more columns than this is tried first, and given to HiGHS after so many steps: fewer, and HiGHS, whose
# call alone takes 1 ms, runs in most windows of 30 targets (2.3 ms for 1.0); more gain nothing.
TRIED_COLUMNS, TRIED_STEPS = 200, 1000
# Tight prices bound the search; for fewer columns, finding them takes longer than they save.
PRICE_ROUNDS, EASY_COLUMNS = 6, 30


def best_columns(columns: Int[np.ndarray, "C 3"], score: Float[np.ndarray, "C"]) -> Int[np.ndarray, "Z"]:
    """The rows of the columns to choose, ascending: no two share a node of a layer, their scores sum to the most.

    A column that scores zero or less is never chosen; -inf forbids one. Exact, to rounding and HiGHS's 1e-7 of the
    largest score. Among choices of the same sum the nodes' numbers decide, not the order of the columns; of two equal
    columns the first is taken.
    Raises InputError if the shapes do not fit, an index is below -1, a column has no node, or a score is NaN or +inf.
    """
    return good_columns(columns, score, None)[0]


def good_columns(
    columns: Int[np.ndarray, "C 3"], score: Float[np.ndarray, "C"], most_branches: int | None
) -> tuple[Int[np.ndarray, "Z"], bool]:
    """As `best_columns`, in no more branches of HiGHS than so many, and whether it is certainly the best."""
    columns, score = _checked(columns, score)
    order = np.lexsort((-score, columns[:, 2], columns[:, 1], columns[:, 0]))
    order = order[score[order] > 0]
    if not len(order):
        return np.zeros(0, np.int64), True
    kept = columns[order]
    gain = score[order] / score[order].max()
    held = [[3 * node + layer for layer, node in enumerate(column) if node >= 0] for column in kept.tolist()]
    gains = gain.tolist()
    chosen, left_open = np.zeros(len(gain), bool), np.full(len(gain), -1)
    for name, members in enumerate(_joined(held)):
        found = _tried([held[column] for column in members], [gains[column] for column in members])
        if found is None:
            left_open[members] = name
        else:
            chosen[[members[place] for place in found]] = True
    certain, hard = True, left_open >= 0
    if hard.any():
        chosen[hard], certain = _programmed(_incidence(kept[hard]), gain[hard], left_open[hard], most_branches)
    return np.sort(order[chosen]), certain


def fractions(columns: Int[np.ndarray, "C 3"], score: Float[np.ndarray, "C"]) -> Float[np.ndarray, "C"]:
    """How much of each column the best choice takes if it may take parts: whole ones in most windows."""
    return _solve(_incidence(columns), score)[0] if len(score) else np.zeros(0)


def _programmed(
    incidence: "csc_array", gain: Float[np.ndarray, "C"], group: Int[np.ndarray, "C"], most_branches: int | None
) -> tuple[Bool[np.ndarray, "C"], bool]:
    """Linear first: it is integral in most windows; integers only for the groups where it is not."""
    solution, certain = _solve(incidence, gain)
    broken = np.unique(group[np.abs(solution - solution.round()) > 1e-6])
    if len(broken):
        again = np.isin(group, broken)
        options = {} if most_branches is None else {"node_limit": most_branches}
        solution[again], certain = _solve(incidence[:, again], gain[again], integral=True, **options)
    return solution > 0.5, certain


def _solve(
    incidence: "csc_array", gain: Float[np.ndarray, "C"], integral: bool = False, **options: int
) -> tuple[Float[np.ndarray, "C"], bool]:
    """How much of each column the best choice takes, whole ones if `integral`; and whether it is certainly the best."""
    from scipy.optimize import Bounds, LinearConstraint, milp  # here, as it takes half a second and 45 MB

    # Presolving costs more than it saves where the linear programme is the whole work.
    settings: Any = {"mip_rel_gap": 0.0, "presolve": integral, **options}
    solved = milp(
        -gain,
        constraints=LinearConstraint(incidence, ub=1.0),
        integrality=np.full(len(gain), int(integral)),
        bounds=Bounds(0.0, 1.0),
        options=settings,
    )
    if solved.x is None and not options:
        raise RuntimeError(f"HiGHS chose none of {len(gain)} columns: {solved.message}")
    return (np.zeros(len(gain)) if solved.x is None else solved.x), bool(solved.success)


def _joined(held: list[list[int]]) -> list[list[int]]:
    """The groups of columns that share nodes, by their places; held: the nodes of each column."""
    home: dict[int, tuple[list[int], list[int]]] = {}  # of each node: its group's columns and nodes
    for column, nodes in enumerate(held):
        mine = home.get(nodes[0])
        if mine is None:
            mine = home[nodes[0]] = ([], [nodes[0]])
        for node in nodes[1:]:
            other = home.get(node)
            if other is None:
                home[node] = mine
                mine[1].append(node)
            elif other is not mine:
                mine[0].extend(other[0])
                mine[1].extend(other[1])
                for moved in other[1]:
                    home[moved] = mine
        mine[0].append(column)
    return list({id(group): sorted(group[0]) for group in home.values()}.values())


def _tried(held: list[list[int]], gain: list[float]) -> list[int] | None:
    """The best choice in one group, as places in its list; None if that takes too long to try.

    Most targets are nearly alone with themselves. Of one node a layer any two columns meet, unless one is a node alone:
    the best takes all.
    """
    if len(held) > TRIED_COLUMNS:
        return None
    price = _prices(held, gain)
    if len({node % 3 for node in price}) == len(price) and min(map(len, held)) > 1:
        return [gain.index(max(gain))]
    return least_loss(held, gain, price, TRIED_STEPS)


def least_loss(
    held: list[list[int]],
    gain: list[float],
    price: list[float] | dict[int, float],
    steps: int,
    limit: float = float("inf"),
) -> list[int] | None:
    """The best choice among some columns that loses less than `limit`, as places in their list; none if there is none.

    held: the nodes of each column; price: of every node by its number. None if it takes more than so many steps.
    The prices of all nodes are more than any choice can gain. A node that stays alone loses its price, a column that is
    taken what its nodes' prices exceed its gain by: depth first, node by node, what loses least is the best choice.
    """
    dearest_first = sorted({node for nodes in held for node in nodes}, key=lambda node: (-price[node], node))
    bit = {node: 1 << place for place, node in enumerate(dearest_first)}
    options: dict[int, list[tuple[float, int, int]]] = {mask: [] for mask in bit.values()}
    for column, nodes in enumerate(held):
        masks = [bit[node] for node in nodes]
        loss = max(sum(price[node] for node in nodes) - gain[column], 0.0)
        options[min(masks)].append((loss, sum(masks), column))
    for node, mask in bit.items():
        options[mask].append((price[node], mask, -1))
        options[mask].sort()
    full, least, best = (1 << len(bit)) - 1, limit, list[int]()
    stack: list[tuple[float, int, tuple[int, ...]]] = [(0.0, 0, ())]
    while stack:
        lost, used, taken = stack.pop()
        if lost >= least * (1 - 1e-12):
            continue
        if used == full:
            least, best = lost, list(taken)
            continue
        steps -= 1
        if steps < 0:
            return None
        first = ~used & (used + 1)
        for loss, mask, column in reversed(options[first]):
            if not mask & used and lost + loss < least:
                stack.append((lost + loss, used | mask, taken if column < 0 else (*taken, column)))
    return best


def _prices(held: list[list[int]], gain: list[float]) -> dict[int, float]:
    """Prices of the nodes that pay for every column: gains shared evenly, then lowered by what is over."""
    price: dict[int, float] = {}
    for nodes, worth in zip(held, gain, strict=True):
        share = worth / len(nodes)
        for node in nodes:
            if price.get(node, 0.0) < share:
                price[node] = share
    if len(held) <= EASY_COLUMNS:
        return price
    place = {node: k for k, node in enumerate(price)}
    at, count = np.array([place[node] for nodes in held for node in nodes]), np.array([len(nodes) for nodes in held])
    start, level = np.cumsum(count) - count, np.array(list(price.values()))
    for _ in range(PRICE_ROUNDS):
        least = level * 3
        np.minimum.at(least, at, np.repeat(np.add.reduceat(level[at], start) - gain, count))
        # A column holds up to three nodes: a third each keeps it paid for.
        level -= np.maximum(least, 0.0) / 3
    return dict(zip(price, level.tolist(), strict=True))


def _incidence(columns: Int[np.ndarray, "C 3"]) -> "csc_array":
    """Which nodes, numbered over all layers, each column holds."""
    from scipy.sparse import csc_array

    there = columns >= 0
    names = (columns * 3 + np.arange(3))[there]
    known, nodes = np.unique(names, return_inverse=True)
    start = np.concatenate([[0], np.cumsum(there.sum(axis=1))])
    return csc_array((np.ones(len(nodes)), nodes, start), shape=(len(known), len(columns)))


def _checked(
    columns: Int[np.ndarray, "C 3"], score: Float[np.ndarray, "C"]
) -> tuple[Int[np.ndarray, "C 3"], Float[np.ndarray, "C"]]:
    columns, score = np.asarray(columns), np.asarray(score, float)
    if columns.ndim != 2 or columns.shape[1] != 3 or score.shape != columns.shape[:1]:
        raise InputError(
            f"columns need (C, 3) indices and (C,) scores; got {columns.shape} and {score.shape}. "
            "Give one score a column."
        )
    if len(columns) and not np.issubdtype(columns.dtype, np.integer):
        raise InputError(f"columns need integer indices; got {columns.dtype}. Convert them, with -1 for none.")
    if len(columns) and (columns.min() < -1 or columns.max(axis=1).min() < 0):
        raise InputError("columns need a node of some layer, -1 for none; got an index below -1 or a column of none.")
    if np.isnan(score).any() or np.isposinf(score).any():
        raise InputError("columns need scores below infinity; got NaN or +inf. Forbid a column with -inf.")
    return columns.astype(np.int64), score
