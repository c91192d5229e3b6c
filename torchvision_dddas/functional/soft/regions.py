"""Soft gates on the regions of a mask: by their area and by their peak of evidence (appendix B, step S5).

Which pixels hang together is found by labelling the hard mask: it passes no gradient, and is an input here.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torchvision_dddas.functional.threshold import step


def gates(
    mask: Float[Tensor, "B 1 H W"],
    evidence: Float[Tensor, "B 1 H W"],
    labels: Int64[Tensor, "B 1 H W"],
    regions: int,
    min_area_px: float | Tensor,
    peak: float | Tensor,
    softness: float = 0.0,
) -> Float[Tensor, "B R"]:
    """How far each region passes: the sum of its mask is min_area_px at least, and its highest evidence the peak.

    labels: 0 no region, else 1 to regions; pixels of one label are one region. Softness is a share of either bound, so
    that large and small numbers soften alike. A label that no pixel has does not pass.
    """
    batch = mask.shape[0]
    place = labels.reshape(batch, -1)
    area = mask.new_zeros(batch, regions + 1).scatter_add(1, place, mask.reshape(batch, -1))
    seen = evidence.reshape(batch, -1)
    lowest = torch.full_like(area, -torch.inf)
    highest = lowest.scatter_reduce(1, place, seen, "amax")[:, 1:]
    there = highest.isfinite()
    highest = torch.where(there, highest, torch.zeros_like(highest))
    # What equals its bound passes: 1 - step of what is missing.
    large = 1 - step(1 - area[:, 1:] / min_area_px, softness)
    high = 1 - step((peak - highest) / torch.clamp(torch.as_tensor(peak), min=1.0), softness)
    return large * high * there


def of_pixels(gate: Float[Tensor, "B R"], labels: Int64[Tensor, "B 1 H W"]) -> Float[Tensor, "B 1 H W"]:
    """Each pixel's gate; 0 where its label is 0."""
    none = gate.new_zeros(gate.shape[0], 1)  # there may be no region at all
    return torch.cat([none, gate], 1).gather(1, labels.reshape(labels.shape[0], -1)).reshape(labels.shape)
