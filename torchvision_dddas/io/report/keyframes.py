"""Key frames of a run: a few small pictures spread over it, and where something happened, in memory that is bounded."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

MOST = 9
"""Pictures that a report shows."""
_MARKED = 7  # of them at most, for what happened
_HELD = 18  # kept of each kind while the run goes on
_AREA_PX = 520 * 390
_QUALITY = 78


@dataclass(frozen=True)
class KeyFrame:
    """A picture as JPEG, when it was, and what happened then, empty if nothing. weight: how much that matters."""

    number: int
    time_s: float
    words: str
    jpeg: bytes
    weight: float = 1.0


class KeyFrames:
    """Takes the frames of a run in order and keeps few."""

    def __init__(self) -> None:
        self._even: list[KeyFrame] = []
        self._marked: list[KeyFrame] = []
        self._taken = 0
        self._stride = 1
        self._known: set[str] = set()

    def add(
        self, number: int, time_s: float, kinds: Mapping[str, float], words: str, draw: Callable[[], np.ndarray]
    ) -> None:
        """A frame. kinds: of what happened at it, each with its weight; the first frame of each is kept.

        words: the same, to be read.
        draw: makes the frame's picture, (H, W, 3) uint8 BGR; only called where it is wanted.
        """
        new = set(kinds) - self._known
        due = self._taken % self._stride == 0
        self._taken += 1
        if not (due or new):
            return
        weight = max((kinds[kind] for kind in new), default=0.0)
        taken = KeyFrame(number, time_s, words, _jpeg(draw()), weight)
        if new:
            self._known |= new
            self._marked.append(taken)
            if len(self._marked) > _HELD:
                del self._marked[_spared(self._marked)]
        if due:
            self._even.append(taken)
            if len(self._even) > _HELD:
                # Every other one goes: those left are spread evenly, however long the run.
                self._even, self._stride = self._even[::2], 2 * self._stride

    def chosen(self) -> list[KeyFrame]:
        """Those to show, by frame: where something happened, and others that are far from all of these."""
        marked = list(self._marked)
        while len(marked) > _MARKED:
            del marked[_spared(marked)]
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


def _spared(taken: Sequence[KeyFrame]) -> int:
    """Which of some frames in order can best be done without: one that matters little, or that has another near."""
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
