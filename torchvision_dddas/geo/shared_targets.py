"""Associate the measurements of several platforms with targets, and begin and end targets.

A platform with lasting identities begins with targets of its own. Two targets are united if their tracks are matched
repeatedly: a single match may be a neighbour, as long as both views share few people.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas.config import FusionParameters
from torchvision_dddas.geo.ground_locator import match_people
from torchvision_dddas.geo.joint_filter import SIZE, JointFilter
from torchvision_dddas.geo.measurements import Measurement
from torchvision_dddas.types import FusedTargets

_LOOKS = 3  # measurements before a target is reported
_UNSURE = 3  # most unreported targets, in multiples of the largest record: false alarms would fill the state
_RECENT_S = 1.0
_AGAIN = 3  # matches, one a second, before two targets are united
_ENOUGH = 3  # simultaneous matches; if there are fewer, each must be the only possible one


@dataclass
class _Target:
    """seen: time and number of the last sighting by each platform. votes: weight of each class."""

    number: int
    looks: int = 0
    seen: dict[str, tuple[float, int]] = field(default_factory=dict)
    votes: dict[str, float] = field(default_factory=dict)

    def seen_by(self, time_s: float) -> dict[str, int]:
        """Return the platforms that saw the target recently, each with its number for the target."""
        return {name: number for name, (last_s, number) in self.seen.items() if time_s - last_s < _RECENT_S}


class SharedTargets:
    """The targets of all platforms with their joint state."""

    def __init__(self, parameters: FusionParameters, limit: float) -> None:
        """limit: the squared distance of a gate."""
        self.filter, self.targets = JointFilter(parameters), list[_Target]()
        self.result: FusedTargets | None = None
        self._forget_s, self._limit = parameters.forget_s, limit
        self._most = 0  # most targets in one record
        self._number, self._named = 0, dict[tuple[str, int], int]()
        self._registered: set[str] = set()  # platforms whose new targets are matched immediately
        self._matched_s = dict[str, float]()
        self._matches = dict[tuple[str, int], tuple[int, int]]()  # by target: its match and how often in a row

    def step(self, found: Measurement, origin_deg: tuple[float, float] | None) -> FusedTargets:
        """Predict to a measurement, update the targets by it, and return the result."""
        name, seen = found.platform, found.seen
        self.filter.predict(found.time_s)
        self._forget()
        if not self.filter.platforms or not (found.number > 0).all():
            self._registered.add(name)
        self.filter.begin_record(name, seen)
        self._most = max(self._most, len(seen))
        same: list[tuple[int, int]] = []
        if len(seen):
            pairs, same = self._associate(found)
            self._correct(found, pairs)
            new = np.setdiff1d(np.arange(len(seen)), pairs[:, 1])
            self.filter.add(name, seen[new])
            targets = np.r_[pairs[:, 0], len(self.targets) + np.arange(len(new))]
            self.targets += [_Target(self._number + k + 1) for k in range(len(new))]
            self._number += len(new)
            for target, row in zip(targets.tolist(), [*pairs[:, 1].tolist(), *new.tolist()], strict=True):
                self._note(found, target, row)
        self.filter.end_record()
        for one, other in same:
            self._unite(one, other)
        self.result = self._tell(found, origin_deg)
        return self.result

    def _associate(self, found: Measurement) -> tuple[np.ndarray, list[tuple[int, int]]]:
        """Return (K, 2) targets and matching rows of a measurement, and the numbers of targets to unite."""
        count, name = len(self.targets), found.platform
        if not count:
            return np.zeros((0, 2), np.int64), []
        where, joint = self._expect(found)
        named = self._named_rows(found)
        if len(named) >= _ENOUGH:  # errors that the filter does not estimate shift all rows alike
            where = where + np.median(found.seen.east_north_m[named[:, 1]] - where[named[:, 0]], axis=0)
        expected = where, joint
        known = self._known_pairs(found, named, *expected)
        known_to = self._registered if name in self._registered else {name}
        open_to = np.flatnonzero([not known_to.isdisjoint(one.seen) for one in self.targets])
        free = np.setdiff1d(open_to, known[:, 0]), np.setdiff1d(np.arange(len(found.seen)), known[:, 1])
        pairs = np.concatenate([known, self._match(found, *expected, *free)])
        if found.time_s - self._matched_s.get(name, -math.inf) < _RECENT_S:
            return pairs, []
        self._matched_s[name] = found.time_s
        recent = [one.seen_by(found.time_s).keys() for one in self.targets]
        others = np.array([i for i, by in enumerate(recent) if name not in by and self._registered & by], np.int64)
        target_of = {row: i for i, row in pairs.tolist() if not recent[i] - {name}}
        rows = np.array(list(target_of), np.int64)
        same = self._match(found, *expected, others, rows)
        if name not in self._registered and len(same) < _ENOUGH:  # each match must be the only possible one
            for i, row in same:
                if len(self._match(found, *expected, others[others != i], np.array([row]))) or len(
                    self._match(found, *expected, np.array([i]), rows[rows != row])
                ):
                    same = same[:0]
        return pairs, self._seen_again(name, [(i, target_of[row]) for i, row in same.tolist()])

    def _expect(self, found: Measurement) -> tuple[np.ndarray, np.ndarray]:
        """Return the places (T, 2) where a platform should see the targets, and their (T, 2, T, 2) covariance."""
        count, seen = len(self.targets), found.seen
        state, spread, _ = self.filter.read()
        errors, by_errors = self.filter.errors_of(found.platform), np.tile(seen.camera_m, 2)
        place = self.filter.place_rows(np.arange(count))
        apart = seen.east_north_m - by_errors @ state[errors] - state[place][:, None]
        by_errors = by_errors[(apart**2).sum(axis=2).argmin(axis=1)]
        by_state = (spread[place] + by_errors @ spread[errors]).reshape(2 * count, -1).T
        joint = (by_state[place] + by_errors @ by_state[errors]).reshape(count, 2, count, 2)
        return state[place] + by_errors @ state[errors], joint

    def _match(
        self, found: Measurement, where: np.ndarray, joint: np.ndarray, targets: np.ndarray, rows: np.ndarray
    ) -> np.ndarray:
        """Return (K, 2) the matching pairs of the given targets and rows."""
        if not (len(targets) and len(rows)):
            return np.zeros((0, 2), np.int64)
        alone = replace(found.seen, camera_m=np.zeros_like(found.seen.camera_m))[rows]
        pairs = match_people(where[targets], joint[targets][:, :, targets], alone, self._limit)
        return np.c_[targets[pairs[:, 0]], rows[pairs[:, 1]]]

    def _seen_again(self, name: str, same: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return the pairs of targets that were matched often enough, as their numbers."""
        matches = {}
        for other, own in same:
            numbers = self.targets[other].number, self.targets[own].number
            before, count = self._matches.get((name, numbers[1]), (0, 0))
            matches[name, numbers[1]] = numbers[0], count + 1 if before == numbers[0] else 1
        self._matches = {key: one for key, one in self._matches.items() if key[0] != name} | matches
        sure = [(other, own) for (_, own), (other, count) in matches.items() if count >= _AGAIN]
        if name not in self._registered and len(sure) < min(_ENOUGH, len(same)):
            return []
        self._registered |= {name} if sure else set()
        return sure

    def _named_rows(self, found: Measurement) -> np.ndarray:
        """Return (K, 2) the targets and rows that the platform's own identities connect."""
        at = {target.number: i for i, target in enumerate(self.targets)}
        named = (self._named.get((found.platform, number), 0) for number in found.number.tolist())
        pairs = [(at[number], row) for row, number in enumerate(named) if number in at]
        return np.array(pairs, np.int64).reshape(-1, 2)

    def _known_pairs(self, found: Measurement, named: np.ndarray, where: np.ndarray, joint: np.ndarray) -> np.ndarray:
        """Return the pairs by a platform's own identities that pass the gate, the nearest row of each target."""
        targets, rows = named.T
        own = replace(found.seen, camera_m=np.zeros_like(found.seen.camera_m)).covariance_m2[rows]
        apart = found.seen.east_north_m[rows] - where[targets]
        inverse = np.linalg.inv(joint[targets, :, targets] + own)
        distance = np.einsum("ki,kij,kj->k", apart, inverse, apart)
        order = [k for k in np.argsort(distance, kind="stable").tolist() if distance[k] < self._limit]
        nearest = dict(zip(targets[order[::-1]].tolist(), rows[order[::-1]].tolist(), strict=True))
        return np.array(list(nearest.items()), np.int64).reshape(-1, 2)

    def _correct(self, found: Measurement, pairs: np.ndarray) -> None:
        """Correct the filter by the rows of a measurement that belong to known targets."""
        if len(pairs):
            targets, rows = pairs.T
            by_errors = np.tile(found.seen.camera_m[rows], 2)
            state = self.filter.state
            expected = state[self.filter.place_rows(targets)] + by_errors @ state[self.filter.errors_of(found.platform)]
            self.filter.correct(found.platform, targets, found.seen_near(rows, expected))

    def _note(self, found: Measurement, target: int, row: int) -> None:
        """Record on a target which platform saw it, under which number and class."""
        one, number, label = self.targets[target], int(found.number[row]), str(found.label[row])
        one.looks += 1
        if label:
            again = label in one.votes and found.platform in one.seen
            one.votes[label] = one.votes.get(label, 0.0) + float(found.score[row]) * (0.3 if again else 1.0)
        one.seen[found.platform] = found.time_s, number
        if number > 0:
            self._named[found.platform, number] = one.number

    def _forget(self) -> None:
        """Drop targets that were not seen for long, and the oldest of too many rarely seen targets."""
        since_s = self.filter.time_s - self._forget_s
        old = [i for i, one in enumerate(self.targets) if max(last_s for last_s, _ in one.seen.values()) < since_s]
        unsure = [i for i, one in enumerate(self.targets) if one.looks < _LOOKS]
        self._drop(sorted({*old, *unsure[: -_UNSURE * max(self._most, 10)]}))

    def _drop(self, which: list[int]) -> None:
        if which:
            gone = {self.targets[i].number for i in which}
            self._named = {name: number for name, number in self._named.items() if number not in gone}
            self.filter.drop(which)
            self.targets = [one for i, one in enumerate(self.targets) if i not in which]

    def _unite(self, first: int, second: int) -> None:
        """Unite two targets, given by their numbers; the lower number stays."""
        rows = {one.number: i for i, one in enumerate(self.targets)}
        kept, other = (rows.get(number, -1) for number in sorted((first, second)))
        if min(kept, other) < 0 or kept == other:
            return
        self.filter.unite(kept, other)
        one, gone = self.targets[kept], self.targets[other]
        one.looks += gone.looks
        one.seen |= {name: max(seen, one.seen.get(name, seen)) for name, seen in gone.seen.items()}
        one.votes |= {label: one.votes.get(label, 0.0) + votes for label, votes in gone.votes.items()}
        self._named = {name: one.number if n == gone.number else n for name, n in self._named.items()}
        self._drop([other])

    def _tell(self, found: Measurement, origin_deg: tuple[float, float] | None) -> FusedTargets:
        state, spread, _ = self.filter.read()
        which = [i for i, one in enumerate(self.targets) if one.looks >= _LOOKS]
        rows = SIZE * np.array(which, np.int64)[:, None] + np.arange(4)
        targets = [self.targets[i] for i in which]
        classes = ("", *sorted({name for one in targets for name in one.votes}))
        votes = np.array([[1.0, *(one.votes.get(c, 0.0) for c in classes[1:])] for one in targets])
        votes = votes.reshape(-1, len(classes))
        seen_by = np.empty(len(targets), object)
        seen_by[:] = [one.seen_by(found.time_s) for one in targets]
        return FusedTargets(
            found.time_s,
            found.frame,
            found.platform,
            np.array([one.number for one in targets], np.int64),
            state[rows],
            spread[rows[:, :, None], rows[:, None, :]],
            seen_by,
            classes,
            votes / votes.sum(axis=1, keepdims=True),
            origin_deg,
        )
