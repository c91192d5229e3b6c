"""Signs on a map for what ground vehicles did: where a target was told human or not, and from where they looked."""

import cv2
import numpy as np

from torchvision_dddas.io.maps.map_frame import FINE, INK, PAPER, MapFrame
from torchvision_dddas.io.maps.map_symbols import dashes, fixed
from torchvision_dddas.io.overlay import Colour

LETTERS = {"human": "H", "not_human": "N"}
COLOURS: dict[str, Colour] = {"human": (60, 130, 20), "not_human": (40, 70, 190)}
LOOK: Colour = (150, 110, 40)
_MOST = 400
_APART_M = 2.0


class Signs:
    """Collects what is shown. Memory: of each vehicle a look every two metres, in all at most a fixed number."""

    def __init__(self) -> None:
        self.verdicts: list[tuple[int, str, np.ndarray]] = []
        self.looks: list[tuple[np.ndarray, np.ndarray]] = []
        self._last: dict[str, np.ndarray] = {}

    def told(self, target: int, kind: str, east_north_m: np.ndarray) -> None:
        """A target was told human or not_human, here for the first time or otherwise than before."""
        if len(self.verdicts) < _MOST:
            self.verdicts.append((target, kind, np.array(east_north_m, float)))

    def look(self, vehicle: str, from_m: np.ndarray, at_m: np.ndarray) -> None:
        """A vehicle saw a target."""
        last = self._last.get(vehicle)
        if not np.isfinite(from_m).all() or (last is not None and np.linalg.norm(from_m - last) < _APART_M):
            return
        self._last[vehicle] = np.array(from_m, float)
        if len(self.looks) < _MOST:
            self.looks.append((np.array(from_m, float), np.array(at_m, float)))


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
        cv2.fillPoly(tinted, [fixed(shape - low)], LOOK, cv2.LINE_AA, 3)
        cv2.addWeighted(tinted, 0.35, part, 0.65, 0, dst=part)
    dashes(plot, shape[[1, 0, -1]], LOOK, 1, dash=400.0 * FINE)


def draw_verdict(plot: np.ndarray, at: np.ndarray, kind: str) -> None:
    """A disc with a letter: H for human, N for not human."""
    x, y = (round(float(v)) for v in np.clip(np.nan_to_num(at), -30_000, 30_000))
    cv2.circle(plot, (x, y), 10 * FINE, PAPER, -1, cv2.LINE_AA)
    cv2.circle(plot, (x, y), 9 * FINE, COLOURS.get(kind, INK), -1, cv2.LINE_AA)
    letter = LETTERS.get(kind, "?")
    (wide, high), _ = cv2.getTextSize(letter, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * FINE, 2 * FINE)
    cv2.putText(plot, letter, (x - wide // 2, y + high // 2), 0, 0.5 * FINE, PAPER, 2 * FINE, cv2.LINE_AA)


def draw_signs(plot: np.ndarray, frame: MapFrame, signs: Signs) -> None:
    """All of them; what lies outside the map is left out by the drawing itself."""
    for from_m, at_m in signs.looks:
        draw_look(plot, frame.pixels(from_m), frame.pixels(at_m))
    for _, kind, place in signs.verdicts:
        draw_verdict(plot, frame.pixels(place), kind)
