"""Boxes, labels and captions that OpenCV draws, wherever they lie; the colours of overlays and maps."""

from collections.abc import Sequence

import cv2
import numpy as np

Colour = tuple[int, int, int]
"""Blue, green, red."""

TEXT: Colour = (255, 255, 255)
WARNING: Colour = (60, 60, 255)
_GOLDEN_DEG = 137.508  # neighbours in number are far apart in hue, for any count of them


def identity_colour(identity: int) -> Colour:
    """The colour of an identity, the same in every frame and on maps."""
    hue = identity * _GOLDEN_DEG % 360 / 2
    value = 255 - 55 * (identity // 5 % 2)
    (blue, green, red), *_ = cv2.cvtColor(np.array([[[hue, 200, value]]], np.uint8), cv2.COLOR_HSV2BGR)[0].tolist()
    return blue, green, red


def colour_picture(image: np.ndarray) -> np.ndarray:
    """A copy of a grey or colour image, (H, W, 3) uint8 BGR, to draw on."""
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()


def line_width(picture: np.ndarray) -> int:
    """Pixels that suit a picture's size."""
    return max(1, round(picture.shape[0] / 480))


def drawable(points: np.ndarray) -> np.ndarray:
    """Whole pixels that OpenCV can draw; places far outside are moved nearer."""
    return np.clip(np.nan_to_num(points), -30_000, 30_000).round().astype(np.int32)


def rectangle(picture: np.ndarray, box: np.ndarray, colour: Colour, thick: int) -> None:
    """Draw a box (x, y, width, height)."""
    x, y, right, bottom = drawable(np.array([*box[:2], *(box[:2] + box[2:])])).tolist()
    cv2.rectangle(picture, (x, y), (right - 1, bottom - 1), colour, thick)


def label(picture: np.ndarray, box: np.ndarray, text: str, colour: Colour) -> None:
    """Write a text on a patch of a colour, above the box where there is room."""
    scale, thick = max(picture.shape[0] / 1200, 0.35), line_width(picture)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    x, y = drawable(box[:2]).tolist()
    top = y - height - 4 if y >= height + 4 else y
    cv2.rectangle(picture, (x, top), (x + width + 3, top + height + 3), colour, -1)
    place = x + 2, top + height + 1
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), thick, cv2.LINE_AA)


def caption(picture: np.ndarray, lines: Sequence[tuple[str, Colour]]) -> None:
    """Write lines, each in its colour, along the lower edge, shortened to fit the width."""
    height, width = picture.shape[:2]
    scale, row, thick = height / 1000, max(12, round(height / 28)), line_width(picture)
    top = max(height - row * len(lines) - row // 3, 0)
    picture[top:] = picture[top:] // 3
    for i, (line, colour) in enumerate(lines):
        plain = line.replace("×", "x").replace("−", "-").encode("ascii", "replace").decode()  # OpenCV's font is ASCII
        size = max(scale, 0.35)
        while len(plain) > 8 and cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, size, thick)[0][0] > width - 8:
            plain = plain.removesuffix("...")[:-1] + "..." if len(plain) > 12 else plain[:-1]
        cv2.putText(picture, plain, (4, top + row * (i + 1) - row // 5), 0, size, colour, thick, cv2.LINE_AA)
