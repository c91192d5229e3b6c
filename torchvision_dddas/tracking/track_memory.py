"""Which tracks are still worth remembering: the gate in time."""

import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace
from torchvision_dddas.tracking.kalman import SEEN, VX, VY, X, Y

_LEAVING = 15  # frames for which a target is taken to go on as it went


def remembered(
    state: np.ndarray, frame: int, interval: int, size: tuple[float, float] | None, parameters: TrackParameters
) -> np.ndarray:
    """(N,) which tracks (N, kalman.COLUMNS) are remembered after a frame; whoever has left is so for a shorter time.

    interval: frames between looks. size: (width, height) of the picture, None if unknown. Arrays or tensors.
    """
    functions = namespace(state)
    age = frame - state[..., SEEN]
    keep = age <= parameters.memory_frames
    if size is None:
        return keep
    # Later a target may as well have stopped or turned before it reached the border.
    going = functions.clip(age, None, _LEAVING)
    x, y = state[..., X] + going * state[..., VX], state[..., Y] + going * state[..., VY]
    outside = (x < 0) | (x > size[0]) | (y < 0) | (y > size[1])
    return keep & (~outside | (age <= parameters.memory_outside_frames) | (age <= interval))
