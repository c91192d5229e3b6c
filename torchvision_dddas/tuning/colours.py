"""Ranges of landmarks' colours from pictures in which they are labelled: hue, saturation and value by gradient."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.colour_files import overlapping
from torchvision_dddas.tuning.soft_colours import SoftColours, about, confusion
from torchvision_dddas.types import Colours

SOFTNESS = (20.0, 2.0)
"""In levels, at the first and the last step."""

RATE = 1.5
"""Of Adam, in levels."""

MOST_PIXELS = 200_000
"""Of all pictures, that a step takes in; of more, some drawn once, labelled ones first."""


def fit_colours(
    pictures: Sequence[np.ndarray],
    labels: Sequence[np.ndarray],
    names: Sequence[str],
    steps: int = 120,
    seed: int = 0,
    start: Colours | None = None,
) -> Colours:
    """Ranges that hold what is labelled and little else.

    pictures: (H, W, 3) uint8 BGR. labels: (H, W) of each: 0 the ground and all that wears no colour, k the k-th of
    names. start: ranges to begin with; about the mean colours without. The best state is taken, by hard ranges.
    Raises InputError where a colour is labelled nowhere, pictures and labels differ in size, or ranges come out that
    overlap, so that one landmark would be taken for another.
    """
    bgr, worn = _pixels(pictures, labels, len(names), seed)
    soft = about(bgr, worn)
    if start is not None:
        if start.names != tuple(names):
            raise InputError(f"the ranges to begin with are of {', '.join(start.names)}; wanted {', '.join(names)}")
        soft = SoftColours(*(torch.as_tensor(np.array(end, float)) for end in (start.low, start.high)))
    adam = torch.optim.Adam(soft.parameters(), lr=RATE)
    best, least = soft.ranges(), _hard(soft.ranges(), bgr, worn)
    for step in range(steps):
        softness = SOFTNESS[0] * (SOFTNESS[1] / SOFTNESS[0]) ** (step / max(steps - 1, 1))
        adam.zero_grad()
        confusion(soft(bgr, softness), worn).sum().backward()
        adam.step()
        if (wrong := _hard(soft.ranges(), bgr, worn)) < least:
            best, least = soft.ranges(), wrong
    low, high = (end.numpy() for end in best)
    for a, b in overlapping(low, high):
        raise InputError(
            f"the colours of {names[a]} and {names[b]} come out overlapping: these pictures do not tell them apart; "
            "paint one of them anew, or label more pictures"
        )
    return Colours(tuple(names), low, high)


def _hard(ranges: tuple[Tensor, Tensor], bgr: Tensor, worn: Tensor) -> float:
    from torchvision_dddas.functional.hsv import from_bgr, within

    low, high = (end.to(bgr) for end in ranges)
    return float(confusion(within(from_bgr(bgr), low, high), worn).sum())


def _pixels(
    pictures: Sequence[np.ndarray], labels: Sequence[np.ndarray], count: int, seed: int
) -> tuple[Tensor, Tensor]:
    """All pixels as one picture (1, 3, 1, N) in [0, 1], and what they wear (1, K, 1, N)."""
    for number, (picture, label) in enumerate(zip(pictures, labels, strict=True), 1):
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.shape[:2] != label.shape:
            raise InputError(
                f"picture {number} is {' x '.join(map(str, picture.shape))}, its labels "
                f"{' x '.join(map(str, label.shape))}; wanted height x width x 3 (BGR), and labels of that size"
            )
    colour = np.concatenate([picture.reshape(-1, 3) for picture in pictures])
    label = np.concatenate([one.ravel() for one in labels])
    if label.max(initial=0) > count or label.min(initial=0) < 0:
        raise InputError(f"labels go from {label.min()} to {label.max()}; wanted 0 to {count}, for the names given")
    if len(label) > MOST_PIXELS:
        chance = np.random.default_rng(seed).uniform(0, 1, len(label))
        kept = np.sort(np.argsort(np.where(label > 0, chance - 1, chance))[:MOST_PIXELS])
        colour, label = colour[kept], label[kept]
    worn = np.stack([label == k for k in range(1, count + 1)]).astype(np.float32)
    pixels = np.ascontiguousarray(colour.T, np.float32) / 255
    return torch.from_numpy(pixels)[None, :, None], torch.from_numpy(worn)[None, :, None]
