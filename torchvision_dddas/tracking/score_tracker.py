"""The default tracker: association by scores, each frame decided in view of the next one."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.assignment import choose_links, plausible_links
from torchvision_dddas.tracking.kalman import SEEN, transform_boxes
from torchvision_dddas.tracking.scores import (
    SceneState,
    SpeedPrior,
    appearance_scores,
    association_scores,
    birth_rate,
    blend_histograms,
    is_ambiguous,
    is_near_border,
    is_remembered,
    similarity,
    visible_shares,
)
from torchvision_dddas.tracking.smoother import FILLED, FixedLagSmoother
from torchvision_dddas.types import Detections, Table, Tracks


@dataclass(frozen=True)
class TrackStates(Table):
    """The tracks that are remembered, one row a track.

    state: (N, kalman.COLUMNS) as last seen. signature: (N, D) histograms, zeros where unknown; D is 0 until one is
    known. at_border: whether last seen at the picture's border. number: of the track, among all that were ever begun.
    hits: detections so far.
    """

    state: np.ndarray = field(default_factory=lambda: np.zeros((0, kalman.COLUMNS)))
    signature: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    at_border: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    number: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    hits: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.number)


def _join(first: TrackStates, *others: TrackStates) -> TrackStates:
    """All tracks in one table."""
    tables = [first, *(tracks for tracks in others if len(tracks))]
    width = max(tracks.signature.shape[1] for tracks in tables)
    return TrackStates.concat([replace(tracks, signature=_widen(tracks.signature, width)) for tracks in tables])


def _widen(signature: np.ndarray, width: int) -> np.ndarray:
    """Unknown histograms (N, 0) as zeros (N, width); others as they are."""
    return signature if signature.shape[1] == width else np.zeros((len(signature), width), np.float32)


@dataclass
class _Sample:
    """A frame and those of its detections that count. row: of the frame's detections. step: motion from the one before.

    appearance: gives the (M, D) histograms. interval: frames from the sampled frame before. signature: the histograms,
    (M, 0) until needed. visible: share of each box.
    """

    frame: int
    box_px: np.ndarray
    score: np.ndarray
    row: np.ndarray
    step: np.ndarray | None
    appearance: Callable[[], np.ndarray] | None
    interval: int

    def __post_init__(self) -> None:
        self.signature, self.visible = np.zeros((len(self.row), 0), np.float32), np.ones(len(self.row))

    def examine(self) -> None:
        """Compute the histograms, once."""
        if self.appearance is not None and len(self.row):
            self.signature, self.visible = self.appearance()[self.row], visible_shares(self.box_px)
        self.appearance = None


class ScoreTracker:
    """The state of a run. Feed it frames in order; each call returns the frames that are settled by it, in order.

    A frame is settled at most `track.hits` + 2 sampled frames later.
    """

    def __init__(self, settings: Settings, interval: int, size: tuple[float, float] | None = None) -> None:
        """interval: usual distance of the frames fed. size: (width, height) of the picture, None if unknown."""
        self.parameters, self.interval, self.size = settings.track, interval, size
        self.speed_prior = SpeedPrior(self.parameters.speed)
        self.tracks = TrackStates()
        self.smoother = FixedLagSmoother(self.parameters.hits, self.parameters.smooth, interval)
        self.begun = 0
        self._before: _Sample | None = None
        self._waiting: _Sample | None = None
        # Detections, those of them that are not certain, and tracks begun inside the picture.
        self.seen = self.doubtful = self.births = 0

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
        interval: int | None = None,
    ) -> list[Tracks]:
        """Add the detections of a frame, whose number is above the last one's.

        now_from_before: (3, 3) pixel homography from the frame fed before; None: the camera stood still, or unknown.
        appearance: gives the (N, D) histograms of the boxes, zeros where unknown; called once at most, maybe with the
        next frame. interval: frames from the frame before, where that is not the usual distance.
        """
        row = np.flatnonzero(detections.score >= self.parameters.min_score)
        wanted = None if self.parameters.appearance == "never" else appearance
        box, score = detections.box_px[row], detections.score[row]
        usual = self.interval if interval is None else interval
        sample = _Sample(frame, box, score, row, now_from_before, wanted, usual)
        if self.parameters.appearance == "always":
            sample.examine()
        if not self.parameters.look_ahead:
            self._decide(sample, None)
        else:
            if self._waiting is not None:
                self._decide(self._waiting, sample)
            self._waiting = sample
        return self.smoother.settle()

    def end(self) -> list[Tracks]:
        """The frames that were still waiting."""
        if self._waiting is not None:
            self._decide(self._waiting, None)
            self._waiting = None
        return self.smoother.settle(everything=True)

    def _decide(self, now: _Sample, ahead: _Sample | None) -> None:
        """Link a frame's detections to the tracks, in view of the next frame where there is one."""
        box, parameters = now.box_px, self.parameters
        if now.step is not None:
            self.tracks = replace(self.tracks, state=kalman.transform(self.tracks.state, now.step))
        if self._before is not None:
            before = self._before.box_px if now.step is None else transform_boxes(self._before.box_px, now.step)
            self.speed_prior.add(before, box, now.frame - self._before.frame)
        self.seen += len(now.score)
        self.doubtful += int((now.score < 1).sum())
        score = self._scores(self.tracks, now, box)
        unexamined = [near for near in (now, ahead) if near is not None and near.appearance is not None]
        if unexamined and is_ambiguous(score, self.tracks.signature):
            for near in unexamined:
                near.examine()
            score = self._scores(self.tracks, now, box)
        tracks, detections = plausible_links(score)
        at_border = is_near_border(box, self.size)
        # Tracks that would begin with each detection, without numbers yet, and those that would go on by each link.
        state = kalman.start(box, now.frame, parameters.scatter, self.speed_prior.speed, parameters.size_scatter)
        count = len(box)
        born = TrackStates(state, now.signature, at_border, np.full(count, -1), np.ones(count, np.int64))
        continued = self._update(now, tracks, detections, at_border[detections])
        if ahead is not None and len(ahead.row):
            there = ahead.box_px
            if ahead.step is not None:  # in the coordinates of this frame
                there = transform_boxes(there, np.linalg.inv(ahead.step))
            onward = self._scores(_join(continued, born, self.tracks), ahead, there)
            parts = np.split(onward, [len(continued), len(continued) + len(born)])
            chosen = choose_links(score[tracks, detections], tracks, detections, *parts)
        else:
            best = best_pairs(score)
            chosen = np.isin(tracks * count + detections, best[:, 0] * count + best[:, 1])
        self._commit(now, tracks[chosen], detections[chosen], continued[chosen], born)
        self._before = now

    def _scene(self, sample: _Sample) -> SceneState:
        doubt = self.doubtful / max(self.seen, 1)
        births = birth_rate(self.births, self.seen, doubt, self.interval)
        return SceneState(sample.frame, sample.interval, self.speed_prior.speed, births, doubt, self.size)

    def _scores(self, tracks: TrackStates, sample: _Sample, box_px: np.ndarray) -> np.ndarray:
        """(N, M) scores of tracks and a frame's detections, whose boxes are given in the tracks' coordinates."""
        score = association_scores(tracks.state, tracks.at_border, box_px, self._scene(sample), self.parameters)
        if tracks.signature.shape[1] and sample.signature.shape[1]:
            alike = similarity(tracks.signature, sample.signature)
            score += appearance_scores(alike, sample.visible, self.parameters)
        return score

    def _update(self, now: _Sample, tracks: np.ndarray, detections: np.ndarray, at_border: np.ndarray) -> TrackStates:
        """The tracks (K,) after a detection (K,) each, which may be at the border."""
        old, box, parameters = self.tracks, now.box_px[detections], self.parameters
        later = kalman.predict(old.state[tracks], now.frame, self._scene(now).agility(parameters))
        state = kalman.update(later, box, now.frame, parameters.scatter, parameters.size_scatter)
        hits = old.hits[tracks] + 1
        width = max(old.signature.shape[1], now.signature.shape[1])
        signature, seen = _widen(old.signature, width)[tracks], _widen(now.signature, width)[detections]
        if width:
            signature = blend_histograms(signature, seen, now.visible[detections], hits)
        return TrackStates(state, signature, at_border, old.number[tracks], hits)

    def _commit(
        self, now: _Sample, tracks: np.ndarray, detections: np.ndarray, continued: TrackStates, born: TrackStates
    ) -> None:
        """Give these tracks (K,), now `continued`, these detections (K,); begin new tracks; drop old ones."""
        new = np.flatnonzero(now.score >= self.parameters.birth_score)
        new = new[~np.isin(new, detections)]
        begun = replace(born[new], number=self.begun + np.arange(len(new)))
        self.begun += len(begun)
        if self._before is not None:
            self.births += int((~begun.at_border).sum())
        unseen = np.ones(len(self.tracks), bool)
        unseen[tracks] = False
        self.tracks = _join(self.tracks[unseen], continued, begun)
        number, at = np.concatenate([continued.number, begun.number]), np.concatenate([detections, new])
        self.smoother.add(now.frame, number, now.box_px[at], now.score[at], now.row[at], now.step)
        keep = is_remembered(self.tracks.state, now.frame, now.interval, self.size, self.parameters)
        late = now.frame - self.tracks.state[:, SEEN] > (FILLED + 1) * now.interval
        if late.any():  # those that were seen too seldom to be confirmed
            keep &= ~late | self.smoother.are_confirmed(self.tracks.number)
        if not keep.all():
            self.smoother.forget(self.tracks.number[~keep])
            self.tracks = self.tracks[keep]
