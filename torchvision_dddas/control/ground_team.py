"""Platforms in addition to an aerial clip: people seen from the ground confirm its targets, and all locate them."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings
from torchvision_dddas.control.confirmation import Beliefs, GroundView, field_of_view, observe_ground, summarize
from torchvision_dddas.control.ground_confirmation import drop_fast_targets
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import GroundLocator, TargetFusion
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.platform_files import Platform, PlatformFile, read_platform
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.people import WindowScorer, detect_people, load_scorer
from torchvision_dddas.types import (
    AerialLocations,
    Confirmation,
    DetectionTable,
    FrameResult,
    FusedTargets,
    GroundLocations,
)

UAV = "uav"
"""Name of the platform in the air."""
_DOUBTED = 0.3  # a platform with a smaller weight is named in a note


Picture = tuple[int, float, np.ndarray | None]
"""Number of a picture in its own clip, its time in the main clip, and the image; None for a table of boxes."""


@dataclass(frozen=True)
class PlatformLook:
    """The view of a platform at a time of the main clip.

    view: by its reported pose, in its own metres; None for an aerial platform.
    lasting: whether the numbers of targets are identities.
    """

    time_s: float
    name: str
    located: GroundLocations | AerialLocations
    view: GroundView | None = None
    lasting: bool = True


@dataclass(frozen=True)
class FurtherUav:
    """A further UAV, whose clip is tracked and located separately. start_utc_s: start of its clip, NaN if unknown."""

    file: Platform
    results: Iterable[FrameResult]
    origin_deg: tuple[float, float] | None
    start_utc_s: float
    notes: Callable[[], Sequence[str]]


class GroundTeam:
    """Add the views of other platforms to the results of an aerial clip: `confirmed` and `fused` of FrameResult.

    >>> team = GroundTeam(["ugv1.toml", "ugv2.toml"], settings)
    >>> for result in team.mark(pipeline(clip)):
    ...     print(result.fused.target, result.confirmed.kind)

    notes: data that could not be used; complete after the last result.
    """

    def __init__(
        self,
        ground: Sequence[str | Path],
        settings: Settings,
        backend: str = "auto",
        uavs: Sequence[FurtherUav] = (),
        *,
        live: bool = False,
    ) -> None:
        """ground: files, as `io.platform_files` describes them. Raise InputError for bad files and for duplicates.

        live: the caller reads the clips and uses `looks`, and the fusion waits for late records.
        """
        self.settings, self.platforms = settings, [read_platform(path) for path in ground]
        self.further = {one.file.name: one for one in uavs}
        self.members: list[Platform] = [*self.platforms, *(one.file for one in uavs)]
        names, clips = [UAV, *(one.name for one in self.members)], [one.clip for one in self.members if one.clip]
        for what, given in ("name", names), ("clip", clips):
            if twice := [value for value, count in Counter(given).items() if count > 1]:
                raise InputError(f"two platforms have the {what} {twice[0]}; give each platform its own {what}")
        self._scorer: WindowScorer | None = None
        if any(one.clip for one in self.platforms):
            self._scorer = load_scorer(settings.people, backend)
        self._sources = {
            one.name: open_source(one.clip, rate_hz=one.rate_hz) for one in self.platforms if one.clip and not live
        }
        self._tables = {
            one.name: read_detections(one.detections, order=None, size=one.camera.size_px)
            for one in self.platforms
            if one.detections is not None
        }
        for one in self.platforms:
            if one.name in self._sources:
                check_size(one, self._sources[one.name].size)
        self._delay_s = settings.fusion.delay_s if live else 0.0
        self._in_time = "taken and worked on before the last result" if live else "taken during the clip"
        self.fusion = TargetFusion(settings, delay_s=self._delay_s)
        self._searching = Lock()  # allows one search for people at a time, because platforms may have threads
        self.notes = [note for one in self.platforms for note in one.notes]
        self._beliefs = Beliefs(settings.confirm)
        self.starts_s: dict[str, float] = {}  # start of each platform, in seconds of the main clip
        self._flows: dict[str, Iterator[PlatformLook]] = {}
        self._next: dict[str, PlatformLook | None] = {}
        self._frames: Counter[str] = Counter()  # frames used
        self._late: Counter[str] = Counter()  # pictures outside the poses
        self._people, self._met, self._nearest_m = Counter[str](), Counter[str](), dict[str, float]()

    @property
    def files(self) -> list[Path]:
        """All files that the platforms name."""
        return [file for one in self.members for file in one.files]

    @property
    def facts(self) -> dict[str, Any]:
        """Facts on each platform for run.json: frames, located people, people that other platforms saw too, weight."""
        weights, offsets = self.fusion.weights, self.fusion.offsets_m
        return {
            name: {
                "frames": self._frames[name],
                "located": self._people[name],
                "shared": self._met[name],
                "weight": weights.get(name),
                "offset_m": offsets.get(name),
            }
            for name in (UAV, *(one.name for one in self.members))
        }

    def check(self, is_located: bool, origin_deg: tuple[float, float] | None, start_utc_s: float = math.nan) -> None:
        """Start a clip. Raise InputError if it has no places, places of another kind, or no clock."""
        if not is_located:
            raise InputError("other platforms need targets with places; give --telemetry or --landmarks too")
        for one in self.members:
            if isinstance(one, PlatformFile):
                geographic = geometry.poses_at(one.camera, one.poses, np.zeros(0), 1.0)[0].geographic
            else:
                geographic = self.further[one.name].origin_deg is not None
            if geographic != (origin_deg is not None):
                has = ("local metres", "longitude and latitude")
                raise InputError(
                    f"{one.name} stands at {has[geographic]}, but the clip is located in {has[not geographic]}; "
                    "give all in one kind"
                )
            self.starts_s[one.name] = one.starts_s
            if math.isnan(one.starts_s):
                self.starts_s[one.name] = one.starts_utc_s - start_utc_s
                if math.isnan(self.starts_s[one.name]):
                    raise InputError(f"{one.name} has starts_utc, but the clip's log gives no date; give starts_s")
        self.fusion = TargetFusion(self.settings, delay_s=self._delay_s, origin_deg=origin_deg)
        self._flows = {
            one.name: self.looks(one, self._pictures(one, self.starts_s[one.name]), self._rate_hz(one))
            if isinstance(one, PlatformFile)
            else self._flight(self.further[one.name], self.starts_s[one.name])
            for one in self.members
        }

    def mark(self, results: Iterable[FrameResult]) -> Iterator[FrameResult]:
        """Return the results with the data of the other platforms."""
        for result in results:
            yield self.add(result)
        self.finish()

    def add(self, result: FrameResult) -> FrameResult:
        """Return the next result, with the views of the other platforms since the previous result."""
        located = result.locations
        if located is None or not math.isfinite(located.time_s) or result.repeats:
            return result
        looks = sorted(self._until(located.time_s), key=lambda look: look.time_s)
        for look in looks:
            # Rounding must not place the same moment after this result, where it would come too late.
            self.fuse(replace(look, time_s=min(look.time_s, located.time_s)))
        fused = self.fuse(PlatformLook(located.time_s, UAV, located))
        return replace(result, confirmed=self.confirm(looks, located), fused=fused[-1] if fused else None)

    def fuse(self, look: PlatformLook) -> list[FusedTargets]:
        """Fuse the view of a platform; return the results of any platform that are now final."""
        known = self.fusion.update(look.located, look.name, time_s=look.time_s, lasting=look.lasting)
        self._frames[look.name] += 1
        self._people[look.name] += len(look.located.positions)
        for one in known:
            if one.by == UAV or one.by in self.further:
                self._met[one.by] += sum(one.by in by and len(by) > 1 for by in one.seen_by)
        return known

    def confirm(self, looks: Iterable[PlatformLook], located: AerialLocations) -> Confirmation:
        """Return the confirmation of the main clip's targets by the ground platforms' views around this time."""
        seen = [(look.name, self._observe(look, located)) for look in looks if look.view is not None]
        names = located.positions.target.tolist()
        self._beliefs.add(names, seen)
        return summarize(located.frame, slice(0, len(names)), names, self._beliefs, seen)

    def finish(self) -> None:
        """Add notes on data that could not be used."""
        for one in self.members:
            name, frames, late = one.name, self._frames[one.name], self._late[one.name]
            if not frames:
                self.notes.append(f"{name} was not used: no picture of it with a pose was {self._in_time}")
            elif late:
                self.notes.append(f"{name}: {late} pictures lie outside its poses")
            if name in self.further:
                self.notes += [f"{name}: {note}" for note in self.further[name].notes()]
            if frames and not self._people[name]:
                self.notes.append(f"{name} located nobody in its {frames} pictures")
            if self._people[name] and not self._met[name]:
                self.notes.append(self._unmatched(name))
        for name, weight in self.fusion.weights.items():
            if weight < _DOUBTED:
                off = math.hypot(*self.fusion.offsets_m[name])
                self.notes.append(f"{name} is {off:.1f} m from where the others agree: its weight is {weight:.2f}")

    def _unmatched(self, name: str) -> str:
        """Return the possible reasons why no other platform sees the targets that a platform locates."""
        if name in self.further:
            return (
                f"{name} locates targets, and none of them was recognized as a target of another platform. Recognition "
                "takes about 3 s in which both platforms see the same three targets or more, or fewer if no other "
                "target is near; it needs correct places and starts_s"
            )
        nearest = f"; the nearest is {self._nearest_m[name]:.0f} m away" if name in self._nearest_m else ""
        return (
            f"{name} locates people, and none of them is where another platform sees one{nearest}: "
            "are its places and starts_s right?"
        )

    def _until(self, time_s: float) -> Iterator[PlatformLook]:
        """Yield the views up to a time, each once."""
        for name, flow in self._flows.items():
            look = self._next.pop(name, None) or next(flow, None)
            while look is not None and look.time_s <= time_s + 1e-6:
                yield look
                look = next(flow, None)
            self._next[name] = look

    def _flight(self, one: FurtherUav, start_s: float) -> Iterator[PlatformLook]:
        """Yield the views of a further UAV, from the clip's beginning on."""
        for result in one.results:
            located = result.locations
            if located is not None and not result.repeats and located.time_s + start_s >= 0:
                yield PlatformLook(located.time_s + start_s, one.file.name, located)

    def looks(self, one: PlatformFile, pictures: Iterable[Picture], rate_hz: float) -> Iterator[PlatformLook]:
        """Yield the views of a ground platform from pictures at a rate; count frames without a pose."""
        settings = self.settings
        locator = GroundLocator(one.camera, settings=settings, poses=[one.poses], rate_hz=rate_hz)
        lasting = one.detections is not None and self._tables[one.name].identity is not None
        for number, time_s, image in pictures:
            if one.poses is not None:
                at = (number - 1) / rate_hz if one.poses.timed else number
                if not one.poses.at[0] - 1e-6 <= at <= one.poses.at[-1] + 1e-6:
                    self._late[one.name] += 1
                    continue
            camera, where = geometry.poses_at(one.camera, one.poses, np.array([number]), rate_hz)
            place, origin = where.place, locator.origin_deg
            if camera.geographic:
                origin = locator.origin_deg = origin or (float(place[0, 0]), float(place[0, 1]))
                place = geometry.east_north(place, origin)
            located = self._locate(one, locator, number, image)
            view = field_of_view(camera, place[0], float(where.heading_rad[0]), settings.people, settings.ground)
            yield PlatformLook(time_s, one.name, located, view, lasting)

    def _rate_hz(self, one: PlatformFile) -> float:
        return self._sources[one.name].rate_hz if one.name in self._sources else one.rate_hz or 1.0

    def _pictures(self, one: PlatformFile, start_s: float) -> Iterator[Picture]:
        """Yield the pictures of a recording, from the main clip's beginning on."""
        if one.clip:
            frames = self._sources[one.name].every(one.interval)
            pictures: Iterator[Picture] = ((frame.number, frame.time_s, frame.image) for frame in frames)
        else:
            rate_hz = self._rate_hz(one)
            pictures = ((n, (n - 1) / rate_hz, None) for n in np.unique(self._tables[one.name].frame).tolist())
        yield from ((number, time_s + start_s, image) for number, time_s, image in pictures if time_s + start_s >= 0)

    def _locate(
        self, one: PlatformFile, locator: GroundLocator, number: int, image: np.ndarray | None
    ) -> GroundLocations:
        """Locate the people of a picture."""
        if image is not None and self._scorer is not None:
            with self._searching:
                people = detect_people([image], self._scorer, self.settings.people)[0]
            return locator.locate(people, frame=number)
        table = self._tables[one.name]
        rows = table.rows(number)
        identity, cut = (None if v is None else v[rows] for v in (table.identity, table.cut))
        columns = table.frame[rows], table.box_px[rows], table.score[rows], table.line[rows]
        part = DetectionTable(table.path, *columns, identity=identity, cut=cut)
        return next(locator.locate_tables([part]))

    def _observe(self, look: PlatformLook, located: AerialLocations) -> Any:
        """Compare a view with the targets."""
        assert isinstance(look.located, GroundLocations) and look.view is not None
        aerial, ground, view = located.positions, look.located.positions, look.view
        person_m, eye_m = ground.east_north_m, view.east_north_m[None]
        if ground.origin_deg is not None and aerial.origin_deg is not None:
            degrees = geometry.lonlat(np.concatenate([person_m, eye_m]), ground.origin_deg)
            person_m, eye_m = np.split(geometry.east_north(degrees, aerial.origin_deg), [len(person_m)])
        view, score, name = replace(view, east_north_m=eye_m[0]), ground.score, look.name
        people = ground.covariance_m2
        seen = observe_ground(
            aerial.east_north_m, aerial.covariance_m2, person_m, people, score, [view], self.settings.confirm
        )
        self._met[name] += int((seen.blob >= 0).sum())
        if len(ground) and len(aerial):
            self._nearest_m[name] = min(self._nearest_m.get(name, math.inf), float(seen.nearest_m.min()))
        return drop_fast_targets(seen, located.velocity_m_s)


def check_size(one: PlatformFile, size_px: tuple[int, int]) -> None:
    """Raise InputError if pictures have another size than the platform's camera."""
    if size_px != one.camera.size_px:
        raise InputError(
            f"pictures of {one.name} have {size_px[0]} x {size_px[1]} px, but its camera's file says "
            f"{one.camera.size_px[0]} x {one.camera.size_px[1]}; give the camera's file for this size"
        )
