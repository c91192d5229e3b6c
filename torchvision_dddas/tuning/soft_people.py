"""What parameters make of the windows that the recognizer scores: probabilities, bodies' boxes, who counts as found.

The formulas are those of `targets.persons`, on tensors. HOG, the classifier and the suppression of neighbours have no
parameter here: a greedy suppression of less than the best keeps the same windows at any threshold, but for those below
it.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.functional.threshold import step
from torchvision_dddas.people.boxes import body_sides, log_odds

Parameters = Mapping[str, Tensor]


def bodies(window_px: Float[Tensor, "N 4"], parameters: Parameters) -> Float[Tensor, "N 4"]:
    """The bodies' boxes in windows, x, y, width, height, by the parameters height_share, width_share and feet_share."""
    shares = (parameters[f"people.{name}_share"] for name in ("height", "width", "feet"))
    return torch.stack(body_sides(*window_px.unbind(1), *shares), 1)


def doubt(margin: Float[Tensor, " N"], right: Float[Tensor, " N"], parameters: Parameters) -> Float[Tensor, " N"]:
    """Negative log-likelihood, in nats, of detections of these scores being right (1) or wrong (0).

    By the parameters probability_slope and probability_even: least where probabilities are the shares that are right.
    """
    odds = log_odds(margin, parameters["people.probability_slope"], parameters["people.probability_even"])
    return functional.binary_cross_entropy_with_logits(odds, right, reduction="none")


def soft_f(
    margin: Float[Tensor, " N"], right: Float[Tensor, " N"], people: int, threshold: Tensor, softness: float
) -> Float[Tensor, ""]:
    """F1 of the detections of one picture that score above a threshold; 1 where nobody is there and none is found.

    people: how many there truly are. softness: in units of the score; 0: the hard figure.
    """
    counts = step(margin - threshold, softness)
    found = counts.sum()
    nobody = torch.zeros_like(found) + (people == 0)
    return (2 * (counts * right).sum() + nobody * _SPARE) / (found + people + nobody * _SPARE)


_SPARE = 1.0
"""Found in a picture without people: the more there are the worse, and none is right."""
