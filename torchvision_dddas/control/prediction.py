"""Predict the targets for the current time, because steering cannot wait until the newest frame is settled."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.types import AerialLocations, Camera, Confirmation, GroundCrowds, Table

# A target is established after this many locations over this time. Most false alarms end earlier.
_SIGHTINGS, _LASTING_S = 3, 0.8
# Gain of the filter for positions and velocities, which is small because the blob of a crowd shifts as parts of it are
# detected or not. A position further than _FAR_M from its prediction is taken without filtering.
_BELIEVED, _FAR_M = 0.4, 5.0
# A target is fast above _RUNNING_M_S, until it is below _WALKING_M_S. A fast target is wanted only if the probability
# that it is human is at least _SURE.
_RUNNING_M_S, _WALKING_M_S, _SURE = 4.5, 3.5, 0.95
# A lost target is kept for _KEPT_S, and extrapolated by its velocity for LOST_S.
_KEPT_S, LOST_S = 8.0, 3.0
# A lost target is dropped if a located target is within this distance and the radius: it continues under that identity.
_RENAMED_M = 3.0
# A target is given up if its probability of being human is at most _GIVEN_UP, and taken up again at _TAKEN_UP.
_GIVEN_UP, _TAKEN_UP = 0.2, 0.5
MISSED = 2
"""Number of successive frames without a target after which the target counts as lost."""
# Radius of a target whose box is unknown.
_RADIUS_M = 1.0


@dataclass(frozen=True)
class Prediction(Table):
    """The established targets, predicted for the current time, with one row for each target.

    target: (N,) int64 identities. east_north_m, velocity_m_s: (N, 2). radius_m: (N,) half the width of the box on the
    ground. probability: (N,) that the target is human. unseen: (N,) bool, no ground vehicle has observed it. wanted:
    (N,) bool, the target is to be followed. lost_s: (N,) time from the target's last location from the air
    to the located frame. missed: (N,) number of latest frames without the target. steady: (N,) bool, its velocity is
    known. by_ground: (N,) bool, it was seen last from the ground and not from the air.
    """

    target: np.ndarray
    east_north_m: np.ndarray
    velocity_m_s: np.ndarray
    radius_m: np.ndarray
    probability: np.ndarray
    unseen: np.ndarray
    wanted: np.ndarray
    lost_s: np.ndarray
    missed: np.ndarray
    steady: np.ndarray
    by_ground: np.ndarray

    def __len__(self) -> int:
        return len(self.target)

    @property
    def is_human(self) -> np.ndarray:
        """(N,) bool, ground vehicles have observed the target, and it is probably human."""
        return ~self.unseen & (self.probability >= _TAKEN_UP)

    @property
    def speed_m_s(self) -> np.ndarray:
        """(N,) speed over the ground."""
        return np.linalg.norm(self.velocity_m_s, axis=1)


@dataclass
class _PredictedTarget:
    """A target at its last location. human: the target is human or may be human."""

    place_m: np.ndarray
    velocity_m_s: np.ndarray
    radius_m: float
    seen_s: float
    first_s: float
    sightings: int = 0
    missed: int = 0
    probability: float = 0.5
    unseen: bool = True
    human: bool = True
    fast: bool = False
    steady: bool = False
    by_ground: bool = False
    located_s: float = 0.0

    def update(self, place_m: np.ndarray, velocity_m_s: np.ndarray, radius_m: float, time_s: float) -> None:
        """Update the target by a location from the air."""
        self.correct(place_m, velocity_m_s, time_s)
        self.radius_m += _BELIEVED * (radius_m - self.radius_m)
        self.missed, self.sightings, self.by_ground = 0, self.sightings + 1, False
        self.located_s = time_s

    def correct(self, place_m: np.ndarray, velocity_m_s: np.ndarray, time_s: float) -> None:
        predicted = self.place_m + self.velocity_m_s * (time_s - self.seen_s)
        off = place_m - predicted
        self.place_m = predicted + (_BELIEVED * off if np.linalg.norm(off) < _FAR_M else off)
        if np.isfinite(velocity_m_s).all():
            gain = _BELIEVED if self.steady else 1.0
            self.velocity_m_s = self.velocity_m_s + gain * (velocity_m_s - self.velocity_m_s)
            self.steady = True
        self.seen_s = time_s
        self.fast = bool(np.linalg.norm(self.velocity_m_s) > (_WALKING_M_S if self.fast else _RUNNING_M_S))

    @property
    def established(self) -> bool:
        """Whether the target was located often enough and over a long enough time."""
        return self.sightings >= _SIGHTINGS and self.seen_s - self.first_s >= _LASTING_S - 1e-6

    @property
    def wanted(self) -> bool:
        return self.human and (not self.fast or (not self.unseen and self.probability >= _SURE))


class TargetPredictor:
    """Predicts the targets of the latest frames. Pass frames in order to `update`."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._known: dict[int, _PredictedTarget] = {}

    def missing(self, located: AerialLocations) -> Prediction:
        """Return the established targets that have been lost for longer than LOST_S, predicted for a frame's time.

        Call this before `update`. Shorter gaps are left out, because extrapolation is then more accurate than the
        observations of ground vehicles.
        """
        seen, here = located.positions.target, located.positions.east_north_m
        expected = self._predict(located.time_s, located.time_s)
        rows = [
            row
            for row in np.flatnonzero((expected.lost_s > LOST_S) & ~np.isin(expected.target, seen)).tolist()
            if not _is_renamed(expected.east_north_m[row], expected.radius_m[row], here)
        ]
        return expected[np.array(rows, np.int64)]

    def update(
        self,
        located: AerialLocations,
        confirmed: Confirmation | None,
        now_s: float,
        crowds: GroundCrowds | None = None,
    ) -> Prediction:
        """Add a located frame, and return the targets predicted for now_s.

        confirmed: its rows are rows of the frame's positions. crowds: crowds seen from the ground at the frame. Their
        rows with `steers` update targets that were not located from the air; locations from the air are more accurate.
        """
        time_s, targets = located.time_s, located.positions.target.tolist()
        for row, radius in enumerate(self._radii_m(located).tolist()):
            place = located.positions.east_north_m[row]
            if np.isfinite(place).all():
                known = self._known.setdefault(
                    targets[row], _PredictedTarget(place, np.zeros(2), radius, time_s, time_s)
                )
                known.update(place, located.velocity_m_s[row], radius, time_s)
        if confirmed is not None:
            for row, kind, probability in zip(confirmed.row, confirmed.kind, confirmed.probability, strict=True):
                if 0 <= row < len(targets) and targets[row] in self._known:
                    known = self._known[targets[row]]
                    known.probability, known.unseen = float(probability), kind == "unseen"
                    if kind == "not_human" and probability <= _GIVEN_UP:
                        known.human = False
                    elif kind != "not_human" or probability >= _TAKEN_UP:
                        known.human = True
        if crowds is not None:
            for row in np.flatnonzero(crowds.steers).tolist():
                if (lost := self._known.get(int(crowds.target[row]))) is not None:
                    lost.correct(crowds.east_north_m[row], crowds.velocity_m_s[row], time_s)
                    lost.by_ground = True
        self._forget(set(targets), time_s)
        return self._predict(time_s, now_s)

    def _predict(self, time_s: float, now_s: float) -> Prediction:
        rows = {target: known for target, known in self._known.items() if known.established}

        def column(name: str, kind: type = float) -> np.ndarray:
            return np.array([getattr(known, name) for known in rows.values()], kind)

        place, velocity = (column(name).reshape(-1, 2) for name in ("place_m", "velocity_m_s"))
        ahead_s = np.clip(now_s - column("seen_s"), 0, LOST_S)
        return Prediction(
            np.array(list(rows), np.int64),
            place + velocity * ahead_s[:, None],
            velocity,
            column("radius_m"),
            column("probability"),
            column("unseen", bool),
            column("wanted", bool),
            time_s - column("located_s"),
            column("missed", np.int64),
            column("steady", bool),
            column("by_ground", bool),
        )

    def _forget(self, seen: set[int], time_s: float) -> None:
        here = np.array([known.place_m for target, known in self._known.items() if target in seen]).reshape(-1, 2)
        for target in self._known.keys() - seen:
            known = self._known[target]
            known.missed += 1
            gone_s = time_s - known.seen_s
            place = known.place_m + known.velocity_m_s * min(gone_s, LOST_S)
            renamed = _is_renamed(place, known.radius_m, here)
            if gone_s > _KEPT_S or renamed or (not known.established and known.missed > 2):
                del self._known[target]

    def _radii_m(self, located: AerialLocations) -> np.ndarray:
        """Return (P,) half the mean side of each located target's box, in metres on the ground."""
        pose, places = located.fix.pose, located.positions.east_north_m
        if pose is None:
            return np.full(len(places), _RADIUS_M)
        boxes = located.box_px[located.row] if len(located.box_px) else np.zeros((len(places), 4))
        depth = (np.c_[places, np.zeros(len(places))] - pose.place_m) @ pose.axes[:, 2]
        scale = pose.focal * float(np.mean(self.camera.focal_px))
        return boxes[:, 2:].mean(axis=1) / 2 * np.maximum(depth, 1.0) / scale


def _is_renamed(place_m: np.ndarray, radius_m: float, here_m: np.ndarray) -> bool:
    """Return whether a target (2,) that was not located is so near a located target (N, 2) that they are the same."""
    return len(here_m) > 0 and bool(np.linalg.norm(here_m - place_m, axis=1).min() < _RENAMED_M + radius_m)
