"""The parts of a map picture: frame, grid and scale, lines, signs, and labels that do not overlap."""

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from torchvision_dddas.io.overlay import Colour
from torchvision_dddas.io.overlay.layers import LETTERS

FINE = 2
"""The map is drawn so many times larger and then reduced, for clean thin lines and small letters."""

WIDTH = 1400
LEFT, RIGHT, TOP, BOTTOM = 86, 24, 46, 106
SHORTEST, TALLEST = 420, 880
INK, LINES, PAPER = (60, 60, 60), (222, 222, 222), (255, 255, 255)
LINES_ACROSS = 12
MARK: Colour = (30, 30, 200)
"""The colour of a landmark."""
VERDICTS: dict[str, Colour] = {"human": (60, 130, 20), "not_human": (40, 70, 190)}
LOOK: Colour = (150, 110, 40)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SUB = 3  # bits of a pixel's fraction that OpenCV draws with


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


def round_step(span: float, lines: int) -> float:
    """1, 2 or 5 times a power of ten, so that about so many lines cover a span."""
    power = 10.0 ** math.floor(math.log10(span / lines))
    return next(power * k for k in (1, 2, 5, 10) if power * k >= span / lines)


def draw_grid(picture: np.ndarray, frame: MapFrame, over_photo: bool) -> None:
    """Grid lines through the plot and their numbers outside it."""
    rows, columns = frame.plot
    plot = picture[rows, columns]
    size = np.array([frame.width, frame.height]) * frame.metres_a_pixel
    step = round_step(float(size[0]), LINES_ACROSS)
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
    """A bar of a round length and an arrow to the north, outside the plot."""
    length = round_step(frame.width * frame.metres_a_pixel, LINES_ACROSS)
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
    # A long track jitters within a pixel from frame to frame: drawing that would take most of the time.
    simple = (
        cv2.approxPolyDP(points.astype(np.float32)[:, None], 0.4 * FINE, False)[:, 0] if len(points) > 99 else points
    )
    ways = [fixed(simple)]
    if halo:
        cv2.polylines(picture, ways, False, PAPER, (thick + 2) * FINE, cv2.LINE_AA, _SUB)
    cv2.polylines(picture, ways, False, colour, thick * FINE, cv2.LINE_AA, _SUB)


def fixed(points: np.ndarray) -> np.ndarray:
    """Fixed-point pixels for OpenCV; those far outside are clipped."""
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
    """Labels beside their places; one that would cover others moves around its place."""

    def __init__(self, frame: MapFrame) -> None:
        self._frame = frame
        self._taken: list[tuple[float, float, float, float]] = []

    def keep_free(self, east_north_m: np.ndarray) -> None:
        """Let no label cover the sign at a place."""
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


def draw_look(plot: np.ndarray, from_xy: np.ndarray, at_xy: np.ndarray, long: float = 26.0) -> None:
    """A wedge from where a vehicle was, open towards what it looked at; pixels of the enlarged picture."""
    way = at_xy - from_xy
    angle = np.arctan2(way[1], way[0])
    reach = long * FINE
    edge = np.linspace(angle - 0.38, angle + 0.38, 9)
    shape = np.concatenate([from_xy[None], from_xy + reach * np.stack([np.cos(edge), np.sin(edge)], axis=1)])
    low = np.floor(np.clip(shape.min(axis=0) - 2, 0, None)).astype(int)
    high = np.ceil(shape.max(axis=0) + 2).astype(int)
    part = plot[low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
    if part.size:
        tinted = part.copy()
        cv2.fillPoly(tinted, [fixed(shape - low)], LOOK, cv2.LINE_AA, _SUB)
        cv2.addWeighted(tinted, 0.35, part, 0.65, 0, dst=part)
    dashes(plot, shape[[1, 0, -1]], LOOK, 1, dash=400.0 * FINE)


def draw_verdict(plot: np.ndarray, at: np.ndarray, kind: str) -> None:
    """A disc with H for human or N for not human."""
    x, y = (round(float(v)) for v in np.clip(np.nan_to_num(at), -30_000, 30_000))
    cv2.circle(plot, (x, y), 10 * FINE, PAPER, -1, cv2.LINE_AA)
    cv2.circle(plot, (x, y), 9 * FINE, VERDICTS.get(kind, INK), -1, cv2.LINE_AA)
    letter = LETTERS.get(kind, "?")
    (wide, high), _ = cv2.getTextSize(letter, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * FINE, 2 * FINE)
    cv2.putText(plot, letter, (x - wide // 2, y + high // 2), 0, 0.5 * FINE, PAPER, 2 * FINE, cv2.LINE_AA)
