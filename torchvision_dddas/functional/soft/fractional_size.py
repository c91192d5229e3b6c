"""Whole sizes made smooth: what an operation gives for a size between two that it takes."""

import math
from collections.abc import Callable

import torch
from torch import Tensor


def between(size: float | Tensor, operation: Callable[[int], Tensor], lowest: int = 1, pitch: int = 1) -> Tensor:
    """The operation's results for the sizes on either side, blended by nearness; exact for a size that it takes.

    size: one number, or a tensor without axes, to which the gradient goes. lowest, pitch: sizes are lowest, lowest +
    pitch, ...: 1 and 2 for odd ones.
    """
    steps = (float(size.detach() if isinstance(size, Tensor) else size) - lowest) / pitch
    below = max(math.floor(steps), 0)
    first = operation(lowest + pitch * below)
    if not isinstance(size, Tensor):
        if steps == below:
            return first
        share: float | Tensor = steps - below
    else:
        share = (size - lowest) / pitch - below
    if not isinstance(share, Tensor):
        return torch.lerp(first, operation(lowest + pitch * (below + 1)), share)
    return first + share.to(first) * (operation(lowest + pitch * (below + 1)) - first)
