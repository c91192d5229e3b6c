"""Key frames of a run: a few small pictures spread over it and at its events, in bounded memory."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

MOST = 9
"""Pictures in a report."""
_MARKED = 7  # at events, at most
_HELD = 18  # of either kind while the run goes on
_AREA_PX = 520 * 390
_QUALITY = 78


@dataclass(frozen=True)
class KeyFrame:
    """A picture as JPEG with its frame number, time and a caption. weight: how much its events matter."""

    number: int
    time_s: float
    text: str
    jpeg: bytes
    weight: float = 1.0

    @property
    def when(self) -> str:
        """Frame number and time for a reader."""
        return f"frame {self.number}" + (f", {self.time_s:.1f} s" if math.isfinite(self.time_s) else "")


class KeyFrames:
    """Chooses a few of the frames of a run, given in order."""

    def __init__(self) -> None:
        self._even: list[KeyFrame] = []
        self._marked: list[KeyFrame] = []
        self._taken = 0
        self._stride = 1
        self._known: set[str] = set()

    def add(
        self, number: int, time_s: float, kinds: Mapping[str, float], text: str, draw: Callable[[], np.ndarray]
    ) -> None:
        """Consider the next frame.

        kinds: kinds of events at it with their weights; the first frame of each kind is kept. text: the caption.
        draw: returns the frame's picture, (H, W, 3) uint8 BGR; called only if the frame is kept.
        """
        new = set(kinds) - self._known
        due = self._taken % self._stride == 0
        self._taken += 1
        if not (due or new):
            return
        weight = max((kinds[kind] for kind in new), default=0.0)
        taken = KeyFrame(number, time_s, text, _jpeg(draw()), weight)
        if new:
            self._known |= new
            self._marked.append(taken)
            if len(self._marked) > _HELD:
                del self._marked[_least_needed(self._marked)]
        if due:
            self._even.append(taken)
            if len(self._even) > _HELD:
                # Dropping every other one keeps the rest evenly spread.
                self._even, self._stride = self._even[::2], 2 * self._stride

    def chosen(self) -> list[KeyFrame]:
        """The key frames by number: those at events, and others that are far from all of these."""
        marked = list(self._marked)
        while len(marked) > _MARKED:
            del marked[_least_needed(marked)]
        chosen = {taken.number: taken for taken in marked}
        rest = [taken for taken in self._even if taken.number not in chosen]
        if rest and not chosen:
            first = rest.pop(0)
            chosen[first.number] = first
        while rest and len(chosen) < MOST:
            far = [min(abs(taken.number - number) for number in chosen) for taken in rest]
            taken = rest.pop(int(np.argmax(far)))
            chosen[taken.number] = taken
        return [chosen[number] for number in sorted(chosen)]


def _least_needed(taken: Sequence[KeyFrame]) -> int:
    """The index of the frame with the least weight or the nearest neighbour."""
    apart = np.diff([one.number for one in taken]).astype(float)
    nearest = np.minimum(np.r_[np.inf, apart], np.r_[apart, np.inf])
    return int(np.argmin(nearest * [one.weight for one in taken]))


def _jpeg(picture: np.ndarray) -> bytes:
    height, width = picture.shape[:2]
    share = min(1.0, (_AREA_PX / (width * height)) ** 0.5)
    if share < 1:
        size = max(1, round(width * share)), max(1, round(height * share))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
