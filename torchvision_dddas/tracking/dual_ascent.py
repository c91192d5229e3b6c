"""Lower prices by subgradient steps over the triplets that matter (Lagrangian relaxation of one layer).

With prices for the first layer alone, the best answer of the other two is a two-frame assignment, in which a target of
the first layer may be used more than once, or never: it is then too cheap, or too dear.
"""

import numpy as np

from torchvision_dddas.tracking.dual_prices import matched
from torchvision_dddas.types import Float, Int

# Steps as a share of Polyak's, shrunk after so many that found no lower bound in a row.
LENGTH, SHRINK, PATIENCE = 0.4, 0.7, 4
# Share of the last direction in the next: less zigzag between the same few targets.
MEMORY = 0.4


class Shortlist:
    """Some triplets of a tensor, sorted by their pair of the last two layers.

    index: (C,) flat indices into `gain`, at least one. nodes: (C, 3) what they hold.
    """

    def __init__(self, index: Int[np.ndarray, "C"], gain: Float[np.ndarray, "N1 M1 L1"]) -> None:
        self.size, self.shape = len(gain), gain.shape[1:]
        pairs = self.shape[0] * self.shape[1]
        cell = index % pairs
        # Two bytes sort in linear time, and name the pairs of up to 255 targets.
        order = np.argsort(cell.astype(np.uint16) if pairs <= 2**16 else cell, kind="stable")
        index, cell = index[order], cell[order]
        self.nodes = np.stack(np.unravel_index(index, gain.shape), axis=1)
        self.first, self.gain = self.nodes[:, 0], gain.ravel()[index]
        self.start = np.flatnonzero(np.diff(cell, prepend=-1))
        self.cell = cell[self.start]
        self.count = np.diff(self.start, append=len(cell))
        self.place = np.full(pairs, -1)
        self.place[self.cell] = np.arange(len(self.cell))
        self.best = np.full(self.shape, -1.0)

    def answer(self, price: Float[np.ndarray, "N1"]) -> tuple[float, Int[np.ndarray, "P"]]:
        """The bound that these prices make over these triplets, and which of these triplets reach it."""
        left = self.gain - price[self.first]
        most = np.maximum.reduceat(left, self.start)
        self.best.ravel()[self.cell] = most
        second, third, excess, row, column = matched(self.best)
        worth = excess[row, column]
        row, column = row[worth > 0] + 1, column[worth > 0] + 1
        alone_second, alone_third = np.ones(self.shape[0], bool), np.ones(self.shape[1], bool)
        alone_second[row] = alone_third[column] = False
        alone_second[0] = alone_third[0] = False
        width = self.shape[1]
        pairs = [row * width + column, np.flatnonzero(alone_second) * width, np.flatnonzero(alone_third)]
        pair = np.concatenate(pairs)
        place = self.place[pair[self.best.ravel()[pair] > 0]]
        # The first of the triplets that reach their pair's best.
        top = np.flatnonzero(left == np.repeat(most, self.count))
        reached = top[np.searchsorted(top, self.start[place])]
        return float(worth.sum() + second.sum() + third.sum() + price.sum()), reached

    def descend(
        self, price: Float[np.ndarray, "N1"], value: float, steps: int
    ) -> tuple[Float[np.ndarray, "N1"], Float[np.ndarray, "C"]]:
        """The prices of the lowest bound in so many steps, and each triplet's share of the answers in the later half.

        value: what some choice gains: the steps are of Polyak's length, towards it.
        """
        lowest, best, direction, length, idle = np.inf, price, np.zeros(len(price)), LENGTH, 0
        share, answers = np.zeros(len(self.gain)), 0
        for step in range(steps):
            here, reached = self.answer(price)
            if 2 * step >= steps:
                share[reached] += 1
                answers += 1
            idle = 0 if here < lowest - 1e-9 else idle + 1
            if here < lowest:
                lowest, best = here, price
            if idle == PATIENCE:
                length, idle = length * SHRINK, 0
            uses = np.bincount(self.first[reached], minlength=len(price))
            slope = np.where((price <= 0) & (uses < 1), 0.0, 1.0 - uses)
            slope[0] = 0.0
            direction = slope + MEMORY * direction
            steep = float(direction @ direction)
            if steep == 0.0 or lowest - value < 1e-9:
                # Every target is used as often as it should be: this answer is the best choice.
                share[:] = 0
                share[reached], answers = 1, 1
                break
            price = np.maximum(price - length * (here - value) / steep * direction, 0.0)
            price[0] = 0.0
        return best, share / max(answers, 1)
