"""What is known of the targets, predicted for now: what steers must not wait until the frame on its way is settled."""

from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.types import Camera, Confirmed, Grounded

# A target steers nothing before it was located so often: most false alarms are gone by then.
_SIGHTINGS = 3
# One that is not located any more is remembered so long; its velocity is believed for a shorter time.
_KEPT_S, _HORIZON_S = 8.0, 3.0
# What is lost where another was found within its reach goes on under that one's name.
_RENAMED_M = 3.0
# A target is given up once it is so surely not human, and taken up again where that is as likely as not.
_GIVEN_UP, _TAKEN_UP = 0.2, 0.5
# Half of a target's width where no box tells it.
_RADIUS_M = 1.0


@dataclass(frozen=True)
class Outlook:
    """The targets that are believed in, as they are expected now, one row a target.

    target: (N,) int64. east_north_m, velocity_m_s: (N, 2). radius_m: (N,) half the width of its box over the ground.
    probability: (N,) of being human. unseen: (N,) bool, no ground vehicle could tell. wanted: (N,) bool, human or
    unseen. lost_s: (N,) since it was last located, by the clock of the frames. missed: (N,) of the latest frames.
    """

    target: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    velocity_m_s: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    radius_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    probability: np.ndarray = field(default_factory=lambda: np.zeros(0))
    unseen: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    wanted: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    lost_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    missed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.target)

    @property
    def speed_m_s(self) -> np.ndarray:
        """(N,) over the ground."""
        return np.linalg.norm(self.velocity_m_s, axis=1)


@dataclass
class _Remembered:
    """One target as it was last located."""

    place_m: np.ndarray
    velocity_m_s: np.ndarray
    radius_m: float
    seen_s: float
    sightings: int = 1
    missed: int = 0
    probability: float = 0.5
    unseen: bool = True
    wanted: bool = True


class Memory:
    """The targets of the latest frames. Feed it frames in order."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._known: dict[int, _Remembered] = {}

    def step(self, grounded: Grounded, confirmed: Confirmed | None, now_s: float) -> Outlook:
        """The targets as expected at now_s, after a frame was located; confirmed: row = that of its positions."""
        radii = radii_m(grounded, self.camera)
        targets = grounded.positions.target.tolist()
        for row, target in enumerate(targets):
            place, velocity = grounded.positions.east_north_m[row], np.nan_to_num(grounded.velocity_m_s[row])
            if not np.isfinite(place).all():
                continue
            known = self._known.setdefault(target, _Remembered(place, velocity, float(radii[row]), 0.0, 0))
            known.place_m, known.velocity_m_s, known.seen_s = place, velocity, grounded.time_s
            known.radius_m += 0.2 * (float(radii[row]) - known.radius_m)
            known.sightings, known.missed = known.sightings + 1, 0
        if confirmed is not None:
            for row, kind, probability in zip(confirmed.row, confirmed.kind, confirmed.probability, strict=True):
                if 0 <= row < len(targets) and targets[row] in self._known:
                    _judge(self._known[targets[row]], kind, float(probability))
        self._forget(set(targets), grounded.time_s)
        return self._expected(now_s, grounded.time_s)

    def _forget(self, seen: set[int], time_s: float) -> None:
        here = np.array([known.place_m for target, known in self._known.items() if target in seen]).reshape(-1, 2)
        for target, known in list(self._known.items()):
            if target in seen:
                continue
            known.missed += 1
            gone_s = time_s - known.seen_s
            place = known.place_m + known.velocity_m_s * min(gone_s, _HORIZON_S)
            renamed = len(here) and np.linalg.norm(here - place, axis=1).min() < _RENAMED_M + known.radius_m
            if gone_s > _KEPT_S or renamed or (known.sightings < _SIGHTINGS and known.missed > 1):
                del self._known[target]

    def _expected(self, now_s: float, time_s: float) -> Outlook:
        rows = {target: known for target, known in self._known.items() if known.sightings >= _SIGHTINGS}
        if not rows:
            return Outlook()
        all_of = list(rows.values())
        ahead_s = np.clip([now_s - known.seen_s for known in all_of], 0, _HORIZON_S)
        velocity = np.array([known.velocity_m_s for known in all_of])
        return Outlook(
            np.array(list(rows), np.int64),
            np.array([known.place_m for known in all_of]) + velocity * ahead_s[:, None],
            velocity,
            np.array([known.radius_m for known in all_of]),
            np.array([known.probability for known in all_of]),
            np.array([known.unseen for known in all_of]),
            np.array([known.wanted for known in all_of]),
            np.array([time_s - known.seen_s for known in all_of]),
            np.array([known.missed for known in all_of], np.int64),
        )


def _judge(known: _Remembered, kind: str, probability: float) -> None:
    known.probability, known.unseen = probability, kind == "unseen"
    if kind == "not_human" and probability <= _GIVEN_UP:
        known.wanted = False
    elif kind != "not_human" or probability >= _TAKEN_UP:
        known.wanted = True


def radii_m(grounded: Grounded, camera: Camera) -> np.ndarray:
    """(P,) half the mean side of each located target's box, over the ground."""
    boxes = grounded.box_px[grounded.row] if len(grounded.box_px) else np.zeros((len(grounded.positions), 4))
    if grounded.fix.pose is None:
        return np.full(len(boxes), _RADIUS_M)
    pose, places = grounded.fix.pose, grounded.positions.east_north_m
    depth = (np.c_[places, np.zeros(len(places))] - pose.place_m) @ pose.axes[:, 2]
    half_px = boxes[:, 2:].mean(axis=1) / 2
    return half_px * np.maximum(depth, 1.0) / (pose.focal * float(np.mean(camera.focal_px)))
