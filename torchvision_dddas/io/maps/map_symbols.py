"""What a map is drawn with: lines, dashes, signs, and labels that keep out of each other's way."""

from itertools import pairwise

import cv2
import numpy as np

from torchvision_dddas.io.maps.map_frame import FINE, INK, LEFT, PAPER, RIGHT, TOP, WIDTH, MapFrame, text_width, write
from torchvision_dddas.io.overlay import Colour

MARK = (30, 30, 200)
"""The colour of a landmark."""

_SUB = 3  # bits of a pixel's fraction that OpenCV draws with


def dashes(picture: np.ndarray, points: np.ndarray, colour: Colour, thick: int, dash: float = 9.0 * FINE) -> None:
    """A broken line, as far as it lies in the picture."""
    height, width = picture.shape[:2]
    for a, b in pairwise(points):
        inside, *ends = cv2.clipLine((0, 0, width, height), _whole(a), _whole(b))
        if inside:
            start, end = (np.array(e, float) for e in ends)
            count = max(int(np.hypot(*(end - start)) / dash), 1)
            for k in range(0, count, 2):
                piece = start + (end - start) * np.array([[k], [min(k + 1, count)]]) / count
                line(picture, piece, colour, thick)


def line(picture: np.ndarray, points: np.ndarray, colour: Colour, thick: int, halo: bool = False) -> None:
    """A line through (N, 2) pixels of the enlarged picture, so thick in the finished one."""
    # A long way jitters within a pixel from frame to frame: what nobody can see costs most of the time.
    simple = (
        cv2.approxPolyDP(points.astype(np.float32)[:, None], 0.4 * FINE, False)[:, 0] if len(points) > 99 else points
    )
    ways = [fixed(simple)]
    if halo:
        cv2.polylines(picture, ways, False, PAPER, (thick + 2) * FINE, cv2.LINE_AA, _SUB)
    cv2.polylines(picture, ways, False, colour, thick * FINE, cv2.LINE_AA, _SUB)


def fixed(points: np.ndarray) -> np.ndarray:
    """Pixels with their fractions as OpenCV takes them; far outside is as good as farther."""
    return np.round(np.clip(np.nan_to_num(points), -30_000, 30_000) * 2**_SUB).astype(np.int32)


def _whole(point: np.ndarray) -> tuple[int, int]:
    x, y = np.clip(np.nan_to_num(point), -1e6, 1e6).round().astype(int).tolist()
    return x, y


def draw_camera(plot: np.ndarray, at: np.ndarray) -> None:
    """A triangle."""
    shape = at + FINE * np.array([[0, -9], [8, 6], [-8, 6]])
    cv2.fillPoly(plot, [fixed(shape)], INK, cv2.LINE_AA, _SUB)


def draw_landmark(plot: np.ndarray, at: np.ndarray) -> None:
    """A diamond."""
    for size, colour in ((9, PAPER), (7, MARK)):
        shape = at + FINE * size * np.array([[0, -1], [1, 0], [0, 1], [-1, 0]])
        cv2.fillPoly(plot, [fixed(shape)], colour, cv2.LINE_AA, _SUB)


class Labels:
    """Names beside their places, where there is room: a label that would lie on others moves around its place."""

    def __init__(self, frame: MapFrame) -> None:
        self._frame = frame
        self._taken: list[tuple[float, float, float, float]] = []

    def keep_free(self, east_north_m: np.ndarray) -> None:
        """Let no label lie on the sign at a place."""
        x, y = (self._frame.pixels(east_north_m) / FINE + (LEFT, TOP)).tolist()
        self._taken.append((x - 6, y - 6, x + 6, y + 6))

    def add(self, picture: np.ndarray, east_north_m: np.ndarray, text: str, colour: Colour) -> None:
        """Write a label beside a place, if the map shows the place."""
        x, y = (self._frame.pixels(east_north_m) / FINE + (LEFT, TOP)).tolist()
        if not (LEFT <= x <= WIDTH - RIGHT and TOP <= y <= TOP + self._frame.height):
            return
        wide = text_width(text, 0.5)
        places = [(x + 9, y - 6), (x + 9, y + 16), (x - 9 - wide, y - 6), (x - 9 - wide, y + 16)]
        places += [(x - wide / 2, y - 12), (x - wide / 2, y + 22), (x + 22, y + 5), (x - 22 - wide, y + 5)]
        boxes = [(left - 1, low - 13, left + wide + 1, low + 2) for left, low in places]
        free = [k for k, box in enumerate(boxes) if self._inside(box) and not any(_meet(box, b) for b in self._taken)]
        chosen = free[0] if free else 0
        self._taken.append(boxes[chosen])
        write(picture, text, places[chosen], 0.5, colour, halo=True)

    def _inside(self, box: tuple[float, float, float, float]) -> bool:
        low = TOP + self._frame.height
        return box[0] > LEFT and box[2] < WIDTH - RIGHT and box[1] > TOP and box[3] < low


def _meet(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def draw_dot(plot: np.ndarray, at: np.ndarray, colour: Colour) -> None:
    """A disc."""
    centre = fixed(at[None])[0].tolist()
    cv2.circle(plot, centre, (5 * FINE) << _SUB, PAPER, -1, cv2.LINE_AA, _SUB)
    cv2.circle(plot, centre, (4 * FINE) << _SUB, colour, -1, cv2.LINE_AA, _SUB)
