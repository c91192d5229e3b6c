"""The colours of landmarks as a TOML, and as a picture that shows what each range marks."""

import json
import re
from collections.abc import Sequence

import cv2
import numpy as np

from torchvision_dddas.io.overlay import label, rectangle
from torchvision_dddas.io.overlay.drawing import line_width
from torchvision_dddas.types import Colours


def colours_toml(colours: Colours) -> str:
    """A table a landmark, as `read_colours` wants it."""
    lines = ["# Ranges of hue (0 to 180), saturation and value (0 to 255); a range from 172 to 8 goes over 0.\n"]
    for name, low, high in zip(colours.names, colours.low.tolist(), colours.high.tolist(), strict=True):
        key = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)
        lines.append(f"\n[{key}]\nlow = {low}\nhigh = {high}\n")
    return "".join(lines)


def colours_picture(image: np.ndarray, masks: np.ndarray, colours: Colours, own_px: Sequence[np.ndarray]) -> np.ndarray:
    """(H, W, 3) uint8 BGR: grey but where a range marks it, outlined in the range's colour, its landmark named.

    masks: (K, H, W) uint8 of the ranges. own_px: (P, 4) of each colour, the boxes of its landmark in this picture.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) // 2 + 40
    drawn = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    thick = line_width(image)
    drawn[masks.any(axis=0)] = image[masks.any(axis=0)]
    for name, mask, shade, boxes in zip(colours.names, masks, shades(colours), own_px, strict=True):
        grown = cv2.dilate(mask, np.ones((2 * thick + 1,) * 2, np.uint8))
        drawn[(grown > 0) & ~masks.any(axis=0)] = shade
        for box in boxes:
            around = box + 4 * thick * np.array([-1, -1, 2, 2])
            rectangle(drawn, around, shade, thick)
            label(drawn, around, name, shade)
    return drawn


def shades(colours: Colours) -> list[tuple[int, int, int]]:
    """A bright BGR colour for each range: that of the middle of its hues."""
    low, high = colours.low[:, 0], colours.high[:, 0]
    hue = (low + (high - low) % 180 / 2) % 180
    vivid = np.stack([hue, np.full(len(hue), 255), np.full(len(hue), 255)], axis=1).astype(np.uint8)
    blue_green_red = cv2.cvtColor(vivid[None], cv2.COLOR_HSV2BGR)[0].tolist()
    return [(b, g, r) for b, g, r in blue_green_red]
