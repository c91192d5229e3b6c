"""Plane homographies from landmarks (appendix A, IV-B)."""

from jaxtyping import Bool, Float
from torch import Tensor, nn

import torchvision_dddas.functional as F


class PlaneHomography(nn.Module):
    """A module of `functional.find_homography`, from ground to image.

    >>> ground = torch.tensor([[[0.0, 0], [1, 0], [0, 1], [1, 1]]])
    >>> image_from_ground, valid = nn.PlaneHomography()(ground, 100 * ground + 20, torch.ones(1, 4))
    >>> image_from_ground[0].round(decimals=3), valid
    (tensor([[100.,   0.,  20.],
            [  0., 100.,  20.],
            [  0.,   0.,   1.]]), tensor([True]))
    """

    def forward(
        self, ground: Float[Tensor, "B n 2"], image: Float[Tensor, "B n 2"], weight: Float[Tensor, "B n"]
    ) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B"]]:
        """Return image_from_ground, and whether each is valid. weight: of a landmark's squared error; 0 ignores it."""
        return F.find_homography(ground, image, weight)
