"""Boxes and labels that OpenCV can draw, wherever they lie."""

import cv2
import numpy as np

Colour = tuple[int, int, int]
"""Blue, green, red."""


def colour_picture(image: np.ndarray) -> np.ndarray:
    """A copy in colour, (H, W, 3) uint8 BGR, to draw on."""
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()


def line_width(picture: np.ndarray) -> int:
    """Pixels that suit a picture's size."""
    return max(1, round(picture.shape[0] / 480))


def whole(points: np.ndarray) -> np.ndarray:
    """Pixels that OpenCV can draw: far outside is as good as farther."""
    return np.clip(np.nan_to_num(points), -30_000, 30_000).round().astype(np.int32)


def rectangle(picture: np.ndarray, box: np.ndarray, colour: Colour, thick: int) -> None:
    """A box x, y, width, height."""
    x, y, right, bottom = whole(np.array([*box[:2], *(box[:2] + box[2:])])).tolist()
    cv2.rectangle(picture, (x, y), (right - 1, bottom - 1), colour, thick)


def label(picture: np.ndarray, box: np.ndarray, text: str, colour: Colour) -> None:
    """A text on a patch of its colour, above the box where there is room."""
    scale, thick = max(picture.shape[0] / 1200, 0.35), line_width(picture)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    x, y = whole(box[:2]).tolist()
    top = y - height - 4 if y >= height + 4 else y
    cv2.rectangle(picture, (x, top), (x + width + 3, top + height + 3), colour, -1)
    place = x + 2, top + height + 1
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), thick, cv2.LINE_AA)
