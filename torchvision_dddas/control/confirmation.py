"""Decide by people recognized from the ground which blobs seen from the air are human (appendix A, III-B).

A blob with a person inside its gate is human. A blob is not human if it is well within a ground camera's view, near
enough to recognize a person, and no person is near. Nothing is known about other blobs. Observations of several
vehicles and frames add up as log-odds. The source gives only the idea. Ours are: a gate from both covariances, views
with limits and occlusion, and evidence weighted by detection and false-alarm rates.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import ConfirmParameters, GroundParameters, PeopleParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import east_north, poses_at, shared_px
from torchvision_dddas.people import smallest_body_px
from torchvision_dddas.types import Bool, Camera, Confirmation, DetectionTable, Float, PoseTable, Positions

HUMAN, NOT_HUMAN, UNSEEN = "human", "not_human", "unseen"


@dataclass(frozen=True)
class GroundView:
    """The area in which a ground camera can recognize people.

    east_north_m: (2,) position of the camera. heading_rad: clockwise from north. half_rad: half the horizontal angle of
    view. near_m, far_m: the distances between which a body fits into the picture and is large enough for the
    classifier. position_sigma_m, heading_sigma_rad: standard deviations of the pose.
    """

    east_north_m: np.ndarray
    heading_rad: float
    half_rad: float
    near_m: float
    far_m: float
    position_sigma_m: float = 0.0
    heading_sigma_rad: float = 0.0


def field_of_view(
    camera: Camera, east_north_m: np.ndarray, heading_rad: float, people: PeopleParameters, ground: GroundParameters
) -> GroundView:
    """Return the view of a camera at a position, with distances from the body heights that the settings can detect."""
    height_m, (width_px, height_px) = ground.body_height_m, camera.size_px
    aside_px = min(camera.centre_px[0] + 0.5, width_px - 0.5 - camera.centre_px[0])
    return GroundView(
        np.asarray(east_north_m, float),
        heading_rad,
        math.atan(max(aside_px, 0.0) / camera.focal_px[0]),
        camera.focal_px[1] * height_m / height_px,
        camera.focal_px[1] * height_m / smallest_body_px(people),
        camera.position_sigma_m,
        camera.heading_sigma_rad,
    )


@dataclass(frozen=True)
class GroundObservation:
    """The observation of N blobs and M people by one vehicle in one frame, with one row for each blob.

    looked: (N,) bool, whether the observation is evidence: a person at the blob, or a clear view of it without a
    person. people: (N,) int64, number of people recognized at the blob, which may be a crowd. nearest_m,
    nearest_sigmas: (N,) distance to the nearest person, infinite without people; NaN if the observation is of boxes.
    best: (N,) highest probability of the people at the blob, 0 without people; below confirm.least_score the blob stays
    in doubt. places: (N,) number of people that fit side by side into the blob, at least 1; None: one each. blob: (M,)
    int64, the blob of each probable person, -1 for others.
    """

    looked: np.ndarray
    people: np.ndarray
    nearest_m: np.ndarray
    nearest_sigmas: np.ndarray
    best: np.ndarray
    places: np.ndarray | None = None
    blob: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))


def observe_ground(
    blob_m: Float[np.ndarray, "N 2"],
    blob_m2: Float[np.ndarray, "N 2 2"],
    person_m: Float[np.ndarray, "M 2"],
    person_m2: Float[np.ndarray, "M 2 2"],
    score: Float[np.ndarray, "M"],
    views: Sequence[GroundView],
    parameters: ConfirmParameters,
) -> GroundObservation:
    """Return the observation of one frame from positions and covariances of the blobs and of one vehicle's people.

    NaN covariances are unknown. A person belongs to the blob that is nearest in standard deviations, if it is within
    the blob's gate. A blob whose gate contains only improbable people, or people of another blob, is in doubt. views:
    views of the cameras that found these people.
    """
    blob_m, person_m = np.asarray(blob_m, float).reshape(-1, 2), np.asarray(person_m, float).reshape(-1, 2)
    unknown_m2 = parameters.unknown_sigma_m**2 * np.eye(2)
    covariances = (np.asarray(covariance, float).reshape(-1, 2, 2) for covariance in (blob_m2, person_m2))
    blob_m2, person_m2 = (
        np.where(np.isfinite(covariance).all(axis=(1, 2), keepdims=True), covariance, unknown_m2)
        for covariance in covariances
    )
    apart = person_m[None] - blob_m[:, None]
    # The spread is at least a micrometre, because the sum of the covariances must not be zero.
    both = blob_m2[:, None] + person_m2[None] + max(parameters.spread_m, 1e-6) ** 2 * np.eye(2)
    sigmas = np.sqrt((apart * np.linalg.solve(both, apart[..., None])[..., 0]).sum(-1))
    inside = sigmas <= math.sqrt(-2 * math.log(1 - parameters.gate_probability))  # chi-square of two degrees of freedom
    people, best, blob = _assigned(sigmas, inside, score, parameters)
    clear = np.zeros(len(blob_m), bool)
    for view in views:
        clear |= _is_clear(blob_m, blob_m2, person_m, view, parameters)
    nearest_m = np.linalg.norm(apart, axis=-1).min(axis=1, initial=np.inf)
    nearest_sigmas = sigmas.min(axis=1, initial=np.inf)
    looked = (people > 0) | (clear & ~inside.any(axis=1))
    return GroundObservation(looked, people, nearest_m, nearest_sigmas, best, blob=blob)


def observe_picture(
    blob_px: Float[np.ndarray, "N 4"],
    person_px: Float[np.ndarray, "M 4"],
    score: Float[np.ndarray, "M"],
    parameters: ConfirmParameters,
    least_px: float = 0.0,
    aspect: float = 0.4,
) -> GroundObservation:
    """Return the observation of one picture from boxes (x, y, width, height) of its blobs and its people.

    A person belongs to the blob with the highest IoU among the blobs whose intersection with the person is a large
    enough share of the smaller box, because a blob may be a crowd or a part of a body. least_px: smallest height of a
    body that is recognized; a smaller blob without a person stays unknown. aspect: width over height of a body.
    """
    blob_px, person_px = np.asarray(blob_px, float).reshape(-1, 4), np.asarray(person_px, float).reshape(-1, 4)
    common = shared_px(blob_px[:, None], person_px)
    areas = blob_px[:, None, 2:].prod(axis=-1), person_px[:, 2:].prod(axis=-1)
    inside = common >= parameters.share * np.minimum(*areas)
    people, best, _ = _assigned(-common / np.maximum(areas[0] + areas[1] - common, 1e-9), inside, score, parameters)
    clear = (blob_px[:, 3] >= least_px) & ~inside.any(axis=1)
    unknown = np.full(len(blob_px), np.nan)
    places = np.maximum(blob_px[:, 2] / np.maximum(aspect * blob_px[:, 3], 1e-9), 1.0)
    return GroundObservation((people > 0) | clear, people, unknown, unknown, best, places)


@dataclass
class Beliefs:
    """The log-odds that targets are human, updated frame by frame. Targets and vehicles are named by unique keys.

    Errors of one vehicle's repeated looks at a target are correlated, so all looks but the first have the weight
    `fresh`.
    """

    parameters: ConfirmParameters
    _odds: dict[Hashable, float] = field(default_factory=dict)
    _seen: set[tuple[Hashable, Hashable]] = field(default_factory=set)

    def add(self, targets: Sequence[Hashable], observations: Iterable[tuple[Hashable, GroundObservation]]) -> None:
        """Add the observations of one frame, as pairs (vehicle, observation). targets: the name of each row."""
        for vehicle, seen in observations:
            weights = evidence(seen, self.parameters)
            for row in np.flatnonzero(seen.looked).tolist():
                key = targets[row]
                weight = self.parameters.fresh if (vehicle, key) in self._seen else 1.0
                self._seen.add((vehicle, key))
                odds = self._odds.get(key, _log_odds(self.parameters.prior)) + weight * weights[row]
                self._odds[key] = float(np.clip(odds, -self.parameters.limit, self.parameters.limit))

    def probability(self, target: Hashable) -> float:
        """Return the probability that a target is human; the prior if it was not observed."""
        return 1 / (1 + math.exp(-self._odds.get(target, _log_odds(self.parameters.prior))))

    def kind(self, target: Hashable) -> str:
        """Return the kind of a target: human, not_human or unseen."""
        if target not in self._odds:
            return UNSEEN
        return HUMAN if self.probability(target) >= 0.5 else NOT_HUMAN


def evidence(seen: GroundObservation, parameters: ConfirmParameters) -> Float[np.ndarray, "N"]:
    """Return (N,) the amount that an observation adds to the log-odds; 0 without a look.

    d and f are the detection and false-alarm rates. Without a person the value is ln (1 - d)/(1 - f). With a person it
    is the log-odds of the person's probability, at most ln d/f, because a probability of 1 is not a proof. In a blob
    as wide as several people, each place without a person adds ln (1 - c d)/(1 - f), where c = crowd_share, so that a
    chance detection does not turn a car into a crowd.
    """
    d, f = parameters.detection_rate, parameters.false_rate
    sure = 1 / (1 + f / d)  # the probability whose odds are d/f
    best = np.clip(seen.best, 0.5, max(sure, 0.5))
    first = np.where(seen.people > 0, np.log(best / (1 - best)), math.log((1 - d) / (1 - f)))
    places = np.ones(len(best)) if seen.places is None else seen.places
    empty = np.maximum(places - np.maximum(seen.people, 1), 0)
    return np.where(seen.looked, first + empty * min(math.log((1 - parameters.crowd_share * d) / (1 - f)), 0.0), 0.0)


def _log_odds(probability: float) -> float:
    return math.log(probability / (1 - probability))


def _assigned(
    distance: Float[np.ndarray, "N M"],
    inside: Bool[np.ndarray, "N M"],
    score: Float[np.ndarray, "M"],
    parameters: ConfirmParameters,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Assign each person to the nearest blob whose gate contains the person.

    Return (N,) the number of probable people, (N,) the highest score of all people, and (M,) the blob of each probable
    person, -1 for others.
    """
    people, best = np.zeros(len(distance), np.int64), np.zeros(len(distance))
    blob = np.full(distance.shape[1], -1)
    ours = np.flatnonzero(inside.any(axis=0))
    if not len(ours):
        return people, best, blob
    nearest = np.where(inside, distance, np.inf).argmin(axis=0)[ours]
    known = np.nan_to_num(np.asarray(score, float)[ours], nan=1.0)
    probable = known >= parameters.least_score
    np.add.at(people, nearest[probable], 1)
    np.maximum.at(best, nearest, known)
    blob[ours[probable]] = nearest[probable]
    return people, best, blob


def _is_clear(
    blob_m: np.ndarray, blob_m2: np.ndarray, person_m: np.ndarray, view: GroundView, parameters: ConfirmParameters
) -> Bool[np.ndarray, "N"]:
    """Return (N,) whether a view shows each blob with certainty: it is well inside the view, and nothing occludes it.

    Well inside means by `inside_sigmas` standard deviations of the blob and the camera. Another blob or a person
    occludes a blob if it is in front of it, nearer to the camera by at least a body's width.
    """
    apart = blob_m - view.east_north_m
    distance = np.maximum(np.linalg.norm(apart, axis=1), 1e-6)
    along = apart / distance[:, None]
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    spread = blob_m2 + view.position_sigma_m**2 * np.eye(2)
    # Rounding may make variances along an axis slightly negative.
    variances = (np.einsum("ni,nij,nj->n", axis, spread, axis) for axis in (along, across))
    radial, lateral = (np.sqrt(np.maximum(variance, 0)) for variance in variances)
    bearing = np.arctan2(along[:, 0], along[:, 1]) - view.heading_rad
    off = np.abs((bearing + np.pi) % (2 * np.pi) - np.pi)
    angle = np.hypot(np.arctan2(lateral, distance), view.heading_sigma_rad)
    k, width_m = parameters.inside_sigmas, parameters.body_width_m
    is_within = (distance - k * radial >= view.near_m) & (distance + k * radial <= view.far_m)
    others = np.concatenate([blob_m, person_m]) - view.east_north_m
    ahead = along @ others.T
    aside = np.abs(along[:, :1] * others[:, 1] - along[:, 1:] * others[:, 0])
    hiding = (ahead > 0) & (ahead < distance[:, None] - width_m) & (aside < width_m)
    return is_within & (off + k * angle <= view.half_rad) & ~hiding.any(axis=1)


@dataclass(frozen=True)
class Vehicle:
    """A table of people, and the cameras that found them, with their poses. Without cameras no views are known."""

    name: str
    people: Positions
    cameras: tuple[Camera, ...] = ()
    poses: tuple[PoseTable | None, ...] = ()


def confirm_positions(
    blobs: Positions,
    vehicles: Sequence[Vehicle],
    settings: Settings,
    interval: int = 1,
    lasting: bool = True,
    rate_hz: float | None = None,
) -> Iterator[Confirmation]:
    """Confirm blobs by people on the ground, and yield a confirmation for each frame.

    interval: the vehicles looked at frames 1, 1 + interval, ... lasting: whether a target's number is an identity, so
    that looks add up over frames. Positions are in local metres that all tables share. If all tables have degrees, and
    the cameras stand at degrees or there are none, the degrees are used.
    Raises InputError for positions of different kinds, and for poses that do not cover the frames.
    """
    origin = _origin(blobs, vehicles)
    blob_m, *persons_m = (
        table.east_north_m if origin is None or table.lonlat_deg is None else east_north(table.lonlat_deg, origin)
        for table in (blobs, *(vehicle.people for vehicle in vehicles))
    )
    frames = np.unique(blobs.frame)
    frames = frames[(frames - 1) % interval == 0]
    views: list[dict[int, list[GroundView]]] = [defaultdict(list) for _ in vehicles]  # by frame
    for vehicle, seen in zip(vehicles, views, strict=True):
        for camera, table in zip(vehicle.cameras, vehicle.poses, strict=True):
            stood, poses = poses_at(camera, table, frames, rate_hz)
            place_m = poses.place if origin is None else east_north(poses.place, origin)
            for frame, place, heading in zip(frames.tolist(), place_m, poses.heading_rad.tolist(), strict=True):
                seen[frame].append(field_of_view(stood, place, heading, settings.people, settings.ground))

    def observations(frame: int, rows: slice) -> Iterator[tuple[str, GroundObservation]]:
        for vehicle, person_m, seen in zip(vehicles, persons_m, views, strict=True):
            people, there = vehicle.people, _rows(vehicle.people.frame, frame)
            blob, person = (blob_m[rows], blobs.covariance_m2[rows]), (person_m[there], people.covariance_m2[there])
            yield vehicle.name, observe_ground(*blob, *person, people.score[there], seen[frame], settings.confirm)

    identity = blobs.target if lasting else np.full(len(blobs), -1)
    return _frames(blobs.frame, identity, observations, settings, interval)


def confirm_pictures(
    blobs: DetectionTable, people: Sequence[DetectionTable], names: Sequence[str], settings: Settings, interval: int = 1
) -> Iterator[Confirmation]:
    """Confirm blobs by people that `dddas people` found in the same pictures, at frames 1, 1 + interval, ..."""
    parameters = settings.people
    least_px = smallest_body_px(parameters)
    body_height_px = parameters.height_share * parameters.window_height_px
    aspect = parameters.width_share * parameters.window_width_px / body_height_px

    def observations(frame: int, rows: slice) -> Iterator[tuple[str, GroundObservation]]:
        for name, table in zip(names, people, strict=True):
            there = table.rows(frame)
            score = table.score[there] if table.probable else np.ones(there.stop - there.start)
            box_px = blobs.box_px[rows]
            yield name, observe_picture(box_px, table.box_px[there], score, settings.confirm, least_px, aspect)

    identity = blobs.identity if blobs.identity is not None else np.full(len(blobs), -1)
    return _frames(blobs.frame, identity, observations, settings, interval)


def _frames(
    frame: np.ndarray,
    identity: np.ndarray,
    observations: Callable[[int, slice], Iterator[tuple[str, GroundObservation]]],
    settings: Settings,
    interval: int,
) -> Iterator[Confirmation]:
    beliefs = Beliefs(settings.confirm)
    for number in np.unique(frame).tolist():
        rows = _rows(frame, number)
        targets: list[Hashable] = [
            ("row", row) if name < 1 else name for row, name in enumerate(identity[rows].tolist(), rows.start)
        ]
        seen = list(observations(number, rows)) if (number - 1) % interval == 0 else []
        if twice := {name for name in targets if targets.count(name) > 1}:
            raise InputError(
                f"target {min(map(str, twice))} is twice in frame {number}; give each target once in a frame"
            )
        beliefs.add(targets, seen)
        yield summarize(number, rows, targets, beliefs, seen)


def summarize(
    number: int,
    rows: slice,
    targets: Sequence[Hashable],
    beliefs: Beliefs,
    seen: Sequence[tuple[str, GroundObservation]],
) -> Confirmation:
    """Return the confirmation of a frame's targets. rows: their rows in the table. seen: (vehicle, observation)."""
    count = len(targets)
    unknown = (np.full(count, np.nan) for _ in range(3))
    nothing = GroundObservation(np.zeros(count, bool), np.zeros(count, np.int64), *unknown)
    all_seen = [nothing, *(one for _, one in seen)]
    least = [np.stack([getattr(one, name) for one in all_seen]) for name in ("nearest_m", "nearest_sigmas")]
    nearest_m, nearest_sigmas = (np.where(np.isfinite(v), v, np.inf).min(axis=0) for v in least)
    people = np.stack([one.people for one in all_seen]).max(axis=0)
    best = np.stack([np.nan_to_num(one.best) for one in all_seen]).max(axis=0)
    return Confirmation(
        number,
        np.arange(rows.start, rows.stop),
        tuple(beliefs.kind(name) for name in targets),
        np.array([beliefs.probability(name) for name in targets]),
        tuple(tuple(name for name, one in seen if one.looked[i]) for i in range(count)),
        people,
        np.where(np.isinf(nearest_m), np.nan, nearest_m),
        np.where(np.isinf(nearest_sigmas), np.nan, nearest_sigmas),
        np.where(best > 0, best, np.nan),
    )


def _rows(frame: np.ndarray, number: int) -> slice:
    return slice(*np.searchsorted(frame, [number, number + 1]).tolist())


def _origin(blobs: Positions, vehicles: Sequence[Vehicle]) -> tuple[float, float] | None:
    """Return (longitude, latitude) of the common origin for metres; None if the tables already share their metres."""
    tables = [blobs, *(vehicle.people for vehicle in vehicles)]
    geographic = {
        camera.geographic
        if pose is None or not {"longitude_deg", "east_m"} & set(pose.values)
        else "longitude_deg" in pose.values
        for vehicle in vehicles
        for camera, pose in zip(vehicle.cameras, vehicle.poses, strict=True)
    }
    if len(geographic) > 1:
        raise InputError("some cameras stand at longitude and latitude, others at local metres; give all in one kind")
    lacking = [i for i, table in enumerate(tables) if table.lonlat_deg is None]
    if geographic == {True} and lacking:
        which = "the blobs" if lacking[0] == 0 else f"the people of {vehicles[lacking[0] - 1].name}"
        raise InputError(
            f"the cameras stand at longitude and latitude, and {which} have no longitude_deg and latitude_deg; "
            "give cameras in the local metres (east_m, north_m) of the tables"
        )
    if not geographic and 0 < len(lacking) < len(tables):
        raise InputError(
            "some tables have longitude_deg and latitude_deg, others only local metres with an unknown origin; "
            "make all tables with the same kind of landmarks and cameras"
        )
    if geographic == {False} or lacking or not len(blobs):
        return None
    assert blobs.lonlat_deg is not None
    longitude, latitude = blobs.lonlat_deg[0].tolist()
    return longitude, latitude
