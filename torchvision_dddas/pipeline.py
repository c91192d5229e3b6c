"""The whole path, frame by frame: what moves, who is who, where on the ground; and where an instrument goes next."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from torchvision_dddas import detection, geometry
from torchvision_dddas.config import Settings
from torchvision_dddas.detection import Engine, Retune, detect_motion
from torchvision_dddas.geo import AerialLocator, LandmarkWatch, WatchedScene, group_crowds
from torchvision_dddas.geo.aerial_locator import tracked_targets
from torchvision_dddas.tracking import CrowdIdentities, track_scenes, without_picture
from torchvision_dddas.types import Fix, FrameResult, Scene, Telemetry, TrackedFrame

if TYPE_CHECKING:
    from torchvision_dddas.control import Mission


class Clip(detection.Clip, Protocol):
    """What the whole path needs of a source."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px, the same for every frame."""
        ...


def survey(
    source: Clip,
    engine: Engine,
    settings: Settings,
    telemetry: Telemetry | None = None,
    watch: LandmarkWatch | None = None,
    interval: int = 1,
    mission: "Mission | None" = None,
    seen: Callable[[Scene], object] | None = None,
    retune: Retune | None = None,
    pictures: bool = True,
) -> Iterator[FrameResult]:
    """Everything of each frame that is followed, in order.

    Pictures are laid on the ground frame by frame as their scenes come; who is who is settled some frames later, and a
    target is located by the picture in which it was seen. seen: called with each scene, the landmarks left out.
    retune: as in detect_motion. pictures: as `tracking.FrameTracker` has it.
    """
    waiting: dict[int, WatchedScene] = {}
    crowds = CrowdIdentities() if settings.crowds.join_m else None

    def scenes() -> Iterator[Scene]:
        for scene in detect_motion(source, settings, engine, telemetry, retune=retune):
            if watch is None:
                if seen is not None:
                    seen(scene)
                yield scene
                continue
            if mission is not None:
                mission.take_reports(scene)
            watched = group_crowds(watch.update(scene), watch.locator, source.rate_hz)
            waiting[scene.frame.number] = watched if pictures else _unpictured(watched)
            if seen is not None:
                seen(watched.scene)
            yield watched.scene

    for followed in track_scenes(scenes(), settings, interval, source.size, pictures):
        if watch is None:
            yield FrameResult(followed)
            continue
        past = [waiting.pop(number) for number in sorted(waiting) if number <= followed.number]
        if crowds is not None:
            followed = _with_crowd_identities(followed, past[-1].fixed.fix, watch.locator, crowds)
        surveyed = _located(followed, past, watch.locator)
        yield surveyed if mission is None else mission.steer(surveyed, past[-1].scene.step)


def _with_crowd_identities(
    followed: TrackedFrame, fix: Fix, locator: AerialLocator, crowds: CrowdIdentities
) -> TrackedFrame:
    """A tracked frame with the identities that its crowds have on the ground. fix: how its picture lies there."""
    tracks = followed.tracks
    seen = tracks.row >= 0
    box, middle = tracks.box_px[seen], followed.detections.middle_px[tracks.row[seen]]
    middle = np.where(np.isfinite(middle), middle, box[:, :2] + (box[:, 2:] - 1) / 2)
    place, radius = locator.ground_places(fix, middle), locator.ground_radii(fix, box)
    return replace(followed, tracks=crowds.rename(tracks, locator.time_s(followed.number), place, radius))


def _unpictured(watched: WatchedScene) -> WatchedScene:
    return replace(watched, scene=replace(watched.scene, frame=without_picture(watched.scene.frame)))


def _located(followed: TrackedFrame, past: Sequence[WatchedScene], locator: AerialLocator) -> FrameResult:
    """A followed frame on the ground. past: what was seen since the one before, it at the end."""
    here, targets = past[-1], tracked_targets(followed, bool(locator.settings.crowds.join_m))
    earlier = tuple(a for watched in past[:-1] for a in watched.fixed.adjustments)
    seconds = dict(followed.seconds)
    for watched in past:
        for stage, spent in watched.fixed.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + spent
    grounded = locator.locate_targets(
        replace(here.fixed, seconds={}), targets, (*followed.adjustments, *earlier), seconds
    )
    origin = locator.site.origin_deg
    degrees = None if origin is None else geometry.lonlat(grounded.marks.east_north_m, origin)
    return FrameResult(followed, grounded, here.sighted_by, degrees)
