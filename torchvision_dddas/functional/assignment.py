"""Soft one-to-one assignment of the targets of two frames: the likelihood of all assignments together.

An assignment pairs targets of one frame with targets of the other. A target without a partner takes the dummy, which
scores 0 and may be used any number of times. The probability of an assignment is exp(sum of its scores / softness)
divided by the sum over all assignments, the partition function. The exact partition function is a permanent, which is
too costly. This module computes Bethe's approximation. Its fixed point is found by messages between rows and columns
(Williams and Lau, 2014: they always converge; Vontobel, 2013: it is the minimum of a convex function).
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

_CLOSE = 1e-6  # the rounds end when no share changes by more than this


def log_partition(score: Float[Tensor, "*B N M"], softness: float, *, rounds: int = 50) -> Float[Tensor, "*B"]:
    """Return Bethe's approximation of softness · log Σ exp(sum of scores / softness), over all assignments.

    score: -inf forbids a pair. softness: above 0, in the unit of the scores; as it vanishes, the result becomes the
    score of the best assignment. rounds: largest number of rounds of messages. The gradient in the scores is the share
    of each pair in all assignments. The messages need no gradient, because the result has no slope in them at the fixed
    point. The result is never above the exact value (Gurvits), and equals it if one frame has a single target.

    >>> F.log_partition(torch.tensor([[[3.0, 0.0], [0.0, 2.0]]]), 0.01).round(decimals=2)
    tensor([5.])
    """
    scaled = score / softness
    with torch.no_grad():
        # Logarithms of the messages from columns to pairs: how free a column is without the pair.
        from_column, share = torch.zeros_like(scaled), torch.zeros_like(scaled)
        for _ in range(rounds if scaled.numel() else 0):
            from_row = scaled - _log_sum_of_others(scaled + from_column, -1)
            from_column = -_log_sum_of_others(from_row, -2)
            before, share = share, torch.sigmoid(from_row + from_column)
            if (share - before).abs().amax() < _CLOSE:
                break
        from_row = scaled - _log_sum_of_others(scaled + from_column, -1)
        # Only the rows carry the gradient; columns and pairs are constants.
        columns = _log_one_more(from_row, -2).sum(-1)
        pairs = functional.softplus(from_row + from_column).sum((-1, -2))
    rows = _log_one_more(scaled + from_column, -1).sum(-1)
    return softness * (rows + columns - pairs)


def _log_one_more(x: Float[Tensor, "*B N M"], axis: int) -> Float[Tensor, "*B K"]:
    """Return log(1 + Σ exp) over an axis. The 1 stands for the target without a partner."""
    alone = torch.zeros_like(x.sum(axis, keepdim=True))
    return torch.logsumexp(torch.cat([x, alone], axis), axis)


def _log_sum_of_others(x: Float[Tensor, "*B N M"], axis: int) -> Float[Tensor, "*B N M"]:
    """For each entry, return log(1 + Σ exp) over the other entries of the axis."""
    if not x.numel():
        return x
    most, at = x.max(axis, keepdim=True)
    # Subtract the largest term, or the dummy's 0 if that is larger, so that exp does not overflow.
    top = most.clamp(min=0)
    terms, alone = torch.exp(x - top), torch.exp(-top)
    others = (terms.sum(axis, keepdim=True) + alone - terms).log() + top
    # For the largest entry, sum the others directly: subtraction from the total would lose the digits of a small rest.
    rest = x.scatter(axis, at, -torch.inf)
    return others.scatter(axis, at, torch.logaddexp(rest.logsumexp(axis, keepdim=True), torch.zeros_like(most)))
