"""Identities of crowds on the ground. When crowds meet and part again, each crowd keeps its identity.

In the picture, two crowds that meet become one blob with one identity, and chance decides which crowd keeps it when
they part. On the ground each crowd is predicted by its position, velocity and radius. Crowds that share a blob move
with the blob until they are separate blobs again.
"""

from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.types import Float, Int, Tracks

# Standard deviation of a crowd's position: a constant, a share of its radius, and a part that grows while it is unseen.
_SIGMA_M, _SIGMA_SHARE, _SIGMA_M_S = 0.8, 0.2, 0.7
_UNKNOWN_M_S = 3.0  # the growing part for a target that was seen once, which may walk or drive slowly
# The gate, in standard deviations of the position; the penalty for an e-fold change of radius, and the largest penalty.
_GATE, _SIZE_PENALTY, _LARGEST_SIZE_PENALTY = 3.0, 0.8, 1.2
# Score for the same picture identity as before.
_SAME_TRACK_SCORE = 1.0
# Time for which an unseen crowd is kept, and time for which it is predicted to move.
_KEPT_S, _MOVES_S = 8.0, 3.0
# Longest time for which a crowd may share a blob. A crowd that was seen for less than _SHORT_S before counts as a part
# of the blob.
_SHARED_S, _SHORT_S = 10.0, 1.5
# A blob with a radius below _PART_RADIUS_M, within _PART_GAP_M of a larger crowd's edge, counts as a part of that crowd
# for _PART_S.
_PART_RADIUS_M, _PART_GAP_M, _PART_S = 1.1, 4.5, 3.0
# Smallest gains of the filter for straight paths. They are small because a blob's centre moves when parts are hidden.
_PLACE_GAIN, _VELOCITY_GAIN, _RADIUS_GAIN, _SHARED_GAIN = 0.5, 0.15, 0.2, 0.3
_PART = -1


@dataclass
class _Crowd:
    """A crowd. track: its identity in the picture. host: identity of the crowd whose blob it shares, 0 for none."""

    identity: int
    place_m: np.ndarray
    velocity_m_s: np.ndarray
    radius_m: float
    track: int
    first_s: float
    seen_s: float
    host: int = 0
    shared_s: float = -np.inf
    is_host: bool = False
    looks: int = 1

    @property
    def last_s(self) -> float:
        """The time at which the crowd was last seen, alone or in a shared blob."""
        return max(self.seen_s, self.shared_s)


class CrowdIdentities:
    """The crowds of a run. Pass the frames in order to `rename` or `update`."""

    def __init__(self) -> None:
        self._crowds: list[_Crowd] = []
        self._identities: dict[int, int] = {}  # identity of the crowd by identity in the picture
        self._parts_since: dict[int, float] = {}  # time at which a possible part of a crowd was first seen, by track
        self._new_identities = count(1)
        self._time_s = 0.0

    def rename(
        self, tracks: Tracks, time_s: float, place_m: Float[np.ndarray, "N 2"], radius_m: Float[np.ndarray, " N"]
    ) -> Tracks:
        """Return the tracks of a frame with the identities of crowds, sorted by identity, without parts of crowds.

        place_m, radius_m: of the N tracks with a detection, as in `update`. A box that fills a gap gets the latest
        crowd identity of its track.
        """
        seen = np.flatnonzero(tracks.row >= 0)
        identity = np.zeros(len(tracks), np.int64)
        identity[seen] = self.update(time_s, tracks.identity[seen], place_m, radius_m)
        taken = set(identity[seen].tolist())
        for row in np.flatnonzero(tracks.row < 0).tolist():
            known = self._identities.get(int(tracks.identity[row]), 0)
            if known not in taken:
                identity[row] = known
                taken.add(known)
        rows = np.flatnonzero(identity > 0)
        rows = rows[np.argsort(identity[rows], kind="stable")]
        return replace(tracks, identity=identity)[rows]

    def update(
        self,
        time_s: float,
        track: Int[np.ndarray, " N"],
        place_m: Float[np.ndarray, "N 2"],
        radius_m: Float[np.ndarray, " N"],
    ) -> Int[np.ndarray, " N"]:
        """Return the identities of a frame's blobs, unique and from 1; 0 for a blob that counts as a part of a crowd.

        track: identity of each blob in the picture. place_m, radius_m: position and radius on the ground, NaN if the
        picture could not be located; such a blob keeps the crowd identity of its track.
        """
        elapsed_s, self._time_s = time_s - self._time_s, time_s
        for crowd in self._crowds:
            if time_s - elapsed_s - crowd.last_s < _MOVES_S:
                crowd.place_m = crowd.place_m + elapsed_s * crowd.velocity_m_s
        located = np.flatnonzero(np.isfinite(place_m).all(axis=1) & np.isfinite(radius_m))
        radius_m = np.maximum(radius_m, 0.3)
        pairs = best_pairs(self._scores(track[located], place_m[located], radius_m[located]))
        matched = {int(located[column]): self._crowds[row] for row, column in pairs}
        self._share_blobs(matched, place_m, radius_m)
        identity = np.zeros(len(track), np.int64)
        for k in located.tolist():
            known, radius = matched.get(k), float(radius_m[k])
            if known is not None:
                self._correct(known, place_m[k], radius, int(track[k]), elapsed_s)
                identity[k] = known.identity
            elif self._is_part(int(track[k]), place_m[k], radius):
                identity[k] = _PART
            else:
                identity[k] = next(self._new_identities)
                begun = _Crowd(int(identity[k]), place_m[k].copy(), np.zeros(2), radius, int(track[k]), time_s, time_s)
                self._crowds.append(begun)
        for k in np.flatnonzero(identity == 0).tolist():
            earlier = self._identities.get(int(track[k]), 0)
            identity[k] = earlier if earlier and earlier not in identity else next(self._new_identities)
        identity = np.maximum(identity, 0)
        self._identities.update(zip(track.tolist(), identity.tolist(), strict=True))
        self._crowds = [crowd for crowd in self._crowds if time_s - crowd.last_s <= _KEPT_S]
        return identity

    def _is_part(self, track: int, place_m: np.ndarray, radius_m: float) -> bool:
        """Return whether a new blob may be people who have fallen behind a crowd."""
        if self._time_s - self._parts_since.setdefault(track, self._time_s) > _PART_S:
            return False
        return radius_m < _PART_RADIUS_M and any(
            crowd.radius_m > radius_m
            and np.linalg.norm(crowd.place_m - place_m) - crowd.radius_m - radius_m < _PART_GAP_M
            and crowd.seen_s - crowd.first_s > _SHORT_S
            for crowd in self._crowds
        )

    def _scores(self, track: np.ndarray, place_m: np.ndarray, radius_m: np.ndarray) -> np.ndarray:
        """Return the (K, N) association scores of crowds and blobs; -inf outside the gate."""
        scores = np.full((len(self._crowds), len(place_m)), -np.inf)
        for row, crowd in enumerate(self._crowds):
            unseen_s = self._time_s - crowd.last_s
            # A blob that contains other crowds too may have its centre off by the difference of the radii.
            excess = np.maximum(radius_m - crowd.radius_m, 0)
            off = np.maximum(np.linalg.norm(place_m - crowd.place_m, axis=1) - excess, 0)
            drift_m_s = _UNKNOWN_M_S if crowd.looks == 1 else _SIGMA_M_S
            off = off / (_SIGMA_M + _SIGMA_SHARE * crowd.radius_m + drift_m_s * min(unseen_s, _MOVES_S))
            size = np.minimum(_SIZE_PENALTY * np.abs(np.log(radius_m / crowd.radius_m)), _LARGEST_SIZE_PENALTY)
            score = _GATE + _LARGEST_SIZE_PENALTY - off - size
            if not crowd.host:
                score = score + _SAME_TRACK_SCORE * (track == crowd.track)
            scores[row] = np.where(off <= _GATE, score, -np.inf)
        return scores

    def _share_blobs(self, matched: dict[int, _Crowd], place_m: np.ndarray, radius_m: np.ndarray) -> None:
        """Find the crowds that share the blob of another crowd, and move them with the blob."""
        free = [crowd for crowd in self._crowds if all(crowd is not other for other in matched.values())]
        for crowd in matched.values():
            crowd.host, crowd.is_host = 0, False
        for crowd in free:
            inside = [
                (float(np.linalg.norm(place_m[k] - crowd.place_m)) - radius_m[k], k)
                for k in matched
                if np.linalg.norm(place_m[k] - crowd.place_m) <= radius_m[k] + 0.5 * crowd.radius_m
            ]
            is_fresh = self._time_s - crowd.last_s < 1.0
            if not inside or not is_fresh or self._time_s - crowd.seen_s > _SHARED_S:
                crowd.host = 0
            elif crowd.seen_s - crowd.first_s < _SHORT_S:
                crowd.seen_s = crowd.shared_s = -np.inf  # the crowd was a part of the blob, so drop it
            else:
                host = matched[min(inside)[1]]
                crowd.host, crowd.shared_s, host.is_host = host.identity, self._time_s, True
        for k, host in matched.items():
            if not host.is_host:
                continue
            group = [host, *(crowd for crowd in free if crowd.host == host.identity)]
            weight = np.array([crowd.radius_m**2 for crowd in group])
            middle = np.average([crowd.place_m for crowd in group], axis=0, weights=weight)
            for crowd in group:
                crowd.place_m = crowd.place_m + _SHARED_GAIN * (place_m[k] - middle)

    def _correct(self, crowd: _Crowd, place_m: np.ndarray, radius_m: float, track: int, elapsed_s: float) -> None:
        gap_s = max(self._time_s - crowd.seen_s, elapsed_s, 1e-6)
        crowd.seen_s, crowd.track = self._time_s, track
        if crowd.is_host:
            return
        crowd.looks += 1
        pairs = crowd.looks * (crowd.looks + 1)
        innovation = place_m - crowd.place_m
        crowd.place_m = crowd.place_m + max(_PLACE_GAIN, (4 * crowd.looks - 2) / pairs) * innovation
        crowd.velocity_m_s = crowd.velocity_m_s + max(_VELOCITY_GAIN, 6 / pairs) * innovation / max(gap_s, 0.2)
        crowd.radius_m += _RADIUS_GAIN * (radius_m - crowd.radius_m)
