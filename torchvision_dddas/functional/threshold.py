"""The threshold that can be softened, so that gradients pass while parameters are tuned (appendix B, step S4)."""

import torch
from jaxtyping import Float
from torch import Tensor


def step(x: Float[Tensor, "*any"], softness: float = 0.0) -> Float[Tensor, "*any"]:
    """1 where x > 0 and 0 elsewhere; with softness above 0 the sigmoid of x / softness, x in its own unit.

    Softness is a Python number: tracing keeps one branch.
    """
    if softness == 0.0:
        return (x > 0).to(x.dtype)
    return torch.sigmoid(x / softness)
