"""Fixed-lag smoothing: decisions are held back while later frames may confirm a track, fill a gap or move a box."""

import math
from collections import deque
from dataclasses import dataclass, field
from functools import lru_cache, reduce

import numpy as np

from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.types import Tracks

FILLED = 2
"""Sampled frames that a gap may last to be filled."""
_BEFORE = 8  # earlier boxes of a track that may smooth a box
_WIDTHS = np.array([[2.0], [5.0]])  # sd of the weights of places and of sizes, which change more slowly


@dataclass
class _Observation:
    """A box of a track. index: of the sampled frame, from 0. row: of the frame's detections, -1 in a filled gap.

    link: confidence that the box belongs to the track, NaN if unknown.
    """

    frame: int
    index: int
    box_px: np.ndarray
    score: float
    row: int
    link: float = math.nan


@dataclass
class _Pending:
    """The decision on a sampled frame. tracks: by number."""

    frame: int
    index: int
    tracks: dict[int, _Observation] = field(default_factory=dict)


class FixedLagSmoother:
    """Holds each sampled frame back for a fixed number of frames; `settle` returns those that are due."""

    def __init__(self, hits: int, smooth: bool, interval: int = 1) -> None:
        """hits: detections that confirm a track. smooth: smooth boxes of a score below 1 along their track.

        interval: frames from one sampled frame to the next.
        """
        self.hits, self.smooth, self.interval = hits, smooth, interval
        self.pending: deque[_Pending] = deque()
        self.count = 0  # sampled frames so far
        self.delay = hits - 1 + FILLED  # sampled frames for which one is held back
        self.kept = self.delay + _BEFORE
        self.steps: deque[np.ndarray | None] = deque(maxlen=2 * self.kept)  # camera motion to each of the latest frames
        self.has_moved = False  # whether the camera ever did
        self.observations: dict[int, deque[_Observation]] = {}
        self.confirmed: set[int] = set()
        self.counts: dict[int, int] = {}
        self.identities: dict[int, int] = {}
        self.identity_count = 0
        self.forgotten: deque[tuple[int, int]] = deque()  # (sampled frames before, track)

    def add(
        self,
        frame: int,
        tracks: np.ndarray,
        box_px: np.ndarray,
        score: np.ndarray,
        row: np.ndarray,
        now_from_before: np.ndarray | None,
        link: np.ndarray | None = None,
        trusts_single: bool = True,
    ) -> None:
        """Add a frame: numbers of tracks (N,), their boxes, scores and rows among the frame's detections.

        link: (N,) as in Tracks; None: unknown. trusts_single: whether one detection of score 1 confirms a track; else
        it takes two.
        """
        links = np.full(len(tracks), np.nan) if link is None else link
        least = min(self.hits, 1 if trusts_single else 2)
        self.steps.append(now_from_before)
        self.has_moved |= now_from_before is not None
        pending = _Pending(frame, self.count)
        self.pending.append(pending)
        self.count += 1
        columns = (tracks.tolist(), box_px, score.tolist(), row.tolist(), links.tolist())
        for number, box, confidence, at, likely in zip(*columns, strict=True):
            observation = _Observation(frame, pending.index, box, confidence, at, likely)
            self.counts[number] = self.counts.get(number, 0) + 1
            if self.counts[number] >= (least if confidence >= 1 else self.hits):
                self.confirmed.add(number)
            past = self.observations.setdefault(number, deque(maxlen=self.kept))
            if past and 1 < pending.index - past[-1].index <= FILLED + 1:
                self._fill(number, past[-1], observation)
            past.append(observation)
            pending.tracks[number] = observation

    def _fill(self, number: int, before: _Observation, after: _Observation) -> None:
        """Boxes of a track in the frames between two observations."""
        for gap in self.pending:
            if before.index < gap.index < after.index:
                part = (gap.frame - before.frame) / (after.frame - before.frame)
                start, end = self._box_at(before, gap.index), self._box_at(after, gap.index)
                score = before.score + part * (after.score - before.score)
                gap.tracks[number] = _Observation(gap.frame, gap.index, start + part * (end - start), score, -1)

    def forget(self, numbers: np.ndarray) -> None:
        """Drop tracks that have ended, as soon as no pending frame can hold them."""
        for number in numbers.tolist():
            self.counts.pop(number, None)
            self.forgotten.append((self.count, number))

    def are_confirmed(self, numbers: np.ndarray) -> np.ndarray:
        """(N,) which tracks are confirmed."""
        return np.array([number in self.confirmed for number in numbers.tolist()], bool)

    def settle(self, everything: bool = False) -> list[Tracks]:
        """The frames that no later one can change; all of them at the end."""
        done = []
        while self.pending and (everything or len(self.pending) > self.delay):
            pending = self.pending.popleft()
            confirmed = {number: seen for number, seen in pending.tracks.items() if number in self.confirmed}
            for number in confirmed:
                if number not in self.identities:
                    self.identity_count += 1
                    self.identities[number] = self.identity_count
            done.append(
                Tracks(
                    pending.frame,
                    np.array([self.identities[number] for number in confirmed], np.int64),
                    np.array([self._smoothed(*item) for item in confirmed.items()], float).reshape(-1, 4),
                    np.array([seen.score for seen in confirmed.values()], float),
                    np.array([seen.row for seen in confirmed.values()], np.int64),
                    np.array([seen.link for seen in confirmed.values()], float),
                )
            )
            # Drop what no pending frame can need.
            while self.forgotten and self.forgotten[0][0] < self.count - len(self.pending):
                _, number = self.forgotten.popleft()
                self.identities.pop(number, None)
                self.confirmed.discard(number)
            oldest = self.count - len(self.steps)
            for number in [n for n, past in self.observations.items() if past[-1].index <= oldest]:
                del self.observations[number]
        return done

    def _smoothed(self, number: int, seen: _Observation) -> np.ndarray:
        if not self.smooth or seen.score >= 1:
            return seen.box_px
        near = [s for s in self.observations.get(number, ()) if s.index > self.count - len(self.steps)]
        if len(near) < 2:
            return seen.box_px
        boxes = np.array([self._box_at(s, seen.index) for s in near])
        return smooth_box(boxes, np.array([s.frame / self.interval for s in near]), seen.frame / self.interval)

    def _box_at(self, seen: _Observation, here: int) -> np.ndarray:
        """An observed box in the coordinates of another sampled frame."""
        low, high = sorted((seen.index, here))
        oldest = self.count - len(self.steps)
        between = range(low + 1, high + 1) if self.has_moved else ()
        steps = [step for index in between if (step := self.steps[index - oldest]) is not None]
        if not steps:
            return seen.box_px
        high_from_low = reduce(lambda before, step: step @ before, steps)
        here_from_there = high_from_low if seen.index < here else np.linalg.inv(high_from_low)
        return transform_boxes(seen.box_px[None], here_from_there)[0]


def smooth_box(box_px: np.ndarray, times: np.ndarray, at: float) -> np.ndarray:
    """The box (4,) at a time, by straight lines fitted to boxes (N, 4) around it; sides by their logarithm.

    times: (N,) of the boxes, in intervals. Weights are Gaussian, so that the fit is local; a slight pull towards no
    slope decides where the times do not.
    """
    place, size = _weights(tuple((times - at).tolist()))
    centre = place @ (box_px[:, :2] + box_px[:, 2:] / 2)
    side = np.exp(size @ np.log(box_px[:, 2:]))
    return np.concatenate([centre - side / 2, side])


@lru_cache(maxsize=1024)
def _weights(since: tuple[float, ...]) -> np.ndarray:
    """(2, N) weights of boxes for the place and for the size. Few patterns of times recur again and again."""
    time = np.array(since)
    weight = np.exp(-0.5 * (time / _WIDTHS) ** 2)
    total = weight.sum(axis=1, keepdims=True)
    once = (weight @ time)[:, None]
    twice = (weight @ time**2)[:, None] + 1e-3 * _WIDTHS**2
    return (twice - once * time) * weight / (total * twice - once**2)
