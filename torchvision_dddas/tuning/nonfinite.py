"""Where a loss is no number: which clip, frame and parameter it comes from."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchvision_dddas.tuning.family import Example, Family


def blamed(
    family: Family,
    batch: Sequence[Example],
    values: Mapping[str, Tensor],
    before: Sequence[Mapping[str, Tensor]],
    softness: float,
    size: int = 8,
) -> str:
    """In words, the first example whose loss or slope is no number, and the parameter; empty where all are numbers.

    values: the parameters now; before: as they were at other times, those that are most like now first. A parameter is
    to blame whose value alone, taken back, makes the loss a number, or whose slope is none. size: examples at once.
    """
    if all(_finite(family, batch[i : i + size], values, softness) for i in range(0, len(batch), size)):
        return _by_slope(family, batch, values, softness)
    example = next((one for one in batch if not _finite(family, [one], values, softness)), None)
    if example is None:
        return f"the loss of {family.name} is no number for {batch[0].clip}, frame {batch[0].frame} and those beside it"
    where = f"the loss of {family.name} is no number for {example.clip}, frame {example.frame}"
    good = next((known for known in before if _finite(family, [example], known, softness)), None)
    if good is None:
        return f"{where}, whatever the parameters"
    guilty = [name for name in values if _finite(family, [example], {**values, name: good[name]}, softness)]
    told = ", ".join(f"{name} = {float(values[name].detach()):.6g}" for name in guilty or values)
    return f"{where}, with {told}"


def _by_slope(family: Family, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> str:
    if not any(value.requires_grad for value in values.values()):
        return ""
    for example in batch:
        leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        loss = family.loss(leaves, [example], softness).sum()
        if not loss.requires_grad:
            continue
        slopes = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        for (name, value), slope in zip(leaves.items(), slopes, strict=True):
            if slope is not None and not bool(torch.isfinite(slope).all()):
                where = f"{example.clip}, frame {example.frame}"
                return f"the slope of the loss in {name} = {float(value.detach()):.6g} is no number for {where}"
    return ""


def _finite(family: Family, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> bool:
    with torch.no_grad():
        return bool(torch.isfinite(family.loss(values, batch, softness)).all())
