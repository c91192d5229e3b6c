"""Straight-through estimates: the value of a hard step with the gradient of a soft one (Bengio et al. 2013)."""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor


def through(hard: Shaped[Tensor, "*any"], soft: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """The hard value, to the bit, whose gradient is the soft one's."""
    # `hard - soft + soft` would round.
    return _Through.apply(hard, soft)


def rounded(x: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """The nearest whole numbers, halves to even, with the gradient of x itself."""
    return through(x.detach().round(), x)


class _Through(torch.autograd.Function):
    @staticmethod
    def forward(ctx: object, hard: Tensor, soft: Tensor) -> Tensor:
        return hard.to(soft.dtype, copy=True)

    @staticmethod
    def backward(ctx: object, *grads: Tensor) -> tuple[None, Tensor]:
        return None, grads[0]
