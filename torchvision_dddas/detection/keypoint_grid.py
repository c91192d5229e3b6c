"""The grid that spreads keypoints over the picture: the same for every back end."""

import math

from torchvision_dddas.config import RegistrationKnobs


def cell_side(width: int, height: int, knobs: RegistrationKnobs) -> int:
    """Side of the grid cells, in pixels, that keeps the number of keypoints within the budget."""
    return max(knobs.cell_px, math.ceil(math.sqrt(width * height / knobs.keypoints)))
