"""How well crowds were detected, tracked, located and confirmed in a simulated run, from truth and results.

Each measure is defined at its field of CrowdScore. Boxes are x, y of the top left pixel, width, height. A box contains
a pixel if it contains the pixel's centre. Metres are in the truth's coordinates.
"""

import math
from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.lab.evaluation.metrics import tracking
from torchvision_dddas.lab.evaluation.metrics.boxes import areas
from torchvision_dddas.lab.evaluation.metrics.matching import pair
from torchvision_dddas.lab.evaluation.metrics.metres import inside
from torchvision_dddas.lab.evaluation.metrics.pixels import ratio
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable
from torchvision_dddas.types import FrameResult, Truth

LEAST_VISIBLE = 0.5
"""A crowd counts in frames that show at least this share of its people."""

COVERING = 0.3
"""A box covers a crowd if the intersection is at least this share of the smaller of the two boxes."""

NEAR_M = 2.0
"""A target this near to the middle of a small crowd covers it, wherever its box is."""

LARGEST, MARGIN_PX = 10.0, 10.0
"""A box larger than this number of times the area of its bodies, grown by a margin on every side, covers nothing."""

TOUCHING_PX = 5.0
"""A blob this near to a pixel of a movable body is not false: it may be the body's shadow or edge."""

STILL_M_S = 0.2
"""People whose mean speed is lower than this are standing."""

STAYS = 0.25
"""A crowd keeps its identity until another target exceeds the identity's target by this share of the crowd's pixels."""

CAP_M = 10.0
"""The error that is charged if the place of a crowd is unknown, and the largest error that is charged."""

HOLD_S = 1.0
"""The last known place of a crowd is used for this time, moved on at the crowd's velocity."""

IOU_LEAST = 0.3
"""IoU from which a box is the target's, for IDF1: blobs fit crowds less tightly than labels fit people."""

ToLocal = Callable[[np.ndarray], np.ndarray]
"""A function from longitude, latitude (N, 2) to the metres of the truth."""


class TrueFrame:
    """The truth of a frame without its picture, in a few kilobytes.

    u, v: (P,) int32 the pixels of all movable bodies. body: (P,) row of each pixel's body, -1 for none. place_m: (N, 2)
    of the bodies. pixels: (N,) number of visible pixels of each body. low_px, high_px: (N, 2) the first and the last
    column and row of these pixels.
    """

    def __init__(self, truth: Truth) -> None:
        self.frame, self.time_s, self.bodies = truth.frame, truth.time_s, truth.bodies
        self.place_m = np.asarray(self.bodies.place_m, float)[:, :2]
        there = cv2.findNonZero(truth.mask | truth.people)  # this takes a third of np.nonzero's time
        self.u: np.ndarray
        self.v: np.ndarray
        self.u, self.v = np.zeros((2, 0), np.int32) if there is None else there[:, 0].T
        number, count = truth.people[self.v, self.u].astype(np.int64), len(self.bodies)
        self.body = np.full(len(self.u), -1)
        if count:
            order = np.argsort(self.bodies.number)
            row = order[np.searchsorted(self.bodies.number[order], number).clip(max=count - 1)]
            self.body = np.where(self.bodies.number[row] == number, row, -1)
        known = self.body >= 0
        self.pixels = np.bincount(self.body[known], minlength=count)
        self.low_px, self.high_px = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
        at_px = np.stack([self.u, self.v], axis=1)[known].astype(float)
        np.minimum.at(self.low_px, self.body[known], at_px)
        np.maximum.at(self.high_px, self.body[known], at_px)

    def box_about(self, bodies: np.ndarray) -> np.ndarray:
        """Return the box around the pixels of some bodies, (4,), given by rows or a mask; NaN if none is visible."""
        visible = self.pixels > 0
        chosen = np.zeros(len(visible), bool)
        chosen[bodies] = True
        chosen &= visible
        if not chosen.any():
            return np.full(4, np.nan)
        low, high = self.low_px[chosen].min(axis=0), self.high_px[chosen].max(axis=0)
        return np.concatenate([low, high - low + 1])

    def _within(self, box_px: np.ndarray, margin_px: float = 0.0) -> np.ndarray:
        """Return which pixels lie in a box (4,) that is grown by a margin, (P,) bool."""
        x, y, width, height = box_px.tolist()
        low_u, low_v = x - 0.5 - margin_px, y - 0.5 - margin_px
        within: np.ndarray = (self.u >= low_u) & (self.u <= low_u + width + 2 * margin_px)
        return within & (self.v >= low_v) & (self.v <= low_v + height + 2 * margin_px)

    def pixels_in(self, box_px: np.ndarray) -> np.ndarray:
        """Return how many pixels of each body lie in each of the boxes (T, 4), (T, N) int64."""
        held = np.zeros((len(box_px), len(self.pixels)), np.int64)
        for row, box in enumerate(box_px):
            body = self.body[self._within(box)]
            held[row] = np.bincount(body[body >= 0], minlength=held.shape[1])
        return held

    def bodies_in(self, pixels: np.ndarray) -> np.ndarray:
        """Return which bodies have half of their visible pixels in each box, (T, N) bool. pixels: as of `pixels_in`."""
        lies: np.ndarray = (self.pixels > 0) & (2 * pixels >= self.pixels)
        return lies

    def untouched(self, box_px: np.ndarray) -> int:
        """Return how many of the boxes (B, 4) have no movable body in them or within TOUCHING_PX of them."""
        return sum(not self._within(box, TOUCHING_PX).any() for box in box_px)


@dataclass(frozen=True)
class Crowd:
    """A crowd in a frame. people: rows of all its bodies. visible: rows of the bodies that the picture shows.

    place_m: (2,) mean of all its people. middle_m: (2,) mean of its visible people. radius_m: radius of a disc that
    they fill evenly. box_px: (4,) around their pixels. counts: whether enough of them are visible.
    """

    number: int
    people: np.ndarray
    visible: np.ndarray
    place_m: np.ndarray
    middle_m: np.ndarray
    radius_m: float
    box_px: np.ndarray
    counts: bool
    still: bool


def crowds(frame: TrueFrame, least_visible: float = LEAST_VISIBLE) -> list[Crowd]:
    """Return the crowds of the world at a frame, whether visible or not."""
    found, bodies = [], frame.bodies
    for number in np.unique(bodies.target[bodies.kind == "person"]).tolist():
        people = np.flatnonzero((bodies.target == number) & (bodies.kind == "person"))
        visible = people[frame.pixels[people] > 0]
        place = frame.place_m[people].mean(axis=0)
        middle, radius = np.full(2, np.nan), 0.0
        if len(visible):
            middle = frame.place_m[visible].mean(axis=0)
            radius = float(np.sqrt(2 * ((frame.place_m[visible] - middle) ** 2).sum(axis=1).mean()))
        counts = len(visible) > 0 and len(visible) >= least_visible * len(people)
        speed_m_s = np.linalg.norm(np.asarray(bodies.velocity_m_s, float)[people, :2], axis=1)
        still = float(speed_m_s.mean()) < STILL_M_S
        box = frame.box_about(visible)
        found.append(Crowd(number, people, visible, place, middle, radius, box, counts, still))
    return found


@dataclass(frozen=True)
class FoundTargets:
    """The targets of a frame in the results, one row per target.

    box_px: (T, 4). identity: (T,) int64. place_m: (T, 2), NaN if not located. covariance_m2: (T, 2, 2). velocity_m_s:
    (T, 2), NaN if unknown. kind: (T,) human, not_human or unseen.
    blob_px: (B, 4) boxes of all detections, tracked or not.
    """

    box_px: np.ndarray
    identity: np.ndarray
    place_m: np.ndarray
    covariance_m2: np.ndarray
    velocity_m_s: np.ndarray
    kind: tuple[str, ...]
    blob_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    @classmethod
    def of(cls, result: FrameResult, local: ToLocal | None = None) -> "FoundTargets":
        """Return the targets that were seen, located or not. local: as in CrowdScorer."""
        tracks = result.tracked.tracks
        seen = np.flatnonzero(tracks.row >= 0)  # a box that bridges a gap is at a place where nothing was found
        place, velocity = np.full((2, len(seen), 2), np.nan)
        covariance, kind = np.full((len(seen), 2, 2), np.nan), ["unseen"] * len(seen)
        if (located := result.locations) is not None:
            positions, row = located.positions, located.row
            degrees = positions.lonlat_deg
            place[row] = positions.east_north_m if local is None or degrees is None else local(degrees)
            covariance[row], velocity[row] = positions.covariance_m2, located.velocity_m_s
            if (confirmed := result.confirmed) is not None:
                for which, what in zip(row[confirmed.row].tolist(), confirmed.kind, strict=True):
                    kind[which] = what
        boxes = np.asarray(tracks.box_px, float).reshape(-1, 4)[seen]
        blobs = np.asarray(result.tracked.detections.box_px, float).reshape(-1, 4)
        return cls(boxes, tracks.identity[seen], place, covariance, velocity, tuple(kind), blobs)

    @property
    def located(self) -> np.ndarray:
        """Whether each target is located, (T,) bool."""
        known: np.ndarray = np.isfinite(self.place_m).all(axis=1)
        return known

    def mean_place(self, rows: np.ndarray) -> np.ndarray:
        """Return the mean of some located targets, (2,), weighted by the areas of their boxes."""
        area = np.maximum(self.box_px[rows, 2] * self.box_px[rows, 3], 1e-9)
        place: np.ndarray = np.average(self.place_m[rows], axis=0, weights=area)
        return place


def covering(frame: TrueFrame, found: list[Crowd], targets: FoundTargets, held: np.ndarray) -> np.ndarray:
    """Return which targets cover which crowds, (C, T) bool. held: (T, N) bool, `bodies_in` the targets' boxes.

    A target covers a crowd if its box contains one of its people and the intersection is COVERING of the smaller of the
    two boxes. It also covers a crowd if it is located within the crowd's radius, at least NEAR_M, of the middle of its
    visible people. A blob over two crossing crowds therefore covers both, and each part of a crowd that was found in
    parts covers it. A box more than LARGEST times as large as its bodies covers nothing by its pixels.
    """
    about = np.array([frame.box_about(row) for row in held]).reshape(-1, 4)
    size = targets.box_px[:, 2] * targets.box_px[:, 3]
    fits = size <= LARGEST * np.prod(about[:, 2:] + 2 * MARGIN_PX, axis=1)  # False if a box contains nobody
    covers = np.zeros((len(found), len(size)), bool)
    for row, crowd in enumerate(found):
        if not len(crowd.visible):
            continue
        shared, _ = areas(targets.box_px, crowd.box_px)
        smaller = np.minimum(size, np.prod(crowd.box_px[2:]))
        share = np.divide(shared, smaller, out=np.zeros_like(shared), where=smaller > 0)
        over = held[:, crowd.visible].any(axis=1) & fits & (share >= COVERING)
        away = np.linalg.norm(targets.place_m - crowd.middle_m, axis=1)
        covers[row] = over | (away <= max(crowd.radius_m, NEAR_M))  # False if a place is NaN
    return covers


@dataclass(frozen=True)
class Spread:
    """Spread of errors in metres; NaN without errors."""

    count: int
    mean: float
    median: float
    p95: float


@dataclass(frozen=True)
class CrowdScore:
    """The measures of one run; shares in [0, 1], NaN if there is nothing to judge.

    frames: number of processed frames. crowd_frames: over them, number of crowds with at least half of their people
    visible. recall: share of these crowds that a located target covers. detected: share that any target covers.
    recall_moving: recall without standing crowds, which do not move against their background.
    false_blobs: detections for each frame that touch no movable body. false_targets: the same for targets with an
    identity. landmark_blobs: detections for each frame that contain only a landmark.
    target_error_m: distance of each located target that holds people from their mean place. crowd_error_m: for each
    crowd that located targets cover, distance of their mean, weighted by the areas of their boxes, from the mean of its
    visible people. inside: share of targets whose 95 % ellipse contains the mean place of their people.
    switches: number of changes of a crowd's identity while its people stayed the same. Crowds are assigned to targets
    one to one by pixels held, and an identity stays with its crowd until another target holds STAYS more.
    switches_a_minute: for each crowd and minute in which it counts. idf1: of crowds and cars, boxes at IoU IOU_LEAST.
    kind_right: share of the identities that a ground vehicle saw whose last kind, human or not_human, is right. A
    target is truly human if most of its boxes contain people. blob_kind_right: the same for each frame and target.
    knowledge_m: mean error of the known places of every crowd of the world, visible or not, at every moment of the
    clip, also between processed frames. The known place is the last place within HOLD_S, moved on at its velocity. The
    error is at most CAP_M, and CAP_M if no place is known. known: share of these moments with a known place.
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
        """Return all figures by name, as in JSON: None if undefined."""

        def plain(pairs: list[tuple[str, object]]) -> dict[str, object]:
            return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in pairs}

        return asdict(self, dict_factory=plain)

    def lines(self) -> list[str]:
        """Return the figures in words, one line for each subject that has figures."""
        crowd, target, lines = self.crowd_error_m, self.target_error_m, []
        if self.crowd_frames:
            lines.append(
                f"crowds: {100 * self.recall:.1f} % of {self.crowd_frames} seen and located, "
                f"{self.false_blobs:.2f} false blobs a frame"
            )
        if crowd.count:
            spread = f"mean {crowd.mean:.2f} m, median {crowd.median:.2f}, 95 % {crowd.p95:.2f}"
            lines.append(f"error of a crowd's place: {spread}")
        if target.count:
            lines.append(f"error of a target from its people: mean {target.mean:.2f} m, median {target.median:.2f}")
        if not math.isnan(self.inside):
            lines.append(f"95 % ellipses contain the truth in {100 * self.inside:.1f} %")
        if not math.isnan(self.switches_a_minute):
            switches = f"{self.switches_a_minute:.2f} switches a crowd and minute"
            lines.append(f"identities: {switches}, IDF1 {100 * self.idf1:.1f} %")
        if self.kinds:
            lines.append(f"human or not: right for {100 * self.kind_right:.1f} % of {self.kinds} targets seen close up")
        if not math.isnan(self.knowledge_m):
            known = f"{self.knowledge_m:.2f} m; {CAP_M:g} m if no place is known"
            lines.append(f"mean error of the known places of all crowds over the whole time: {known}")
        return lines


class CrowdScorer:
    """Score a run from its streams: `feed` takes, in order, the truth of each frame and then the frame's result.

    Frames without truth, and frames that could not be read, are left out. The scorer keeps the truth of frames without
    a result, without their pictures, and some numbers for each target and frame.
    """

    def __init__(self, local: ToLocal | None = None, least_visible: float = LEAST_VISIBLE) -> None:
        """local: None if the results are in the truth's metres."""
        self._local, self._least = local, least_visible
        self._waiting: dict[int, TrueFrame] = {}
        self._before: tuple[TrueFrame, list[Crowd]] | None = None
        self._counts: Counter[str] = Counter()
        self._target_error, self._crowd_error = array("d"), array("d")
        self._carrier: dict[int, tuple[frozenset[int], int]] = {}  # the people and the identity of each crowd
        self._minutes = self._cost = 0.0
        self._true_rows: list[tuple[int, int, np.ndarray]] = []
        self._found_rows: list[tuple[int, int, np.ndarray]] = []
        self._human_boxes: Counter[int] = Counter()  # boxes of an identity with people, minus boxes without people
        self._kind: dict[int, str] = {}
        self._known: dict[int, tuple[float, np.ndarray, np.ndarray]] = {}  # last time, place and velocity of each crowd

    def feed(self, item: Truth | TrueFrame | FrameResult) -> None:
        """Take the truth of a frame, or the result of a frame whose truth was fed before."""
        if not isinstance(item, FrameResult):
            self._waiting[item.frame] = TrueFrame(item) if isinstance(item, Truth) else item
            return
        number, frame = item.tracked.number, item.tracked.frame
        truth = self._waiting.get(number)
        self._waiting = {n: later for n, later in self._waiting.items() if n > number}
        if truth is None or (frame is not None and not frame.image.any()):
            return
        targets = FoundTargets.of(item, self._local)
        found, bodies, n = crowds(truth, self._least), truth.bodies, self._counts
        held = truth.pixels_in(targets.box_px)
        lies = truth.bodies_in(held)
        covers = covering(truth, found, targets, lies)
        in_blob, vehicle = truth.bodies_in(truth.pixels_in(targets.blob_px)), bodies.kind == "ugv"
        n["frames"] += 1
        n["false_blobs"] += truth.untouched(targets.blob_px)
        n["false_targets"] += truth.untouched(targets.box_px)
        n["landmark_blobs"] += int((in_blob[:, vehicle].any(axis=1) & ~in_blob[:, ~vehicle].any(axis=1)).sum())
        people_in = lies & (bodies.kind == "person")
        self._judge_places(truth, targets, found, people_in, covers)
        self._judge_identities(truth, targets, found, held, covers)
        self._judge_kinds(targets, people_in.any(axis=1))
        self._judge_knowledge(truth, targets, found, covers)
        self._before = truth, found

    def score(self) -> CrowdScore:
        """Return the measures of the frames so far."""
        n, frames = self._counts, self._counts["frames"]
        idf1 = math.nan
        if frames:
            paired = pair(_table(self._true_rows), _table(self._found_rows))
            idf1 = tracking.identity_measures(tracking.count_identity(paired, IOU_LEAST))["idf1"]
        right = sum((self._human_boxes[which] > 0) == (kind == "human") for which, kind in self._kind.items())
        return CrowdScore(
            frames=frames,
            crowd_frames=n["crowd_frames"],
            recall=ratio(n["found"], n["crowd_frames"]),
            recall_moving=ratio(n["found"] - n["still_found"], n["crowd_frames"] - n["still"]),
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

    def _judge_places(
        self, truth: TrueFrame, targets: FoundTargets, found: list[Crowd], people_in: np.ndarray, covers: np.ndarray
    ) -> None:
        rows = np.flatnonzero(targets.located & people_in.any(axis=1))
        people_m = np.array([truth.place_m[people_in[row]].mean(axis=0) for row in rows]).reshape(-1, 2)
        off = targets.place_m[rows] - people_m
        self._target_error.extend(np.linalg.norm(off, axis=1))
        in_ellipse = inside(off, targets.covariance_m2[rows])
        self._counts.update(ellipses=int(np.isfinite(in_ellipse).sum()), inside=int(np.nansum(in_ellipse)))
        for crowd, over in zip(found, covers, strict=True):
            if not crowd.counts:
                continue
            by: np.ndarray = over & targets.located
            self._counts.update(crowd_frames=1, found=int(by.any()), detected=int(over.any()))
            self._counts.update(still=int(crowd.still), still_found=int(crowd.still and by.any()))
            if by.any():
                self._crowd_error.append(float(np.linalg.norm(targets.mean_place(by) - crowd.middle_m)))

    def _judge_identities(
        self, truth: TrueFrame, targets: FoundTargets, found: list[Crowd], held: np.ndarray, covers: np.ndarray
    ) -> None:
        bodies, counting = truth.bodies, [k for k, crowd in enumerate(found) if crowd.counts]
        if self._before is not None:
            self._minutes += len(counting) * (truth.time_s - self._before[0].time_s) / 60
        worth = np.zeros((len(counting), len(targets.identity)))
        for line, k in enumerate(counting):
            mine = held[:, found[k].people].sum(axis=1) / max(truth.pixels[found[k].people].sum(), 1)
            had = self._carrier.get(found[k].number)
            stays = STAYS * (targets.identity == had[1]) if had is not None else 0.0
            worth[line] = covers[k] * (1e-3 + mine + stays)
        for row, column in zip(*linear_sum_assignment(worth, maximize=True), strict=True):
            if not worth[row, column]:
                continue
            crowd, now = found[counting[row]], int(targets.identity[column])
            people = frozenset(bodies.number[crowd.people].tolist())
            had = self._carrier.get(crowd.number)
            self._counts["switches"] += int(had is not None and had[0] == people and had[1] != now)
            self._carrier[crowd.number] = people, now
        for number in np.unique(bodies.target[(truth.pixels > 0) & (bodies.kind != "ugv")]).tolist():
            self._true_rows.append((truth.frame, number, truth.box_about(bodies.target == number)))
        pairs = zip(targets.identity.tolist(), targets.box_px, strict=True)
        self._found_rows += [(truth.frame, identity, box) for identity, box in pairs]

    def _judge_kinds(self, targets: FoundTargets, is_human: np.ndarray) -> None:
        for which, kind, human in zip(targets.identity.tolist(), targets.kind, is_human.tolist(), strict=True):
            self._human_boxes[which] += 1 if human else -1
            if kind != "unseen":
                self._kind[which] = kind
                self._counts.update(kinds=1, kinds_right=int((kind == "human") == human))

    def _judge_knowledge(self, truth: TrueFrame, targets: FoundTargets, found: list[Crowd], covers: np.ndarray) -> None:
        if self._before is not None:
            last, crowds_before = self._before
            before = {crowd.number: crowd.place_m for crowd in crowds_before}
            for share in np.arange(1, truth.frame - last.frame) / (truth.frame - last.frame):
                moment = last.time_s + share * (truth.time_s - last.time_s)
                for crowd in found:
                    if (then := before.get(crowd.number)) is not None:
                        self._charge(crowd.number, moment, then + share * (crowd.place_m - then))
        for crowd, over in zip(found, covers, strict=True):
            by: np.ndarray = over & targets.located
            if by.any():
                velocity = np.nan_to_num(targets.velocity_m_s[by]).mean(axis=0)
                self._known[crowd.number] = truth.time_s, targets.mean_place(by), velocity
            self._charge(crowd.number, truth.time_s, crowd.place_m)

    def _charge(self, number: int, time_s: float, place_m: np.ndarray) -> None:
        """Add the error of the known place of a crowd at a moment. place_m: (2,) the true place."""
        known_s, known_m, velocity_m_s = self._known.get(number, (-math.inf, place_m, place_m))
        age_s, cost = time_s - known_s, CAP_M
        if age_s <= HOLD_S + 1e-9:
            cost = min(float(np.linalg.norm(known_m + age_s * velocity_m_s - place_m)), CAP_M)
            self._counts["known"] += 1
        self._counts["moments"] += 1
        self._cost += cost


def _spread(errors: array) -> Spread:
    values = np.asarray(errors, float)
    if not len(values):
        return Spread(0, math.nan, math.nan, math.nan)
    return Spread(len(values), float(values.mean()), float(np.median(values)), float(np.quantile(values, 0.95)))


def _table(rows: list[tuple[int, int, np.ndarray]]) -> TrackTable:
    frame, which = (np.array([row[k] for row in rows], np.int64) for k in (0, 1))
    return TrackTable(frame, which, np.array([row[2] for row in rows], float).reshape(-1, 4))
