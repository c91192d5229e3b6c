"""The frame of a map picture: which metres lie at which pixels, a grid with numbers, a scale bar and north."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.io.overlay import Colour

FINE = 2
"""The map is drawn so many times larger, and then reduced: so thin lines and small letters come out clean."""

WIDTH = 1400
LEFT, RIGHT, TOP, BOTTOM = 86, 24, 46, 106
SHORTEST, TALLEST = 420, 880
INK, LINES, PAPER = (60, 60, 60), (222, 222, 222), (255, 255, 255)
LINES_ACROSS = 12
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True)
class MapFrame:
    """West and south edge in local metres, metres a pixel, and the plot's size in pixels of the finished picture."""

    west_m: float
    south_m: float
    metres_a_pixel: float
    width: int
    height: int

    def pixels(self, east_north_m: np.ndarray) -> np.ndarray:
        """(..., 2) x, y in the plot, in pixels of the enlarged picture."""
        fine = FINE / self.metres_a_pixel
        return (np.asarray(east_north_m, float) - (self.west_m, self.south_m)) * (fine, -fine) + (0, self.height * FINE)

    @property
    def plot(self) -> tuple[slice, slice]:
        """Rows and columns of the plot in the enlarged picture."""
        return slice(TOP * FINE, (TOP + self.height) * FINE), slice(LEFT * FINE, (LEFT + self.width) * FINE)


def frame_around(east_north_m: np.ndarray) -> MapFrame:
    """The frame that shows all of these places, with room around them; ten metres where there are none."""
    known = east_north_m[np.isfinite(east_north_m).all(axis=1)]
    low, high = (known.min(axis=0), known.max(axis=0)) if len(known) else (np.zeros(2), np.zeros(2))
    middle, size = (low + high) / 2, np.maximum((high - low) * 1.16, 10.0)
    width = WIDTH - LEFT - RIGHT
    height = round(min(max(width * size[1] / size[0], SHORTEST), TALLEST))
    metres = max(size[0] / width, size[1] / height)
    west, south = middle - np.array([width, height]) * metres / 2
    return MapFrame(float(west), float(south), float(metres), width, height)


def blank(frame: MapFrame) -> np.ndarray:
    """White paper, enlarged."""
    return np.full(((frame.height + TOP + BOTTOM) * FINE, WIDTH * FINE, 3), 255, np.uint8)


def step_of(span: float, lines: int) -> float:
    """1, 2 or 5 times a power of ten, so that about so many lines cover a span."""
    power = 10.0 ** math.floor(math.log10(span / lines))
    return next(power * k for k in (1, 2, 5, 10) if power * k >= span / lines)


def draw_grid(picture: np.ndarray, frame: MapFrame, over_photo: bool) -> None:
    """Grid lines through the plot and their numbers outside it."""
    rows, columns = frame.plot
    plot = picture[rows, columns]
    size = np.array([frame.width, frame.height]) * frame.metres_a_pixel
    step = step_of(float(size[0]), LINES_ACROSS)
    digits = max(0, -math.floor(math.log10(step)))
    for axis in (0, 1):
        start = (frame.west_m, frame.south_m)[axis]
        for k in range(math.ceil(start / step), math.floor((start + size[axis]) / step) + 1):
            place = np.array([frame.west_m, frame.south_m])
            place[axis] = k * step
            x, y = frame.pixels(place).round().astype(int).tolist()
            if over_photo:
                part = plot[:, max(x - 1, 0) : x + 1] if axis == 0 else plot[max(y - 1, 0) : y + 1]
                part[:] = part // 2 + 128
            else:
                end = (x, plot.shape[0]) if axis == 0 else (plot.shape[1], y)
                cv2.line(plot, (x, 0) if axis == 0 else (0, y), end, LINES, FINE)
            text = f"{k * step:.{digits}f}"
            wide = text_width(text, 0.5)
            at = (
                (x / FINE + LEFT - wide / 2, frame.height + TOP + 20)
                if axis == 0
                else (LEFT - wide - 8, y / FINE + TOP + 5)
            )
            write(picture, text, at, 0.5)
    cv2.rectangle(picture, (columns.start, rows.start), (columns.stop, rows.stop), INK, FINE)
    write(picture, "north, m", (10, TOP - 12), 0.5)
    write(picture, "east, m", (WIDTH - RIGHT - text_width("east, m", 0.5), frame.height + TOP + 40), 0.5)


def draw_scale(picture: np.ndarray, frame: MapFrame) -> None:
    """A bar of a round length and an arrow to the north, outside the plot: they hide nothing."""
    length = step_of(frame.width * frame.metres_a_pixel, LINES_ACROSS)
    text = f"{length:g} m"
    wide = length / frame.metres_a_pixel
    right = WIDTH - RIGHT - 4
    left, low = right - wide, TOP + frame.height + BOTTOM - 18
    for x in (left, right):
        cv2.line(picture, _at(x, low - 5), _at(x, low + 5), INK, 2 * FINE)
    cv2.line(picture, _at(left, low), _at(right, low), INK, 2 * FINE)
    write(picture, text, (left - text_width(text, 0.5) - 12, low + 5), 0.5)
    x, y = WIDTH - RIGHT - 12, 8
    cv2.arrowedLine(picture, _at(x, y + 30), _at(x, y), INK, 2 * FINE, cv2.LINE_AA, tipLength=0.4)
    write(picture, "N", (x - 12 - text_width("N", 0.55), y + 26), 0.55)


def write(
    picture: np.ndarray, text: str, at: tuple[float, float], size: float, colour: Colour = INK, halo: bool = False
) -> None:
    """A text whose first letter stands at a place of the finished picture. OpenCV's letters are those of ASCII."""
    text = text.encode("ascii", "replace").decode()
    if halo:
        cv2.putText(picture, text, _at(*at), _FONT, size * FINE, PAPER, 4 * FINE, cv2.LINE_AA)
    cv2.putText(picture, text, _at(*at), _FONT, size * FINE, colour, FINE, cv2.LINE_AA)


def text_width(text: str, size: float) -> float:
    """Pixels of the finished picture."""
    return float(cv2.getTextSize(text, _FONT, size * FINE, FINE)[0][0] / FINE)


def _at(x: float, y: float) -> tuple[int, int]:
    return round(x * FINE), round(y * FINE)
