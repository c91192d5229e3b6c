"""How alike targets of two or three frames are: the generalised Jaccard coefficient (appendix C, eq. 1, 4, 5).

Features are non-negative vectors, (B, N, D): box centres in pixels from the picture's corner (D = 2), or histograms (D
= 768). Frames with fewer targets are padded. The affinity of a padded target is 0, and so is the affinity of two
vectors of zeros. `tracking.source_tracker` computes the same for one window without torch.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def pair_affinity(
    a: Float[Tensor, "B N D"], b: Float[Tensor, "B M D"], a_valid: Bool[Tensor, "B N"], b_valid: Bool[Tensor, "B M"]
) -> Float[Tensor, "B N M"]:
    """Return S = Σ min / Σ max of each pair, in [0, 1].

    >>> a, b = torch.tensor([[[1.0, 3.0]]]), torch.tensor([[[2.0, 2.0]]])
    >>> there = torch.ones(1, 1, dtype=torch.bool)
    >>> F.pair_affinity(a, b, there, there)
    tensor([[[0.6000]]])
    """
    return _divide(*_sums(a, b), a_valid[..., :, None] & b_valid[..., None, :])


def triplet_affinity(
    a: Float[Tensor, "B N D"],
    b: Float[Tensor, "B M D"],
    c: Float[Tensor, "B L D"],
    a_valid: Bool[Tensor, "B N"],
    b_valid: Bool[Tensor, "B M"],
    c_valid: Bool[Tensor, "B L"],
) -> Float[Tensor, "B N M L"]:
    """Return (numerators of (a, b) and (b, c), summed) / (their denominators, summed): eq. 4 and 5, newest frame first.

    >>> a, b, c = (torch.tensor([[[1.0, 3.0]]]) for _ in range(3))
    >>> there = torch.ones(1, 1, dtype=torch.bool)
    >>> F.triplet_affinity(a, b, c, there, there, there)
    tensor([[[[1.]]]])
    """
    valid = a_valid[..., :, None, None] & b_valid[..., None, :, None] & c_valid[..., None, None, :]
    both = zip(_sums(a, b), _sums(b, c), strict=True)
    smaller, larger = (first[..., None] + second[..., None, :, :] for first, second in both)
    return _divide(smaller, larger, valid)


def _sums(
    a: Float[Tensor, "B N D"], b: Float[Tensor, "B M D"]
) -> tuple[Float[Tensor, "B N M"], Float[Tensor, "B N M"]]:
    """Return numerator Σ min(a, b) and denominator Σ max(a, b) of each pair.

    Because min + max = a + b and max - min = |a - b|, both follow from one distance, without a (B, N, M, D) tensor.
    """
    total = a.sum(-1)[..., :, None] + b.sum(-1)[..., None, :]
    # ONNX has no L1 distance of all pairs, so an exported graph does hold a (B, N, M, D) tensor.
    exported = torch.compiler.is_compiling()
    apart = (a[..., :, None, :] - b[..., None, :, :]).abs().sum(-1) if exported else torch.cdist(a, b, p=1.0)
    return ((total - apart) / 2).clamp(min=0), (total + apart) / 2


def _divide(smaller: Tensor, larger: Tensor, valid: Tensor) -> Tensor:
    there = valid & (larger > 0)
    # The inner `where` prevents 0 / 0 in the gradient.
    share = smaller / torch.where(there, larger, torch.ones_like(larger))
    return torch.where(there, share, torch.zeros_like(share))
