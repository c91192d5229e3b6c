"""From windows that score to people: one box each, drawn around the body, with a probability."""

from typing import Any

import numpy as np

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.people.suppression import group, nms, settled
from torchvision_dddas.types import Float, People

# A body that comes so near to the picture's border, in its own heights, may be cut by it: twice what foot rows miss by.
_NEAR = 0.05

# Arrays here, tensors where parameters are tuned by gradient: one formula for both.
Column = Any
Share = Any


def people_of(
    window_px: Float[np.ndarray, "N 4"],
    margin: Float[np.ndarray, " N"],
    size: tuple[int, int],
    parameters: PeopleParameters,
) -> People:
    """The people whom windows show, best first. size: (width, height) of the picture."""
    window_px, margin = np.asarray(window_px, float).reshape(-1, 4), np.asarray(margin, float)
    if parameters.suppression == "nms":
        kept = nms(body(window_px, parameters), margin, parameters.overlap, parameters.contained)
        # The best windows are the best placed ones: cubed, so that those that hardly passed say little.
        window_px = settled(window_px, (margin - parameters.threshold) ** 3, kept, parameters.settle)
        margin = margin[kept]
    else:
        if parameters.suppression == "opencv":
            window_px, margin = group(window_px, margin, parameters.group, parameters.group_distance)
        order = np.argsort(-margin, kind="stable")
        window_px, margin = window_px[order], margin[order]
    box_px = body(window_px, parameters)
    return People(box_px, probability(margin, parameters), margin, cut(box_px, size), window_px)


def body(window_px: Float[np.ndarray, "N 4"], parameters: PeopleParameters) -> Float[np.ndarray, "N 4"]:
    """The body's box in a window, by ratios that were calibrated on true boxes."""
    x, y, width, height = window_px.T
    sides = body_sides(x, y, width, height, parameters.height_share, parameters.width_share, parameters.feet_share)
    return np.stack(sides, axis=1)


def body_sides(
    x: Column, y: Column, width: Column, height: Column, height_share: Share, width_share: Share, feet_share: Share
) -> tuple[Column, Column, Column, Column]:
    """The same by columns: left, top, width, height of the body, in the kind of number that is given."""
    wide, tall = width_share * width, height_share * height
    return x + (width - wide) / 2, y + feet_share * height - tall, wide, tall


def probability(margin: Float[np.ndarray, " N"], parameters: PeopleParameters) -> Float[np.ndarray, " N"]:
    """That a window of this score shows a person (Platt scaling)."""
    return 1 / (
        1 + np.exp(-np.clip(log_odds(margin, parameters.probability_slope, parameters.probability_even), -50, 50))
    )


def log_odds(margin: Column, slope: Share, even: Share) -> Column:
    """Of that probability, in the kind of number that is given."""
    return slope * (margin - even)


def cut(box_px: Float[np.ndarray, "N 4"], size: tuple[int, int]) -> np.ndarray:
    """(N,) bool: the picture's border cuts the body, or comes so near that it may."""
    near = _NEAR * box_px[:, 3:]
    low, high = box_px[:, :2], box_px[:, :2] + box_px[:, 2:]
    return (low < near).any(axis=1) | (high > np.array(size) - near).any(axis=1)
