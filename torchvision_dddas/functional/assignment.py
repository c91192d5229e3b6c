"""Soft one-to-one assignment of two frames' targets: odds of all assignments at once, and their likelihood.

An assignment pairs targets of a frame with targets of another; who stays alone scores 0, the dummy that is used any
number of times. Its probability is exp(sum of its scores / softness) over that of all assignments: the partition
function. Exactly that is a permanent, beyond reach; what stands here is Bethe's approximation, whose fixed point is
found by passing messages between rows and columns (Williams and Lau, 2014: it always converges; Vontobel, 2013: it is
the least of a convex function).
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

_CLOSE = 1e-6  # change of any share that ends the rounds


def log_partition(score: Float[Tensor, "*B N M"], softness: float, *, rounds: int = 50) -> Float[Tensor, "*B"]:
    """Bethe's softness · log Σ exp(sum of scores / softness), over all assignments.

    score: -inf forbids a pair. softness: above 0, in the unit of the scores; as it vanishes the result becomes the
    score of the best assignment. rounds: of messages, at most. The gradient in the scores is the share of each pair in
    all assignments: at the fixed point messages have no slope, so that they need none. Never above the exact sum
    (Gurvits), and equal to it where one frame has a single target.

    >>> F.log_partition(torch.tensor([[[3.0, 0.0], [0.0, 2.0]]]), 0.01).round(decimals=2)
    tensor([5.])
    """
    scaled = score / softness
    with torch.no_grad():
        # Logarithms of the messages from columns to their pairs: how free a column is, would the pair not be.
        from_column, share = torch.zeros_like(scaled), torch.zeros_like(scaled)
        for _ in range(rounds if scaled.numel() else 0):
            from_row = scaled - _log_sum_of_others(scaled + from_column, -1)
            from_column = -_log_sum_of_others(from_row, -2)
            before, share = share, torch.sigmoid(from_row + from_column)
            if (share - before).abs().amax() < _CLOSE:
                break
        from_row = scaled - _log_sum_of_others(scaled + from_column, -1)
        # Of the columns and the pairs; the rows have the slope.
        columns = _log_one_more(from_row, -2).sum(-1)
        pairs = functional.softplus(from_row + from_column).sum((-1, -2))
    rows = _log_one_more(scaled + from_column, -1).sum(-1)
    return softness * (rows + columns - pairs)


def _log_one_more(x: Float[Tensor, "*B N M"], axis: int) -> Float[Tensor, "*B K"]:
    """log(1 + Σ exp) over an axis, 1 being for who stays alone."""
    alone = torch.zeros_like(x.sum(axis, keepdim=True))
    return torch.logsumexp(torch.cat([x, alone], axis), axis)


def _log_sum_of_others(x: Float[Tensor, "*B N M"], axis: int) -> Float[Tensor, "*B N M"]:
    """log(1 + Σ of exp over the others of the axis), for each."""
    if not x.numel():
        return x
    most, at = x.max(axis, keepdim=True)
    # Relative to the largest, or to the dummy's 0 where that is more.
    top = most.clamp(min=0)
    terms, alone = torch.exp(x - top), torch.exp(-top)
    others = (terms.sum(axis, keepdim=True) + alone - terms).log() + top
    # The largest is summed around, not subtracted: what is left may be smaller than what is lost in the difference.
    rest = x.scatter(axis, at, -torch.inf)
    return others.scatter(axis, at, torch.logaddexp(rest.logsumexp(axis, keepdim=True), torch.zeros_like(most)))
