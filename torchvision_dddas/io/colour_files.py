"""The colours of landmarks in TOML files, and a picture that shows them.

Ranges of hue (0 to 180), saturation and value (0 to 255):

[red]                     # the landmark's name; `dddas colours` finds the ranges in a picture
low = [172, 90, 60]       # a hue above the one of `high`: the range goes over 0
high = [8, 255, 255]
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.config import format_toml, read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.colours import CalibratedColours, find_overlaps, mask_range, to_hsv
from torchvision_dddas.io.overlay import label, line_width, rectangle
from torchvision_dddas.types import Colours

HIGHEST = (180, 255, 255)
"""Of hue, saturation and value; the lowest is 0. A hue of 180 is that of 0."""


def read_colours(path: str | Path) -> Colours:
    """Read the ranges, in the file's order.

    Raises InputError with the file and the name: unreadable, no TOML, no colours, low or high missing or no three whole
    numbers in range, lowest saturation or value above the highest, two ranges that overlap.
    """
    content = read_toml(path, "colours")
    if not content:
        raise InputError(f"colours {path} names no colour; wanted [name] with low and high, as `dddas colours` writes")
    ends = np.array([_range(name, given, path) for name, given in content.items()], np.int64)
    names, low, high = tuple(content), ends[:, 0], ends[:, 1]
    for a, b in find_overlaps(low, high):
        raise InputError(
            f"colours {path}: {names[a]} and {names[b]} overlap in hue, saturation and value; wanted ranges of their "
            "own, so that each landmark differs from the others"
        )
    return Colours(names, low, high)


def _range(name: str, given: Any, path: str | Path) -> list[list[int]]:
    if not isinstance(given, dict) or {"low", "high"} - given.keys():
        raise InputError(f"colours {path}: {name} lacks low or high; wanted both, each [hue, saturation, value]")
    if more := sorted(given.keys() - {"low", "high"}):
        raise InputError(f"colours {path}: {name} has {more[0]}, which no colour has; there are low and high")
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
                f"colours {path}: {name}'s lowest {axis} {first} is above its highest {last}; only a hue may go over 0"
            )
    return [low, high]


def format_colours(colours: Colours) -> str:
    """A table a landmark, as `read_colours` wants it."""
    ranges = zip(colours.names, colours.low.tolist(), colours.high.tolist(), strict=True)
    comment = "Ranges of hue (0 to 180), saturation and value (0 to 255); a range from 172 to 8 goes over 0."
    return format_toml({name: {"low": low, "high": high} for name, low, high in ranges}, [comment])


def draw_calibration(images: Sequence[np.ndarray], found: CalibratedColours) -> bytes:
    """A PNG of all pictures, one below the other: grey but where a range marks it, each landmark named.

    A range is outlined in its colour.
    """
    ranges = found.ranges
    # A bright BGR colour for each range: that of the middle of its hues.
    low, high = ranges.low[:, 0], ranges.high[:, 0]
    vivid = np.full((1, len(low), 3), 255, np.uint8)
    vivid[0, :, 0] = (low + (high - low) % 180 / 2) % 180
    shades = [(b, g, r) for b, g, r in cv2.cvtColor(vivid, cv2.COLOR_HSV2BGR)[0].tolist()]
    sheets = []
    for number, image in enumerate(images):
        hsv = to_hsv(image)
        masks = np.stack([mask_range(hsv, *ends) for ends in zip(ranges.low, ranges.high, strict=True)])
        is_marked, thick = masks.any(axis=0), line_width(image)
        sheet = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) // 2 + 40, cv2.COLOR_GRAY2BGR)
        sheet[is_marked] = image[is_marked]
        for name, mask, shade, group in zip(ranges.names, masks, shades, found.groups, strict=True):
            grown = cv2.dilate(mask, np.ones((2 * thick + 1,) * 2, np.uint8))
            sheet[(grown > 0) & ~is_marked] = shade
            for sighting in group:
                if sighting.picture == number:
                    around = np.array(sighting.box_px, float) + 4 * thick * np.array([-1, -1, 2, 2])
                    rectangle(sheet, around, shade, thick)
                    label(sheet, around, name, shade)
        width = images[0].shape[1]
        sheets.append(cv2.resize(sheet, (width, max(round(sheet.shape[0] * width / sheet.shape[1]), 1))))
    return cv2.imencode(".png", np.concatenate(sheets))[1].tobytes()
