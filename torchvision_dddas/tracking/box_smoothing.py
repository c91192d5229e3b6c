"""Where a target was, once its next few boxes are known too."""

from functools import lru_cache

import numpy as np

from torchvision_dddas.tracking.kalman import carried_boxes

_WIDTHS = np.array([[2.0], [5.0]])  # sd of the weights of places and sizes: sizes change more slowly


def smoothed(box_px: np.ndarray, looks: np.ndarray, at: float) -> np.ndarray:
    """The box (4,) at a time, by straight lines fitted to boxes (N, 4) around it; the sides by their logarithm.

    looks: (N,) times of the boxes, counted in looks. Weights are Gaussian, so the fit is local; a faint pull to no
    slope decides where the times say nothing of it.
    """
    place, size = _weights(tuple((looks - at).tolist()))
    centre = place @ (box_px[:, :2] + box_px[:, 2:] / 2)
    side = np.exp(size @ np.log(box_px[:, 2:]))
    return np.concatenate([centre - side / 2, side])


@lru_cache(maxsize=1024)
def _weights(since: tuple[float, ...]) -> np.ndarray:
    """(2, N) what each box counts for the place and for the size; few patterns of times come up again and again."""
    time = np.array(since)
    weight = np.exp(-0.5 * (time / _WIDTHS) ** 2)
    total = weight.sum(axis=1, keepdims=True)
    once = (weight @ time)[:, None]
    twice = (weight @ time**2)[:, None] + 1e-3 * _WIDTHS**2
    return (twice - once * time) * weight / (total * twice - once**2)


def between(before_px: np.ndarray, after_px: np.ndarray, part: float) -> np.ndarray:
    """The box (4,) a part of the way from one to another."""
    return before_px + part * (after_px - before_px)


def seen_from(box_px: np.ndarray, here_from_there: np.ndarray | None) -> np.ndarray:
    """A box (4,) of another look in the coordinates of this one; None: the camera stood still."""
    return box_px if here_from_there is None else carried_boxes(box_px[None], here_from_there)[0]
