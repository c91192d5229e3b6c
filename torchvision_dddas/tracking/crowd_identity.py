"""Who is who among crowds on the ground: where they meet and part again, each goes on as the one that it was.

In the picture two crowds that meet are one blob, which is followed as one of them, and what is left when they part is a
matter of chance. On the ground each is expected where it was going, and as large as it was: so those that share a blob
are carried on, moved together with it, until there are as many blobs again.
"""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.types import Float, Int

# A crowd is this far off where it is expected: at once, by its own radius, and for each second that it was not seen.
_OFF_M, _OFF_SHARE, _OFF_M_S = 0.8, 0.2, 0.7
# Further off than so many of these it is another one. What an e-fold of its size costs, and half a step up, at most.
_GATE, _SIZE, _SIZE_MOST = 3.0, 0.8, 1.2
# What it is worth to be followed in the picture as before.
_FOLLOWED = 1.0
# What is not seen is expected so long, and moves on for so long.
_KEPT_S, _MOVES_S = 8.0, 3.0
# What shares a blob is expected so long; and what was there for less when it came into the blob was a part of it.
_SHARED_S, _SHORT_S = 10.0, 1.5
# What is as small, and no further from the rim of a crowd, is one of it for so long: it goes by no name.
_PART_M, _BEHIND_M, _PART_S = 1.1, 4.5, 3.0
# Of what is seen of a place, a velocity and a radius so much is believed: blobs swing about as parts are seen or not.
_PLACE, _VELOCITY, _RADIUS = 0.5, 0.15, 0.2
# And so much where several share it.
_SHARED = 0.3
_PART = -1


@dataclass
class _Known:
    """A crowd. followed: the number under which it is followed in the picture. host: whose blob it shares, 0: none."""

    number: int
    place: np.ndarray
    velocity: np.ndarray
    radius: float
    followed: int
    first_s: float
    seen_s: float
    host: int = 0
    shared_s: float = -np.inf
    hosting: bool = False


class RollCall:
    """The crowds so far. Feed it frames in order."""

    def __init__(self) -> None:
        self._known: list[_Known] = []
        self._names: dict[int, int] = {}  # of what is followed in the picture
        self._parts: dict[int, float] = {}  # since when those are seen who may have fallen behind
        self._count = 0
        self._time_s = 0.0

    def step(
        self,
        time_s: float,
        followed: Int[np.ndarray, " N"],
        place_m: Float[np.ndarray, "N 2"],
        radius_m: Float[np.ndarray, " N"],
    ) -> Int[np.ndarray, " N"]:
        """The identities of the targets of a frame, from 1, none twice; 0: as yet a part of another.

        followed: as whom each is followed in the picture. place_m, radius_m: NaN where the picture lies nowhere; such a
        one keeps the name that it had.
        """
        lapse_s, self._time_s = time_s - self._time_s, time_s
        self._move(lapse_s)
        rows = np.flatnonzero(np.isfinite(place_m).all(axis=1) & np.isfinite(radius_m))
        radius_m = np.maximum(radius_m, 0.3)
        names = np.zeros(len(followed), np.int64)
        found = best_pairs(self._scores(followed[rows], place_m[rows], radius_m[rows]))
        matched = {int(rows[column]): self._known[row] for row, column in found}
        self._share(matched, place_m, radius_m)
        for k in rows.tolist():
            known = matched.get(k)
            if known is None and self._part(int(followed[k]), place_m[k], float(radius_m[k])):
                names[k] = _PART
                continue
            if known is None:
                known = self._begin(place_m[k], float(radius_m[k]), int(followed[k]), time_s)
            else:
                self._see(known, place_m[k], float(radius_m[k]), int(followed[k]), time_s, lapse_s)
            names[k] = known.number
        for k in np.flatnonzero(names == 0).tolist():
            name = self._names.get(int(followed[k]), 0)
            if not name or name in names:
                name = self._next()
            names[k] = name
        names = np.maximum(names, 0)
        self._names.update(zip(followed.tolist(), names.tolist(), strict=True))
        self._forget()
        return names

    def name(self, followed: int) -> int:
        """The identity of what is followed in the picture, as it was last; 0: none."""
        return self._names.get(followed, 0)

    def _next(self) -> int:
        self._count += 1
        return self._count

    def _begin(self, place: np.ndarray, radius: float, followed: int, time_s: float) -> _Known:
        known = _Known(self._next(), place.copy(), np.zeros(2), radius, followed, time_s, time_s)
        self._known.append(known)
        return known

    def _part(self, followed: int, place: np.ndarray, radius: float) -> bool:
        """Whether what is seen for the first time may be somebody who has fallen behind a crowd."""
        if self._time_s - self._parts.setdefault(followed, self._time_s) > _PART_S:
            return False
        return radius < _PART_M and any(
            known.radius > radius
            and np.linalg.norm(known.place - place) - known.radius - radius < _BEHIND_M
            and known.seen_s - known.first_s > _SHORT_S
            for known in self._known
        )

    def _move(self, lapse_s: float) -> None:
        """To where all are expected now."""
        for known in self._known:
            if self._time_s - lapse_s - max(known.seen_s, known.shared_s) < _MOVES_S:
                known.place = known.place + lapse_s * known.velocity

    def _scores(self, followed: np.ndarray, place_m: np.ndarray, radius_m: np.ndarray) -> np.ndarray:
        """(K, N) how well each blob goes for each crowd; -inf: not at all."""
        scores = np.full((len(self._known), len(place_m)), -np.inf)
        for row, known in enumerate(self._known):
            lost_s = self._time_s - max(known.seen_s, known.shared_s)
            # The middle of a blob that holds more is off by as much as it is larger.
            more = np.maximum(radius_m - known.radius, 0)
            off = np.maximum(np.linalg.norm(place_m - known.place, axis=1) - more, 0)
            off = off / (_OFF_M + _OFF_SHARE * known.radius + _OFF_M_S * min(lost_s, _MOVES_S))
            size = np.minimum(_SIZE * np.abs(np.log(radius_m / known.radius)), _SIZE_MOST)
            score = _GATE + _SIZE_MOST - off - size
            if not known.host:
                score = score + _FOLLOWED * (followed == known.followed)
            scores[row] = np.where(off <= _GATE, score, -np.inf)
        return scores

    def _share(self, matched: dict[int, _Known], place_m: np.ndarray, radius_m: np.ndarray) -> None:
        """Find who is in whose blob, and move those who share one along with it."""
        free = [known for known in self._known if all(known is not other for other in matched.values())]
        for known in matched.values():
            known.host, known.hosting = 0, False
        for known in free:
            inside = [
                (float(np.linalg.norm(place_m[k] - known.place)) - radius_m[k], k)
                for k in matched
                if np.linalg.norm(place_m[k] - known.place) <= radius_m[k] + 0.5 * known.radius
            ]
            fresh = self._time_s - max(known.seen_s, known.shared_s) < 1.0
            if not inside or not fresh or self._time_s - known.seen_s > _SHARED_S:
                known.host = 0
                continue
            _, k = min(inside)
            if known.seen_s - known.first_s < _SHORT_S:
                known.seen_s = known.shared_s = -np.inf  # a part of it
                continue
            known.host, known.shared_s = matched[k].number, self._time_s
            matched[k].hosting = True
        for k, host in matched.items():
            if not host.hosting:
                continue
            group = [host, *(known for known in free if known.host == host.number)]
            weight = np.array([known.radius**2 for known in group])
            middle = np.average([known.place for known in group], axis=0, weights=weight)
            for known in group:
                known.place = known.place + _SHARED * (place_m[k] - middle)

    def _see(
        self, known: _Known, place: np.ndarray, radius: float, followed: int, time_s: float, lapse_s: float
    ) -> None:
        gap_s = max(time_s - known.seen_s, lapse_s, 1e-6)
        known.seen_s, known.followed = time_s, followed
        if known.hosting:
            return
        off = place - known.place
        known.place = known.place + _PLACE * off
        young = time_s - known.first_s < _SHORT_S
        known.velocity = known.velocity + (2 if young else 1) * _VELOCITY * off / max(gap_s, 0.2)
        known.radius += _RADIUS * (radius - known.radius)

    def _forget(self) -> None:
        self._known = [known for known in self._known if self._time_s - max(known.seen_s, known.shared_s) <= _KEPT_S]
