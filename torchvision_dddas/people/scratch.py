"""Large arrays in small memory: pieces of them, and arrays that are used again, as fresh ones cost page faults."""

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


def spans(length: int, most: int) -> list[tuple[int, int]]:
    """(begin, end) of the fewest stretches, of about equal length, that make up the whole."""
    count = -(-length // most)
    return [(length * i // count, length * (i + 1) // count) for i in range(count)]
