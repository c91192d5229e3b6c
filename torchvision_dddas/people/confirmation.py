"""Tables of blobs and of people to what each blob is: frame by frame, on the ground or in one picture."""

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import east_north, poses_at
from torchvision_dddas.people.collaboration import Beliefs, Look, View, confirm_boxes, look, view_of
from torchvision_dddas.people.pyramid import smallest_body_px
from torchvision_dddas.types import Camera, Confirmation, DetectionTable, PoseTable, Positions


@dataclass(frozen=True)
class Vehicle:
    """One table of people, and the cameras that found them with their poses; without, no views are known."""

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
    """Blobs and people on the ground. The vehicles looked at frames 1, 1 + interval, ...

    lasting: whether a target's number is an identity, so that looks add up over frames.
    Metres are local ones that all tables share; where cameras stand at degrees, or there are none, and all tables have
    degrees, these count. Raises InputError for places of different kinds, and poses that do not cover the frames.
    """
    origin = _origin(blobs, vehicles)
    blob_m, *persons_m = (_metres(table, origin) for table in (blobs, *(v.people for v in vehicles)))
    frames = np.unique(blobs.frame)
    frames = frames[(frames - 1) % interval == 0]
    views = [_views(vehicle, frames, origin, settings, rate_hz) for vehicle in vehicles]

    def looks(frame: int, rows: slice) -> Iterator[tuple[str, Look]]:
        for vehicle, person_m, seen in zip(vehicles, persons_m, views, strict=True):
            there = _rows(vehicle.people.frame, frame)
            yield (
                vehicle.name,
                look(
                    blob_m[rows],
                    blobs.covariance_m2[rows],
                    person_m[there],
                    vehicle.people.covariance_m2[there],
                    vehicle.people.score[there],
                    seen[frame],
                    settings.confirm,
                ),
            )

    identity = blobs.target if lasting else np.full(len(blobs), -1)
    return _frames(blobs.frame, identity, looks, settings, interval)


def confirm_pictures(
    blobs: DetectionTable, people: Sequence[DetectionTable], names: Sequence[str], settings: Settings, interval: int = 1
) -> Iterator[Confirmation]:
    """Blobs and people of the same pictures, as `dddas people` found them at frames 1, 1 + interval, ..."""
    parameters = settings.people
    least_px = smallest_body_px(parameters)
    aspect = (
        parameters.width_share * parameters.window_width_px / (parameters.height_share * parameters.window_height_px)
    )

    def looks(frame: int, rows: slice) -> Iterator[tuple[str, Look]]:
        for name, table in zip(names, people, strict=True):
            there = table.rows(frame)
            score = table.score[there] if table.probable else np.ones(there.stop - there.start)
            box_px = blobs.box_px[rows]
            yield name, confirm_boxes(box_px, table.box_px[there], score, settings.confirm, least_px, aspect)

    identity = blobs.identity if blobs.identity is not None else np.full(len(blobs), -1)
    return _frames(blobs.frame, identity, looks, settings, interval)


def _frames(
    frame: np.ndarray,
    identity: np.ndarray,
    looks: Callable[[int, slice], Iterator[tuple[str, Look]]],
    settings: Settings,
    interval: int,
) -> Iterator[Confirmation]:
    beliefs = Beliefs(settings.confirm)
    for number in np.unique(frame).tolist():
        rows = _rows(frame, number)
        targets: list[Hashable] = [
            ("row", row) if name < 1 else name for row, name in enumerate(identity[rows].tolist(), rows.start)
        ]
        seen = list(looks(number, rows)) if (number - 1) % interval == 0 else []
        if twice := {name for name in targets if targets.count(name) > 1}:
            raise InputError(
                f"target {min(map(str, twice))} is twice in frame {number}; a target is there once a frame"
            )
        beliefs.add(targets, seen)
        yield confirmed_by(number, rows, targets, beliefs, seen)


def confirmed_by(
    number: int, rows: slice, targets: Sequence[Hashable], beliefs: Beliefs, seen: Sequence[tuple[str, Look]]
) -> Confirmation:
    """What is believed of the targets of a frame. rows: their places in their table; seen: who looked in this frame."""
    count = len(targets)
    nothing = Look(*(np.zeros(count, kind) for kind in (bool, np.int64)), *(np.full(count, np.nan) for _ in range(3)))
    all_looks = [nothing, *(one for _, one in seen)]
    least = [np.stack([getattr(one, name) for one in all_looks]) for name in ("nearest_m", "nearest_sigmas")]
    nearest_m, nearest_sigmas = (np.where(np.isfinite(v), v, np.inf).min(axis=0) for v in least)
    people = np.stack([one.people for one in all_looks]).max(axis=0)
    best = np.stack([np.nan_to_num(one.best) for one in all_looks]).max(axis=0)
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
    """Longitude and latitude of the common metres' origin; None where the tables' own metres are common."""
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
            "some tables have longitude_deg and latitude_deg, others local metres alone, whose origin nothing tells; "
            "give all in one kind, as one kind of landmarks and cameras makes them"
        )
    if geographic == {False} or lacking or not len(blobs):
        return None
    assert blobs.lonlat_deg is not None
    longitude, latitude = blobs.lonlat_deg[0].tolist()
    return longitude, latitude


def _metres(table: Positions, origin: tuple[float, float] | None) -> np.ndarray:
    if origin is None or table.lonlat_deg is None:
        return table.east_north_m
    return east_north(table.lonlat_deg, origin)


def _views(
    vehicle: Vehicle,
    frames: np.ndarray,
    origin: tuple[float, float] | None,
    settings: Settings,
    rate_hz: float | None,
) -> dict[int, list[View]]:
    """Frame -> the views of a vehicle's cameras."""
    views: dict[int, list[View]] = {frame: [] for frame in frames.tolist()}
    for camera, table in zip(vehicle.cameras, vehicle.poses, strict=True):
        stood, poses = poses_at(camera, table, frames, rate_hz)
        place_m = poses.place if origin is None else east_north(poses.place, origin)
        for frame, place, heading in zip(frames.tolist(), place_m, poses.heading_rad.tolist(), strict=True):
            views[frame].append(view_of(stood, place, heading, settings.people, settings.ground))
    return views
