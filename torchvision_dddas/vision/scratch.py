"""Arrays that are used again: fresh ones of this size cost page faults, which took a fifth of the time onboard."""

import math

import numpy as np


class Scratch:
    """Arrays by name; each is what it was given last, until it is asked for again. One object a thread."""

    def __init__(self) -> None:
        self.held: dict[str, np.ndarray] = {}

    def __call__(self, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        """A contiguous array of any content."""
        size = math.prod(shape)
        held = self.held.get(name)
        if held is None or held.size < size or held.dtype != dtype:
            held = self.held[name] = np.empty(size, dtype)
        return held[:size].reshape(shape)
