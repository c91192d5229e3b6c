"""People seen by cameras on the ground to places: frame by frame, several cameras fused."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.fusion import fuse
from torchvision_dddas.geo.ranging import range_people, touches_border
from torchvision_dddas.types import (
    Camera,
    DetectionTable,
    GroundLocations,
    People,
    Poses,
    PoseTable,
    Positions,
    Sightings,
)


@dataclass(frozen=True)
class CameraView:
    """What one camera saw, a row a box: its table, where that alone puts everyone, as whom, and whether cut.

    score: (N,) in [0, 1]; 1 where the table's scores are on another scale.
    """

    table: DetectionTable
    sightings: Sightings
    target: np.ndarray
    cut: np.ndarray
    score: np.ndarray
    lonlat_deg: np.ndarray | None


class GroundLocator:
    """Locates people seen by one or several cameras on the ground.

    >>> locator = GroundLocator(camera)
    >>> places = locator.locate(people, frame=1)

    origin_deg: longitude and latitude of the local metres; None where the cameras stand at local metres.
    """

    def __init__(
        self,
        cameras: Camera | Sequence[Camera],
        settings: Settings | None = None,
        *,
        poses: Sequence[PoseTable | None] = (),
        rate_hz: float | None = None,
    ) -> None:
        """poses: where each camera stood over time; None for one that stands still. rate_hz: for poses by time.

        Raises InputError where there is no camera, the numbers of cameras and poses differ, or ground.mode = paper is
        to fuse.
        """
        self.cameras = [cameras] if isinstance(cameras, Camera) else list(cameras)
        self.settings, self.rate_hz = settings or Settings(), rate_hz
        self.poses = list(poses) or [None] * len(self.cameras)
        if not self.cameras or not all(isinstance(camera, Camera) for camera in self.cameras):
            raise InputError("GroundLocator wants one Camera or several, got another type or none")
        if len(self.poses) != len(self.cameras):
            raise InputError(f"{len(self.cameras)} cameras and {len(self.poses)} tables of poses; wanted one for each")
        if self.settings.ground.mode == "paper" and len(self.cameras) > 1:
            raise InputError(
                f"ground.mode = paper knows no covariances to fuse {len(self.cameras)} cameras by; give one table, or "
                "use default"
            )
        self.origin_deg: tuple[float, float] | None = None
        self._names = _PersonNumbers()

    def locate(self, people: People | Sequence[People], frame: int = 1) -> GroundLocations:
        """Where the people of one frame stand. people: of the one camera, or of each in their order."""
        seen = [people] if isinstance(people, People) else list(people)
        if not all(isinstance(one, People) for one in seen):
            raise InputError("locate wants the People of each camera, got another type")
        tables = [
            DetectionTable("", np.full(len(one), frame), one.box_px, one.score, np.arange(len(one)), cut=one.cut)
            for one in seen
        ]
        views = self.place_tables(tables)
        return self._frame(frame, views, [np.arange(len(view.table)) for view in views])

    def locate_tables(self, tables: Sequence[DetectionTable]) -> Iterator[GroundLocations]:
        """Where people stand, frame by frame. Raises InputError as `place_tables`, at once."""
        return self._frames(self.place_tables(tables))

    def place_tables(self, tables: Sequence[DetectionTable]) -> list[CameraView]:
        """Where each camera alone puts the people of its table.

        Local metres are those of the cameras, or east and north of where the first camera stood first.
        Raises InputError where the numbers of tables and cameras differ, cameras mix degrees and metres, poses do not
        cover the frames, or an identity is twice in a frame.
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

    def _frames(self, views: list[CameraView]) -> Iterator[GroundLocations]:
        for frame, rows in simultaneous_rows(views, self.settings.ground.within_frames):
            yield self._frame(frame, views, rows)

    def _frame(self, frame: int, views: list[CameraView], here: list[np.ndarray]) -> GroundLocations:
        located = [rows[view.sightings.by[rows] != "bearing"] for view, rows in zip(views, here, strict=True)]
        if len(views) == 1:
            view, rows = views[0], located[0]
            seen = view.sightings[rows]
            degrees = None if view.lonlat_deg is None else view.lonlat_deg[rows]
            target, place, covariance, score = (
                view.target[rows],
                seen.east_north_m,
                seen.covariance_m2,
                view.score[rows],
            )
            members = np.arange(len(rows))[:, None]
        else:
            fused = fuse(
                [view.sightings[rows] for view, rows in zip(views, located, strict=True)],
                self.settings.ground.gate_sigmas,
            )
            people = [[(v, located[v][r]) for v, r in enumerate(row) if r >= 0] for row in fused.members.tolist()]
            numbers = self._names.assign([[(v, int(views[v].target[r])) for v, r in person] for person in people])
            target, place, covariance = np.array(numbers, np.int64), fused.east_north_m, fused.covariance_m2
            score = np.array([max(views[v].score[r] for v, r in person) for person in people], float)
            degrees = None if self.origin_deg is None else geometry.lonlat(place, self.origin_deg)
            members = fused.members
        positions = Positions(np.full(len(place), frame), target, place, covariance, score, self.origin_deg, degrees)
        pairs = list(zip(views, here, strict=True))
        return GroundLocations(
            frame,
            positions,
            members,
            Sightings.concat([view.sightings[rows] for view, rows in pairs]),
            np.repeat(np.arange(len(here)), [len(rows) for rows in here]),
            np.concatenate([view.target[rows] for view, rows in pairs]),
            np.concatenate([view.cut[rows] for view, rows in pairs]),
            np.concatenate([view.table.score[rows] for view, rows in pairs]),
            np.concatenate([view.table.box_px[rows] for view, rows in pairs]),
        )


def simultaneous_rows(views: Sequence[CameraView], within_frames: int = 0) -> Iterator[tuple[int, list[np.ndarray]]]:
    """The first frame of each group of simultaneous frames, and each view's rows in it.

    A group holds at most one frame of each camera, none later than within_frames after the first: cameras need not take
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


class _PersonNumbers:
    """Numbers of people seen by several vehicles, kept as long as the vehicles' own identities are.

    A person takes the number that most of the vehicles' targets had when they were seen last.
    """

    def __init__(self) -> None:
        self._number: dict[tuple[int, int], int] = {}
        self._last = 0

    def assign(self, people: Sequence[Sequence[tuple[int, int]]]) -> list[int]:
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
