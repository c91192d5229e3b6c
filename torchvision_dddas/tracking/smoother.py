"""Fixed-lag smoothing: delay frames, so that later frames can confirm tracks, fill gaps and smooth boxes."""

import math
from collections import deque
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.types import Tracks

FILLED = 2
"""Longest gap, in sampled frames, that is filled."""
_BEFORE = 8  # number of earlier boxes of a track that are used to smooth a box
_WIDTHS = np.array([2.0, 5.0])  # widths of the Gaussian weights of positions, and of sizes, which change more slowly


@dataclass(slots=True)
class _Observation:
    """A box of a track.

    index: index of the sampled frame, from 0. row: row among the frame's detections, -1 in a filled gap. link:
    confidence that the box belongs to the track, NaN if unknown.
    """

    frame: int
    index: int
    box_px: np.ndarray
    score: float
    row: int
    link: float = math.nan


@dataclass(slots=True)
class _Pending:
    """A sampled frame that is not settled. tracks: the box of each track, by the track's number."""

    frame: int
    index: int
    tracks: dict[int, _Observation] = field(default_factory=dict)


class FixedLagSmoother:
    """Delays each sampled frame by a fixed number of sampled frames. `settle` returns the frames that are due."""

    def __init__(self, hits: int, smooth: bool, interval: int = 1, by_birth: bool = False) -> None:
        """Start without frames.

        hits: detections that confirm a track. smooth: smooth the boxes with a score below 1 along their track.
        interval: frames from one sampled frame to the next. by_birth: give identities by the tracks' own numbers, which
        are known before a track is confirmed; else count the confirmed tracks.
        """
        self.hits, self.smooth, self.interval, self.by_birth = hits, smooth, interval, by_birth
        self.pending: deque[_Pending] = deque()
        self.count = 0  # number of sampled frames so far
        self.delay = hits - 1 + FILLED  # number of sampled frames by which a frame is delayed
        self.kept = self.delay + _BEFORE
        self.steps: deque[np.ndarray | None] = deque(maxlen=2 * self.kept)  # camera motion to each of the latest frames
        self.has_moved = False  # whether the camera has ever moved
        self.observations: dict[int, deque[_Observation]] = {}
        self.confirmed: set[int] = set()
        self.counts: dict[int, int] = {}
        self.identities: dict[int, int] = {}
        self.identity_count = 0
        self.forgotten: deque[tuple[int, int]] = deque()  # (number of sampled frames before its end, track number)

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
        least: int = 1,
    ) -> None:
        """Add a frame with the numbers of its tracks (N,), their boxes, scores and rows among the frame's detections.

        link: (N,) as in Tracks; None: unknown. trusts_single: whether one detection of score 1 confirms a track; else
        two are needed. least: smallest number of detections that confirm a track.
        """
        links = np.full(len(tracks), np.nan) if link is None else link
        certain = max(least, min(self.hits, 1 if trusts_single else 2))
        self.steps.append(now_from_before)
        self.has_moved |= now_from_before is not None
        pending = _Pending(frame, self.count)
        self.pending.append(pending)
        self.count += 1
        columns = (tracks.tolist(), box_px, score.tolist(), row.tolist(), links.tolist())
        for number, box, confidence, at, likely in zip(*columns, strict=True):
            observation = _Observation(frame, pending.index, box, confidence, at, likely)
            self.counts[number] = self.counts.get(number, 0) + 1
            if self.counts[number] >= (certain if confidence >= 1 else max(least, self.hits)):
                self.confirmed.add(number)
            past = self.observations.setdefault(number, deque(maxlen=self.kept))
            if past and 1 < pending.index - past[-1].index <= FILLED + 1:
                self._fill(number, past[-1], observation)
            past.append(observation)
            pending.tracks[number] = observation

    def _fill(self, number: int, before: _Observation, after: _Observation) -> None:
        """Interpolate the boxes of a track in the frames between two observations."""
        for gap in self.pending:
            if before.index < gap.index < after.index:
                part = (gap.frame - before.frame) / (after.frame - before.frame)
                start, end = (self._boxes_at(seen.box_px[None], seen.index, gap.index)[0] for seen in (before, after))
                score = before.score + part * (after.score - before.score)
                gap.tracks[number] = _Observation(gap.frame, gap.index, start + part * (end - start), score, -1)

    def forget(self, numbers: np.ndarray) -> None:
        """Mark tracks as ended. Their data are dropped when no pending frame can contain them."""
        for number in numbers.tolist():
            self.counts.pop(number, None)
            self.forgotten.append((self.count, number))

    def are_confirmed(self, numbers: np.ndarray) -> np.ndarray:
        """Return (N,) whether tracks are confirmed."""
        return np.array([number in self.confirmed for number in numbers.tolist()], bool)

    def settle(self, everything: bool = False) -> list[Tracks]:
        """Return the frames that no later frame can change, or all frames at the end."""
        done = []
        while self.pending and (everything or len(self.pending) > self.delay):
            pending = self.pending.popleft()
            confirmed = {number: seen for number, seen in pending.tracks.items() if number in self.confirmed}
            for number in confirmed:
                if number not in self.identities:
                    self.identity_count += 1
                    self.identities[number] = number + 1 if self.by_birth else self.identity_count
            done.append(
                Tracks(
                    pending.frame,
                    np.array([self.identities[number] for number in confirmed], np.int64),
                    self._smoothed(confirmed, pending),
                    np.array([seen.score for seen in confirmed.values()], float),
                    np.array([seen.row for seen in confirmed.values()], np.int64),
                    np.array([seen.link for seen in confirmed.values()], float),
                )
            )
            # Drop the data that no pending frame can need.
            while self.forgotten and self.forgotten[0][0] < self.count - len(self.pending):
                _, number = self.forgotten.popleft()
                self.identities.pop(number, None)
                self.confirmed.discard(number)
            oldest = self.count - len(self.steps)
            for number in [n for n, past in self.observations.items() if past[-1].index <= oldest]:
                del self.observations[number]
        return done

    def _smoothed(self, confirmed: dict[int, _Observation], at: _Pending) -> np.ndarray:
        """Return the (K, 4) boxes of confirmed tracks in a frame. Boxes with a score below 1 are smoothed."""
        given = np.array([seen.box_px for seen in confirmed.values()], float).reshape(-1, 4)
        oldest = self.count - len(self.steps)
        near: list[_Observation] = []
        starts, smoothed = [], []
        for place, (number, seen) in enumerate(confirmed.items()):
            past = self.observations.get(number, ()) if self.smooth and seen.score < 1 else ()
            of_track = past if past and past[0].index > oldest else [s for s in past if s.index > oldest]
            if len(of_track) > 1:
                smoothed.append(place)
                starts.append(len(near))
                near += of_track
        if not near:
            return given
        box, index = (
            np.concatenate([s.box_px for s in near], dtype=float).reshape(-1, 4),
            np.array([s.index for s in near]),
        )
        if self.has_moved:
            for there in np.unique(index).tolist():
                box[index == there] = self._boxes_at(box[index == there], there, at.index)
        since = (np.array([s.frame for s in near]) - at.frame) / self.interval
        given[smoothed] = smooth_boxes(box, since, np.array(starts))
        return given

    def _boxes_at(self, box_px: np.ndarray, there: int, here: int) -> np.ndarray:
        """Transform boxes (N, 4) from the coordinates of the sampled frame `there` to the coordinates of `here`."""
        low, high = sorted((there, here))
        oldest = self.count - len(self.steps)
        between = range(low + 1, high + 1) if self.has_moved else ()
        steps = [step for index in between if (step := self.steps[index - oldest]) is not None]
        if not steps:
            return box_px
        high_from_low = reduce(lambda before, step: step @ before, steps)
        here_from_there = high_from_low if there < here else np.linalg.inv(high_from_low)
        return transform_boxes(box_px, here_from_there)


def smooth_boxes(box_px: np.ndarray, since: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Fit straight lines to the boxes of each track, and return the (K, 4) boxes at time 0.

    The lines are fitted to the centres and to the logarithms of the sides. box_px: (N, 4) the boxes of all tracks, one
    track after another. since: (N,) their times, in intervals. starts: (K,) index of each track's first box. The
    weights are Gaussian in time. A weak regularisation of the slope to 0 determines the fit if all times are equal.
    """
    weight = np.exp(-0.5 * (since[:, None] / _WIDTHS) ** 2)  # (N, 2), for positions and for sizes
    time, parts = since[:, None], np.empty((len(box_px), 14))
    parts[:, :2], parts[:, 2:4], parts[:, 4:6] = weight, weight * time, weight * time**2
    value = np.concatenate([box_px[:, :2] + box_px[:, 2:] / 2, np.log(box_px[:, 2:])], axis=1)
    both = weight.repeat(2, axis=1)
    parts[:, 6:10], parts[:, 10:] = both * value, both * time * value
    sums = np.add.reduceat(parts, starts)
    total, once, twice = (sums[:, first : first + 2].repeat(2, axis=1) for first in (0, 2, 4))
    twice = twice + 1e-3 * _WIDTHS.repeat(2) ** 2
    fitted = (twice * sums[:, 6:10] - once * sums[:, 10:]) / (total * twice - once**2)
    side = np.exp(fitted[:, 2:])
    return np.concatenate([fitted[:, :2] - side / 2, side], axis=1)
