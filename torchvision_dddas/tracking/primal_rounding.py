"""Whole triplets from prices: a choice that shares no target, and better ones nearby."""

from collections.abc import Iterator

import numpy as np

from torchvision_dddas.tracking.dual_prices import OTHERS, Prices
from torchvision_dddas.tracking.triplets import fractions
from torchvision_dddas.types import Bool, Float, Int

# Triplets a target that are rounded from, of those that lose least: whole ones, and pairs with each other layer. Pairs
# apart, since dummies that all score the same would crowd the whole ones out.
PER_TARGET = np.array([4, 2, 2])
# How far draws after the first shake what the linear programme says.
SHAKE = 1.0


def gained(gain: Float[np.ndarray, "N1 M1 L1"], chosen: Int[np.ndarray, "C 3"]) -> float:
    """What a choice of triplets gains."""
    return float(gain[tuple(chosen.T)].sum())


def rounded(
    gain: Float[np.ndarray, "N1 M1 L1"],
    nodes: Int[np.ndarray, "C 3"],
    share: Float[np.ndarray, "C"],
    prices: Prices,
    draws: int,
) -> Iterator[Int[np.ndarray, "Z 3"]]:
    """Choices from some triplets `nodes`, each with its share of the answers of a descent.

    Those in every answer are taken. For the rest a linear programme says how much of each triplet to take, and the most
    goes first, in several draws.
    """
    agreed = nodes[share > 1 - 1e-9]
    uses = np.bincount(agreed[:, 0], minlength=gain.shape[0])
    agreed = agreed[(agreed[:, 0] == 0) | (uses[agreed[:, 0]] == 1)]
    nodes = nodes[_free_of(agreed, nodes, gain.shape)]
    loss = prices[0][nodes[:, 0]] + prices[1][nodes[:, 1]] + prices[2][nodes[:, 2]] - gain[tuple(nodes.T)]
    # Among ties anyone, but not the first of each target: they would all want the same partners.
    nodes = nodes[np.argsort(loss + 1e-9 * np.random.default_rng(0).random(len(loss)))]
    nodes = nodes[_first_of_each_kind(nodes)]
    worth = gain[tuple(nodes.T)]
    parts = fractions(nodes - 1, worth)
    random = np.random.default_rng(0)
    for draw in range(draws):
        # The first as the programme says, the others shaken: what it takes half of may go either way.
        order = np.argsort(-(parts + SHAKE * random.random(len(parts)) if draw else parts), kind="stable")
        yield np.concatenate([agreed, nodes[_first_that_fit(nodes, order[parts[order] > 1e-6])]])


def improved(gain: Float[np.ndarray, "N1 M1 L1"], chosen: Int[np.ndarray, "C 3"]) -> Int[np.ndarray, "Z 3"]:
    """A choice that no new assignment of one layer's targets to what is left of the triplets makes better."""
    value, idle, layer = gained(gain, chosen), 0, 0
    while idle < 3:
        other = reassigned(gain, chosen[:, OTHERS[layer]], layer)
        if gained(gain, other) > value + 1e-9:
            chosen, value, idle = other, gained(gain, other), 0
        else:
            idle += 1
        layer = (layer + 1) % 3
    return chosen


def reassigned(
    gain: Float[np.ndarray, "N1 M1 L1"], pairs: Int[np.ndarray, "P 2"], layer: int
) -> Int[np.ndarray, "Z 3"]:
    """The best choice of triplets that holds these pairs of the other two layers, or their targets alone."""
    from scipy.optimize import linear_sum_assignment  # here, as it takes half a second and 45 MB

    pairs = pairs[(pairs > 0).all(axis=1)]
    rows = []
    for side, other in enumerate(OTHERS[layer]):
        single = np.ones(gain.shape[other], bool)
        single[pairs[:, side]] = False
        rest = np.zeros((int(single[1:].sum()), 2), np.int64)
        rest[:, side] = np.flatnonzero(single[1:]) + 1
        rows.append(rest)
    group = np.insert(np.concatenate([pairs, *rows]), layer, 0, axis=1)
    where = list(group.T)
    where[layer] = np.arange(gain.shape[layer])[:, None]
    worth = gain[tuple(where)]
    without = np.maximum(worth[0], 0.0)
    target, place = linear_sum_assignment(np.maximum(worth[1:] - without, 0.0), maximize=True)
    better = worth[1 + target, place] > without[place]
    group[place[better], layer] = target[better] + 1
    return group[gain[tuple(group.T)] > 0]


def _first_that_fit(nodes: Int[np.ndarray, "C 3"], order: Int[np.ndarray, "D"]) -> list[int]:
    """The triplets, in this order, that share no target with one before."""
    used: tuple[set[int], set[int], set[int]] = (set(), set(), set())
    taken = []
    for column, held in zip(order.tolist(), nodes[order].tolist(), strict=True):
        if not any(node and node in layer for node, layer in zip(held, used, strict=True)):
            taken.append(column)
            for node, layer in zip(held, used, strict=True):
                layer.add(node)
    return taken


def _free_of(
    taken: Int[np.ndarray, "Z 3"], nodes: Int[np.ndarray, "C 3"], shape: tuple[int, ...]
) -> Bool[np.ndarray, "C"]:
    """Which triplets share no target with those taken."""
    free = np.ones(len(nodes), bool)
    for layer, size in enumerate(shape):
        held = np.zeros(size, bool)
        held[taken[:, layer]] = True
        held[0] = False
        free &= ~held[nodes[:, layer]]
    return free


def _first_of_each_kind(nodes: Int[np.ndarray, "C 3"]) -> Bool[np.ndarray, "C"]:
    """Which triplets are among the first of some target: of its whole ones, or of its pairs with another layer."""
    wanted = np.zeros(len(nodes), bool)
    there = nodes > 0
    for layer, (other, _) in enumerate(OTHERS):
        kind = np.where(there.all(axis=1), 0, np.where(there[:, other], 1, 2))
        key = nodes[:, layer] * 3 + kind
        sorted_ = np.argsort(key, kind="stable")
        start = np.flatnonzero(np.diff(key[sorted_], prepend=-1))
        rank = np.arange(len(nodes)) - np.repeat(start, np.diff(start, append=len(nodes)))
        wanted[sorted_[(rank < PER_TARGET[kind[sorted_]]) & there[sorted_, layer]]] = True
    return wanted
