"""Sightings of people by several vehicles: which are of the same person, and where that person stands.

What is common to sightings is estimated with the places, not counted anew with each: a vehicle's position, heading,
pitch, camera height and focal length are common to all that it sees, a person's height to all that see the person. So
two people seen by the same two vehicles tell how far the vehicles' GPS disagree, and each gains by the other. All is
linear about the single sightings. Assumed independent: what is new in each sighting, and the vehicles from one another;
a GPS error common to the whole team is in no covariance here and no fusion takes it away.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.types import Float, Int, Sightings

# Rounds in which each vehicle's sightings are matched anew to the others'.
ROUNDS = 3
# Most pairs that are tried as hypotheses of a vehicle's common error.
BELIEFS = 60
# Hypotheses times pairs that are computed at once: a few megabytes.
MATRICES = 20_000


@dataclass(frozen=True)
class Fused:
    """People seen by a team at one time, one row a person.

    east_north_m: (P, 2). covariance_m2: (P, 2, 2). members: (P, V) the row of each vehicle's sighting, -1 for none.
    """

    east_north_m: np.ndarray
    covariance_m2: np.ndarray
    members: np.ndarray

    def __len__(self) -> int:
        return len(self.members)


def fuse(team: Sequence[Sightings], gate_sigmas: float = 3.0) -> Fused:
    """Fuse what several vehicles see at one time, the sightings of each vehicle in one item; all must be located.

    gate_sigmas: sightings are of one person if their distance, by its covariance, is as likely as this many sigmas.
    """
    members = associate(team, gate_sigmas)
    where, joint, _ = estimate_places(team, members)
    own = joint[np.arange(len(members)), :, np.arange(len(members))]
    return Fused(where, own, members)


def associate(team: Sequence[Sightings], gate_sigmas: float = 3.0) -> Int[np.ndarray, "P V"]:
    """The sightings of each person, -1 where a vehicle does not see it: every sighting is of exactly one person.

    The vehicle that sees most begins; each other's are matched to what is known by then. Then each vehicle in turn is
    matched anew to the others, whose disagreement is known better by then, until nothing changes.
    """
    order = sorted(range(len(team)), key=lambda v: -len(team[v]))
    members = np.zeros((0, len(team)), np.int64)
    for vehicle in order:
        members = _matched(team, members, vehicle, gate_sigmas)
    for _ in range(ROUNDS if len(team) > 2 else 0):
        before = {tuple(row) for row in members.tolist()}
        for vehicle in order:
            others = members.copy()
            others[:, vehicle] = -1
            members = _matched(team, others[(others >= 0).any(axis=1)], vehicle, gate_sigmas)
        if {tuple(row) for row in members.tolist()} == before:
            break
    return members[np.lexsort(np.where(members < 0, np.iinfo(np.int64).max, members).T[::-1])]


def gate_distance(sigmas: float) -> float:
    """Squared Mahalanobis distance in the plane with the tail probability of this many sigmas on a line."""
    return -2 * math.log(max(math.erfc(sigmas / math.sqrt(2)), 1e-300))


def estimate_places(
    team: Sequence[Sightings], members: Int[np.ndarray, "P V"]
) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2 P 2"], Float[np.ndarray, "V 6"]]:
    """Places of people, their joint covariance, and each vehicle's errors in sigmas: least squares over all sightings.

    Unknown are each person's place and height, and each vehicle's six errors; what is known of the heights and errors
    beforehand is that their sigma is 1.
    """
    people, vehicles = members.shape
    size = 3 * people + 6 * vehicles
    normal, right = np.zeros((size, size)), np.zeros(size)
    normal[2 * people :, 2 * people :] = np.eye(size - 2 * people)
    for vehicle, seen in enumerate(team):
        who = np.flatnonzero(members[:, vehicle] >= 0)
        row, n = members[who, vehicle], len(who)
        place = np.broadcast_to(np.eye(2), (n, 2, 2))
        design = np.concatenate([place, seen.body_m[row][:, :, None], seen.camera_m[row]], axis=2)
        errors = np.broadcast_to(3 * people + 6 * vehicle + np.arange(6), (n, 6))
        at = np.concatenate([np.stack([2 * who, 2 * who + 1, 2 * people + who], axis=1), errors], axis=1)
        weighed = design.swapaxes(1, 2) @ np.linalg.inv(seen.own_m2[row])
        np.add.at(normal, (at[:, :, None], at[:, None, :]), weighed @ design)
        np.add.at(right, at, np.einsum("nij,nj->ni", weighed, seen.east_north_m[row]))
    # Scaled to ones on the diagonal: metres and sigmas differ by orders of magnitude.
    scale = 1 / np.sqrt(np.diag(normal))
    covariance = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    found = covariance @ right
    joint = covariance[: 2 * people, : 2 * people].reshape(people, 2, people, 2)
    return found[: 2 * people].reshape(-1, 2), joint, found[3 * people :].reshape(-1, 6)


def _matched(team: Sequence[Sightings], known: np.ndarray, vehicle: int, gate_sigmas: float) -> np.ndarray:
    """The people known by other vehicles, with this vehicle's sightings among them; unmatched ones are new people."""
    seen = team[vehicle]
    members = known.copy()
    left = np.ones(len(seen), bool)
    if len(known) and len(seen):
        where, joint, _ = estimate_places(team, known)
        for person, row in _pairs(where, joint, seen, gate_distance(gate_sigmas)):
            members[person, vehicle], left[row] = row, False
    new = np.full((left.sum(), len(team)), -1, np.int64)
    new[:, vehicle] = np.flatnonzero(left)
    return np.concatenate([members, new])


def _pairs(where: np.ndarray, joint: np.ndarray, seen: Sightings, limit: float) -> np.ndarray:
    """(K, 2) the people and the sightings that are the same, one to one.

    The sightings may all be off together, by more than people stand apart. So each likely pair in turn is believed, and
    what it says of the errors in common is taken from the rest before these are matched (Hungarian). The belief under
    which most agrees holds.
    """
    apart = seen.east_north_m - where[:, None]
    spread = joint[np.arange(len(where)), :, np.arange(len(where))][:, None] + seen.covariance_m2
    distance = _squared(apart, spread)
    common = np.einsum("nik,mjk->nimj", seen.camera_m, seen.camera_m)
    best, most = np.zeros((0, 2), np.int64), 0.0
    likely = np.argsort(distance, axis=None)[:BELIEFS]
    likely = likely[distance.ravel()[likely] < limit]
    persons, rows = np.unravel_index(likely, distance.shape)
    at_once = max(1, MATRICES // max(distance.size, 1))
    for begin in range(0, len(likely), at_once):
        person, row = persons[begin : begin + at_once], rows[begin : begin + at_once]
        # Covariance of what any other pair is apart with what this one is in its own sigmas: (beliefs, P, N, 2, 2).
        whiten = np.linalg.inv(np.linalg.cholesky(spread[person, row])).swapaxes(1, 2)
        of_person, of_row = (
            held.transpose(2, 0, 1, 3) @ whiten[:, None] for held in (joint[:, :, person], common[:, :, row])
        )
        cross = of_person[:, :, None] + of_row[:, None]
        told = np.einsum("kij,ki->jk", whiten, apart[person, row])[:, :, None, None]
        # By components: NumPy is slow with many small matrices.
        (ee, en), (ne, nn) = np.moveaxis(cross, (-2, -1), (0, 1))
        rest = _by_covariance(
            apart[..., 0] - ee * told[0] - en * told[1],
            apart[..., 1] - ne * told[0] - nn * told[1],
            spread[..., 0, 0] - ee**2 - en**2,
            spread[..., 0, 1] - ee * ne - en * nn,
            spread[..., 1, 1] - ne**2 - nn**2,
        )
        belief = np.arange(len(person))
        rest[belief, person, :] = rest[belief, :, row] = np.inf
        rest[belief, person, row] = distance[person, row]
        score = np.where(rest < limit, limit - rest, 0.0)
        reach = np.minimum(score.max(axis=2).sum(axis=1), score.max(axis=1).sum(axis=1))
        for k in np.flatnonzero(reach > most).tolist():
            if reach[k] > most:  # which may have grown
                found = best_pairs(score[k])
                agreed = score[k][found[:, 0], found[:, 1]].sum()
                if agreed > most:
                    best, most = found, agreed
    return best


def _squared(apart: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squared distances by their covariances; (..., 2) and (..., 2, 2)."""
    return _by_covariance(
        apart[..., 0], apart[..., 1], covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    )


def _by_covariance(east: np.ndarray, north: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """The same, with the variance a of east, the covariance b, and the variance c of north."""
    return (c * east**2 - 2 * b * east * north + a * north**2) / (a * c - b**2)
