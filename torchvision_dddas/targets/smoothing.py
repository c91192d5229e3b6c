"""Where a target was, once its next few boxes are known too."""

import numpy as np

from torchvision_dddas.targets.kalman import carried_boxes

_PLACE_LOOKS, _SIZE_LOOKS = 2.0, 5.0  # sd of the weights: sizes change more slowly than places


def smoothed(box_px: np.ndarray, looks: np.ndarray, at: float) -> np.ndarray:
    """The box (4,) at a time, by straight lines fitted to boxes (N, 4) around it; the sides by their logarithm.

    looks: (N,) times of the boxes, counted in looks. Weights are Gaussian, so the fit is local.
    """
    since = looks - at
    centre = _line(box_px[:, :2] + box_px[:, 2:] / 2, since, _PLACE_LOOKS)
    size = np.exp(_line(np.log(box_px[:, 2:]), since, _SIZE_LOOKS))
    return np.concatenate([centre - size / 2, size])


def _line(value: np.ndarray, since: np.ndarray, width: float) -> np.ndarray:
    """Value (N, D) at 0 of a weighted line; a faint pull to no slope decides where the times say nothing of it."""
    weight = np.exp(-0.5 * (since / width) ** 2)
    once, twice = weight @ since, weight @ since**2 + 1e-3 * width**2
    total = weight.sum()
    return (twice * weight - once * weight * since) @ value / (total * twice - once**2)


def between(before_px: np.ndarray, after_px: np.ndarray, part: float) -> np.ndarray:
    """The box (4,) a part of the way from one to another."""
    return before_px + part * (after_px - before_px)


def seen_from(box_px: np.ndarray, here_from_there: np.ndarray | None) -> np.ndarray:
    """A box (4,) of another look in the coordinates of this one; None: the camera stood still."""
    return box_px if here_from_there is None else carried_boxes(box_px[None], here_from_there)[0]
