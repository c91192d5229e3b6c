"""The pipeline from frames to results: detection, identities, places on the ground, and commands in a closed loop."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.control import GroundTeam, Mission
from torchvision_dddas.detection import (
    Engine,
    MotionDetector,
    Retune,
    detect_motion,
)
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import (
    AerialLocator,
    LandmarkWatch,
    WatchedScene,
    describe_clock_offset,
    describe_contradictions,
    describe_heading_offset,
    describe_no_place,
    group_crowds,
    has_places,
    touches_border,
    tracked_targets,
)
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.pipeline.assembly import Assembly, assemble, describe_assumed_rate
from torchvision_dddas.pipeline.moving_boxes import MovingBoxes
from torchvision_dddas.pipeline.own_detector import Detector, OwnDetector
from torchvision_dddas.tracking import CrowdEvents, CrowdIdentities, SceneTracker, without_picture
from torchvision_dddas.types import (
    Camera,
    Colours,
    DetectionTable,
    Elevation,
    Frame,
    FrameResult,
    Landmarks,
    Scene,
    Source,
    Telemetry,
    TrackedFrame,
    ZoneEvent,
    as_picture,
)

# In a longer clip, only the latest camera motions are used to test whether the clip is synchronised with its log.
_MOST_MOTIONS = 20_000


class ClipSource(Protocol):
    """A source of frames with a known size and rate."""

    def __iter__(self) -> Iterator[Frame]: ...

    @property
    def rate_hz(self) -> float:
        """Frames a second."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px, the same for every frame."""
        ...


class Pipeline:
    """Detect, track and locate moving targets in the frames of an aerial camera.

    >>> pipeline = td.Pipeline(detector=lambda frame: td.Detections([[40.0, 60, 20, 20]], [0.9], label=["car"]))
    >>> results = list(pipeline(np.random.default_rng(0).integers(0, 256, (8, 120, 160), np.uint8)))
    >>> len(results), results[-1].tracks.label
    (8, array(['car'], dtype=object))
    """

    open_clip: Callable[..., Any] = staticmethod(open_source)
    """Function that opens a path. The top-level package replaces it by `open_video`, which also opens `sim:`."""

    def __init__(
        self,
        settings: Settings | str | Path | None = None,
        *,
        backend: str = "auto",
        telemetry: Telemetry | None = None,
        landmarks: Landmarks | None = None,
        camera: Camera | None = None,
        colours: Colours | None = None,
        elevation: Elevation | None = None,
        detector: Detector | DetectionTable | None = None,
        movers: bool = False,
        ground: str | Path | Sequence[str | Path] = (),
        aerial: str | Path | Sequence[str | Path] = (),
        interval: int = 1,
        rate_hz: float | None = None,
    ) -> None:
        """settings: a record, the name of a shipped configuration, or a TOML file. backend: auto, onboard or torch.

        landmarks: places of landmarks. Their pixels come from the table, or from `colours` if given.
        elevation: as in AerialLocator. detector: replaces the motion detector. Either a function that gets
        each tracked Frame and returns Detections, or a result of supervision, ultralytics and others that
        `Detections.from_supervision` accepts; or a table of boxes. Classes are kept.
        movers: also run the motion detector. Boxes then have speeds, and moving targets without a box are kept
        without a class.
        ground, aerial: TOML files of ground platforms and further UAVs, as for `dddas run`; results then have
        `confirmed` and `fused`.
        interval: frames from one tracked frame to the next. rate_hz: frames a second of a path, and of frames that
        come one by one; None: the video's own rate, or 10 for pictures, with a note. An opened source has its own rate.
        Raise InputError for values of a wrong type, and for colours, camera or elevation without anything to locate.
        """
        if interval < 1 or not (rate_hz is None or rate_hz > 0):
            raise InputError(f"interval must be at least 1 and rate_hz positive, got {interval} and {rate_hz}")
        if isinstance(settings, str | Path):
            settings = load_config(settings)
        for name, value, kind in (
            ("settings", settings, Settings),
            ("telemetry", telemetry, Telemetry),
            ("landmarks", landmarks, Landmarks),
            ("camera", camera, Camera),
            ("colours", colours, Colours),
            ("elevation", elevation, Elevation),
        ):
            if value is not None and not isinstance(value, kind):
                read = "; td.read_telemetry(path) reads one from a log" if kind is Telemetry else ""
                raise InputError(f"{name} must be of type {kind.__name__}, got {type(value).__name__}{read}")
        if not (detector is None or callable(detector) or isinstance(detector, DetectionTable)):
            raise InputError(f"detector must be a function or a DetectionTable, got {type(detector).__name__}")
        if movers and detector is None:
            raise InputError("movers needs a detector; without a detector, the pipeline finds movers anyway")
        self._assembly: Assembly | None = None
        self._given: dict[str, Any] = {
            "telemetry": telemetry,
            "landmarks": landmarks,
            "camera": camera,
            "colours": colours,
            "elevation": elevation,
        }
        self._backend, self.interval, self._given_hz, self.rate_hz = backend, interval, rate_hz, rate_hz or 10.0
        self.settings, self.telemetry = settings or Settings(), telemetry
        self.notes: list[str] = []
        if landmarks is None and not has_places(telemetry):
            if colours or camera or elevation:
                raise InputError("camera, colours and elevation need landmarks, or telemetry with places")
            if telemetry is not None:
                self.notes.append(f"nothing is located: {describe_no_place(telemetry)}")
        self._motions: deque[tuple[float, np.ndarray]] = deque(maxlen=_MOST_MOTIONS)
        self._watch: LandmarkWatch | None = None
        self._mission: Mission | None = None
        self._seen: Callable[[Scene], object] | None = None
        self._retune: Retune | None = None
        self._pictures = True
        self._lag: int | None = None
        self._own_detector, self._movers = detector, movers
        self._ground, self._aerial = ([x] if isinstance(x, str | Path) else list(x) for x in (ground, aerial))
        self._team: GroundTeam | None = None
        self._detector: MotionDetector | OwnDetector | None = None

    @classmethod
    def from_assembly(
        cls,
        assembly: Assembly,
        *,
        interval: int = 1,
        seen: Callable[[Scene], object] | None = None,
        retune: Retune | None = None,
        pictures: bool = True,
        detector: Detector | DetectionTable | None = None,
        movers: bool = False,
        lag: int | None = None,
    ) -> "Pipeline":
        """Make a pipeline from assembled parts, for one clip.

        seen: called with each scene, without its landmarks. retune: as for `detect_motion`. pictures: whether results
        keep their pictures, which take most of a long run's memory. detector, movers: as for `Pipeline`. lag: as for
        `Tracker`; results with provisional tracks have no places.
        """
        pipeline = cls(assembly.settings, interval=interval, detector=detector, movers=movers)
        pipeline._assembly = assembly
        pipeline._seen, pipeline._retune, pipeline._pictures, pipeline._lag = seen, retune, pictures, lag
        return pipeline

    def __call__(self, source: "str | Path | ClipSource | Iterable[Frame | np.ndarray]") -> Iterator[FrameResult]:
        """Yield the result of each tracked frame of a source, in order, from its beginning.

        source: an input of `open_video`, a record with `rate_hz` and `size`, or an iterable of frames or BGR images.
        Raise InputError for another source, for frames of a wrong shape or type, and for fewer than three frames.
        """
        if isinstance(source, str | Path):
            source = self.open_clip(str(source), rate_hz=self._given_hz, full_scale=self.settings.levels.given)
        if not hasattr(source, "__iter__"):
            raise InputError(f"a pipeline needs a path or frames, got {type(source).__name__}")
        self._detector = None
        return self._run(source)

    def update(self, frame: Frame | np.ndarray) -> list[FrameResult]:
        """Process one frame, and return the results that it settles. Raise InputError if it is no picture."""
        if self._detector is None:
            image = as_picture(frame.image if isinstance(frame, Frame) else frame)
            is_assumed = self._given_hz is None and not isinstance(frame, Frame)
            engine = self._begin((image.shape[1], image.shape[0]), self.rate_hz, is_assumed)
            self._detector = self._own(engine) or MotionDetector(
                self.settings, backend=engine, rate_hz=self.rate_hz, telemetry=self.telemetry
            )
        return [result for scene in self._detector.update(frame) for result in self._take(scene)]

    def flush(self) -> list[FrameResult]:
        """End the clip, and return all remaining results. Raise InputError if there were fewer than three frames."""
        if self._detector is None:
            return []
        detector, self._detector = self._detector, None
        results = [result for scene in detector.flush() for result in self._take(scene)]
        return results + list(self._rest())

    def _run(self, source: Any) -> Iterator[FrameResult]:
        if not hasattr(source, "rate_hz") or not hasattr(source, "size"):
            for frame in source:
                yield from self.update(frame)
            yield from self.flush()
            return
        engine = self._begin(source.size, source.rate_hz, getattr(source, "assumes_rate", False))
        own = self._own(engine)
        scenes = detect_motion(source, self.settings, engine, self.telemetry, retune=self._retune)
        for scene in scenes if own is None else (scene for frame in source for scene in own.update(frame)):
            yield from self._take(scene)
        yield from self._rest()

    def _own(self, engine: Engine) -> OwnDetector | None:
        """Return the replacement of the motion detector, if one was given."""
        given = self._own_detector
        if given is None or self._movers:
            return None
        return OwnDetector(given, engine, interval=self.interval, rate_hz=self.rate_hz)

    def _begin(self, size_px: tuple[int, int], rate_hz: float, is_assumed: bool) -> Engine:
        """Start a clip: make a tracker, and the parts that locate its frames."""
        assembly, given = self._assembly, self.settings
        if assembly is None:
            assembly = assemble(self.settings, self._backend, size_px, rate_hz, **self._given)
            self.notes = [*assembly.notes] if assembly.watch is not None else self.notes
            if is_assumed and (note := describe_assumed_rate(rate_hz)) not in self.notes:
                self.notes.append(note)
            if assembly.watch is not None:
                assembly.watch.locator.assumes_rate = is_assumed
        self.settings, self.telemetry = assembly.settings, assembly.telemetry
        self._watch, self._mission = assembly.watch, assembly.mission
        self._clip_rate_hz = rate_hz
        if self._ground or self._aerial:
            from torchvision_dddas.pipeline.further_uavs import open_uav  # imported here because it imports this module

            further = [open_uav(path, given, self._backend) for path in self._aerial]
            self._team = GroundTeam(self._ground, self.settings, self._backend, further)
            site = None if self._watch is None else self._watch.locator.site
            clock = math.nan if site is None or site.telemetry is None else site.telemetry.start_utc_s
            self._team.check(site is not None, None if site is None else site.origin_deg, clock)
        backend = assembly.engine.name
        kind: tuple[bool | None, bool] = True, False
        if (own := self._own_detector) is not None:
            kind = (own.own, own.certain) if isinstance(own, DetectionTable) else (None, False)
        self._moving_boxes = None if own is None or not self._movers else MovingBoxes(own, self.interval)
        self._tracker = SceneTracker(
            self.settings, self.interval, size_px, self._pictures, backend, rate_hz, *kind, self._lag
        )
        join_m = self.settings.crowds.join_m if self._watch is not None else 0.0
        self._crowds = (CrowdIdentities(), CrowdEvents(join_m)) if join_m else None
        self._waiting: dict[int, WatchedScene] = {}
        self._watched: WatchedScene | None = None  # the last watched scene
        self._motions.clear()
        return assembly.engine

    @property
    def motions(self) -> list[tuple[float, np.ndarray]]:
        """Time of each latest frame, s, and (3, 3) pixel homography from the frame before, NaN if unknown."""
        return list(self._motions)

    def _take(self, scene: Scene) -> Iterator[FrameResult]:
        """Locate a scene's landmarks, give its targets identities, and finish the frames that the scene settles."""
        if self._moving_boxes is not None:
            scene = self._moving_boxes.combine(scene)
        if self._watch is not None:
            motion = scene.camera_motion
            self._motions.append((scene.frame.time_s, np.full((3, 3), np.nan) if motion is None else motion))
            if self._mission is not None:
                self._mission.take_reports(scene)
            if scene.repeats and self._watched is not None:
                watched = _repeated(self._watched, scene)
            else:
                watched = group_crowds(self._watch.update(scene), self._watch.locator, self._clip_rate_hz)
            self._watched, scene = watched, watched.scene
            if not self._pictures:
                watched = replace(watched, scene=replace(scene, frame=without_picture(scene.frame)))
            self._waiting[scene.frame.number] = watched
        if self._seen is not None:
            self._seen(scene)
        for tracked in self._tracker.update(scene):
            yield FrameResult(tracked) if tracked.tracks.provisional else self._finish(tracked)

    def _rest(self) -> Iterator[FrameResult]:
        waiting = deque(self._tracker.flush())
        while waiting:
            result = self._finish(waiting.popleft())
            if not waiting and self._crowds is not None:  # the last frame gets the open events
                result = replace(result, events=(*result.events, *self._in_degrees(self._crowds[1].flush())))
            yield result
        if self._crowds is not None:  # no result is left that could hold the open events, so they become notes
            self.notes += [f"at the end of the clip: {event.describe()}" for event in self._crowds[1].flush()]
        if self._watch is not None:
            for describe in (describe_clock_offset, describe_heading_offset, describe_contradictions):
                if note := describe(self._watch.locator, self._motions):
                    self.notes.append(note)
        if self._team is not None:
            self._team.finish()
            self.notes += self._team.notes

    def _finish(self, tracked: TrackedFrame) -> FrameResult:
        """Locate the targets of a settled frame by the fix of its own picture."""
        if self._watch is None:
            return FrameResult(tracked)
        past = [self._waiting.pop(number) for number in sorted(self._waiting) if number <= tracked.number]
        events: list[ZoneEvent] = []
        if self._crowds is not None:
            tracked, events = _follow_crowds(tracked, past[-1], self._watch.locator, *self._crowds)
        result = replace(_locate(tracked, past, self._watch.locator), events=tuple(self._in_degrees(events)))
        if self._team is not None:
            return self._team.add(result)
        return result if self._mission is None else self._mission.steer(result, past[-1].scene.step)

    def _in_degrees(self, events: list[ZoneEvent]) -> Iterator[ZoneEvent]:
        origin = None if self._watch is None else self._watch.locator.site.origin_deg
        for event in events:
            yield (
                event
                if origin is None
                else replace(event, lonlat_deg=geometry.lonlat(event.east_north_m[None], origin)[0])
            )


def find_scenes(
    source: Source,
    settings: Settings,
    engine: Engine,
    telemetry: Telemetry | None = None,
    detector: Detector | DetectionTable | None = None,
    movers: bool = False,
) -> Iterator[Scene]:
    """Yield the scenes of a clip without identities. detector, movers: as for `Pipeline`."""
    if detector is not None and not movers:
        own = OwnDetector(detector, engine, rate_hz=source.rate_hz)
        return (scene for frame in source for scene in own.update(frame))
    scenes = detect_motion(source, settings, engine, telemetry)
    return scenes if detector is None else map(MovingBoxes(detector).combine, scenes)


def _repeated(watched: WatchedScene, scene: Scene) -> WatchedScene:
    """Return a scene that repeats a watched scene."""
    same = replace(scene, detections=watched.scene.detections, mask=watched.scene.mask, core=watched.scene.core)
    fixed = watched.fixed.repeated(scene.frame.number, scene.frame.time_s)
    return replace(watched, scene=same, fixed=fixed)


def _follow_crowds(
    tracked: TrackedFrame,
    watched: WatchedScene,
    locator: AerialLocator,
    identities: CrowdIdentities,
    events: CrowdEvents,
) -> tuple[TrackedFrame, list[ZoneEvent]]:
    """Return a tracked frame with the identities of its crowds on the ground, and the events of the crowds."""
    tracks, fix = tracked.tracks, watched.fixed.fix
    seen = tracks.row >= 0
    box, middle = tracks.box_px[seen], tracked.detections.middle_px[tracks.row[seen]]
    middle = np.where(np.isfinite(middle), middle, box[:, :2] + (box[:, 2:] - 1) / 2)
    place, radius = locator.ground_places(fix, middle), locator.ground_radii(fix, box)
    time_s = locator.time_of(fix)
    renamed, row = identities.rename(tracks, time_s, place, radius), tracks.row[seen]
    order = {int(r): k for k, r in enumerate(row)}
    kept = [(int(n), order[int(r)]) for n, r in zip(renamed.identity, renamed.row, strict=True) if r >= 0]
    number, at = np.array(kept, np.int64).reshape(-1, 2).T
    at_edge = touches_border(box, locator.camera.size_px)
    told = events.update(tracked.number, time_s, number, place[at], radius[at], at_edge[at])
    return replace(tracked, tracks=renamed), told


def _locate(tracked: TrackedFrame, past: Sequence[WatchedScene], locator: AerialLocator) -> FrameResult:
    """Locate a tracked frame on the ground. past: the scenes since the last tracked frame, this one last."""
    here, targets = past[-1], tracked_targets(tracked, bool(locator.settings.crowds.join_m))
    earlier = tuple(a for watched in past[:-1] for a in watched.fixed.adjustments)
    seconds = dict(tracked.seconds)
    for watched in past:
        for stage, spent in watched.fixed.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + spent
    fixed, adjustments = replace(here.fixed, seconds={}), (*tracked.adjustments, *earlier)
    is_known = all(watched.scene.camera_motion is not None for watched in past)
    motion = tracked.now_from_before if is_known else None
    grounded = locator.locate_targets(fixed, targets, adjustments=adjustments, seconds=seconds, motion=motion)
    origin = locator.site.origin_deg
    degrees = None if origin is None else geometry.lonlat(grounded.marks.east_north_m, origin)
    return FrameResult(tracked, grounded, here.sighted_by, degrees)
