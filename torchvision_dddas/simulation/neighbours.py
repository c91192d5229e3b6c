"""Who is near whom, by a grid of cells: the time grows with the number of bodies, not with its square."""

import numpy as np


def pairs(place: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The pairs (P,), (P,) of rows of places (N, 2) that are nearer to one another than reach_m, each once."""
    none = np.zeros(0, np.int64)
    if len(place) < 2:
        return none, none
    cell = np.floor((place - place.min(axis=0)) / reach_m).astype(np.int64) + 1
    across = int(cell[:, 0].max()) + 2
    key = cell[:, 1] * across + cell[:, 0]
    order = np.argsort(key, kind="stable")
    ranked = key[order]
    # Neighbours later in the same row of cells, and in the three cells of the row above, which lie in a row as well.
    rank = np.arange(len(place))
    spans = [
        (rank + 1, np.searchsorted(ranked, ranked + 1, side="right")),
        (np.searchsorted(ranked, ranked + across - 1), np.searchsorted(ranked, ranked + across + 1, side="right")),
    ]
    firsts, seconds = [], []
    for begin, end in spans:
        many = np.maximum(end - begin, 0)
        total = int(many.sum())
        first = np.repeat(rank, many)
        seconds.append(np.arange(total) - np.repeat(np.cumsum(many) - many, many) + np.repeat(begin, many))
        firsts.append(first)
    first, second = order[np.concatenate(firsts)], order[np.concatenate(seconds)]
    near = ((place[first] - place[second]) ** 2).sum(axis=1) < reach_m**2
    return first[near], second[near]
