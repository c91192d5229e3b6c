"""The grid that spreads keypoints over the picture: the same for every back end."""

import math

from torchvision_dddas.config import RegistrationParameters


def cell_side(width: int, height: int, parameters: RegistrationParameters) -> int:
    """Side of the grid cells, in pixels, that keeps the number of keypoints within the budget."""
    return max(parameters.cell_px, math.ceil(math.sqrt(width * height / parameters.keypoints)))
