"""Read and write the colours of landmarks as TOML.

Ranges of hue (0 to 180), saturation and value (0 to 255):

[red]                     # the landmark's name; `dddas colours` finds the ranges in a picture
low = [172, 90, 60]       # if the hue exceeds that of `high`, the range wraps around 0
high = [8, 255, 255]
"""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.config import format_toml, read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Colours

HIGHEST = (180, 255, 255)
"""Largest hue, saturation and value; the smallest are 0. A hue of 180 equals a hue of 0."""


def read_colours(path: str | Path) -> Colours:
    r"""Read the ranges of colours, in the file's order.

    Raise InputError with the file and the name if the file is unreadable, not TOML or empty, if low or high is not
    three whole numbers in range, if a lowest saturation or value is above the highest, or if two ranges overlap.

    >>> written = pathlib.Path("colours.toml").write_text("[red]\nlow = [170, 80, 80]\nhigh = [10, 255, 255]\n")
    >>> td.read_colours("colours.toml").names
    ('red',)
    """
    content = read_toml(path, "colours")
    if not content:
        raise InputError(f"colours {path} names no colour; give [name] with low and high, as `dddas colours` writes")
    ends = np.array([_range(name, given, path) for name, given in content.items()], np.int64)
    names, low, high = tuple(content), ends[:, 0], ends[:, 1]
    for a, b in find_overlaps(low, high):
        raise InputError(
            f"colours {path}: {names[a]} and {names[b]} overlap in hue, saturation and value; give separate ranges, "
            "so that each landmark differs from the others"
        )
    return Colours(names, low, high)


def _range(name: str, given: Any, path: str | Path) -> list[list[int]]:
    if not isinstance(given, dict) or {"low", "high"} - given.keys():
        raise InputError(f"colours {path}: {name} lacks low or high; wanted both, each [hue, saturation, value]")
    if more := sorted(given.keys() - {"low", "high"}):
        raise InputError(f"colours {path}: {name} has the unknown key {more[0]}; the keys are low and high")
    low, high = given["low"], given["high"]
    for end, values in (("low", low), ("high", high)):
        whole = isinstance(values, list) and all(type(v) is int for v in values)
        if not whole or len(values) != 3 or not all(0 <= v <= most for v, most in zip(values, HIGHEST, strict=True)):
            raise InputError(
                f"colours {path}: {name}.{end} is {str(values)[:60]}; wanted [hue, saturation, value], whole numbers "
                "from 0 to 180, 255 and 255"
            )
    for axis, first, last in zip(("saturation", "value"), low[1:], high[1:], strict=True):
        if first > last:
            raise InputError(
                f"colours {path}: {name}'s lowest {axis} {first} is above its highest {last}; only hues may wrap around"
            )
    return [low, high]


def format_colours(colours: Colours) -> str:
    """Return one TOML table for each landmark, in the form that `read_colours` reads."""
    ranges = zip(colours.names, colours.low.tolist(), colours.high.tolist(), strict=True)
    comment = "Ranges of hue (0 to 180), saturation and value (0 to 255); a range from 172 to 8 wraps around 0."
    return format_toml({name: {"low": low, "high": high} for name, low, high in ranges}, [comment])


def find_overlaps(low: np.ndarray, high: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of ranges, given as (K, 3) lowest and highest values, that share a colour."""
    hues = [
        {hue % 180 for hue in range(first, last + 1 if first <= last else last + 181)}
        for first, last in zip(low[:, 0], high[:, 0], strict=True)
    ]
    return [
        (a, b)
        for a, b in combinations(range(len(low)), 2)
        if hues[a] & hues[b] and (np.maximum(low[a, 1:], low[b, 1:]) <= np.minimum(high[a, 1:], high[b, 1:])).all()
    ]
