"""Motion history: when each place last moved, in the coordinates of the current reference frame (appendix B, step S5).

Stamps are seconds above 0; 0 means "not within the duration". The history moves with the camera (`carry`), which the
source does not say.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.functional.morphology import dilate, erode
from torchvision_dddas.functional.warp import warp

Seconds = float | Float[Tensor, "B"]


def update(
    history: Float[Tensor, "B 1 H W"], silhouette: Float[Tensor, "B 1 H W"], now_s: Seconds, duration_s: Seconds
) -> Float[Tensor, "B 1 H W"]:
    """Now where the silhouette is above one half, 0 where the stamp is older than the duration, else unchanged."""
    now, duration = _each(now_s, history), _each(duration_s, history)
    kept = torch.where(history < now - duration, torch.zeros_like(history), history)
    return torch.where(silhouette > 0.5, now.expand_as(history), kept)


def carry(
    history: Float[Tensor, "B 1 H W"], reference_from_previous: Float[Tensor, "B 3 3"]
) -> Float[Tensor, "B 1 H W"]:
    """The history in the new reference frame: stamps come from the nearest pixel, for a mean of times is no time."""
    return warp(history, reference_from_previous, nearest=True)[0]


def gradient(
    history: Float[Tensor, "B 1 H W"], delta_min_s: Seconds, delta_max_s: Seconds, aperture: int = 3
) -> tuple[Float[Tensor, "B 1 H W"], Bool[Tensor, "B 1 H W"]]:
    """Direction of motion (radians, 0 = right, pi/2 = down) and where it may be believed.

    A Sobel gradient over aperture x aperture pixels (odd), edges repeated; valid where the stamps under the aperture
    span at least delta_min_s and at most delta_max_s. Source: OpenCV's calcMotionGradient, which the source used.
    """
    smooth, slope = _sobel(aperture)
    along_u = _separable(history, smooth, slope)
    along_v = _separable(history, slope, smooth)
    span = dilate(history, aperture) - erode(history, aperture)
    steep = torch.maximum(along_u.abs(), along_v.abs()) > 1e-4 * aperture**2
    valid = steep & (span >= _each(delta_min_s, history)) & (span <= _each(delta_max_s, history))
    return torch.where(valid, torch.atan2(along_v, along_u), torch.zeros_like(history)), valid


def region_orientation(
    orientation_rad: Float[Tensor, "B 1 H W"],
    valid: Bool[Tensor, "B 1 H W"],
    history: Float[Tensor, "B 1 H W"],
    regions: Bool[Tensor, "B R H W"],
    now_s: Seconds,
    duration_s: Seconds,
) -> tuple[Float[Tensor, "B R"], Bool[Tensor, "B R"]]:
    """Mean direction of each region, in radians, and whether it has one: a weighted circular mean of valid gradients.

    A stamp weighs 1 when new and falls to 0 at the duration. Opposite directions that cancel give no direction.
    """
    age = (_each(now_s, history) - history) / _each(duration_s, history)
    weight = ((1.0 - age).clamp(0.0, 1.0) * valid).flatten(2)
    angle = orientation_rad.flatten(2)
    vectors = torch.cat([weight * angle.cos(), weight * angle.sin(), weight], 1)
    cos, sin, total = (vectors @ regions.flatten(2).to(history.dtype).mT).unbind(1)
    found = cos.square() + sin.square() > (1e-3 * total.clamp(min=1e-6)).square()
    return torch.where(found, torch.atan2(sin, cos), torch.zeros_like(cos)), found


def _each(value: Seconds, like: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).reshape(-1, 1, 1, 1)


def _sobel(aperture: int) -> tuple[list[float], list[float]]:
    """Smoothing and differentiating weights of one axis: binomial, and binomial differenced."""
    smooth, slope = [1.0], [-1.0, 0.0, 1.0]
    for _ in range(aperture - 1):
        smooth = [a + b for a, b in zip([*smooth, 0.0], [0.0, *smooth], strict=True)]
    for _ in range(aperture - 3):
        slope = [a + b for a, b in zip([*slope, 0.0], [0.0, *slope], strict=True)]
    return smooth, slope


def _separable(image: Tensor, down: list[float], across: list[float]) -> Tensor:
    reach = len(down) // 2
    padded = torch.nn.functional.pad(image, (reach,) * 4, mode="replicate")
    for dim, weights in ((-2, down), (-1, across)):
        length = padded.shape[dim] - 2 * reach
        terms = [padded.narrow(dim, k, length) * weight for k, weight in enumerate(weights) if weight]
        padded = torch.stack(terms).sum(0)
    return padded
