"""Soft forms of hard steps, which pass gradients. Each form tends to its hard step as softness vanishes.

Softness is a Python number, so that a trace keeps one branch. At 0 each function is the hard step.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int64, Shaped
from torch import Tensor


def step(x: Float[Tensor, "*any"], *, softness: float = 0.0) -> Float[Tensor, "*any"]:
    """Return 1 where x > 0 and 0 elsewhere; with softness above 0, in the unit of x, the sigmoid of x / softness.

    >>> F.step(torch.tensor([-1.0, 1.0])), F.step(torch.tensor([0.0, 1.0]), softness=1.0)
    (tensor([0., 1.]), tensor([0.5000, 0.7311]))
    """
    if softness == 0.0:
        return (x > 0).to(x.dtype)
    return torch.sigmoid(x / softness)


def straight_through(hard: Shaped[Tensor, "*any"], soft: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Return the hard value, bit for bit, with the gradient of the soft value (Bengio et al. 2013).

    >>> soft = torch.tensor(0.3, requires_grad=True)
    >>> F.straight_through(torch.tensor(1.0), soft).backward()
    >>> soft.grad
    tensor(1.)
    """
    # `hard - soft + soft` would round.
    return _StraightThrough.apply(hard, soft)


def round_straight_through(x: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Return the nearest whole numbers, halves to even, with the gradient of x.

    >>> x = torch.tensor(2.6, requires_grad=True)
    >>> F.round_straight_through(x).backward()
    >>> F.round_straight_through(x).item(), x.grad
    (3.0, tensor(1.))
    """
    return straight_through(x.detach().round(), x)


class _StraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: object, hard: Tensor, soft: Tensor) -> Tensor:
        return hard.to(soft.dtype, copy=True)

    @staticmethod
    def backward(ctx: object, *grads: Tensor) -> tuple[None, Tensor]:
        return None, grads[0]


def blend_sizes(size: float | Tensor, operation: Callable[[int], Tensor], *, lowest: int = 1, pitch: int = 1) -> Tensor:
    """Apply an operation at a fractional size: interpolate its results for the sizes on either side.

    size: a number, or a tensor without axes, which receives the gradient. lowest, pitch: sizes are lowest, lowest +
    pitch, ...; 1 and 2 for odd sizes.

    >>> F.blend_sizes(2.25, lambda size: torch.tensor(float(size)))
    tensor(2.2500)
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


def gate_regions(
    mask: Float[Tensor, "B 1 H W"],
    evidence: Float[Tensor, "B 1 H W"],
    labels: Int64[Tensor, "B 1 H W"],
    regions: int,
    min_area_px: float | Tensor,
    peak: float | Tensor,
    *,
    softness: float = 0.0,
) -> Float[Tensor, "B R"]:
    """Return how far each region passes: its mask must sum to min_area_px, and its evidence must reach `peak`.

    Regions are labelled on the hard mask, which passes no gradient.
    labels: 0 for no region, else 1 to `regions`; pixels of one label form one region. Softness is a share of each
    bound, so that large and small numbers soften alike. A label without pixels does not pass.

    >>> mask = torch.ones(1, 1, 1, 4)
    >>> labels = torch.tensor([1, 1, 1, 2]).reshape(1, 1, 1, 4)
    >>> F.gate_regions(mask, 9 * mask, labels, 2, min_area_px=2, peak=7)
    tensor([[1., 0.]])
    """
    batch = mask.shape[0]
    place = labels.reshape(batch, -1)
    area = mask.new_zeros(batch, regions + 1).scatter_add(1, place, mask.reshape(batch, -1))
    seen = evidence.reshape(batch, -1)
    lowest = torch.full_like(area, -torch.inf)
    highest = lowest.scatter_reduce(1, place, seen, "amax")[:, 1:]
    there = highest.isfinite()
    highest = torch.where(there, highest, torch.zeros_like(highest))
    # A value equal to its bound passes: 1 - step of the missing amount.
    large = 1 - step(1 - area[:, 1:] / min_area_px, softness=softness)
    high = 1 - step((peak - highest) / torch.clamp(torch.as_tensor(peak), min=1.0), softness=softness)
    return large * high * there


def gates_of_pixels(gate: Float[Tensor, "B R"], labels: Int64[Tensor, "B 1 H W"]) -> Float[Tensor, "B 1 H W"]:
    """Return the gate of each pixel's region; 0 where the label is 0.

    >>> F.gates_of_pixels(torch.tensor([[1.0, 0.5]]), torch.tensor([0, 1, 2]).reshape(1, 1, 1, 3)).flatten()
    tensor([0.0000, 1.0000, 0.5000])
    """
    none = gate.new_zeros(gate.shape[0], 1)  # there may be no region
    return torch.cat([none, gate], 1).gather(1, labels.reshape(labels.shape[0], -1)).reshape(labels.shape)


def may_branch(on: Tensor) -> bool:
    """Return whether Python may branch on a tensor's values: not in a trace, nor on a GPU, where the host would wait.

    >>> F.may_branch(torch.ones(1))
    True
    """
    return on.device.type == "cpu" and not is_traced()


def all_true(condition: Tensor) -> bool:
    """Return whether to stop early because a condition holds everywhere. False if Python may not branch."""
    return may_branch(condition) and bool(condition.all())


def is_traced() -> bool:
    """Return whether a graph is being traced, in which all data must take the same path.

    >>> F.is_traced()
    False
    """
    return bool(torch.compiler.is_compiling() or torch.jit.is_tracing())  # type: ignore[attr-defined]
