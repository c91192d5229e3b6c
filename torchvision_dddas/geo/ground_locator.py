"""Locate people seen by cameras on the ground, frame by frame, and fuse several cameras.

Errors that sightings share are estimated together with the places, and are not counted again with each sighting: the
position, heading, pitch, camera height and focal length of a vehicle are common to all people that it sees, and the
height of a person to all vehicles that see the person. Two people seen by the same two vehicles therefore show how far
the vehicles' GPS disagree, and both places improve. The model is linear about the single sightings. Assumed
independent: the new errors of each sighting, and the errors of different vehicles. No covariance here contains a GPS
error common to the whole team, and fusion does not remove it.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, check_settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.heights import geoid_of, median_of
from torchvision_dddas.geo.ranging import range_people, touches_border
from torchvision_dddas.types import (
    Camera,
    DetectionTable,
    Float,
    GroundLocations,
    Int,
    People,
    Poses,
    PoseTable,
    Positions,
    Sightings,
)

# Rounds in which the sightings of each vehicle are matched again to the other vehicles' sightings.
_ROUNDS = 3
# Cameras whose ground heights differ by less than this stand on one plane.
_LEVEL_M = 0.5
# Largest number of pairs that are tried as hypotheses of a vehicle's common error.
_BELIEFS = 60
# Number of matrices, hypotheses times pairs, that are computed at once: a few megabytes.
_MATRICES = 20_000


@dataclass(frozen=True)
class CameraView:
    """What one camera saw, one row a box: table, places by this camera alone, targets, and whether boxes are cut.

    score: (N,) in [0, 1]; 1 if the table's scores are on another scale.
    """

    table: DetectionTable
    sightings: Sightings
    target: np.ndarray
    cut: np.ndarray
    score: np.ndarray
    lonlat_deg: np.ndarray | None


class GroundLocator:
    """Locate people seen by one or several cameras on the ground.

    >>> camera = td.Camera("ugv1", (640, 480), (500.0, 500.0), (319.5, 239.5), height_m=1.2)
    >>> people = td.People(np.array([[309.5, 240, 20, 60]]), np.ones(1), np.ones(1), np.array([False]))
    >>> north_m = td.GroundLocator(camera).locate(people).positions.east_north_m[0, 1]
    >>> round(float(north_m))
    13
    """

    def __init__(
        self,
        cameras: Camera | Sequence[Camera],
        *,
        settings: Settings | None = None,
        poses: Sequence[PoseTable | None] = (),
        rate_hz: float | None = None,
    ) -> None:
        """poses: places of each camera over time; None for a standing camera. rate_hz: needed for poses with times.

        Raise InputError if there is no camera, if the numbers of cameras and poses differ, or for several cameras with
        ground.mode = paper.
        """
        self.cameras = [cameras] if isinstance(cameras, Camera) else list(cameras)
        self.settings, self.rate_hz = check_settings(settings), rate_hz
        self.poses = list(poses) or [None] * len(self.cameras)
        if not self.cameras or not all(isinstance(camera, Camera) for camera in self.cameras):
            raise InputError("GroundLocator expects one Camera or several, got another type or none")
        if len(self.poses) != len(self.cameras):
            raise InputError(f"{len(self.cameras)} cameras and {len(self.poses)} tables of poses; wanted one for each")
        if self.settings.ground.mode == "paper" and len(self.cameras) > 1:
            raise InputError(
                f"ground.mode = paper has no covariances, so it cannot fuse {len(self.cameras)} cameras; give one "
                "table, or use default"
            )
        self.origin_deg: tuple[float, float] | None = None
        heights = np.array([camera.elevation_m for camera in self.cameras])
        self._above_sea_m, self._geoid_m = median_of(heights), math.nan
        self.notes: list[str] = []
        if np.isfinite(heights).any() and np.nanmax(np.abs(heights - self._above_sea_m)) > _LEVEL_M:
            self.notes.append(
                f"elevation_m of the cameras is {np.nanmin(heights):.1f} to {np.nanmax(heights):.1f} m: distances "
                f"are not corrected for this, because the ground is assumed level, at {self._above_sea_m:.1f} m"
            )
        # Numbers of people, by (vehicle, target), and the last number that was given.
        self._number: dict[tuple[int, int], int] = {}
        self._last_number = 0

    def locate(self, people: People | Sequence[People], *, frame: int = 1) -> GroundLocations:
        """Locate the people of one frame. people: people seen by the camera, or the People of each camera in order."""
        seen = [people] if isinstance(people, People) else list(people)
        if not all(isinstance(one, People) for one in seen):
            raise InputError("locate expects the People of each camera, got another type")
        tables = [
            DetectionTable("", np.full(len(one), frame), one.box_px, one.score, np.arange(len(one)), cut=one.cut)
            for one in seen
        ]
        views = self.place_tables(tables)
        return self._locate(frame, views, [np.arange(len(view.table)) for view in views])

    def locate_tables(self, tables: Sequence[DetectionTable]) -> Iterator[GroundLocations]:
        """Locate people frame by frame. Raise InputError at once, as `place_tables` does."""
        views = self.place_tables(tables)
        frames = _simultaneous_rows(views, self.settings.ground.within_frames)
        return (self._locate(frame, views, rows) for frame, rows in frames)

    def place_tables(self, tables: Sequence[DetectionTable]) -> list[CameraView]:
        """Locate the people of each table by its own camera alone.

        Local metres are the cameras' metres, or east and north of the first place of the first camera.
        Raise InputError if the numbers of tables and cameras differ, if cameras mix degrees and metres, if poses do not
        cover the frames, or if an identity occurs twice in a frame.
        """
        if len(tables) != len(self.cameras):
            raise InputError(
                f"{len(tables)} tables and {len(self.cameras)} cameras; wanted one --camera for each table"
            )
        stood = [
            geometry.poses_at(camera, pose, table.frame, self.rate_hz)
            for camera, pose, table in zip(self.cameras, self.poses, tables, strict=True)
        ]
        if len({camera.geographic for camera, _ in stood}) > 1:
            raise InputError(
                "some cameras stand at longitude and latitude, others at local metres; give all in one kind"
            )
        if self.origin_deg is None and stood[0][0].geographic:
            first = next((where.place[0] for _, where in stood if len(where.place)), stood[0][0].place)
            self.origin_deg = float(first[0]), float(first[1])
        if math.isfinite(self._above_sea_m):
            self._geoid_m = geoid_of(np.zeros((1, 2)), self.origin_deg, self.settings.aerial.geoid)
        return [self._view(table, *seen) for table, seen in zip(tables, stood, strict=True)]

    def _view(self, table: DetectionTable, camera: Camera, where: Poses) -> CameraView:
        paper, origin = self.settings.ground.mode == "paper", self.origin_deg
        metres = where.place
        if origin is not None:
            metres = (geometry.plain_east_north if paper else geometry.east_north)(where.place, origin)
        cut = touches_border(table.box_px, camera.size_px) if table.cut is None else table.cut
        seen = range_people(table.box_px, cut, camera, where, metres, self.settings.ground)
        degrees = None
        if origin is not None and paper:
            degrees = geometry.plain_lonlat(seen.east_north_m - metres, where.place)
        elif origin is not None:
            degrees = geometry.lonlat(seen.east_north_m, origin)
        score = table.score if table.probable else np.ones(len(table))
        return CameraView(table, seen, table.targets, cut, score, degrees)

    def _locate(self, frame: int, views: list[CameraView], rows: list[np.ndarray]) -> GroundLocations:
        pairs = list(zip(views, rows, strict=True))
        sightings = [view.sightings[own] for view, own in pairs]
        located = [own[seen.by != "bearing"] for own, seen in zip(rows, sightings, strict=True)]
        team = [view.sightings[own] for view, own in zip(views, located, strict=True)]
        if len(views) == 1:
            (view,), (own,), (seen,) = views, located, team
            target, place, covariance, score = view.target[own], seen.east_north_m, seen.covariance_m2, view.score[own]
            degrees = None if view.lonlat_deg is None else view.lonlat_deg[own]
            members, (label, number) = np.arange(len(own))[:, None], view.table.classes(own)
        else:
            members, place, covariance = fuse(team, self.settings.ground.gate_sigmas)
            people = [[(v, located[v][r]) for v, r in enumerate(row) if r >= 0] for row in members.tolist()]
            target = self._numbers([[(v, int(views[v].target[r])) for v, r in person] for person in people])
            best = [max(person, key=lambda seen: float(views[seen[0]].score[seen[1]])) for person in people]
            score = np.array([views[v].score[r] for v, r in best], float)
            classes = [view.table.classes(slice(None)) for view in views]
            label, number = (np.array([classes[v][k][r] for v, r in best], (object, int)[k]) for k in (0, 1))
            degrees = None if self.origin_deg is None else geometry.lonlat(place, self.origin_deg)
        return GroundLocations(
            frame,
            Positions(
                np.full(len(place), frame),
                target,
                place,
                covariance,
                score,
                self.origin_deg,
                degrees,
                label,
                number,
                np.full(len(place), self._above_sea_m),
                np.full(len(place), self._above_sea_m + self._geoid_m),
            ),
            members,
            Sightings.concat(sightings),
            np.repeat(np.arange(len(rows)), [len(own) for own in rows]),
            np.concatenate([view.target[own] for view, own in pairs]),
            np.concatenate([view.cut[own] for view, own in pairs]),
            np.concatenate([view.table.score[own] for view, own in pairs]),
            np.concatenate([view.table.box_px[own] for view, own in pairs]),
        )

    def _numbers(self, people: list[list[tuple[int, int]]]) -> np.ndarray:
        """Return a unique number for each person, given as the (vehicle, target) pairs of its sightings.

        A person takes the number that most of the vehicles' targets had when they were last seen.
        """
        wish = []
        for person, seen in enumerate(people):
            before = [self._number[one] for one in seen if one in self._number]
            wish += [(-before.count(number), number, person) for number in set(before)]
        given: dict[int, int] = {}
        for _, number, person in sorted(wish):
            if person not in given and number not in given.values():
                given[person] = number
        for person, seen in enumerate(people):
            if person not in given:
                self._last_number += 1
                given[person] = self._last_number
            self._number.update(dict.fromkeys(seen, given[person]))
        return np.array([given[person] for person in range(len(people))], np.int64)


def _simultaneous_rows(views: Sequence[CameraView], within_frames: int) -> Iterator[tuple[int, list[np.ndarray]]]:
    """Yield the first frame of each group of simultaneous frames, and each view's rows in it.

    A group holds at most one frame of each camera, and none later than within_frames after the first: cameras need not
    take their pictures at the same time.
    """
    queues = [deque(np.unique(view.table.frame).tolist()) for view in views]
    while any(queues):
        first = min(queue[0] for queue in queues if queue)
        rows = []
        for view, queue in zip(views, queues, strict=True):
            taken = queue and queue[0] <= first + within_frames
            span = view.table.rows(queue.popleft()) if taken else slice(0, 0)
            rows.append(np.arange(span.start, span.stop))
        yield first, rows


# Fusion: which sightings are of the same person, and where that person stands.


def fuse(
    team: Sequence[Sightings], gate_sigmas: float = 3.0
) -> tuple[Int[np.ndarray, "P V"], Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2 2"]]:
    """Associate the sightings of a team's vehicles at one time, and estimate the places of the people they see.

    team: the sightings of each vehicle, all located. gate_sigmas: two sightings belong to one person if their
    Mahalanobis distance is at most this many standard deviations. Return the members, as `associate` does, the places
    and their covariances.
    """
    members = associate(team, gate_sigmas)
    place, joint = estimate_places(team, members)
    own = np.arange(len(members))
    return members, place, joint[own, :, own]


def associate(team: Sequence[Sightings], gate_sigmas: float = 3.0) -> Int[np.ndarray, "P V"]:
    """Return the sightings of each person, -1 if a vehicle does not see it. Each sighting belongs to one person.

    Start with the vehicle that sees most people, and match the sightings of each other vehicle to the people known so
    far. Then match each vehicle in turn again to the others, whose disagreement is now known better, until nothing
    changes.
    """
    order = sorted(range(len(team)), key=lambda v: -len(team[v]))
    members = np.zeros((0, len(team)), np.int64)
    for vehicle in order:
        members = _matched(team, members, vehicle, gate_sigmas)
    for _ in range(_ROUNDS if len(team) > 2 else 0):
        before = {tuple(row) for row in members.tolist()}
        for vehicle in order:
            others = members.copy()
            others[:, vehicle] = -1
            members = _matched(team, others[(others >= 0).any(axis=1)], vehicle, gate_sigmas)
        if {tuple(row) for row in members.tolist()} == before:
            break
    return members[np.lexsort(np.where(members < 0, np.iinfo(np.int64).max, members).T[::-1])]


def gate_distance(sigmas: float) -> float:
    """Return the squared Mahalanobis distance in the plane with the tail probability of this many sigmas on a line."""
    return -2 * math.log(max(math.erfc(sigmas / math.sqrt(2)), 1e-300))


def estimate_places(
    team: Sequence[Sightings], members: Int[np.ndarray, "P V"]
) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2 P 2"]]:
    """Return the places of people and their joint covariance, by least squares over all sightings.

    The unknowns are each person's place and height, and each vehicle's six errors; heights and errors have a prior
    sigma of 1.
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
        weighted = design.swapaxes(1, 2) @ np.linalg.inv(seen.own_m2[row])
        np.add.at(normal, (at[:, :, None], at[:, None, :]), weighted @ design)
        np.add.at(right, at, np.einsum("nij,nj->ni", weighted, seen.east_north_m[row]))
    # Scale the diagonal to 1, because metres and sigmas differ by orders of magnitude.
    scale = 1 / np.sqrt(np.diag(normal))
    covariance = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    joint = covariance[: 2 * people, : 2 * people].reshape(people, 2, people, 2)
    return (covariance @ right)[: 2 * people].reshape(-1, 2), joint


def _matched(team: Sequence[Sightings], known: np.ndarray, vehicle: int, gate_sigmas: float) -> np.ndarray:
    """Add a vehicle's sightings to the people known by other vehicles; unmatched sightings are new people."""
    seen = team[vehicle]
    members = known.copy()
    left = np.ones(len(seen), bool)
    if len(known) and len(seen):
        for person, row in match_people(*estimate_places(team, known), seen, gate_distance(gate_sigmas)):
            members[person, vehicle], left[row] = row, False
    new = np.full((left.sum(), len(team)), -1, np.int64)
    new[:, vehicle] = np.flatnonzero(left)
    return np.concatenate([members, new])


def match_people(where: np.ndarray, joint: np.ndarray, seen: Sightings, limit: float) -> np.ndarray:
    """Return (K, 2) the pairs of people and sightings that are the same, one to one.

    where (P, 2), joint (P, 2, P, 2): places of the people and their covariance. limit: the squared distance of a gate.

    All sightings may share an error larger than the distance between people. Each likely pair is therefore tried as a
    hypothesis: its implied common error is removed from the other pairs before these are matched (Hungarian). The
    hypothesis with the best agreement wins.
    """
    apart = seen.east_north_m - where[:, None]
    spread = joint[np.arange(len(where)), :, np.arange(len(where))][:, None] + seen.covariance_m2
    east, north = apart[..., 0], apart[..., 1]
    var_east, covar, var_north = spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]
    distance = _squared_distance(east, north, var_east, covar, var_north)
    common = np.einsum("nik,mjk->nimj", seen.camera_m, seen.camera_m)
    best, most = np.zeros((0, 2), np.int64), 0.0
    likely = np.argsort(distance, axis=None)[:_BELIEFS]
    persons, rows = np.unravel_index(likely[distance.ravel()[likely] < limit], distance.shape)
    at_once = max(1, _MATRICES // max(distance.size, 1))
    for begin in range(0, len(persons), at_once):
        person, row = persons[begin : begin + at_once], rows[begin : begin + at_once]
        # Covariance of every other pair's difference with this pair's difference in its own sigmas:
        # (beliefs, P, N, 2, 2).
        whiten = np.linalg.inv(np.linalg.cholesky(spread[person, row])).swapaxes(1, 2)
        of_person, of_row = (
            held.transpose(2, 0, 1, 3) @ whiten[:, None] for held in (joint[:, :, person], common[:, :, row])
        )
        cross = of_person[:, :, None] + of_row[:, None]
        believed = np.einsum("kij,ki->jk", whiten, apart[person, row])[:, :, None, None]
        # Compute by components, because NumPy is slow with many small matrices.
        (ee, en), (ne, nn) = np.moveaxis(cross, (-2, -1), (0, 1))
        rest = _squared_distance(
            east - ee * believed[0] - en * believed[1],
            north - ne * believed[0] - nn * believed[1],
            var_east - ee**2 - en**2,
            covar - ee * ne - en * nn,
            var_north - ne**2 - nn**2,
        )
        belief = np.arange(len(person))
        rest[belief, person, :] = rest[belief, :, row] = np.inf
        rest[belief, person, row] = distance[person, row]
        score = np.where(rest < limit, limit - rest, 0.0)
        reach = np.minimum(score.max(axis=2).sum(axis=1), score.max(axis=1).sum(axis=1))
        for k in np.flatnonzero(reach > most).tolist():
            if reach[k] > most:  # `most` may have grown in this loop
                found = geometry.best_pairs(score[k])
                agreed = score[k][found[:, 0], found[:, 1]].sum()
                if agreed > most:
                    best, most = found, agreed
    return best


def _squared_distance(
    east: np.ndarray, north: np.ndarray, var_east: np.ndarray, covar: np.ndarray, var_north: np.ndarray
) -> np.ndarray:
    """Return the squared distances, given the elements of their covariances."""
    return (var_north * east**2 - 2 * covar * east * north + var_east * north**2) / (var_east * var_north - covar**2)
