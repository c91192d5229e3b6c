"""From detections to identities, one look at a time."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.appearance_score import blended, in_doubt, likeness_scores, visible_share
from torchvision_dddas.tracking.kalman import SEEN, carried_boxes
from torchvision_dddas.tracking.lookahead import best_links, plausible
from torchvision_dddas.tracking.scores import Sight, births_of, link_scores, near_border
from torchvision_dddas.tracking.smoother import FILLED, Ledger
from torchvision_dddas.tracking.speed_prior import Pace
from torchvision_dddas.tracking.track_memory import remembered
from torchvision_dddas.tracking.track_state import Roster, widened
from torchvision_dddas.types import Detections, Tracks


@dataclass
class _Look:
    """A frame and those of its detections that count. row: of the frame's detections. step: now from the look before.

    appearance: gives the (M, D) histograms. signature: these, (M, 0) until asked for, and visible: share of each box.
    interval: frames from the look before, were none missing.
    """

    frame: int
    box_px: np.ndarray
    score: np.ndarray
    row: np.ndarray
    step: np.ndarray | None
    appearance: Callable[[], np.ndarray] | None
    signature: np.ndarray
    visible: np.ndarray
    interval: int = 1

    def examine(self) -> None:
        """Look at the picture, once."""
        if self.appearance is not None and len(self.row):
            self.signature, self.visible = self.appearance()[self.row], visible_share(self.box_px)
        self.appearance = None

    def boxes_before(self) -> np.ndarray:
        """The boxes in the coordinates of the look before."""
        return self.box_px if self.step is None else carried_boxes(self.box_px, np.linalg.inv(self.step))


class Tracker:
    """The state of a run. Feed it frames in order; each call returns the frames that are settled by it, in order.

    A batch run is the same calls one after another, so it gives the same result as a run online. A frame is settled
    `track.hits` + 2 looks later at the most.
    """

    def __init__(self, settings: Settings, interval_frames: int, size: tuple[float, float] | None = None) -> None:
        """interval_frames: usual distance of the frames fed. size: (width, height) of the picture, None if unknown."""
        self.parameters, self.interval, self.size = settings.track, interval_frames, size
        self.pace = Pace(self.parameters.speed)
        self.roster = Roster()
        self.ledger = Ledger(self.parameters.hits, self.parameters.smooth, interval_frames)
        self.begun = 0
        self.before: _Look | None = None
        self.waiting: _Look | None = None
        self.seen = self.doubtful = self.births = 0  # detections; those not certain; tracks begun inside the picture

    def feed(
        self,
        frame: int,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        appearance: Callable[[], np.ndarray] | None = None,
        interval_frames: int | None = None,
    ) -> list[Tracks]:
        """Take the detections of a frame, whose number is above the last one's.

        now_from_before: (3, 3) pixel homography from the frame fed before; None: the camera stood still, or unknown.
        appearance: gives the (N, D) histograms of the boxes, zeros where unknown; called once at most, and maybe with
        the next frame. interval_frames: from the frame before, where that is not the usual distance.
        """
        row = np.flatnonzero(detections.score >= self.parameters.min_score)
        box = detections.box_px[row]
        asked = None if self.parameters.appearance == "never" else appearance
        unknown = np.zeros((len(row), 0), np.float32), np.ones(len(row))
        interval = self.interval if interval_frames is None else interval_frames
        look = _Look(frame, box, detections.score[row], row, now_from_before, asked, *unknown, interval)
        if self.parameters.appearance == "always":
            look.examine()
        if not self.parameters.look_ahead:
            self._decide(look, None)
        else:
            if self.waiting is not None:
                self._decide(self.waiting, look)
            self.waiting = look
        return self.ledger.settle()

    def end(self) -> list[Tracks]:
        """The frames that were still waiting."""
        if self.waiting is not None:
            self._decide(self.waiting, None)
            self.waiting = None
        return self.ledger.settle(everything=True)

    def _decide(self, look: _Look, ahead: _Look | None) -> None:
        """Link a look's detections to the tracks, in view of the next look where there is one."""
        if look.step is not None:
            self.roster = self.roster.carried(look.step)
        if self.before is not None:
            before = self.before.box_px if look.step is None else carried_boxes(self.before.box_px, look.step)
            self.pace.add(before, look.box_px, look.frame - self.before.frame)
        self.seen += len(look.score)
        self.doubtful += int((look.score < 1).sum())
        links = self._scores(self.roster, look, look.box_px)
        unexamined = [near for near in (look, ahead) if near is not None and near.appearance is not None]
        if unexamined and in_doubt(links, self.roster.signature):
            for near in unexamined:
                near.examine()
            links = self._scores(self.roster, look, look.box_px)
        tracks, now = plausible(links)
        born = self._born(look)
        followed = self._followed(look, tracks, now, born.at_border)
        if ahead is not None and len(ahead.row):
            onward = self._scores(followed.plus(born).plus(self.roster), ahead, ahead.boxes_before())
            parts = np.split(onward, [len(followed), len(followed) + len(born)])
            chosen = best_links(links[tracks, now], tracks, now, *parts)
        else:
            best = best_pairs(links)
            chosen = np.isin(tracks * len(look.row) + now, best[:, 0] * len(look.row) + best[:, 1])
        self._commit(look, tracks[chosen], now[chosen], followed.only(chosen), born)
        self.before = look

    def _sight(self, look: _Look) -> Sight:
        doubt = self.doubtful / max(self.seen, 1)
        births = births_of(self.births, self.seen, doubt, self.interval)
        return Sight(look.frame, look.interval, self.pace.speed, births, doubt, self.size)

    def _scores(self, roster: Roster, look: _Look, box_px: np.ndarray) -> np.ndarray:
        """(N, M) scores of links to a look's detections, whose boxes are given in the roster's coordinates."""
        scores = link_scores(roster.state, roster.at_border, box_px, self._sight(look), self.parameters)
        if roster.signature.shape[1] and look.signature.shape[1]:
            scores += likeness_scores(roster.signature, look.signature, look.visible, self.parameters)
        return scores

    def _followed(self, look: _Look, tracks: np.ndarray, now: np.ndarray, at_border: np.ndarray) -> Roster:
        """The tracks (K,) after a detection (K,) each. at_border: (M,) which of the look's detections are."""
        old, box, sight = self.roster, look.box_px[now], self._sight(look)
        later = kalman.predicted(old.state[tracks], look.frame, sight.agility(self.parameters))
        hits = old.hits[tracks] + 1
        width = max(old.signature.shape[1], look.signature.shape[1])
        signature, seen = widened(old.signature, width)[tracks], widened(look.signature, width)[now]
        return Roster(
            kalman.updated(later, box, look.frame, self.parameters.scatter, self.parameters.size_scatter),
            blended(signature, seen, look.visible[now], hits) if width else signature,
            at_border[now],
            old.number[tracks],
            hits,
        )

    def _born(self, look: _Look) -> Roster:
        """Tracks that would begin with each detection (M,) of a look, without numbers yet."""
        box, count = look.box_px, len(look.row)
        return Roster(
            kalman.started(box, look.frame, self.parameters.scatter, self.pace.speed, self.parameters.size_scatter),
            look.signature,
            near_border(box, self.size),
            np.full(count, -1),
            np.ones(count, np.int64),
        )

    def _commit(self, look: _Look, tracks: np.ndarray, now: np.ndarray, followed: Roster, born: Roster) -> None:
        """Write down that these tracks (K,), now `followed`, have these detections (K,), and begin new ones."""
        unmatched = np.ones(len(look.row), bool)
        unmatched[now] = False
        beginning = unmatched & (look.score >= self.parameters.birth_score)
        new = np.flatnonzero(beginning)
        begun = replace(born.only(beginning), number=self.begun + np.arange(len(new)))
        self.begun += len(begun)
        if self.before is not None:
            self.births += int((~begun.at_border).sum())
        unseen = np.ones(len(self.roster), bool)
        unseen[tracks] = False
        self.roster = self.roster.only(unseen).plus(followed).plus(begun)
        number, at = np.concatenate([followed.number, begun.number]), np.concatenate([now, new])
        self.ledger.write(look.frame, number, look.box_px[at], look.score[at], look.row[at], look.step)
        self._forget(look)

    def _forget(self, look: _Look) -> None:
        """Drop the tracks that were lost too long ago, or left, or were seen too seldom to be anything."""
        keep = remembered(self.roster.state, look.frame, look.interval, self.size, self.parameters)
        late = look.frame - self.roster.state[:, SEEN] > (FILLED + 1) * look.interval
        if late.any():
            keep &= ~late | self.ledger.confirmed(self.roster.number)
        if not keep.all():
            self.ledger.forget(self.roster.number[~keep])
            self.roster = self.roster.only(keep)
