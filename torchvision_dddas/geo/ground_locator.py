"""Tables of people seen from the ground to places on it: frame by frame, several cameras fused."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.fusion import fuse
from torchvision_dddas.geo.ranging import sight, touches_border
from torchvision_dddas.types import Camera, DetectionTable, GroundLocations, Poses, PoseTable, Positions, Sightings


@dataclass(frozen=True)
class View:
    """What one camera saw: its table, where that puts everyone, as whom, whether cut and how probable, a row a box.

    score: (N,) in [0, 1]; 1 where the table's scores are on another scale.
    """

    table: DetectionTable
    sightings: Sightings
    target: np.ndarray
    cut: np.ndarray
    score: np.ndarray
    lonlat_deg: np.ndarray | None


@dataclass(frozen=True)
class Survey:
    """What all cameras saw. origin_deg: longitude and latitude of the local metres; None where there are none."""

    views: list[View]
    origin_deg: tuple[float, float] | None


def survey(
    tables: Sequence[DetectionTable],
    cameras: Sequence[Camera],
    poses: Sequence[PoseTable | None],
    settings: Settings,
    rate_hz: float | None = None,
) -> Survey:
    """Where each camera alone puts the people of its table; poses: None for a camera that stands still.

    Local metres are those of the cameras, or east and north of where the first camera stood first.
    Raises InputError where the numbers of tables, cameras and poses differ, cameras mix degrees and metres, poses do
    not cover the frames, an identity is twice in a frame, or ground.mode = paper is to fuse.
    """
    if not len(tables) == len(cameras) == len(poses):
        raise InputError(f"{len(tables)} tables and {len(cameras)} cameras; wanted one --camera for each table")
    if settings.ground.mode == "paper" and len(tables) > 1:
        raise InputError(
            f"ground.mode = paper knows no covariances to fuse {len(tables)} cameras by; give one table, or use default"
        )
    stood = [
        geometry.poses_at(camera, pose, table.frame, rate_hz)
        for camera, pose, table in zip(cameras, poses, tables, strict=True)
    ]
    if len({camera.geographic for camera, _ in stood}) > 1:
        raise InputError("some cameras stand at longitude and latitude, others at local metres; give all in one kind")
    origin = None
    if stood and stood[0][0].geographic:
        first = next((where.place[0] for _, where in stood if len(where.place)), stood[0][0].place)
        origin = float(first[0]), float(first[1])
    views = [_view(table, *seen, origin, settings) for table, seen in zip(tables, stood, strict=True)]
    return Survey(views, origin)


def _view(
    table: DetectionTable, camera: Camera, where: Poses, origin: tuple[float, float] | None, settings: Settings
) -> View:
    paper = settings.ground.mode == "paper"
    metres = where.place
    if origin is not None:
        metres = (geometry.plain_east_north if paper else geometry.east_north)(where.place, origin)
    cut = touches_border(table.box_px, camera.size_px) if table.cut is None else table.cut
    seen = sight(table.box_px, cut, camera, where, metres, settings.ground)
    degrees = None
    if origin is not None and paper:
        degrees = geometry.plain_lonlat(seen.east_north_m - metres, where.place)
    elif origin is not None:
        degrees = geometry.lonlat(seen.east_north_m, origin)
    score = table.score if table.probable else np.ones(len(table))
    return View(table, seen, table.targets, cut, score, degrees)


def looks(views: Sequence[View], within_frames: int = 0) -> Iterator[tuple[int, list[np.ndarray]]]:
    """The number of the first frame of each look, and each view's rows in it.

    A look holds at most one frame of each camera, none later than within_frames after the first: cameras need not take
    their pictures together.
    """
    frames = [np.unique(view.table.frame).tolist() for view in views]
    place = [0] * len(views)
    while any(k < len(own) for k, own in zip(place, frames, strict=True)):
        first = min(own[k] for k, own in zip(place, frames, strict=True) if k < len(own))
        rows = []
        for n, (view, own) in enumerate(zip(views, frames, strict=True)):
            here = slice(0, 0)
            if place[n] < len(own) and own[place[n]] <= first + within_frames:
                here = view.table.rows(own[place[n]])
                place[n] += 1
            rows.append(np.arange(here.start, here.stop))
        yield first, rows


def locate(found: Survey, settings: Settings) -> Iterator[GroundLocations]:
    """Where people stand, frame by frame: of several cameras the fused places."""
    names = _Names()
    for frame, here in looks(found.views, settings.ground.within_frames):
        vehicle = np.repeat(np.arange(len(here)), [len(rows) for rows in here])
        located = [rows[view.sightings.by[rows] != "bearing"] for view, rows in zip(found.views, here, strict=True)]
        if len(found.views) == 1:
            positions, members = _alone(frame, found.views[0], located[0], found.origin_deg)
        else:
            positions, members = _together(frame, found, located, names, settings.ground.gate_sigmas)
        yield GroundLocations(
            frame,
            positions,
            members,
            _joined([_of(view.sightings, rows) for view, rows in zip(found.views, here, strict=True)]),
            vehicle,
            *(
                np.concatenate([column[rows] for column, rows in zip(columns, here, strict=True)])
                for columns in (
                    [view.target for view in found.views],
                    [view.cut for view in found.views],
                    [view.table.score for view in found.views],
                    [view.table.box_px for view in found.views],
                )
            ),
        )


def _alone(
    frame: int, view: View, rows: np.ndarray, origin: tuple[float, float] | None
) -> tuple[Positions, np.ndarray]:
    seen = _of(view.sightings, rows)
    positions = Positions(
        np.full(len(rows), frame),
        view.target[rows],
        seen.east_north_m,
        seen.covariance_m2,
        view.score[rows],
        origin,
        None if view.lonlat_deg is None else view.lonlat_deg[rows],
    )
    return positions, np.arange(len(rows))[:, None]


def _together(
    frame: int, found: Survey, rows: Sequence[np.ndarray], names: "_Names", gate_sigmas: float
) -> tuple[Positions, np.ndarray]:
    views = found.views
    fused = fuse([_of(view.sightings, own) for view, own in zip(views, rows, strict=True)], gate_sigmas)
    seen = [[(v, rows[v][r]) for v, r in enumerate(row) if r >= 0] for row in fused.members.tolist()]
    named = names.give([[(v, int(views[v].target[r])) for v, r in person] for person in seen])
    positions = Positions(
        np.full(len(fused), frame),
        np.array(named, np.int64),
        fused.east_north_m,
        fused.covariance_m2,
        np.array([max(views[v].score[r] for v, r in person) for person in seen], float),
        found.origin_deg,
        None if found.origin_deg is None else geometry.lonlat(fused.east_north_m, found.origin_deg),
    )
    return positions, fused.members


def _of(sightings: Sightings, rows: np.ndarray) -> Sightings:
    return replace(sightings, **{f.name: getattr(sightings, f.name)[rows] for f in fields(sightings)})


def _joined(parts: Sequence[Sightings]) -> Sightings:
    """The sightings of several cameras as one table."""
    return Sightings(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Sightings)))


class _Names:
    """Numbers of people seen by several vehicles, kept as long as the vehicles' own identities are.

    A person takes the number that most of the vehicles' targets had when they were seen last.
    """

    def __init__(self) -> None:
        self._number: dict[tuple[int, int], int] = {}
        self._last = 0

    def give(self, people: Sequence[Sequence[tuple[int, int]]]) -> list[int]:
        """A number for each person, given as (vehicle, target) of its sightings; each number is given once."""
        wish = []
        for person, seen in enumerate(people):
            before = [self._number[one] for one in seen if one in self._number]
            wish += [(-before.count(number), number, person) for number in set(before)]
        given: dict[int, int] = {}
        taken: set[int] = set()
        for _, number, person in sorted(wish):
            if person not in given and number not in taken:
                given[person] = number
                taken.add(number)
        for person, seen in enumerate(people):
            if person not in given:
                self._last += 1
                given[person] = self._last
            self._number.update(dict.fromkeys(seen, given[person]))
        return [given[person] for person in range(len(people))]
