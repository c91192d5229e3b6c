"""What the tracker has decided, held back while the next looks may confirm a track in it, fill a gap or move a box."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.tracking.box_smoothing import between, seen_from, smoothed
from torchvision_dddas.types import Tracks

FILLED = 2
"""Looks that a gap may last to be filled."""
_BEFORE = 8  # boxes of a track before one that is settled that may still smooth it


@dataclass
class _Sighting:
    """A box of a track. look: counted from 0. row: of the frame's detections, -1 for a gap that was filled."""

    frame: int
    look: int
    box_px: np.ndarray
    score: float
    row: int


@dataclass
class _Page:
    frame: int
    look: int
    tracks: dict[int, _Sighting] = field(default_factory=dict)


class Ledger:
    """One page a look. `settle` gives out those whose time has come, the same ones however the looks came in."""

    def __init__(self, hits: int, smooth: bool, interval: int = 1) -> None:
        """hits: detections that confirm a track. smooth: move boxes of a score below 1 to where their track was.

        interval: frames between looks.
        """
        self.hits, self.smooth, self.interval = hits, smooth, interval
        self.pages: deque[_Page] = deque()
        self.looks = 0
        self.delay = hits - 1 + FILLED  # looks for which a page is held back
        self.kept = self.delay + _BEFORE
        self.steps: deque[np.ndarray | None] = deque(maxlen=2 * self.kept)  # to each of the latest looks
        self.moving = False  # whether the camera ever did
        self.past: dict[int, deque[_Sighting]] = {}
        self.sure: set[int] = set()
        self.counts: dict[int, int] = {}
        self.identities: dict[int, int] = {}
        self.named = 0
        self.gone: deque[tuple[int, int]] = deque()  # (look, track) of those forgotten

    def write(
        self,
        frame: int,
        tracks: np.ndarray,
        box_px: np.ndarray,
        score: np.ndarray,
        row: np.ndarray,
        now_from_before: np.ndarray | None,
    ) -> None:
        """Add a look: numbers of tracks (N,), their boxes, scores and rows among the frame's detections."""
        self.steps.append(now_from_before)
        self.moving |= now_from_before is not None
        page = _Page(frame, self.looks)
        self.pages.append(page)
        self.looks += 1
        for number, box, certainty, at in zip(tracks.tolist(), box_px, score.tolist(), row.tolist(), strict=True):
            sighting = _Sighting(frame, page.look, box, certainty, at)
            self.counts[number] = self.counts.get(number, 0) + 1
            if self.counts[number] >= self.hits or certainty >= 1:
                self.sure.add(number)
            past = self.past.setdefault(number, deque(maxlen=self.kept))
            if past and 1 < page.look - past[-1].look <= FILLED + 1:
                self._fill(number, past[-1], sighting)
            past.append(sighting)
            page.tracks[number] = sighting

    def forget(self, numbers: np.ndarray) -> None:
        """Tracks that will not be seen again; what is known of them is kept as long as a page may name them."""
        for number in numbers.tolist():
            self.counts.pop(number, None)
            self.gone.append((self.looks, number))

    def confirmed(self, numbers: np.ndarray) -> np.ndarray:
        """(N,) which tracks are more than a false alarm."""
        return np.array([number in self.sure for number in numbers.tolist()], bool)

    def settle(self, everything: bool = False) -> list[Tracks]:
        """The frames on which no later look has a say; all of them at the end."""
        done = []
        while self.pages and (everything or len(self.pages) > self.delay):
            page = self.pages.popleft()
            sure = [(number, seen) for number, seen in page.tracks.items() if number in self.sure]
            for number, _ in sure:
                if number not in self.identities:
                    self.named += 1
                    self.identities[number] = self.named
            done.append(
                Tracks(
                    page.frame,
                    np.array([self.identities[number] for number, _ in sure], np.int64),
                    np.array([self._box(number, seen) for number, seen in sure], float).reshape(-1, 4),
                    np.array([seen.score for _, seen in sure], float),
                    np.array([seen.row for _, seen in sure], np.int64),
                )
            )
            self._tidy()
        return done

    def _fill(self, number: int, before: _Sighting, after: _Sighting) -> None:
        for page in self.pages:
            if before.look < page.look < after.look:
                part = (page.frame - before.frame) / (after.frame - before.frame)
                start = seen_from(before.box_px, self._step(before.look, page.look))
                end = seen_from(after.box_px, self._step(after.look, page.look))
                score = before.score + part * (after.score - before.score)
                page.tracks[number] = _Sighting(page.frame, page.look, between(start, end, part), score, -1)

    def _box(self, number: int, seen: _Sighting) -> np.ndarray:
        if not self.smooth or seen.score >= 1:
            return seen.box_px
        near = [s for s in self.past.get(number, ()) if s.look > self.looks - len(self.steps)]
        if len(near) < 2:
            return seen.box_px
        boxes = np.array([s.box_px for s in near])
        if self.moving:
            boxes = np.array([seen_from(s.box_px, self._step(s.look, seen.look)) for s in near])
        return smoothed(boxes, np.array([s.frame / self.interval for s in near]), seen.frame / self.interval)

    def _step(self, there: int, here: int) -> np.ndarray | None:
        """How pixels moved from one look to another; None if the camera stood still between them."""
        if not self.moving:
            return None
        low, high = sorted((there, here))
        oldest = self.looks - len(self.steps)
        steps = [s for look in range(low + 1, high + 1) if (s := self.steps[look - oldest]) is not None]
        if not steps:
            return None
        high_from_low = steps[0]
        for step in steps[1:]:
            high_from_low = step @ high_from_low
        return high_from_low if there < here else np.linalg.inv(high_from_low)

    def _tidy(self) -> None:
        """Drop what no page still held back can ask for."""
        while self.gone and self.gone[0][0] < self.looks - len(self.pages):
            _, number = self.gone.popleft()
            self.identities.pop(number, None)
            self.sure.discard(number)
        oldest = self.looks - len(self.steps)
        for number in [n for n, past in self.past.items() if past[-1].look <= oldest]:
            del self.past[number]
