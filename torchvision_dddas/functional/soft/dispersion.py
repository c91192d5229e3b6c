"""How far apart a frame's targets are, softened: the cluster entropy of appendix C (III-D, eq. 9) with a slope.

The source cuts a tree of clusters at a dissimilarity G, and its entropy tells how many clusters there are. Here every
target has a neighbourhood: all that lie within the cut, itself among them, each by a soft step. The mean of
log2(N / neighbours) is that entropy wherever the clusters are as far apart as the cut is wide, so that neighbourhoods
are clusters; where a chain joins targets that are farther apart it is larger than the tree's.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.functional.threshold import step


def dispersion(
    apart: Float[Tensor, "*B N N"],
    there: Bool[Tensor, "*B N"],
    cut: Float[Tensor, ""] | float,
    softness: float = 0.0,
) -> Float[Tensor, "*B"]:
    """Ndm in [0, 1]: 1 when every target is alone within the cut, 0 when all are together; 1 for one target or none.

    apart: dissimilarities in [0, 1], 0 of a target to itself. there: which targets are there. softness: of the step at
    the cut, in the dissimilarity's own unit.
    """
    both = there[..., :, None] & there[..., None, :]
    same = torch.eye(apart.shape[-1], dtype=torch.bool, device=apart.device)
    near = torch.where(both, torch.where(same, 1.0, step(cut - apart, softness)), 0.0).sum(-1)
    count = there.sum(-1).to(apart.dtype)
    several = count > 1
    # The inner `where` keeps log 0 and 0 / 0 out of the gradient.
    share = torch.where(there, near, 1.0).log2() / torch.where(several, count, 2.0).log2()[..., None]
    mean = torch.where(there, share, 0.0).sum(-1) / count.clamp(min=1)
    return torch.where(several, 1 - mean, 1.0)
