"""Tables of people seen from the ground to places on it: frame by frame, several cameras fused."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.settings import Settings
from torchvision_dddas.sources.cameras import PoseTable, poses_at
from torchvision_dddas.sources.detections import DetectionTable
from torchvision_dddas.targets import geodesy
from torchvision_dddas.targets.fusion import fuse
from torchvision_dddas.targets.ranging import sight, touches_border
from torchvision_dddas.types import Camera, Located, Positions, Sightings


@dataclass(frozen=True)
class View:
    """What one camera saw: its table, and where it stood at each row."""

    camera: Camera
    table: DetectionTable
    sightings: Sightings
    target: np.ndarray
    cut: np.ndarray
    lonlat_deg: np.ndarray | None


def locate(
    tables: Sequence[DetectionTable],
    cameras: Sequence[Camera],
    poses: Sequence[PoseTable | None],
    settings: Settings,
    rate_hz: float | None = None,
) -> Iterator[Located]:
    """Where people stand, frame by frame: one table and one camera a vehicle; of several the fused places.

    Local metres are those of the cameras, or east and north of where the first camera stood first.
    Raises InputError where the numbers of tables and cameras differ, cameras mix degrees and metres, poses do not cover
    the frames, or ground.mode = paper is to fuse.
    """
    if len(tables) != len(cameras):
        raise InputError(f"{len(tables)} tables and {len(cameras)} cameras; wanted one --camera for each table")
    if settings.ground.mode == "paper" and len(tables) > 1:
        raise InputError(
            f"ground.mode = paper knows no covariances to fuse {len(tables)} cameras by; give one table, or use default"
        )
    views, origin = _views(tables, cameras, poses, settings, rate_hz)
    names = _Names(len(views))
    for frame in np.unique(np.concatenate([view.table.frame for view in views])).tolist():
        yield _located(frame, views, names, origin, settings)


def _views(
    tables: Sequence[DetectionTable],
    cameras: Sequence[Camera],
    poses: Sequence[PoseTable | None],
    settings: Settings,
    rate_hz: float | None,
) -> tuple[list[View], tuple[float, float] | None]:
    stood = [
        poses_at(camera, pose, table.frame, rate_hz) for camera, pose, table in zip(cameras, poses, tables, strict=True)
    ]
    if len({camera.geographic for camera, _ in stood}) > 1:
        raise InputError("some cameras stand at longitude and latitude, others at local metres; give all in one kind")
    origin = None
    if stood and stood[0][0].geographic:
        first = next((where.place[0] for _, where in stood if len(where.place)), stood[0][0].place)
        origin = float(first[0]), float(first[1])
    paper = settings.ground.mode == "paper"
    to_metres = geodesy.plain_east_north if paper else geodesy.east_north
    views = []
    for (camera, where), table in zip(stood, tables, strict=True):
        metres = where.place if origin is None else to_metres(where.place, origin)
        cut = touches_border(table.box_px, camera.size_px) if table.cut is None else table.cut
        seen = sight(table.box_px, cut, camera, where, metres, settings.ground)
        degrees = None
        if origin is not None:
            offset = seen.east_north_m - metres
            degrees = geodesy.plain_lonlat(offset, where.place) if paper else geodesy.lonlat(seen.east_north_m, origin)
        views.append(View(camera, table, seen, _targets(table), cut, degrees))
    return views, origin


def _targets(table: DetectionTable) -> np.ndarray:
    """The identity of each row; where a row has none, its place in the frame, after the identities of the table."""
    identity = table.identity if table.identity is not None else np.full(len(table), -1)
    place = np.arange(len(table)) - np.searchsorted(table.frame, table.frame) + 1
    return np.where(identity > 0, identity, place + max(identity.max(initial=0), 0)).astype(np.int64)


def _located(
    frame: int, views: Sequence[View], names: "_Names", origin: tuple[float, float] | None, settings: Settings
) -> Located:
    here = [np.arange(view.table.rows(frame).start, view.table.rows(frame).stop) for view in views]
    vehicle = np.repeat(np.arange(len(views)), [len(rows) for rows in here])
    seen = joined([_of(view.sightings, rows) for view, rows in zip(views, here, strict=True)])
    sighted = [
        np.concatenate([column[rows] for column, rows in zip(columns, here, strict=True)])
        for columns in (
            [view.target for view in views],
            [view.cut for view in views],
            [view.table.score for view in views],
            [view.table.box_px for view in views],
        )
    ]
    target, cut, score, box_px = sighted
    found = [rows[view.sightings.by[rows] != "bearing"] for view, rows in zip(views, here, strict=True)]
    if len(views) == 1:
        view, rows = views[0], found[0]
        positions = Positions(
            np.full(len(rows), frame),
            view.target[rows],
            view.sightings.east_north_m[rows],
            view.sightings.covariance_m2[rows],
            view.table.score[rows],
            origin,
            None if view.lonlat_deg is None else view.lonlat_deg[rows],
        )
        members = np.arange(len(rows))[:, None]
    else:
        fused = fuse(
            [_of(view.sightings, rows) for view, rows in zip(views, found, strict=True)], settings.ground.gate_sigmas
        )
        members = fused.members
        own = [view.target[rows] for view, rows in zip(views, found, strict=True)]
        scores = [view.table.score[rows] for view, rows in zip(views, found, strict=True)]
        named = names.give([[(v, int(own[v][r])) for v, r in enumerate(row) if r >= 0] for row in members])
        best = [max(scores[v][r] for v, r in enumerate(row) if r >= 0) for row in members]
        positions = Positions(
            np.full(len(members), frame),
            np.array(named, np.int64),
            fused.east_north_m,
            fused.covariance_m2,
            np.array(best, float),
            origin,
            None if origin is None else geodesy.lonlat(fused.east_north_m, origin),
        )
    return Located(frame, positions, members, seen, vehicle, target, cut, score, box_px)


def _of(sightings: Sightings, rows: np.ndarray) -> Sightings:
    return replace(sightings, **{f.name: getattr(sightings, f.name)[rows] for f in fields(sightings)})


def joined(parts: Sequence[Sightings]) -> Sightings:
    """The sightings of several cameras as one table."""
    return Sightings(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Sightings)))


class _Names:
    """Numbers of people seen by several vehicles, kept as long as the vehicles' own identities are.

    A person takes the number that most of the vehicles' targets had when they were seen last.
    """

    def __init__(self, vehicles: int) -> None:
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
