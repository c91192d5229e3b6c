"""The default tracker: it links detections by scores, and decides each frame with the next frame in view."""

from collections import deque
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas.config import Settings, TrackParameters
from torchvision_dddas.geometry import best_pairs, namespace
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.appearance import (
    ambiguity,
    appearance_scores,
    blend_histograms,
    similarity,
    visible_shares,
)
from torchvision_dddas.tracking.assignment import choose_links, link_confidences, plausible_links
from torchvision_dddas.tracking.box_motion import FEWEST, candidate_shifts, likelier_shift
from torchvision_dddas.tracking.kalman import HEIGHT, SEEN, VX, VY, WIDTH, X, Y, transform_boxes
from torchvision_dddas.tracking.scene import SceneStatistics
from torchvision_dddas.tracking.scores import (
    BoxLook,
    association_scores,
    common_velocity,
    is_near_border,
    likely_velocities,
    newborn_scores,
)
from torchvision_dddas.tracking.smoother import FILLED, FixedLagSmoother
from torchvision_dddas.types import AppearanceUse, Detections, Table, Tracks

_RECENT = 3  # velocities come from tracks that were seen within this many looks
# A target is predicted outside the picture for the larger of these times. Later it may have stopped or turned.
_LEAVING_FRAMES, _LEAVING_LOOKS = 15, 3
_DOUBTS = 500  # number of detections whose median is the usual doubt
_LEAST_DOUBT, _LEAST_SCORE = 0.01, 1e-3
_DAMAGED_HITS = 5  # detections that confirm a track in damaged pictures, because false targets there are short-lived
_LONE_LOOKS = 2  # a detection that is not continued within this many looks counts as alone
_LONE_SHARE = 0.01  # if a larger share of detections stays alone, a single detection does not confirm a track


@dataclass(frozen=True)
class TrackStates(Table):
    """The tracks in memory, with one row for each track. state: (N, kalman.COLUMNS) at the last detection.

    signature: (N, D) histograms, zeros if unknown; D is 0 until the first histogram is known. number: serial number of
    the track. hits: number of detections. look: look of the last detection.
    """

    state: np.ndarray = field(default_factory=lambda: np.zeros((0, kalman.COLUMNS)))
    signature: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    number: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    hits: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    look: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.number)


def _join(first: TrackStates, *others: TrackStates) -> TrackStates:
    """Join tables of tracks into one table."""
    tables = [first, *(tracks for tracks in others if len(tracks))]
    width = max(tracks.signature.shape[1] for tracks in tables)
    same = [
        tracks if tracks.signature.shape[1] == width else replace(tracks, signature=_widen(tracks.signature, width))
        for tracks in tables
    ]
    return same[0] if len(same) == 1 else TrackStates.concat(same)


def _widen(signature: np.ndarray, width: int) -> np.ndarray:
    """Replace unknown histograms, (N, 0), by zeros, (N, width). Return known histograms unchanged."""
    return signature if signature.shape[1] == width else np.zeros((len(signature), width), np.float32)


@dataclass
class _Sample:
    """A sampled frame with the M detections that the tracker uses.

    row: (M,) index of each in the frame's detections. begins: (M,) whether a detection may begin a track. step: (3, 3)
    camera motion from the frame before, or None. appearance: returns the histograms of all detections. time: time in
    looks. look: number of the look. examined: why the histograms were computed, "" until then. signature: the (M, D)
    histograms, (M, 0) until they are computed. visible: visible share of each box. begun: numbers of the tracks that
    detections began, by detection; a provisional track keeps its number.
    """

    frame: int
    box_px: np.ndarray
    score: np.ndarray
    row: np.ndarray
    begins: np.ndarray
    step: np.ndarray | None
    appearance: Callable[[], np.ndarray] | None
    time: float
    look: int
    damaged: bool = False
    examined: str = ""
    begun: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.signature, self.visible = np.zeros((len(self.row), 0), np.float32), np.ones(len(self.row))

    def examine(self, cause: str) -> None:
        """Compute the histograms unless this was done before. cause: the reason, for the record."""
        if self.appearance is not None and len(self.row):
            self.examined = cause
            self.signature, self.visible = self.appearance()[self.row], visible_shares(self.box_px)
        self.appearance = None


@dataclass(frozen=True)
class _Choice:
    """The links of a frame, and the tracks that it begins.

    tracks, detections: (K,) indices of linked tracks and detections. continued: these tracks after their links. link:
    (K,) confidences. begun, new: tracks that begin, and their detections. at_border: (M,) whether a detection is at the
    picture's border.
    """

    tracks: np.ndarray
    detections: np.ndarray
    continued: TrackStates
    link: np.ndarray
    begun: TrackStates
    new: np.ndarray
    at_border: np.ndarray

    @property
    def number(self) -> np.ndarray:
        """The numbers of all tracks in the frame."""
        return np.concatenate([self.continued.number, self.begun.number])

    @property
    def at(self) -> np.ndarray:
        """Their detections."""
        return np.concatenate([self.detections, self.new])

    @property
    def links(self) -> np.ndarray:
        """The confidences of their links, NaN where a track begins."""
        return np.concatenate([self.link, np.full(len(self.new), np.nan)])


class DoubtRule:
    """Selects the detections to track: their doubt must not be far above the usual doubt of recent detections.

    The doubt is 1 / score - 1, which is the odds that a detection is false if scores are probabilities.
    """

    def __init__(self, parameters: TrackParameters) -> None:
        self.parameters = parameters
        self._recent: deque[float] = deque(maxlen=_DOUBTS)

    def apply(self, score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (M,) whether detections of the next look are tracked, and (M,) whether they may begin a track."""
        doubt = 1 / np.clip(score, _LEAST_SCORE, 1.0) - 1
        self._recent.extend(doubt.tolist())
        # Use the lower median: if half of the detections are unlikely, the mean of the middle two is not typical.
        usual = max(sorted(self._recent)[(len(self._recent) - 1) // 2] if self._recent else 0.0, _LEAST_DOUBT)
        return doubt <= self.parameters.doubt * usual, doubt <= self.parameters.birth_doubt * usual


class ScoreTracker:
    """The default tracker of a run. Pass frames in order to `feed`, which returns the settled frames in order.

    A frame is settled when no later frame can change its tracks, at most `track.hits` + 2 sampled frames later.
    """

    def __init__(
        self,
        settings: Settings,
        interval: int,
        size: tuple[float, float] | None = None,
        confirmed: bool = False,
        by_birth: bool = False,
    ) -> None:
        """Start without tracks.

        interval: usual number of frames between fed frames. size: (width, height) of the picture, None if unknown.
        confirmed: whether the detector has confirmed its detections over several frames. by_birth: give identities as
        `FixedLagSmoother` does, so that those of `preview` stay.
        """
        self.parameters, self.interval, self.size = settings.track, interval, size
        self.scene = SceneStatistics(size)
        self.tracks = TrackStates()
        self.flow = self.tracks.state  # states of recent tracks, whose velocities show how targets move
        self.common_velocity = np.zeros(2)  # their common velocity, pixels a look
        self.smoother = FixedLagSmoother(self.parameters.hits, self.parameters.smooth, interval, by_birth)
        self.begun = self._looks = 0
        self._before: _Sample | None = None
        self._waiting: _Sample | None = None
        self._decided: tuple[_Sample, _Choice] | None = None  # the frame that was decided last
        self._doubts = DoubtRule(settings.track)
        self._confirmed = confirmed
        self._least = max(1, -(-settings.track.hits // interval)) if confirmed else 1
        self._uses: dict[int, AppearanceUse] = {}  # use of appearance, by frame, in frames that are not settled
        self._seen = self._lone = 0  # number of detections, and number of those that stayed alone

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
        at: float | None = None,
        damaged: bool = False,
    ) -> list[Tracks]:
        """Add the detections of a frame, and return the settled frames. The frame number must increase.

        now_from_before: (3, 3) pixel homography from the frame fed before; None if the camera stood still or its motion
        is unknown. appearance: returns the (N, D) histograms of the boxes, zeros if unknown. It is called at most once,
        perhaps while the next frame is fed. at: the frame number at a constant frame rate; None: the number itself.
        damaged: see Frame.
        """
        counts, begins = self._doubts.apply(detections.score)
        row = np.flatnonzero(counts)
        wanted = None if self.parameters.appearance == "never" else appearance
        box, score = detections.box_px[row], detections.score[row]
        time, self._looks = (frame if at is None else at) / self.interval, self._looks + 1
        sample = _Sample(frame, box, score, row, begins[row], now_from_before, wanted, time, self._looks, damaged)
        if self.parameters.appearance == "always":
            sample.examine("track.appearance is always")
        if not self.parameters.look_ahead:
            self._decide(sample, None)
        else:
            if self._waiting is not None:
                self._decide(self._waiting, sample)
            self._waiting = sample
        return self._settle()

    def end(self) -> list[Tracks]:
        """Return the remaining frames at the end of the run."""
        if self._waiting is not None:
            self._decide(self._waiting, None)
            self._waiting = None
        return self._settle(everything=True)

    def preview(self) -> Tracks:
        """Return the provisional tracks of the frame fed last, without its successor. They have the detections' boxes.

        Histograms are used only if another frame needed them. The next call of `feed` is not affected.
        """
        if self._waiting is None:
            assert self._decided is not None
            now, chosen = self._decided
        else:
            trial, now = copy(self), copy(self._waiting)
            trial.scene, trial._uses, now.appearance = self.scene.copy(), {}, None
            chosen = trial._choose(now, None)
            self.begun = trial.begun
        at, number = chosen.at, chosen.number
        return Tracks(
            frame=now.frame,
            identity=number + 1,
            box_px=now.box_px[at],
            score=now.score[at],
            row=now.row[at],
            link=chosen.links,
            provisional=True,
        )

    def _settle(self, everything: bool = False) -> list[Tracks]:
        settled = self.smoother.settle(everything)
        uses = (self._uses.pop(tracks.frame, None) for tracks in settled)
        return [replace(tracks, appearance=use) if use else tracks for tracks, use in zip(settled, uses, strict=True)]

    def _decide(self, now: _Sample, ahead: _Sample | None) -> None:
        """Link a frame's detections to the tracks, and update the tracks. ahead: the next frame, if it is known."""
        chosen = self._choose(now, ahead)
        self._commit(now, chosen)
        self._before, self._decided = now, (now, chosen)

    def _choose(self, now: _Sample, ahead: _Sample | None) -> _Choice:
        """Choose the links of a frame's detections to the tracks, in the coordinates of the frame."""
        box, parameters = now.box_px, self.parameters
        self._follow_camera(now)
        score = self._scores(self.tracks, now, box)
        unexamined = [near for near in (now, ahead) if near is not None and near.appearance is not None]
        if unexamined and (cause := ambiguity(score, self.tracks.signature)):
            for near in unexamined:
                near.examine(cause if near is now else f"already compared with frame {now.frame}, where {cause}")
            score = self._scores(self.tracks, now, box)
        if score.size and (now.examined or now.appearance is not None):
            self._uses[now.frame] = AppearanceUse(bool(now.examined), now.examined or "no link is in doubt")
        tracks, detections = plausible_links(score)
        at_border = is_near_border(box, self.size)
        # Tracks that would begin with each detection, without numbers yet, and tracks after each plausible link.
        state = kalman.start(box, now.time, parameters.scatter, self.scene.step, parameters.size_scatter)
        state[:, VX : VY + 1] = self.common_velocity
        count = len(box)
        once, look = np.ones(count, np.int64), np.full(count, now.look)
        born = TrackStates(state, now.signature, np.full(count, -1), once, look)
        continued = self._update(now, tracks, detections, at_border[detections])
        if ahead is not None and len(ahead.row):
            there = ahead.box_px
            if ahead.step is not None:  # convert the boxes to the coordinates of this frame
                there = transform_boxes(there, np.linalg.inv(ahead.step))
            onward = self._scores(_join(continued, born, self.tracks), ahead, there)
            parts = np.split(onward, [len(continued), len(continued) + len(born)])
            chosen = choose_links(score[tracks, detections], tracks, detections, *parts)
        else:
            best = best_pairs(score)
            chosen = np.isin(tracks * count + detections, best[:, 0] * count + best[:, 1])
        link = link_confidences(score, tracks[chosen], detections[chosen])
        begun, new = self._begin(now, tracks[chosen], detections[chosen], born)
        return _Choice(tracks[chosen], detections[chosen], continued[chosen], link, begun, new, at_border)

    def _follow_camera(self, now: _Sample) -> None:
        """Transform the tracks to the coordinates of a frame, and add its boxes to the scene statistics."""
        before = None if self._before is None else self._before.box_px
        if now.step is not None:
            self.tracks = replace(self.tracks, state=kalman.transform(self.tracks.state, now.step))
            before = None if before is None else transform_boxes(before, now.step)
        self._set_flow(now)
        if now.step is None and (shift := self._shift(now)) is not None:
            self.tracks = replace(self.tracks, state=_moved(self.tracks.state, shift))
            self._set_flow(now)
        self.scene.add_look(before, now.box_px, 1.0 if self._before is None else now.time - self._before.time)

    def _set_flow(self, now: _Sample) -> None:
        self.flow = self.tracks.state[(self.tracks.hits > 1) & (self.tracks.look >= now.look - _RECENT)]
        self.common_velocity = common_velocity(self.flow)

    @property
    def _trusts_single(self) -> bool:
        """Whether a single certain detection confirms a track. False if too many detections stayed alone."""
        return self._confirmed or self._lone <= _LONE_SHARE * (self._seen + _DOUBTS)

    def _shift(self, now: _Sample) -> np.ndarray | None:
        """Return the camera's shift, px, that the boxes show beyond the tracks' velocities; None without a shift."""
        recent = self.tracks.look == now.look - 1
        known = recent & (self.tracks.hits > 1)
        newborn = bool(known.sum() < FEWEST)
        tracks, box = self.tracks[recent if newborn else known], now.box_px
        later = kalman.predict(tracks.state, now.time, 0.0)
        shifts = candidate_shifts(later[:, : Y + 1], later[:, HEIGHT], box[:, :2] + box[:, 2:] / 2, box[:, 3])
        if not shifts:
            return None
        each = tracks[np.tile(np.arange(len(tracks)), 1 + len(shifts))]
        each = replace(each, state=_moved(each.state, np.repeat([np.zeros(2), *shifts], len(tracks), axis=0)))
        still, *moved = np.split(self._scores(each, now, box), 1 + len(shifts))
        chosen = likelier_shift(still, moved, newborn)
        return None if chosen is None else shifts[chosen]

    def _scores(self, tracks: TrackStates, sample: _Sample, box_px: np.ndarray) -> np.ndarray:
        """Return (N, M) scores of tracks and a frame's detections. box_px: the boxes in the tracks' coordinates."""
        if not len(tracks) or not len(box_px):
            return np.zeros((len(tracks), len(box_px)))
        scene, missed = self.scene.state(sample.time), sample.look - tracks.look - 1
        look = BoxLook.of(tracks.state, missed, box_px, scene, self.parameters)
        score, once = np.empty((len(tracks), len(box_px))), tracks.hits == 1
        old, new = (~once).nonzero()[0], once.nonzero()[0]
        if len(old):
            score[old] = association_scores(look.of_tracks(old), self.parameters)
        if len(new):
            velocities = likely_velocities(tracks.state[new], self.flow, self.common_velocity)
            score[new] = newborn_scores(look.of_tracks(new), self.parameters, velocities)
        if tracks.signature.shape[1] and sample.signature.shape[1]:
            alike = similarity(tracks.signature, sample.signature)
            score += appearance_scores(alike, sample.visible, self.parameters)
        return score

    def _update(self, now: _Sample, tracks: np.ndarray, detections: np.ndarray, is_cut: np.ndarray) -> TrackStates:
        """Return the tracks (K,) updated by one detection (K,) each. is_cut: see `kalman.update`."""
        old, box, parameters = self.tracks, now.box_px[detections], self.parameters
        later = kalman.predict(old.state[tracks], now.time, parameters.wander * self.scene.step)
        state = kalman.update(later, box, now.time, parameters.scatter, parameters.size_scatter, is_cut)
        hits = old.hits[tracks] + 1
        width = max(old.signature.shape[1], now.signature.shape[1])
        signature, seen = _widen(old.signature, width)[tracks], _widen(now.signature, width)[detections]
        if width:
            signature = blend_histograms(signature, seen, now.visible[detections], hits)
        return TrackStates(state, signature, old.number[tracks], hits, np.full(len(tracks), now.look))

    def _is_part(self, now: _Sample, linked: np.ndarray) -> np.ndarray:
        """Return (M,) whether the centre of a detection lies in the predicted box of an established, linked track.

        Targets may be detected in parts. If one part continues a track, the other parts must not begin new tracks.
        """
        old = self.tracks[linked[self.tracks.hits[linked] >= self._least]]
        later = kalman.predict(old.state, now.time, 0.0)
        offset = np.abs((now.box_px[:, :2] + now.box_px[:, 2:] / 2)[:, None] - later[:, X : Y + 1])
        return np.asarray((offset <= later[:, WIDTH : HEIGHT + 1] / 2).all(axis=2).any(axis=1))

    def _begin(
        self, now: _Sample, tracks: np.ndarray, detections: np.ndarray, born: TrackStates
    ) -> tuple[TrackStates, np.ndarray]:
        """Return the tracks that free detections begin, and these detections. born: a track of each detection."""
        is_free = np.ones(len(now.row), bool)
        is_free[detections] = False
        if self._confirmed:
            is_free &= ~self._is_part(now, tracks)
        new = np.flatnonzero(is_free & now.begins)
        for detection in new.tolist():
            if detection not in now.begun:
                now.begun[detection] = self.begun
                self.begun += 1
        return replace(born[new], number=np.array([now.begun[k] for k in new.tolist()], np.int64)), new

    def _commit(self, now: _Sample, chosen: _Choice) -> None:
        """Take over the links and new tracks of a frame, and drop old tracks."""
        tracks, new, begun, at_border = chosen.tracks, chosen.new, chosen.begun, chosen.at_border
        births = 0 if self._before is None else int((~at_border[new]).sum())
        self.scene.add_links(now.look - self.tracks.look[tracks] - 1, births)
        unseen = np.ones(len(self.tracks), bool)
        unseen[tracks] = False
        self.tracks, at = _join(self.tracks[unseen], chosen.continued, begun), chosen.at
        self.smoother.add(
            frame=now.frame,
            tracks=chosen.number,
            box_px=now.box_px[at],
            score=now.score[at],
            row=now.row[at],
            now_from_before=now.step,
            link=chosen.links,
            trusts_single=self._trusts_single,
            least=_DAMAGED_HITS if now.damaged else self._least,
        )
        looks = now.look - self.tracks.look
        self._seen += len(now.row)
        left_alone = (self.tracks.hits == 1) & (looks == _LONE_LOOKS)
        if left_alone.any():
            place = self.tracks.state[left_alone]
            sides = place[:, WIDTH : HEIGHT + 1]
            boxes = np.concatenate([place[:, : Y + 1] - sides / 2, sides], axis=1)
            self._lone += int((~is_near_border(boxes, self.size)).sum())
        keep = is_remembered(self.tracks.state, now.time, looks, self.interval, self.size, self.parameters)
        late = looks > FILLED + 1
        if late.any():  # drop tracks that can no longer be confirmed
            keep &= ~late | self.smoother.are_confirmed(self.tracks.number)
        if not keep.all():
            self.smoother.forget(self.tracks.number[~keep])
            self.tracks = self.tracks[keep]


def is_remembered(
    state: np.ndarray,
    time: float,
    looks: np.ndarray,
    interval: int,
    size: tuple[float, float] | None,
    parameters: TrackParameters,
) -> np.ndarray:
    """Return (N,) whether tracks are kept after a look. Tracks that have left the picture are dropped earlier.

    state: (N, kalman.COLUMNS) at the last detection. time: time of the look. looks: (N,) looks since the last
    detection. interval: frames in a look. All may be arrays or tensors.
    """
    age = time - state[..., SEEN]
    frames = age * interval
    keep = frames <= parameters.memory_frames
    if size is None:
        return keep
    going = namespace(state).clip(age, None, max(_LEAVING_FRAMES / interval, _LEAVING_LOOKS))
    x, y = state[..., X] + going * state[..., VX], state[..., Y] + going * state[..., VY]
    outside = (x < 0) | (x > size[0]) | (y < 0) | (y > size[1])
    return keep & (~outside | (frames <= parameters.memory_outside_frames) | (looks <= 1))


def _moved(state: np.ndarray, shift_px: np.ndarray) -> np.ndarray:
    """Return states with positions shifted by (2,) or (N, 2) pixels."""
    state = state.copy()
    state[:, : Y + 1] += shift_px
    return state
