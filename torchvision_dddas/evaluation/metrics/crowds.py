"""How well crowds were found, followed, located and told from vehicles in a simulated run, from truth and results.

Every measure is defined at its field of CrowdScore; what lies in a box and what covers a crowd in crowd_frames.
"""

import math
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.evaluation.metrics import tracking
from torchvision_dddas.evaluation.metrics.crowd_frames import (
    LEAST_VISIBLE,
    Crowd,
    Shown,
    Told,
    bodies_held,
    box_about,
    covering,
    crowds,
    pixels_held,
    shown,
    touched,
)
from torchvision_dddas.evaluation.metrics.matching import pair
from torchvision_dddas.evaluation.metrics.pixels import ratio
from torchvision_dddas.evaluation.metrics.truth import TrackTable
from torchvision_dddas.types import FrameResult, Truth

INSIDE = 5.991
"""Of chi-square with two degrees of freedom, in 95 %."""

STAYS = 0.25
"""A crowd keeps its identity until another target holds this share of its pixels more than the one that has it."""

CAP_M = 10.0
"""What not knowing where a crowd is costs, as if it were known to within so much, and the most that an error does."""

HOLD_S = 1.0
"""So long the last known place of a crowd stands for it, moved on at its velocity."""

IOU_LEAST = 0.3
"""From which a box is the target's, for IDF1: blobs fit crowds less tightly than labels do people."""


@dataclass(frozen=True)
class Spread:
    """Of errors in metres; NaN where there are none."""

    count: int
    mean: float
    median: float
    p95: float


@dataclass(frozen=True)
class CrowdScore:
    """The measures of one run; shares in [0, 1], NaN where there is nothing to judge.

    frames: that were looked at. crowd_frames: over them, crowds of which at least half of the people show. recall:
    share of those that a located target covers; detected: that any target covers; recall_moving: recall without crowds
    that stand, which do not move against their background.
    false_blobs: detections a frame that touch nothing that can move; false_targets: the same of targets with an
    identity. landmark_blobs: detections a frame that hold a landmark and nobody else.
    target_error_m: of each located target that holds people, from their mean place. crowd_error_m: of each crowd that
    located targets cover, from their mean, weighted by the areas of their boxes, to the mean of its visible people.
    inside: share of targets whose 95 % ellipse holds that place of their people.
    switches: how often a crowd's identity changed while its people stayed the same, under a one-to-one assignment of
    crowds to targets by pixels held in which an identity stays with its crowd until another target holds STAYS more;
    switches_a_minute: for each crowd and minute in which it counts. idf1: of crowds and cars, boxes at IoU IOU_LEAST.
    kind_right: share of identities that some ground vehicle saw whose last kind, human or not_human, is right; a target
    is truly human if most of its boxes hold people. blob_kind_right: the same for each frame and target told.
    knowledge_m: the error of what is known at every moment of the clip, in looked-at frames and between, of every crowd
    of the world, in the picture or not: the place last told within HOLD_S, moved on at its velocity; CAP_M where there
    is none, and at most. known: share of those moments with one.
    """

    frames: int
    crowd_frames: int
    recall: float
    recall_moving: float
    detected: float
    false_blobs: float
    false_targets: float
    landmark_blobs: float
    target_error_m: Spread
    crowd_error_m: Spread
    inside: float
    switches: int
    switches_a_minute: float
    crowd_minutes: float
    idf1: float
    kinds: int
    kind_right: float
    blob_kind_right: float
    knowledge_m: float
    known: float

    def by_name(self) -> dict[str, object]:
        """All figures by name, as JSON has them: None where there is none."""

        def plain(value: object) -> object:
            if isinstance(value, dict):
                return {name: plain(part) for name, part in value.items()}
            return None if isinstance(value, float) and math.isnan(value) else value

        named = plain(asdict(self))
        assert isinstance(named, dict)
        return named

    def lines(self) -> list[str]:
        """The figures in words, one line a subject; none of subjects without a figure."""
        of, told = self.crowd_error_m, []
        if self.crowd_frames:
            told.append(
                f"crowds: {100 * self.recall:.1f} % of {self.crowd_frames} seen and located, "
                f"{self.false_blobs:.2f} false blobs a frame"
            )
        if of.count:
            told.append(f"error of a crowd's place: mean {of.mean:.2f} m, median {of.median:.2f}, 95 % {of.p95:.2f}")
        if (of := self.target_error_m).count:
            told.append(f"error of a target from its people: mean {of.mean:.2f} m, median {of.median:.2f}")
        if not math.isnan(self.inside):
            told.append(f"95 % ellipses hold the truth in {100 * self.inside:.1f} %")
        if not math.isnan(self.switches_a_minute):
            told.append(
                f"identities: {self.switches_a_minute:.2f} switches a crowd and minute, IDF1 {100 * self.idf1:.1f} %"
            )
        if self.kinds:
            told.append(f"human or not: right for {100 * self.kind_right:.1f} % of {self.kinds} targets seen close up")
        if not math.isnan(self.knowledge_m):
            told.append(
                f"what is known of all crowds at all times: {self.knowledge_m:.2f} m off, {CAP_M:g} where nothing is"
            )
        return told


@dataclass
class _Known:
    """What was last told of a crowd."""

    time_s: float
    place_m: np.ndarray
    velocity_m_s: np.ndarray


class CrowdScorer:
    """Scores a run from its streams: feed it the truth of each frame, and then what was found in it, in order.

    Frames without truth are left out, and so are those that could not be read. It holds the truth of frames that are
    not yet settled, without their pictures, and some numbers for each target and frame.
    """

    def __init__(
        self, local: Callable[[np.ndarray], np.ndarray] | None = None, least_visible: float = LEAST_VISIBLE
    ) -> None:
        """local: takes (N, 2) longitude, latitude to the truth's metres; None: places are told in those."""
        self._local, self._least = local, least_visible
        self._waiting: dict[int, Shown] = {}
        self._before: tuple[Shown, list[Crowd]] | None = None
        self._counts: Counter[str] = Counter()
        self._target_error, self._crowd_error = array("d"), array("d")
        self._carrier: dict[int, tuple[frozenset[int], int]] = {}
        self._minutes = 0.0
        self._true_rows: list[tuple[int, int, np.ndarray]] = []
        self._found_rows: list[tuple[int, int, np.ndarray]] = []
        self._holds: defaultdict[int, int] = defaultdict(int)
        self._kind: dict[int, str] = {}
        self._known: dict[int, _Known] = {}
        self._cost = 0.0

    def feed(self, item: Truth | Shown | FrameResult) -> None:
        """The truth of a frame, or what was found in one whose truth was fed before."""
        if not isinstance(item, FrameResult):
            self._waiting[item.frame] = shown(item) if isinstance(item, Truth) else item
            return
        number = item.tracked.number
        truth = self._waiting.get(number)
        for old in [frame for frame in self._waiting if frame <= number]:
            del self._waiting[old]
        frame = item.tracked.frame
        if truth is not None and (frame is None or frame.image.any()):
            self._judge(truth, told_of(item, self._local))

    def score(self) -> CrowdScore:
        """The measures of what was fed until now."""
        n, frames = self._counts, self._counts["frames"]
        moving = n["crowd_frames"] - n["still"], n["found"] - n["still_found"]
        truth, found = (_table(rows) for rows in (self._true_rows, self._found_rows))
        idf1 = (
            tracking.identity_measures(tracking.count_identity(pair(truth, found), IOU_LEAST))["idf1"]
            if frames
            else math.nan
        )
        right = sum((self._holds[which] > 0) == (kind == "human") for which, kind in self._kind.items())
        return CrowdScore(
            frames=frames,
            crowd_frames=n["crowd_frames"],
            recall=ratio(n["found"], n["crowd_frames"]),
            recall_moving=ratio(moving[1], moving[0]),
            detected=ratio(n["detected"], n["crowd_frames"]),
            false_blobs=ratio(n["false_blobs"], frames),
            false_targets=ratio(n["false_targets"], frames),
            landmark_blobs=ratio(n["landmark_blobs"], frames),
            target_error_m=_spread(self._target_error),
            crowd_error_m=_spread(self._crowd_error),
            inside=ratio(n["inside"], n["ellipses"]),
            switches=n["switches"],
            switches_a_minute=ratio(n["switches"], self._minutes),
            crowd_minutes=self._minutes,
            idf1=idf1,
            kinds=len(self._kind),
            kind_right=ratio(right, len(self._kind)),
            blob_kind_right=ratio(n["kinds_right"], n["kinds"]),
            knowledge_m=ratio(self._cost, n["moments"]),
            known=ratio(n["known"], n["moments"]),
        )

    def _judge(self, truth: Shown, told: Told) -> None:
        found = crowds(truth, self._least)
        held = pixels_held(truth, told.box_px)
        lies = bodies_held(truth, held)
        covers = covering(truth, found, told, lies)
        self._counts["frames"] += 1
        self._judge_blobs(truth, told)
        self._judge_places(truth, told, found, lies, covers)
        self._judge_identities(truth, told, found, held, covers)
        self._judge_kinds(truth, told, lies)
        self._judge_knowledge(truth, told, found, covers)
        self._before = truth, found

    def _judge_blobs(self, truth: Shown, told: Told) -> None:
        self._counts["false_blobs"] += int((~touched(truth, told.blob_px)).sum())
        self._counts["false_targets"] += int((~touched(truth, told.box_px)).sum())
        lies = bodies_held(truth, pixels_held(truth, told.blob_px))
        vehicle = truth.kind == "ugv"
        self._counts["landmark_blobs"] += int((lies[:, vehicle].any(axis=1) & ~lies[:, ~vehicle].any(axis=1)).sum())

    def _judge_places(self, truth: Shown, told: Told, found: list[Crowd], lies: np.ndarray, covers: np.ndarray) -> None:
        located = np.isfinite(told.place_m).all(axis=1)
        person = truth.kind == "person"
        for row in np.flatnonzero(located & lies[:, person].any(axis=1)):
            off = told.place_m[row] - truth.place_m[lies[row] & person].mean(axis=0)
            self._target_error.append(float(np.linalg.norm(off)))
            covariance = told.covariance_m2[row]
            if np.isfinite(covariance).all() and np.linalg.det(covariance) > 0:
                self._counts["ellipses"] += 1
                self._counts["inside"] += int(off @ np.linalg.solve(covariance, off) <= INSIDE)
        for crowd, over in zip(found, covers, strict=True):
            if not crowd.counts:
                continue
            by: np.ndarray = over & located
            self._counts.update(crowd_frames=1, found=int(by.any()), detected=int(over.any()))
            self._counts.update(still=int(crowd.still), still_found=int(crowd.still and by.any()))
            if by.any():
                self._crowd_error.append(float(np.linalg.norm(_mean_place(told, by) - crowd.middle_m)))

    def _judge_identities(
        self, truth: Shown, told: Told, found: list[Crowd], held: np.ndarray, covers: np.ndarray
    ) -> None:
        counting = [k for k, crowd in enumerate(found) if crowd.counts]
        self._minutes += len(counting) * (truth.time_s - self._before[0].time_s) / 60 if self._before else 0.0
        worth = np.zeros((len(counting), len(told)))
        for line, k in enumerate(counting):
            mine = held[:, found[k].people].sum(axis=1) / max(truth.pixels[found[k].people].sum(), 1)
            had = self._carrier.get(found[k].number)
            stays = STAYS * (told.identity == had[1]) if had is not None else 0.0
            worth[line] = covers[k] * (1e-3 + mine + stays)
        for row, column in zip(*linear_sum_assignment(worth, maximize=True), strict=True):
            if not worth[row, column]:
                continue
            crowd, now = found[counting[row]], int(told.identity[column])
            people = frozenset(truth.number[crowd.people].tolist())
            had = self._carrier.get(crowd.number)
            self._counts["switches"] += int(had is not None and had[0] == people and had[1] != now)
            self._carrier[crowd.number] = people, now
        for number in np.unique(truth.target[(truth.pixels > 0) & (truth.kind != "ugv")]).tolist():
            box = box_about(truth, np.flatnonzero(truth.target == number))
            self._true_rows.append((truth.frame, number, box))
        self._found_rows += [(truth.frame, int(i), box) for i, box in zip(told.identity, told.box_px, strict=True)]

    def _judge_kinds(self, truth: Shown, told: Told, lies: np.ndarray) -> None:
        human = np.asarray(lies[:, truth.kind == "person"].any(axis=1))
        for row, kind in enumerate(told.kind):
            which = int(told.identity[row])
            self._holds[which] += 1 if human[row] else -1
            if kind != "unseen":
                self._kind[which] = kind
                self._counts.update(kinds=1, kinds_right=int((kind == "human") == bool(human[row])))

    def _judge_knowledge(self, truth: Shown, told: Told, found: list[Crowd], covers: np.ndarray) -> None:
        now = {crowd.number: crowd.place_m for crowd in found}
        if self._before is not None:
            last, crowds_then = self._before
            before = {crowd.number: crowd.place_m for crowd in crowds_then}
            for share in np.arange(1, truth.frame - last.frame) / (truth.frame - last.frame):
                moment = last.time_s + share * (truth.time_s - last.time_s)
                for number in before.keys() & now.keys():
                    self._charge(number, moment, before[number] + share * (now[number] - before[number]))
        located = np.isfinite(told.place_m).all(axis=1)
        for crowd, over in zip(found, covers, strict=True):
            by: np.ndarray = over & located
            if by.any():
                velocity = np.nan_to_num(told.velocity_m_s[by]).mean(axis=0)
                self._known[crowd.number] = _Known(truth.time_s, _mean_place(told, by), velocity)
            self._charge(crowd.number, truth.time_s, crowd.place_m)

    def _charge(self, number: int, time_s: float, place_m: np.ndarray) -> None:
        known, cost = self._known.get(number), CAP_M
        if known is not None and (age := time_s - known.time_s) <= HOLD_S + 1e-9:
            cost = min(float(np.linalg.norm(known.place_m + age * known.velocity_m_s - place_m)), CAP_M)
            self._counts["known"] += 1
        self._counts["moments"] += 1
        self._cost += cost


def told_of(surveyed: FrameResult, local: Callable[[np.ndarray], np.ndarray] | None = None) -> Told:
    """What a run says of a frame: its targets that were seen, located or not. local: as in CrowdScorer."""
    tracks = surveyed.tracked.tracks
    seen = np.flatnonzero(tracks.row >= 0)  # a box that bridges a gap is where nothing was found
    count = len(seen)
    place, velocity = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    covariance, kind = np.full((count, 2, 2), np.nan), ["unseen"] * count
    grounded = surveyed.locations
    if grounded is not None:
        positions, row = grounded.positions, grounded.row
        told = positions.east_north_m
        place[row] = told if local is None or positions.lonlat_deg is None else local(positions.lonlat_deg)
        covariance[row], velocity[row] = positions.covariance_m2, grounded.velocity_m_s
        if surveyed.confirmed is not None:
            for which, what in zip(row[surveyed.confirmed.row].tolist(), surveyed.confirmed.kind, strict=True):
                kind[which] = what
    boxes = np.asarray(tracks.box_px, float).reshape(-1, 4)[seen]
    blobs = np.asarray(surveyed.tracked.detections.box_px, float).reshape(-1, 4)
    return Told(boxes, tracks.identity[seen], place, covariance, velocity, tuple(kind), blobs)


def _mean_place(told: Told, rows: np.ndarray) -> np.ndarray:
    """(2,) the mean of some located targets, weighted by the areas of their boxes."""
    area = np.maximum(told.box_px[rows, 2] * told.box_px[rows, 3], 1e-9)
    place: np.ndarray = np.average(told.place_m[rows], axis=0, weights=area)
    return place


def _spread(errors: array) -> Spread:
    values = np.asarray(errors, float)
    if not len(values):
        return Spread(0, math.nan, math.nan, math.nan)
    return Spread(len(values), float(values.mean()), float(np.median(values)), float(np.quantile(values, 0.95)))


def _table(rows: list[tuple[int, int, np.ndarray]]) -> TrackTable:
    frame, which = (np.array([row[k] for row in rows], np.int64) for k in (0, 1))
    return TrackTable(frame, which, np.array([row[2] for row in rows], float).reshape(-1, 4))
