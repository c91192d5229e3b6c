"""Assignment over three layers: tracks, detections now, detections in the next frame.

The default tracker chooses its links by prices of the next frame's detections (`choose_links`). The source's triplets
are chosen exactly (`choose_triplets`). A column (i, j, k) names one node in each of three layers, or -1 for none. The
columns are divided into connected groups by shared nodes. Small groups are solved by branch and bound. All large groups
are solved together by linear programming, and by integer programming (HiGHS) if the solution has fractions.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import cheapest
from torchvision_dddas.types import Bool, Float, Int

if TYPE_CHECKING:
    from scipy.sparse import csc_array

_LEAST_SCORE = -2.0  # links with a lower score are never made, even if the next frame supports them
_NEXT_WEIGHT = 0.8  # weight of the next frame's scores; with 1, a sharp turn looks like an exchange of identities
_RIVALS = 6  # number of best links that are compared for a track or a detection; only stacked boxes have more
_TIE_BREAK = 1e-6
_ROUNDS, _CLOSE = 12, 1e-4  # largest number of price updates; relative gap to the bound at which they stop
# A group with at most _SEARCH_COLUMNS columns is searched by branch and bound, and passed to HiGHS after _SEARCH_STEPS
# steps. With fewer steps HiGHS, whose call alone takes 1 ms, runs in most windows of 30 targets (2.3 ms instead of
# 1.0); more steps gain nothing.
_SEARCH_COLUMNS, _SEARCH_STEPS = 200, 1000
# Lowered prices bound the search more tightly. With at most _EASY_COLUMNS columns, lowering takes longer than it saves.
_PRICE_ROUNDS, _EASY_COLUMNS = 6, 30


def plausible_links(score: Float[np.ndarray, "N M"]) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """Return the tracks and detections (P,) of the plausible links, given association scores (N, M)."""
    row, column = (score > _LEAST_SCORE).nonzero()
    if not len(row) or min(np.bincount(row).max(), np.bincount(column).max()) < _RIVALS:
        return row, column
    # Stacked boxes have equal scores, and a search of all their links would take too long: keep the best few.
    distinct = score[row, column] - _TIE_BREAK * ((column - row) % score.shape[1])
    leading = _is_leading(distinct, row) | _is_leading(distinct, column)
    return row[leading], column[leading]


def choose_links(
    value: Float[np.ndarray, "P"],
    tracks: Int[np.ndarray, "P"],
    now: Int[np.ndarray, "P"],
    onward: Float[np.ndarray, "P L"],
    born: Float[np.ndarray, "M L"],
    bridging: Float[np.ndarray, "N L"],
) -> Bool[np.ndarray, "P"]:
    """Return which links belong to disjoint triplets with a large sum of scores (K = 3, one frame of delay).

    Prices of the next frame's detections (Lagrange multipliers of "each at most once") reduce the problem to a
    two-frame assignment, which is solved repeatedly while the prices are updated. The best choice found is returned.
    The bound from the prices shows that it has the largest sum in nearly all windows, but not always.

    value, tracks, now: scores, tracks and detections of the plausible links of this frame. The other arguments are
    scores to the L detections of the next frame. onward: scores of the tracks after these links. born: scores of tracks
    that would begin with each of the M detections. bridging: of tracks without a detection in this frame, which are the
    (i, k) links that the source's eq. 4 and 5 leave out. Only links of this frame are returned, because the next frame
    decides its own links with its own successor in view.
    """
    price = np.zeros(onward.shape[1])
    best, answer = -np.inf, np.zeros(len(value), bool)
    if not len(value):
        return answer
    # Stack the scores to the next frame. Only scores above 0 can be chosen: one in a hundred with 1000 boxes a frame.
    parts, places = (onward, born, bridging), [(part > 0).nonzero() for part in (onward, born, bridging)]
    begin, free, end = np.cumsum([len(value), len(born), len(bridging)]).tolist()
    row = np.concatenate([at[0] + first for at, first in zip(places, (0, begin, free), strict=True)])
    column = np.concatenate([at[1] for at in places])
    gain = _NEXT_WEIGHT * np.concatenate([part[at] for part, at in zip(parts, places, strict=True)])
    starts, born_row, old_row = _run_starts(row), begin + now, free + tracks
    filled = row[starts]
    for _ in range(_ROUNDS):
        # Subtract the prices of the next frame's detections, and add each node's best net gain to this frame's links.
        net, most = gain - price[column], np.zeros(end)
        if len(row):
            most[filled] = np.maximum(np.maximum.reduceat(net, starts), 0.0)
        worth = np.maximum(value + most[:begin] - most[born_row] - most[old_row], 0.0)
        links = worth.nonzero()[0]
        chosen = links[_best_entries(tracks[links], now[links], worth[links])]
        bound = float(worth[chosen].sum() + most[begin:].sum() + price.sum())
        used = np.zeros(end, bool)
        used[:begin] = True
        used[chosen] = False
        used[born_row[chosen]] = used[old_row[chosen]] = True
        is_left = ~used[row]
        left = is_left.nonzero()[0]
        ahead = gain[left]
        found = float(value[chosen].sum() + ahead[_best_entries(row[left], column[left], ahead)].sum())
        if found > best:
            best, answer = found, np.zeros(len(value), bool)
            answer[chosen] = True
        if bound - best < _CLOSE * max(1.0, best):
            break
        # Find the detection that each free node wants most, the first detection if equal.
        dearest = (is_left & (net > 0) & (net == most[row])).nonzero()[0]
        wanted = column[dearest[_run_starts(row[dearest])]]
        excess = np.bincount(wanted, minlength=len(price)) - 1
        excess[(excess < 0) & (price <= 0)] = 0
        if not excess.any():
            break
        price = np.maximum(price + (bound - best) / float((excess**2).sum()) * excess, 0.0)
    return answer


def link_confidences(
    score: Float[np.ndarray, "N M"], tracks: Int[np.ndarray, "K"], detections: Int[np.ndarray, "K"]
) -> Float[np.ndarray, "K"]:
    """Return the (K,) confidences in [0, 1] of chosen links: .5 if an alternative is as likely.

    score: association scores. The alternatives to a link are: no link, a link to another free detection or track, and
    an exchange of detections with another link.
    """
    if not len(tracks):
        return np.zeros(0)
    mine = score[tracks]
    chosen = lead = mine[np.arange(len(tracks)), detections]
    free_tracks, free_detections = np.ones(score.shape[0], bool), np.ones(score.shape[1], bool)
    free_tracks[tracks], free_detections[detections] = False, False
    if free_detections.any():
        lead = np.minimum(lead, chosen - mine[:, free_detections].max(axis=1))
    if free_tracks.any():
        lead = np.minimum(lead, chosen - score[free_tracks][:, detections].max(axis=0))
    if len(tracks) > 1:
        crossed = mine[:, detections]
        loss = chosen[:, None] + chosen - crossed - crossed.T
        np.fill_diagonal(loss, np.inf)
        lead = np.minimum(lead, loss.min(axis=1))
    return 1 / (1 + np.exp(-lead.clip(-50.0, 50.0)))


def _run_starts(values: np.ndarray) -> np.ndarray:
    """Return the indices at which runs of equal values begin."""
    begins = np.ones(len(values), bool)
    np.not_equal(values[1:], values[:-1], out=begins[1:])
    return begins.nonzero()[0]


def _best_entries(row: np.ndarray, column: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the indices of the entries that form one-to-one pairs with the largest sum, by row, like `best_pairs`.

    All values are above 0. row: ascending, and column is ascending within each row.
    """
    if not len(row):
        return row
    rows, columns = ((np.bincount(nodes) > 0).cumsum() for nodes in (row, column))
    count, wide = rows[-1], columns[-1]
    if count == wide == len(row):
        return np.arange(count)
    place = (rows[row] - 1) * wide + columns[column] - 1
    cost = np.zeros(count * wide)
    cost[place] = -value
    row, column = cheapest(cost.reshape(count, wide))
    found = row * wide + column
    return place.searchsorted(found[cost[found] < 0])


def _is_leading(value: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return (P,) whether a value is among the largest _RIVALS values of its group."""
    order = np.lexsort((-value, group))
    starts = np.searchsorted(group[order], np.arange(group.max(initial=-1) + 2))
    limit = np.full(len(starts) - 1, -np.inf)
    many = np.flatnonzero(np.diff(starts) >= _RIVALS)
    limit[many] = value[order[starts[many] + _RIVALS - 1]]
    return value >= limit[group]


def choose_triplets(
    columns: Int[np.ndarray, "C 3"], score: Float[np.ndarray, "C"], most_branches: int | None = None
) -> tuple[Int[np.ndarray, "Z"], bool]:
    """Choose columns that share no node and have the largest sum of scores.

    Return the indices of the chosen columns, ascending, and whether their sum is certainly the largest. Columns with a
    score of 0 or less are never chosen; -inf forbids a column. The result is exact to rounding and HiGHS's tolerance of
    1e-7 of the largest score, unless HiGHS would need more than `most_branches`. Among choices with equal sums the node
    numbers decide, not the order of the columns; of two equal columns the first is chosen.
    Raises InputError if the shapes do not fit, an index is below -1, a column has no node, or a score is NaN or +inf.
    """
    columns, score = np.asarray(columns), np.asarray(score, float)
    if columns.ndim != 2 or columns.shape[1] != 3 or score.shape != columns.shape[:1]:
        raise InputError(
            f"triplets need (C, 3) indices and (C,) scores; got {columns.shape} and {score.shape}. "
            "Give one score for each column."
        )
    if len(columns) and not np.issubdtype(columns.dtype, np.integer):
        raise InputError(f"triplets need integer indices; got {columns.dtype}. Convert them, with -1 for none.")
    if len(columns) and (columns.min() < -1 or columns.max(axis=1).min() < 0):
        raise InputError(
            "triplets need a node in some layer, and -1 for none; got an index below -1 or a column without a node."
        )
    if np.isnan(score).any() or np.isposinf(score).any():
        raise InputError("triplets need scores below infinity; got NaN or +inf. Forbid a column with -inf.")
    order = np.lexsort((-score, columns[:, 2], columns[:, 1], columns[:, 0]))
    order = order[score[order] > 0]
    if not len(order):
        return np.zeros(0, np.int64), True
    kept, gain = columns[order], score[order] / score[order].max()
    held = [[3 * node + layer for layer, node in enumerate(column) if node >= 0] for column in kept.tolist()]
    gains = gain.tolist()
    chosen, unsolved = np.zeros(len(gain), bool), np.full(len(gain), -1)
    for name, members in enumerate(_connected_groups(held)):
        found = _search([held[column] for column in members], [gains[column] for column in members])
        if found is None:
            unsolved[members] = name
        else:
            chosen[[members[place] for place in found]] = True
    certain, hard = True, np.flatnonzero(unsolved >= 0)
    if len(hard):
        # Try linear programming first: its solution is integral in most windows. Use integer programming for the rest.
        incidence, group = _incidence(kept[hard]), unsolved[hard]
        solution, certain = _solve(incidence, gain[hard])
        again = np.isin(group, group[np.abs(solution - solution.round()) > 1e-6])
        if again.any():
            options = {} if most_branches is None else {"node_limit": most_branches}
            solution[again], certain = _solve(incidence[:, again], gain[hard][again], integral=True, **options)
        chosen[hard] = solution > 0.5
    return np.sort(order[chosen]), certain


def relaxed_shares(columns: Int[np.ndarray, "C 3"], score: Float[np.ndarray, "C"]) -> Float[np.ndarray, "C"]:
    """Return the (C,) shares of columns in the best fractional choice (linear programming): 0 or 1 in most windows."""
    return _solve(_incidence(columns), score)[0] if len(score) else np.zeros(0)


def _solve(
    incidence: "csc_array", gain: Float[np.ndarray, "C"], integral: bool = False, **options: int
) -> tuple[Float[np.ndarray, "C"], bool]:
    """Return the (C,) share of each column in the best choice, 0 or 1 if `integral`, and whether HiGHS finished."""
    from scipy.optimize import Bounds, LinearConstraint, milp  # imported here: it takes half a second and 45 MB

    # For linear programmes presolving takes more time than it saves.
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


def _connected_groups(held: list[list[int]]) -> list[list[int]]:
    """Return the connected groups of columns, as lists of indices. held: the nodes of each column."""
    home: dict[int, tuple[list[int], list[int]]] = {}  # for each node the columns and the nodes of its group
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


def _search(held: list[list[int]], gain: list[float]) -> list[int] | None:
    """Return the best choice in one group, as indices into its list; None if the search takes too long."""
    if len(held) > _SEARCH_COLUMNS:
        return None
    # Start with prices whose sum over each column is at least its gain: share the gains evenly, then lower the excess.
    price: dict[int, float] = {}
    for nodes, worth in zip(held, gain, strict=True):
        for node in nodes:
            price[node] = max(price.get(node, 0.0), worth / len(nodes))
    if len(held) > _EASY_COLUMNS:
        place = {node: k for k, node in enumerate(price)}
        at, count = np.array([place[node] for nodes in held for node in nodes]), np.array(list(map(len, held)))
        start, level = np.cumsum(count) - count, np.array(list(price.values()))
        for _ in range(_PRICE_ROUNDS):
            least = level * 3
            np.minimum.at(least, at, np.repeat(np.add.reduceat(level[at], start) - gain, count))
            # A column has up to three nodes. Lowering each by a third of the excess keeps the sum above the gain.
            level -= np.maximum(least, 0.0) / 3
        price = dict(zip(price, level.tolist(), strict=True))
    # If the group has only one node in each layer, all columns of several nodes exclude each other: take the best.
    if len({node % 3 for node in price}) == len(price) and min(map(len, held)) > 1:
        return [gain.index(max(gain))]
    return least_loss(held, gain, price, _SEARCH_STEPS)


def least_loss(
    held: list[list[int]],
    gain: list[float],
    price: list[float] | dict[int, float],
    steps: int,
    limit: float = float("inf"),
) -> list[int] | None:
    """Return the best choice of columns with a loss below `limit`, as indices into the list.

    The result is empty if there is no such choice, and None if the search needs more than `steps` steps. held: the
    nodes of each column. price: price of every node by its number. The sum of all prices is an upper bound of the gain.
    A node without a column loses its price; a chosen column loses the sum of its nodes' prices minus its gain. A
    depth-first search over the nodes finds the smallest loss.
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


def _incidence(columns: Int[np.ndarray, "C 3"]) -> "csc_array":
    """Return the (nodes, C) incidence matrix: which nodes of all layers each column contains."""
    from scipy.sparse import csc_array

    there = columns >= 0
    names = (columns * 3 + np.arange(3))[there]
    known, nodes = np.unique(names, return_inverse=True)
    start = np.concatenate([[0], np.cumsum(there.sum(axis=1))])
    return csc_array((np.ones(len(nodes)), nodes, start), shape=(len(known), len(columns)))
