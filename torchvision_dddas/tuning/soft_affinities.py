"""How wrong links of two frames are expected to be by the source's affinities (appendix C, III), with slopes in knobs.

The formulas are those of `targets.gating`, `targets.dummies` and `targets.dispersion`; what is soft is the threshold of
the gate, the rule that chooses the weight of location, and the assignment (`ops.relax`). Affinities lie in [0, 1] and
are no logarithms of anything: a temperature makes odds of them. Similarities do not depend on a parameter; they are
given.

Left out: three frames at once (K = 3), for which there is no partition function here.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import PaperParameters
from torchvision_dddas.functional.soft.assignment import log_partition
from torchvision_dddas.functional.soft.dispersion import dispersion
from torchvision_dddas.functional.threshold import step
from torchvision_dddas.tracking.gating import raised
from torchvision_dddas.tracking.triplet_scores import pair_gain_over_alone

# Of messages; more change the loss by less than a hundredth where targets crowd.
_ROUNDS = 10

LOCATION, APPEARANCE = 0, 1
"""Places of the two features on their axis."""


@dataclass(frozen=True)
class Windows:
    """W windows of two frames, the newer one's targets (N) as rows, the older one's (M) as columns; float64.

    similarity, alternative: with a dummy first on both axes, as `targets.paper.affinity` and
    `targets.gating.alternatives` have them, of both features. now, before: who is there. true: the true links.
    joined_at: of each two targets of the newer and the older frame, P places each, as `targets.dispersion` has it.
    there: who is. speaks: which of the frames has a say in the dispersion. pictured: whether appearance is known.
    """

    similarity: Float[Tensor, "W 2 N1 M1"]
    alternative: Float[Tensor, "W 2 N1 M1"]
    now: Bool[Tensor, "W N"]
    before: Bool[Tensor, "W M"]
    true: Bool[Tensor, "W N M"]
    joined_at: Float[Tensor, "W 2 2 P P"]
    there: Bool[Tensor, "W 2 P"]
    speaks: Bool[Tensor, "W 2"]
    pictured: Bool[Tensor, "W"]


def unlikeliness(parameters: PaperParameters, windows: Windows, softness: float) -> Float[Tensor, "W"]:
    """Minus the logarithm of the true links' probability: nats a window.

    parameters: numbers or tensors; `gated` must be features. softness: above 0, of an affinity: by how much an
    assignment is worse that is e times less likely, and the width of the gate's threshold and of the rule's.
    """
    score = _possible(link_gains(parameters, windows, softness), windows)
    told = torch.where(windows.true, score, 0.0).sum((1, 2))
    return (log_partition(score, softness, _ROUNDS) - told) / softness


def wrong_links(parameters: PaperParameters, windows: Windows, softness: float) -> Float[Tensor, "W"]:
    """How many targets of the newer frame are expected to be linked wrongly, or not though they were there before.

    As softness vanishes it is how many the best assignment links wrongly. What is expected of a sum over links is the
    slope of the log-partition along it, taken here as a difference over one softness: between the slopes at its ends,
    so that a link that no parameter can save counts once and no more. parameters, softness: as in `unlikeliness`.
    """
    score = _possible(link_gains(parameters, windows, softness), windows)
    known = windows.true.any(2, keepdim=True)
    # Beside one wrong for each who was there before: a true link is one less, any of a newcomer one more.
    more = torch.where(windows.true, -1.0, torch.where(known, 0.0, 1.0)).to(score)
    with_more, plain = (log_partition(each, softness, _ROUNDS) for each in (score + softness * more, score))
    return known.sum((1, 2)) + (with_more - plain) / softness


def _possible(score: Float[Tensor, "W N M"], windows: Windows) -> Float[Tensor, "W N M"]:
    return score.masked_fill(~(windows.now[:, :, None] & windows.before[:, None]), -torch.inf)


def link_gains(parameters: PaperParameters, windows: Windows, softness: float = 0.0) -> Float[Tensor, "W N M"]:
    """What each link is worth above leaving both targets with nobody; any number where one is not there."""
    weight = location_weight(parameters, windows, softness)
    share = torch.stack([weight, 1 - weight], 1)[:, :, None, None]
    how_far = step(1 - parameters.threshold - windows.alternative, softness).to(windows.similarity)
    gain: Tensor = pair_gain_over_alone((share * raised(windows.similarity, how_far, parameters.threshold)).sum(1))
    return gain


def location_weight(parameters: PaperParameters, windows: Windows, softness: float = 0.0) -> Float[Tensor, "W"]:
    """The weight of location: that of `targets.dispersion.location_weight` as softness vanishes, or the fixed one."""
    if parameters.rule == "fixed":
        fixed = torch.as_tensor(parameters.weight).to(windows.similarity)
        return torch.where(windows.pictured, fixed, 1.0)
    by_location, by_appearance = (
        step(_of_window(windows, feature, cut, softness) - parameters.lowest_dispersion, softness)
        for feature, cut in ((LOCATION, parameters.location_cut), (APPEARANCE, parameters.appearance_cut))
    )
    return torch.where(windows.pictured, by_location + (1 - by_location) * (1 - by_appearance) / 2, 1.0)


def _of_window(windows: Windows, feature: int, cut: float | Tensor, softness: float) -> Float[Tensor, "W"]:
    """The smallest dispersion of the frames that have a say."""
    of_frames = dispersion(windows.joined_at[:, feature], windows.there, cut, softness)
    return of_frames.masked_fill(~windows.speaks, torch.inf).amin(1)
