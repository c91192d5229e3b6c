"""Give detections identities: the public tracker, and functions that track whole clips and tables."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from torchvision_dddas.config import Settings, check_settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import chain
from torchvision_dddas.runtime import wants_torch
from torchvision_dddas.tracking.appearance import strip_histograms
from torchvision_dddas.tracking.camera_motion import CameraMotion, Registrar
from torchvision_dddas.tracking.score_tracker import ScoreTracker
from torchvision_dddas.tracking.source_tracker import PicturedBoxes, SourceTracker
from torchvision_dddas.types import (
    Adjustment,
    Detections,
    DetectionTable,
    Frame,
    Scene,
    Source,
    TrackedFrame,
    Tracks,
    are_corners,
    as_picture,
    check_boxes,
    is_sampled,
    refuse_table,
)

_MOST_CLASSES = 10_000  # number of identities whose class is kept; those seen longest ago are dropped
_TRIED = 100  # number of boxes from arrays that are checked for their order of coordinates
MOTION = "moving"
"""The kind of the motion detector's detections."""
WEIGHT, LOOKED = "paper.weight", "appearance.looked"
"""Names of the association's adjustments: the source's weight of location, and the default tracker's use of appearance.

The second is not a parameter, but the record names it like one.
"""

# Largest deviation of a time stamp from the constant rate, in frames, that counts as rounding.
_ROUNDED = 0.05


class Tracker:
    """Gives detections identities, one sampled frame after another.

    A frame is settled when no later frame can change its tracks, which is some frames later. With `track.mode = paper`,
    the source's three-frame association, a frame is settled at once, or in batches with torch. `update` returns the
    settled frames in order, and `flush` returns the rest.

    >>> tracker, tracks = td.Tracker(size=(640, 480)), []
    >>> for k in range(12):
    ...     tracks += tracker.update((np.array([[100.0 + 3 * k, 50, 40, 80]]), np.array([0.9])))
    >>> tracks += tracker.flush()
    >>> len(tracks), tracks[-1].id, tracks[-1].xyxy.round()
    (12, array([1]), array([[133.,  50., 173., 130.]]))

    With `lag=0`, the last record of each update has the provisional tracks of the frame itself:

    >>> tracker = td.Tracker(size=(640, 480), lag=0)
    >>> for k in range(6):
    ...     tracks = tracker.update((np.array([[100.0 + 3 * k, 50, 40, 80]]), np.array([0.9])))
    >>> [(each.frame, each.provisional, each.id.tolist(), each.corrects) for each in tracks]
    [(1, False, [1], ()), (6, True, [1], ())]
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        interval: int = 1,
        size: tuple[float, float] | None = None,
        motion: bool | None = None,
        certain: bool = False,
        backend: str = "onboard",
        rate_hz: float | None = None,
        lag: int | None = None,
    ) -> None:
        """Start without tracks.

        interval: frames from one sampled frame to the next. size: (width, height) of the pictures, None if unknown.
        motion: whether the detections come from the motion detector. Then they count as certain, and
        `track.own_scatter` applies to their boxes; None: decide by the kind of the first detections. certain: count
        every score as 1. backend: with torch, the source's association (`track.mode = paper`) computes the histograms
        and affinities of several frames at once, and settles these frames together; auto is torch if there is a CUDA
        device. The default association ignores it. rate_hz: frames a second, needed if `update` gets times. lag: with
        0, `update` also returns the tracks of its own frame, last and marked as `provisional`. The settled record of
        the frame comes later, and its `corrects` names the provisional identities that were wrong. Identities then have
        gaps, because tracks that are never confirmed have numbers too. None: only settled frames.
        Raises InputError for an interval below 1, a size that is not two positive numbers, another lag, lag with the
        source's association in torch, and as `wants_torch`.
        """
        if not isinstance(interval, int | np.integer) or interval < 1:
            raise InputError(f"interval must be a whole number of frames from 1, got {interval}")
        if size is not None and (len(size) != 2 or not all(np.isfinite(side) and side > 0 for side in size)):
            raise InputError(f"size must be (width, height) in pixels, got {size}")
        self.settings, self.interval, self.size = check_settings(settings), int(interval), size
        if isinstance(lag, bool) or lag not in (None, 0):
            raise InputError(f"lag must be 0 (provisional tracks at once) or None (settled tracks only), got {lag!r}")
        self._motion, self._certain, self._rate_hz, self._lag = motion, certain, rate_hz, lag
        self._in_batches = self.settings.track.mode == "paper" and wants_torch(backend)
        if self._in_batches and lag is not None:
            raise InputError(
                "provisional tracks (lag=0, --latency now) cannot work with track.mode = paper in torch, which settles "
                "frames in batches; take the backend onboard"
            )
        self._histograms_s = 0.0
        self._tracker: ScoreTracker | SourceTracker | None = None
        self._frame: int | None = None
        self._time_s, self._at = math.nan, math.nan  # time of the last frame, and its number at a constant rate
        self._tried = np.zeros((0, 4))  # the first boxes given as arrays, to check their order of coordinates
        self._given: deque[Detections] = deque()  # detections of the frames that are not settled
        self._told: dict[int, Tracks] = {}  # provisional tracks of these frames, by frame
        self._classes: dict[int, tuple[str, int]] = {}  # class of the latest detection, by identity

    def update(
        self,
        detections: "Detections | np.ndarray | tuple[np.ndarray, np.ndarray]",
        camera_motion: np.ndarray | None = None,
        *,
        image: np.ndarray | None = None,
        frame: int | None = None,
        interval: int | None = None,
        time_s: float = math.nan,
        damaged: bool = False,
    ) -> list[Tracks]:
        """Add the detections of the next sampled frame, and return the frames that are now settled.

        With lag=0, the provisional tracks of this frame come last. detections: a Detections record, (N, 4) boxes x, y,
        width, height in pixels, or a tuple of boxes and (N,) scores. camera_motion: (3, 3) pixel homography from the
        frame before; None if the camera stood still or its motion is unknown. image: (H, W, 3) uint8 BGR or (H, W)
        grey, needed for the use of appearance. frame: the frame number; None: the last number plus the interval, from
        1. interval: frames since the frame before, if not the usual interval. time_s: time of the frame, if the frame
        rate is not constant; it is used for prediction. damaged: see Frame; targets that first appear in a damaged
        frame need more detections.
        Raises InputError for other shapes, boxes without a size, values that are not finite, and a frame number that is
        not above the last number.
        """
        is_moving = isinstance(detections, Detections) and detections.kind == MOTION
        is_array = not isinstance(detections, Detections)
        detections = _check_detections(detections, bool(self._certain or self._motion or is_moving))
        if is_array and len(self._tried) < _TRIED:
            self._tried = np.concatenate([self._tried, detections.box_px])
            if are_corners(self._tried, self.size):
                raise InputError("boxes look like xyxy; wanted x, y, width, height: boxes[:, 2:] -= boxes[:, :2]")
        if camera_motion is not None:
            camera_motion = np.asarray(camera_motion, float)
            if camera_motion.shape != (3, 3) or not np.isfinite(camera_motion).all():
                raise InputError(f"camera_motion must be a finite (3, 3) homography; got shape {camera_motion.shape}")
        image = None if image is None else as_picture(image, name="image")
        expected = 1 if self._frame is None else self._frame + (interval or self.interval)
        number = expected if frame is None else frame
        if self._frame is not None and number <= self._frame:
            raise InputError(f"frame {number} follows frame {self._frame}; give the frames in order, each once")
        self._at = self._moment(number, time_s)
        self._frame, self._time_s = number, time_s
        if self._tracker is None:
            settings, track = self.settings, self.settings.track
            if self._motion is None:
                self._motion = detections.kind == MOTION
            if self._motion:  # blobs may be parts of targets, joined targets, or include shadows
                own = {"scatter": track.own_scatter, "size_scatter": track.own_size_scatter}
                settings = settings.model_copy(update={"track": track.model_copy(update=own)})
            if self._in_batches:
                from torchvision_dddas.tracking.torch_source_tracker import TorchSourceTracker

                self._tracker = TorchSourceTracker(settings, self.interval, self.size)
            elif track.mode == "paper":
                self._tracker = SourceTracker(settings, self.interval, self.size)
            else:
                is_told = self._lag is not None
                self._tracker = ScoreTracker(settings, self.interval, self.size, self._motion, by_birth=is_told)
        self._given.append(detections)
        if self._motion or self._certain:
            detections = replace(detections, score=np.ones(len(detections)))
        appearance = None if image is None else self._histograms(image, detections.box_px)
        if isinstance(self._tracker, ScoreTracker):
            settled = self._tracker.feed(number, detections, camera_motion, appearance, self._at, damaged)
            return [*self._as_given(settled), *([] if self._lag is None else [self._preview()])]
        return self._as_given(self._tracker.feed(number, detections, camera_motion, appearance))

    def flush(self) -> list[Tracks]:
        """Return the frames that are not settled yet, at the end of a run."""
        return self._as_given(self._tracker.end()) if self._tracker is not None else []

    @property
    def appearance_s(self) -> float:
        """Computing time of histograms so far, seconds. It may include histograms of earlier frames."""
        return self._histograms_s + getattr(self._tracker, "histograms_s", 0.0)

    def _moment(self, number: int, time_s: float) -> float:
        """Return the number that the frame would have at a constant frame rate."""
        if self._frame is None:
            return float(number)
        lapse = (time_s - self._time_s) * (self._rate_hz or math.nan)
        by_number = number - self._frame
        # Time stamps are often rounded to milliseconds.
        is_regular = math.isnan(lapse) or abs(lapse - by_number) <= _ROUNDED or lapse <= 0
        return self._at + (by_number if is_regular else lapse)

    def _histograms(self, image: np.ndarray, box_px: np.ndarray) -> Callable[[], np.ndarray]:
        boxes = PicturedBoxes(image, box_px)
        if self._in_batches:
            return boxes
        is_source = self.settings.track.mode == "paper"

        def compute() -> np.ndarray:
            start = time.perf_counter()
            found = boxes() if is_source else strip_histograms(image, box_px)
            self._histograms_s += time.perf_counter() - start
            return found

        return compute

    def _preview(self) -> Tracks:
        """Return the provisional tracks of the frame added last."""
        assert isinstance(self._tracker, ScoreTracker)
        tracks, given = self._tracker.preview(), self._given[-1]
        row = tracks.row
        classes = {"label": given.label[row], "class_id": given.class_id[row]}
        self._told[tracks.frame] = tracks = replace(tracks, score=given.score[row], **classes)
        return tracks

    def _as_given(self, settled: list[Tracks]) -> list[Tracks]:
        """Return the tracks with the scores and classes of their detections. Filled gaps have the last known class."""
        found = []
        for tracks in settled:
            given, score = self._given.popleft(), np.array(tracks.score, float)
            is_detection = tracks.row >= 0
            score[is_detection] = given.score[tracks.row[is_detection]]
            classes = []
            for identity, row in zip(tracks.identity.tolist(), tracks.row.tolist(), strict=True):
                seen = self._classes.pop(identity, ("", -1))
                classes.append((given.label[row], given.class_id[row]) if row >= 0 else seen)
                self._classes[identity] = classes[-1]
            while len(self._classes) > _MOST_CLASSES:
                del self._classes[next(iter(self._classes))]
            label = np.array([name for name, _ in classes], object)
            number = np.array([number for _, number in classes], np.int64)
            found.append(replace(tracks, score=score, label=label, class_id=number))
            if (told := self._told.pop(tracks.frame, None)) is not None:
                rows = dict(zip(tracks.identity.tolist(), tracks.row.tolist(), strict=True))
                before = zip(told.identity.tolist(), told.row.tolist(), strict=True)
                found[-1] = replace(found[-1], corrects=tuple(k for k, row in before if rows.get(k) != row))
        return found


def _check_detections(given: "Detections | np.ndarray | tuple[np.ndarray, np.ndarray]", certain: bool) -> Detections:
    if isinstance(given, Detections):
        box, score = given.box_px, given.score
    else:
        refuse_table(given)
        has_scores = isinstance(given, tuple) and len(given) == 2
        try:
            box = np.asarray(given[0] if has_scores else given, float)
            score = np.asarray(given[1], float) if has_scores else np.ones(len(box))
        except (TypeError, ValueError):
            raise InputError("detections must be a Detections record, (N, 4) boxes, or (boxes, scores)") from None
        box = box.reshape(0, 4) if box.size == 0 else box
    if box.ndim != 2 or box.shape[1] != 4:
        raise InputError(f"boxes must be (N, 4), x, y, width, height in pixels; got {box.shape}")
    if score.shape != (len(box),):
        raise InputError(f"there must be one score for each box, ({len(box)},); got {score.shape}")
    check_boxes(box, score, certain)
    if isinstance(given, Detections):
        return given
    return Detections(box, score, box[:, 2] * box[:, 3], kind="given")


class FrameTracker:
    """A tracker of whole frame records, which keeps each record until its tracks are settled."""

    def __init__(
        self,
        settings: Settings,
        interval: int,
        size: tuple[float, float] | None,
        motion: bool | None = False,
        certain: bool = False,
        pictures: bool = True,
        backend: str = "onboard",
        rate_hz: float | None = None,
        lag: int | None = None,
    ) -> None:
        """Like Tracker. pictures: whether settled frames keep their pictures, which take most of the memory."""
        self.interval, self.pictures = interval, pictures
        self.tracker = Tracker(
            settings,
            interval=interval,
            size=size,
            motion=motion,
            certain=certain,
            backend=backend,
            rate_hz=rate_hz,
            lag=lag,
        )
        self._waiting: deque[list[TrackedFrame]] = deque()  # frames that are not settled, each with its repeats
        self._settled: TrackedFrame | None = None  # the frame that was settled last
        self._picture = 0  # number of the frame whose picture was added last
        paper = settings.paper
        self._in_force = {  # current values by the name in an Adjustment
            WEIGHT: paper.weight if paper.rule == "fixed" else 1.0,
            LOOKED: float(settings.track.appearance == "always"),
        }

    def update(self, given: TrackedFrame) -> Iterator[TrackedFrame]:
        """Add a frame without tracks, and yield the frames that are now settled, and with lag=0 the frame itself.

        A frame that repeats the frame added before is not tracked; it gets a copy of that frame's settled tracks.
        """
        if given.repeats and given.repeats == self._picture:
            if self._waiting:
                self._waiting[-1].append(self._without_picture(given))
            elif self._settled is not None:
                yield self._copied(self._without_picture(given), self._settled)
            return
        self._picture = given.repeats or given.number
        frame, before, start = given.frame, self.tracker.appearance_s, time.perf_counter()
        interval = max(self.interval, frame.skipped + 1) if frame is not None and frame.skipped else None
        image = frame.image if frame is not None else None
        time_s = math.nan if frame is None else frame.time_s
        settled = self.tracker.update(
            given.detections,
            given.now_from_before,
            image=image,
            frame=given.number,
            interval=interval,
            time_s=time_s,
            damaged=frame is not None and frame.damaged,
        )
        appearance_s = self.tracker.appearance_s - before
        seconds = {"appearance": appearance_s, "track": time.perf_counter() - start - appearance_s}
        self._waiting.append([replace(self._without_picture(given), seconds=given.seconds | seconds)])
        yield from self._settle(settled)

    def flush(self) -> Iterator[TrackedFrame]:
        """Yield the remaining frames at the end."""
        yield from self._settle(self.tracker.flush())

    def _settle(self, settled: list[Tracks]) -> Iterator[TrackedFrame]:
        for tracks in settled:
            if tracks.provisional:  # its adjustments come with the settled frame
                yield replace(self._waiting[-1][0], tracks=tracks, adjustments=())
                continue
            given, *repeats = self._waiting.popleft()
            self._settled = replace(given, tracks=tracks, adjustments=given.adjustments + self._changes(tracks))
            yield self._settled
            for repeat in repeats:
                yield self._copied(repeat, self._settled)

    def _without_picture(self, given: TrackedFrame) -> TrackedFrame:
        if self.pictures or given.frame is None:
            return given
        return replace(given, frame=without_picture(given.frame))

    @staticmethod
    def _copied(repeat: TrackedFrame, settled: TrackedFrame) -> TrackedFrame:
        """Return a repeated frame with the tracks of the settled frame that it repeats."""
        tracks = replace(settled.tracks, frame=repeat.number, appearance=None)
        return replace(repeat, detections=settled.detections, tracks=tracks)

    def _changes(self, tracks: Tracks) -> tuple[Adjustment, ...]:
        """Return the adjustments of a frame's use of appearance."""
        use = tracks.appearance
        if use is None:
            return ()
        name, new = (LOOKED, float(use.looked)) if np.isnan(use.weight) else (WEIGHT, use.weight)
        old, self._in_force[name] = self._in_force[name], new
        return () if new == old else (Adjustment(tracks.frame, name, old, new, use.cause),)


def without_picture(frame: Frame) -> Frame:
    """Return the frame with a black picture of the same size that takes no memory."""
    return replace(frame, image=np.broadcast_to(np.uint8(0), frame.image.shape))


class SceneTracker:
    """Tracks the targets of a clip's scenes at frames 1, 1 + interval, ... It chains the scenes' registrations."""

    def __init__(
        self,
        settings: Settings,
        interval: int,
        size: tuple[int, int],
        pictures: bool = True,
        backend: str = "onboard",
        rate_hz: float | None = None,
        motion: bool | None = True,
        certain: bool = False,
        lag: int | None = None,
    ) -> None:
        """Start without scenes. The arguments are those of FrameTracker; the default is motion = True."""
        self._interval = interval
        self._tracker = FrameTracker(settings, interval, size, motion, certain, pictures, backend, rate_hz, lag)
        self._steps: list[np.ndarray] = []
        self._adjustments: tuple[Adjustment, ...] = ()
        self._seconds: dict[str, float] = {}

    def update(self, scene: Scene) -> Iterator[TrackedFrame]:
        """Add the next scene, and yield the frames that are now settled."""
        # Leave out unknown steps: the product of the other steps is more accurate than no motion at all.
        if scene.step is not None and scene.step.reliable:
            self._steps.append(scene.step.later_from_earlier)
        self._adjustments += scene.adjustments
        for stage, spent in scene.seconds.items():
            self._seconds[stage] = self._seconds.get(stage, 0.0) + spent
        number = scene.frame.number
        if not is_sampled(number, self._interval):
            return
        tracks = Tracks(number)
        given = TrackedFrame(number, scene.frame, scene.detections, tracks, cause=scene.cause, repeats=scene.repeats)
        motion = chain(self._steps) if self._steps else None
        given = replace(given, now_from_before=motion, adjustments=self._adjustments, seconds=self._seconds)
        self._steps, self._adjustments, self._seconds = [], (), {}
        yield from self._tracker.update(given)

    def flush(self) -> Iterator[TrackedFrame]:
        """Yield the remaining frames at the end."""
        yield from self._tracker.flush()


def track_scenes(
    scenes: Iterable[Scene],
    settings: Settings,
    interval: int,
    size: tuple[int, int],
    pictures: bool = True,
    backend: str = "onboard",
    rate_hz: float | None = None,
) -> Iterator[TrackedFrame]:
    """Track the targets of a clip's scenes by a `SceneTracker`. backend, rate_hz: see `Tracker`."""
    tracker = SceneTracker(settings, interval, size, pictures, backend, rate_hz)
    for scene in scenes:
        yield from tracker.update(scene)
    yield from tracker.flush()


class _TableTracker(FrameTracker):
    """Tracks the rows of a table."""

    def __init__(
        self,
        table: DetectionTable,
        settings: Settings,
        interval: int,
        size: tuple[float, float] | None,
        backend: str = "onboard",
        rate_hz: float | None = None,
    ) -> None:
        super().__init__(settings, interval, size, table.own, table.certain, backend=backend, rate_hz=rate_hz)
        self.table = table

    def add(
        self,
        numbers: Iterable[int],
        frame: Frame | None = None,
        motion: np.ndarray | None = None,
        cause: str = "",
        seconds: dict[str, float] | None = None,
    ) -> Iterator[TrackedFrame]:
        """Add the table's rows of the given frames, and yield the frames that are now settled."""
        for number in numbers:
            lines = self.table.line[self.table.rows(number)]
            rows, tracks = self.table.at(number), Tracks(number)
            yield from self.update(TrackedFrame(number, frame, rows, tracks, motion, lines, cause, (), seconds or {}))


def track_clip(
    source: Source,
    table: DetectionTable,
    engine: Registrar,
    settings: Settings,
    interval: int,
    backend: str = "onboard",
) -> Iterator[TrackedFrame]:
    """Track a table of detections along its clip, at frames 1, 1 + interval, ...

    The camera's motion is estimated between successive readable pictures. Frames that cannot be read, or lie after the
    clip's end, are tracked without a picture. backend: see `Tracker`.
    """
    rate_hz = getattr(source, "rate_hz", None)
    tracker = _TableTracker(table, settings, interval, source.size, backend, rate_hz)
    camera, number = CameraMotion(engine), 1
    unread = "the frame could not be read"
    start = time.perf_counter()
    for frame in source.every(interval):
        read = time.perf_counter()
        yield from tracker.add(range(number, frame.number, interval), cause=unread)
        number = frame.number + interval
        motion, cause = camera.update(frame.image)
        seconds = {"read": read - start, "register": time.perf_counter() - read}
        yield from tracker.add([frame.number], frame, motion, cause, seconds)
        start = time.perf_counter()
    yield from tracker.add(range(number, max(source.last, table.last) + 1, interval), cause=unread)
    yield from tracker.flush()


def track_table(table: DetectionTable, settings: Settings, interval: int) -> Iterator[TrackedFrame]:
    """Track the rows of a table from its first to its last frame, without camera motion and without appearance.

    Frames without rows are yielded without detections. In a long gap, frames are skipped from the end of all tracks to
    the frame before the next row, so that one stray row does not cause a million empty frames.
    """
    if not len(table):
        return
    tracker = _TableTracker(table, settings, interval, table.extent)
    forgotten = settings.track.memory_frames + (settings.track.hits + 3) * interval
    start, last = table.first + -(table.first - 1) % interval, table.last - (table.last - 1) % interval
    for row in np.union1d(table.frame[is_sampled(table.frame, interval)], [last]).tolist():
        quiet = range(start, min(row, start + forgotten), interval)
        yield from tracker.add(quiet)
        yield from tracker.add(range(max(start + len(quiet) * interval, row - interval), row + 1, interval))
        start = row + interval
    yield from tracker.flush()
