"""The whole path from frames to results: detection, identities, places on the ground, and commands in a closed loop."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.control import Mission
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
    describe_no_place,
    group_crowds,
    has_places,
    tracked_targets,
)
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.pipeline.assembly import Assembly, assemble
from torchvision_dddas.tracking import CrowdIdentities, SceneTracker, without_picture
from torchvision_dddas.types import (
    Camera,
    Colours,
    Elevation,
    Frame,
    FrameResult,
    Landmarks,
    Scene,
    Telemetry,
    TrackedFrame,
    as_picture,
)

# Of a longer clip the latest motions of the camera show whether it is synchronised with its log.
_MOST_MOTIONS = 20_000


class Clip(Protocol):
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
    """Detects, tracks and locates what moves in the frames of a camera in the air.

    >>> for result in Pipeline("fast")("clip.mp4"):
    ...     print(result.frame, result.tracks.xyxy, result.tracks.id)

    Call it with a source, or give it single frames with `update` and take the last results with `flush`. A frame's
    result is settled some frames later. Targets are located where landmarks are given, or telemetry with places.
    notes: what the user should know of what was given, and after the last frame whether log and clip are synchronised.
    """

    open_clip: Callable[..., Any] = staticmethod(open_source)
    """Opens a path. The package's front door puts `open_video` in its place, which opens `sim:` too."""

    def __init__(
        self,
        settings: Settings | str | Path | None = None,
        backend: str = "auto",
        telemetry: Telemetry | None = None,
        landmarks: Landmarks | None = None,
        camera: Camera | None = None,
        *,
        colours: Colours | None = None,
        elevation: Elevation | None = None,
        interval: int = 1,
        rate_hz: float = 10.0,
    ) -> None:
        """settings: a record, the name of a shipped configuration, or a TOML file. backend: auto, onboard or torch.

        landmarks: where they were; places in the pictures come from the table, or by colours if these are given.
        elevation: as for AerialLocator. interval: frames from one tracked frame to the next. rate_hz: frames a second,
        of frames that come one by one; a source has its own rate.
        Raises InputError for values of a wrong type, and for colours, camera or elevation without anything to locate.
        """
        if interval < 1 or not rate_hz > 0:
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
                read = "; td.read_telemetry(path) makes one of a log" if kind is Telemetry else ""
                raise InputError(f"{name} must be of type {kind.__name__}, got {type(value).__name__}{read}")
        self._assembly: Assembly | None = None
        self._given: dict[str, Any] = {
            "telemetry": telemetry,
            "landmarks": landmarks,
            "camera": camera,
            "colours": colours,
            "elevation": elevation,
        }
        self._backend, self.interval, self.rate_hz = backend, interval, rate_hz
        self.settings, self.telemetry = settings or Settings(), telemetry
        self.notes: list[str] = []
        if landmarks is None and not has_places(telemetry):
            if colours or camera or elevation:
                raise InputError(
                    "camera, colours and elevation are of no use without landmarks, or telemetry with places"
                )
            if telemetry is not None:
                self.notes.append(f"nothing is located: {describe_no_place(telemetry)}")
        self._watch: LandmarkWatch | None = None
        self._mission: Mission | None = None
        self._seen: Callable[[Scene], object] | None = None
        self._retune: Retune | None = None
        self._pictures = True
        self._detector: MotionDetector | None = None

    @classmethod
    def from_assembly(
        cls,
        assembly: Assembly,
        interval: int = 1,
        seen: Callable[[Scene], object] | None = None,
        retune: Retune | None = None,
        pictures: bool = True,
    ) -> "Pipeline":
        """A pipeline of assembled parts, for one clip.

        seen: called with each scene, without its landmarks. retune: as for `detect_motion`. pictures: whether results
        keep their pictures, most of a long run's memory.
        """
        pipeline = cls(assembly.settings, interval=interval)
        pipeline._assembly = assembly
        pipeline._seen, pipeline._retune, pipeline._pictures = seen, retune, pictures
        return pipeline

    def __call__(self, source: "str | Path | Clip | Iterable[Frame | np.ndarray]") -> Iterator[FrameResult]:
        """The result of each tracked frame of a source, in order. A source is used from its beginning.

        source: what `open_video` opens, a record with `rate_hz` and `size`, or an iterable of frames or BGR images.
        Raises InputError for another source, for frames of a wrong shape or type, and for fewer than three frames.
        """
        if isinstance(source, str | Path):
            source = self.open_clip(str(source), full_scale=self.settings.levels.given)
        if not hasattr(source, "__iter__"):
            raise InputError(f"a pipeline wants a path or frames, got {type(source).__name__}")
        self._detector = None
        return self._run(source)

    def update(self, frame: Frame | np.ndarray) -> list[FrameResult]:
        """Take one frame; returns the results that are settled by it. Raises InputError for anything but a picture."""
        if self._detector is None:
            image = as_picture(frame.image if isinstance(frame, Frame) else frame)
            engine = self._begin((image.shape[1], image.shape[0]), self.rate_hz)
            self._detector = MotionDetector(self.settings, engine, self.rate_hz, self.telemetry)
        return [result for scene in self._detector.update(frame) for result in self._take(scene)]

    def flush(self) -> list[FrameResult]:
        """End the clip; returns all remaining results. Raises InputError if there were fewer than three frames."""
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
        engine = self._begin(source.size, source.rate_hz)
        for scene in detect_motion(source, self.settings, engine, self.telemetry, retune=self._retune):
            yield from self._take(scene)
        yield from self._rest()

    def _begin(self, size_px: tuple[int, int], rate_hz: float) -> Engine:
        """Start a clip: a tracker, and what locates its frames."""
        assembly = self._assembly
        if assembly is None:
            assembly = assemble(self.settings, self._backend, size_px, rate_hz, **self._given)
            self.notes = [*assembly.notes] if assembly.watch is not None else self.notes
        self.settings, self.telemetry = assembly.settings, assembly.telemetry
        self._watch, self._mission = assembly.watch, assembly.mission
        self._clip_rate_hz = rate_hz
        backend = assembly.engine.name
        self._tracker = SceneTracker(self.settings, self.interval, size_px, self._pictures, backend, rate_hz)
        self._crowds = CrowdIdentities() if self.settings.crowds.join_m and self._watch is not None else None
        self._waiting: dict[int, WatchedScene] = {}
        self._watched: WatchedScene | None = None  # the last one
        self._motions: deque[tuple[float, np.ndarray]] = deque(maxlen=_MOST_MOTIONS)
        return assembly.engine

    def _take(self, scene: Scene) -> Iterator[FrameResult]:
        """Locate a scene's landmarks, give its targets identities, and finish the frames that are settled by it."""
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
            yield self._finish(tracked)

    def _rest(self) -> Iterator[FrameResult]:
        for tracked in self._tracker.flush():
            yield self._finish(tracked)
        if self._watch is not None and (note := describe_clock_offset(self._watch.locator, self._motions)):
            self.notes.append(note)

    def _finish(self, tracked: TrackedFrame) -> FrameResult:
        """Locate the targets of a settled frame by the picture that shows them."""
        if self._watch is None:
            return FrameResult(tracked)
        past = [self._waiting.pop(number) for number in sorted(self._waiting) if number <= tracked.number]
        if self._crowds is not None:
            tracked = _with_crowd_identities(tracked, past[-1], self._watch.locator, self._crowds)
        result = _locate(tracked, past, self._watch.locator)
        return result if self._mission is None else self._mission.steer(result, past[-1].scene.step)


def _repeated(watched: WatchedScene, scene: Scene) -> WatchedScene:
    """A scene that repeats a watched one."""
    same = replace(scene, detections=watched.scene.detections, mask=watched.scene.mask, core=watched.scene.core)
    fixed = watched.fixed.repeated(scene.frame.number, scene.frame.time_s)
    return replace(watched, scene=same, fixed=fixed)


def _with_crowd_identities(
    tracked: TrackedFrame, watched: WatchedScene, locator: AerialLocator, crowds: CrowdIdentities
) -> TrackedFrame:
    """A tracked frame with the identities that its crowds have on the ground."""
    tracks, fix = tracked.tracks, watched.fixed.fix
    seen = tracks.row >= 0
    box, middle = tracks.box_px[seen], tracked.detections.middle_px[tracks.row[seen]]
    middle = np.where(np.isfinite(middle), middle, box[:, :2] + (box[:, 2:] - 1) / 2)
    place, radius = locator.ground_places(fix, middle), locator.ground_radii(fix, box)
    return replace(tracked, tracks=crowds.rename(tracks, locator.time_of(fix), place, radius))


def _locate(tracked: TrackedFrame, past: Sequence[WatchedScene], locator: AerialLocator) -> FrameResult:
    """A tracked frame on the ground. past: the scenes since the last tracked frame, this one at the end."""
    here, targets = past[-1], tracked_targets(tracked, bool(locator.settings.crowds.join_m))
    earlier = tuple(a for watched in past[:-1] for a in watched.fixed.adjustments)
    seconds = dict(tracked.seconds)
    for watched in past:
        for stage, spent in watched.fixed.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + spent
    fixed, adjustments = replace(here.fixed, seconds={}), (*tracked.adjustments, *earlier)
    is_known = all(watched.scene.camera_motion is not None for watched in past)
    motion = tracked.now_from_before if is_known else None
    grounded = locator.locate_targets(fixed, targets, adjustments, seconds, motion)
    origin = locator.site.origin_deg
    degrees = None if origin is None else geometry.lonlat(grounded.marks.east_north_m, origin)
    return FrameResult(tracked, grounded, here.sighted_by, degrees)
