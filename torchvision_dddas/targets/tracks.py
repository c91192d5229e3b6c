"""From detections to identities, one look at a time."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.settings import Settings
from torchvision_dddas.targets import kalman
from torchvision_dddas.targets.assignment import pairs
from torchvision_dddas.targets.columns import best_columns
from torchvision_dddas.targets.kalman import HEIGHT, SEEN, X, Y
from torchvision_dddas.targets.links import (
    Sight,
    likeness_scores,
    link_scores,
    near_border,
    visible_share,
)
from torchvision_dddas.targets.pace import Pace
from torchvision_dddas.types import Detections, Tracks

_LEAST_LINK = -2.0  # a link of a lower score is not made even if the next look speaks for it
_AHEAD = 0.7  # weight of the next look
_SIZE_GAIN = 0.5
_RATE = 5.0
_LEAVES = 15  # frames for which a target is taken to go on as it went
_FILL = 2  # looks that a gap may last to be filled


@dataclass
class _Look:
    """A frame on its way. now_from_before: from the look before it."""

    frame: int
    box_px: np.ndarray
    score: np.ndarray
    used: np.ndarray  # rows of the frame's detections
    now_from_before: np.ndarray | None
    signature: np.ndarray | None
    visible: np.ndarray


class Tracker:
    """The state of a run. Feed it frames in order; each call returns the frames that are settled by it, in order.

    A batch run is the same calls one after another, so it gives the same result as a run online.
    """

    def __init__(self, settings: Settings, interval_frames: int, size: tuple[int, int] | None = None) -> None:
        """interval_frames: usual distance of the frames fed. size: (width, height) of the picture, None if unknown."""
        self.knobs, self.interval, self.size = settings.track, interval_frames, size
        self.pace = Pace(self.knobs.speed)
        self.state = np.zeros((0, kalman.COLUMNS))
        self.signature: np.ndarray | None = None
        self.at_border = np.zeros(0, bool)
        self.identity = np.zeros(0, np.int64)  # of this class's own count; users see those of confirmed tracks only
        self.hits = np.zeros(0, np.int64)
        self.first = True
        self.next = 0
        self.waiting: _Look | None = None
        self.before: _Look | None = None
        self.births = [0.0, 0.0]
        self.book = _Book(self.knobs.hits, interval_frames)

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
    ) -> list[Tracks]:
        """Take the detections of a frame, whose number is above the last one's.

        now_from_before: (3, 3) pixel homography from the frame fed before; None: the camera stood still, or unknown.
        appearance: gives the (N, D) histograms of the boxes; called only where they are needed.
        """
        used = np.flatnonzero(detections.score >= self.knobs.min_score)
        boxes = detections.box_px[used]
        wanted = appearance is not None and self.knobs.appearance != "never" and len(used)
        signature = appearance()[used] if wanted and appearance is not None else None
        look = _Look(frame, boxes, detections.score[used], used, now_from_before, signature, visible_share(boxes))
        earlier, self.waiting = self.waiting, look
        if earlier is not None:
            self._decide(earlier, look if self.knobs.look_ahead else None)
        return self.book.settled(frame)

    def end(self) -> list[Tracks]:
        """The frames that were still waiting."""
        if self.waiting is not None:
            self._decide(self.waiting, None)
            self.waiting = None
        return self.book.settled(None)

    # -- one look ----------------------------------------------------------------------------------------------------

    def _decide(self, look: _Look, ahead: _Look | None) -> None:
        knobs = self.knobs
        if look.now_from_before is not None and len(self.state):
            self.state = kalman.carried(self.state, look.now_from_before)
        if self.before is not None:
            gap = look.frame - self.before.frame
            self.pace.add(_moved(self.before.box_px, look.now_from_before), look.box_px, gap)
        sight = self._sight(look.frame)
        links = self._links(
            self.state, self.signature, self.at_border, look.box_px, look.signature, look.visible, sight
        )
        if ahead is not None and len(ahead.box_px):
            matched = self._with_next(links, look, ahead)
        else:
            matched = pairs(links, 0.0)
        self._commit(look, matched)
        self.before = look

    def _sight(self, frame: int) -> Sight:
        rate = self.births[0] / self.births[1] * _RATE / self.interval if self.births[1] > 30 else 0.0
        return Sight(frame, self.interval, self.pace.speed, rate, self.size)

    def _links(self, state, signature, at_border, boxes, signs, visible, sight) -> np.ndarray:
        links = link_scores(state, at_border, boxes, sight, self.knobs)
        if signature is not None and signs is not None:
            likeness = np.sqrt(signature) @ np.sqrt(signs).T
            links += likeness_scores(likeness, visible, self.knobs)
        return links

    def _with_next(self, links: np.ndarray, look: _Look, ahead: _Look) -> np.ndarray:
        """The pairs (track, detection) that are best in view of the next look."""
        knobs = self.knobs
        boxes = _moved(ahead.box_px, None if ahead.now_from_before is None else np.linalg.inv(ahead.now_from_before))
        gap = ahead.frame - look.frame
        sight = self._sight(ahead.frame)
        tracks, now = np.nonzero(links > _LEAST_LINK)
        agility = knobs.agility * sight.speed / 0.07
        later = kalman.predicted(self.state[tracks], look.frame, agility)
        follow = kalman.updated(later, look.box_px[now], look.frame, knobs.scatter, _SIZE_GAIN)
        born = kalman.started(look.box_px, look.frame, knobs.scatter, sight.speed)
        state = np.concatenate([follow, born, self.state])
        border = near_border(look.box_px, self.size)
        at_border = np.concatenate([border[now], border, self.at_border])
        signature = None
        if look.signature is not None and self.signature is not None and ahead.signature is not None:
            gain = self._signature_gain(self.hits[tracks] + 1, look.visible[now])[:, None]
            mixed = (1 - gain) * self.signature[tracks] + gain * look.signature[now]
            signature = np.concatenate([mixed, look.signature, self.signature])
        on = self._links(state, signature, at_border, boxes, ahead.signature, ahead.visible, sight)
        a, b = len(follow), len(follow) + len(born)
        columns, scores = [], []
        none = np.full(len(tracks), -1)
        value = links[tracks, now]
        columns.append(np.stack([tracks, now, none], 1))
        scores.append(value)
        p, k = np.nonzero(on[:a] > 0)
        columns.append(np.stack([tracks[p], now[p], k], 1))
        scores.append(value[p] + _AHEAD * on[p, k])
        j, k = np.nonzero(on[a:b] > 0)
        columns.append(np.stack([np.full(len(j), -1), j, k], 1))
        scores.append(_AHEAD * on[a + j, k])
        i, k = np.nonzero(on[b:] > 0)
        columns.append(np.stack([i, np.full(len(i), -1), k], 1))
        scores.append(_AHEAD * on[b + i, k])
        column, score = np.concatenate(columns), np.concatenate(scores)
        keep = score > 0
        column, score = column[keep], score[keep]
        chosen = column[best_columns(column, score)]
        return chosen[(chosen[:, 0] >= 0) & (chosen[:, 1] >= 0), :2]

    def _signature_gain(self, hits: np.ndarray, visible: np.ndarray) -> np.ndarray:
        return np.maximum(0.2, 1 / hits) * visible**2

    def _commit(self, look: _Look, matched: np.ndarray) -> None:
        knobs = self.knobs
        frame, boxes = look.frame, look.box_px
        tracks, now = matched[:, 0], matched[:, 1]
        agility = knobs.agility * self.pace.speed / 0.07
        later = kalman.predicted(self.state[tracks], frame, agility)
        self.state[tracks] = kalman.updated(later, boxes[now], frame, knobs.scatter, _SIZE_GAIN)
        self.hits[tracks] += 1
        border = near_border(boxes, self.size)
        self.at_border[tracks] = border[now]
        if look.signature is not None and self.signature is not None:
            gain = self._signature_gain(self.hits[tracks], look.visible[now])[:, None]
            self.signature[tracks] += gain * (look.signature[now] - self.signature[tracks])
        new = np.ones(len(boxes), bool)
        new[now] = False
        new = np.flatnonzero(new & (look.score >= knobs.birth_score))
        owner = np.full(len(boxes), -1, np.int64)
        owner[now] = self.identity[tracks]
        owner[new] = self.next + np.arange(len(new))
        self.next += len(new)
        if self.before is not None:
            self.births[0] += float((~border[new]).sum())
            self.births[1] += len(boxes)
        self.state = np.concatenate([self.state, kalman.started(boxes[new], frame, knobs.scatter, self.pace.speed)])
        self.hits = np.concatenate([self.hits, np.ones(len(new), np.int64)])
        self.identity = np.concatenate([self.identity, owner[new]])
        self.at_border = np.concatenate([self.at_border, border[new]])
        if look.signature is not None:
            fresh = look.signature[new]
            if self.signature is None:
                self.signature = fresh if len(fresh) == len(self.state) else None
            else:
                self.signature = np.concatenate([self.signature, fresh])
        self.book.add(look, owner)
        self._forget(frame)

    def _forget(self, frame: int) -> None:
        age = frame - self.state[:, SEEN]
        keep = age <= self.knobs.memory_frames
        if self.size is not None:
            # Later a target may as well have stopped or turned before it reached the border.
            reach = np.minimum(age, _LEAVES)[:, None]
            gone = self.state[:, : Y + 1] + reach * self.state[:, kalman.VX : kalman.VY + 1]
            outside = (gone < 0).any(axis=1) | (gone > np.array(self.size)).any(axis=1)
            keep &= ~outside | (age <= max(self.knobs.memory_outside_frames, self.interval))
        young = self.hits < self.knobs.hits
        keep &= ~young | (age <= (_FILL + 1) * self.interval) | self.book.confirmed(self.identity)
        if not keep.all():
            self.state, self.hits, self.identity = self.state[keep], self.hits[keep], self.identity[keep]
            self.at_border = self.at_border[keep]
            if self.signature is not None:
                self.signature = self.signature[keep]


def _moved(box_px: np.ndarray, homography: np.ndarray | None) -> np.ndarray:
    """Boxes carried over by a homography: the centre moves, the size changes with the scale there."""
    if homography is None or not len(box_px):
        return box_px
    state = kalman.carried(kalman.started(box_px, 0, 0.0, 0.0), homography)
    size = state[:, kalman.WIDTH : HEIGHT + 1]
    return np.concatenate([state[:, X : Y + 1] - size / 2, size], axis=1)


@dataclass
class _Book:
    """What has been decided, held back until no later look can confirm a track in it or fill a gap."""

    hits: int
    interval: int
    pages: deque = field(default_factory=deque)
    seen: dict = field(default_factory=dict)  # own count -> [hits, sure, last frame, last box, last score]
    public: dict = field(default_factory=dict)

    def confirmed(self, identity: np.ndarray) -> np.ndarray:
        return np.array([i in self.public or self.seen[i][1] for i in identity.tolist()], bool)

    def add(self, look: _Look, owner: np.ndarray) -> None:
        rows = []
        for k, who in enumerate(owner.tolist()):
            if who < 0:
                continue
            entry = self.seen.setdefault(who, [0, False, None])
            entry[0] += 1
            entry[1] |= entry[0] >= self.hits or look.score[k] >= 1.0
            last = entry[2]
            if last is not None:
                self._fill(who, last, (look.frame, look.box_px[k], look.score[k]))
            entry[2] = (look.frame, look.box_px[k], look.score[k])
            rows.append((who, look.box_px[k], look.score[k], int(look.used[k])))
        self.pages.append((look.frame, rows))

    def _fill(self, who: int, last: tuple, now: tuple) -> None:
        if now[0] - last[0] > (_FILL + 1) * self.interval or now[0] - last[0] <= self.interval:
            return
        for frame, rows in self.pages:
            if last[0] < frame < now[0]:
                part = (frame - last[0]) / (now[0] - last[0])
                rows.append((who, last[1] + part * (now[1] - last[1]), last[2] + part * (now[2] - last[2]), -1))

    def settled(self, frame: int | None) -> list[Tracks]:
        """The frames on which nothing can change any more; all of them at the end."""
        done = []
        delay = self.hits - 1 + _FILL
        while self.pages and (frame is None or len(self.pages) > delay):
            number, rows = self.pages.popleft()
            sure = [r for r in rows if self.seen[r[0]][1]]
            for r in sure:
                self.public.setdefault(r[0], len(self.public) + 1)
            done.append(
                Tracks(
                    number,
                    np.array([self.public[r[0]] for r in sure], np.int64),
                    np.array([r[1] for r in sure], float).reshape(-1, 4),
                    np.array([r[2] for r in sure], float),
                    np.array([r[3] for r in sure], np.int64),
                )
            )
        return done
