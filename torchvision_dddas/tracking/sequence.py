"""Identities along a clip: from its own scenes, from its pictures and a table of detections, or from a table alone.

Every function takes each `interval`-th frame, 1, 1 + interval, ..., and yields them in order as they are settled.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.detection import Engine
from torchvision_dddas.geometry import chain
from torchvision_dddas.tracking.camera_motion import Camera
from torchvision_dddas.tracking.tracker import Tracker
from torchvision_dddas.types import (
    Adjustment,
    Detections,
    DetectionTable,
    Frame,
    Scene,
    Source,
    TrackedFrame,
    Tracks,
    is_sampled,
)

if TYPE_CHECKING:
    from torchvision_dddas.tracking.source_tracker import PaperTracker


def follow_scenes(
    scenes: Iterable[Scene], settings: Settings, interval: int, size: tuple[int, int], pictures: bool = True
) -> Iterator[TrackedFrame]:
    """A clip's own detections. The registrations from frame to frame are chained over the interval.

    Each counts as certain: its score grades its contrast, and it has been confirmed over several frames already.
    pictures: as `Follower` has it.
    """
    follower = Follower(_for_own(settings), interval, size, certain=True, pictures=pictures)
    steps: list[np.ndarray | None] = []
    adjustments: tuple[Adjustment, ...] = ()
    seconds: Counter[str] = Counter()
    for scene in scenes:
        steps.append(scene.step.later_from_earlier if scene.step is not None and scene.step.reliable else None)
        adjustments += scene.adjustments
        seconds.update(scene.seconds)
        number = scene.frame.number
        if not is_sampled(number, interval):
            continue
        # A step that is not known counts as none: the others are nearer to the truth than a camera that stood still.
        known = [step for step in steps if step is not None]
        now_from_before = chain(known) if known else None
        yield from follower.take(
            TrackedFrame(
                number,
                scene.frame,
                scene.detections,
                Tracks(number),
                now_from_before,
                cause=scene.cause,
                adjustments=adjustments,
                seconds=dict(seconds),
            )
        )
        steps, adjustments, seconds = [], (), Counter()
    yield from follower.end()


def _for_own(settings: Settings) -> Settings:
    """With the scatter of blobs, which come in parts, with shadows and joined, in place of that of whole targets."""
    parameters = settings.track
    own = {
        "scatter": parameters.own_scatter,
        "size_scatter": parameters.own_size_scatter,
        "births": parameters.own_births,
    }
    return settings.model_copy(update={"track": parameters.model_copy(update=own)})


def follow_clip(
    source: Source, table: DetectionTable, engine: Engine, settings: Settings, interval: int
) -> Iterator[TrackedFrame]:
    """A table of detections along its clip. Frames that cannot be read, or lie after its end, are fed without picture.

    The camera's motion is taken from one picture to the next one that can be read.
    """
    follower, camera, number = _follower(table, settings, interval, source.size), Camera(engine), 1
    start = time.perf_counter()
    for frame in source.every(interval):
        read = time.perf_counter()
        for missing in range(number, frame.number, interval):
            yield from follower.take(_unread(table, missing))
        number = frame.number + interval
        now_from_before, cause = camera.step(frame.image)
        seconds = {"read": read - start, "register": time.perf_counter() - read}
        yield from follower.take(_of(table, frame.number, frame, now_from_before, cause, seconds))
        start = time.perf_counter()
    for missing in range(number, max(source.last, table.last) + 1, interval):
        yield from follower.take(_unread(table, missing))
    yield from follower.end()


def follow_table(table: DetectionTable, settings: Settings, interval: int) -> Iterator[TrackedFrame]:
    """A table alone: no registration, no appearance. From its first to its last row, frames without rows are empty.

    A stretch of these is left out from where all tracks are forgotten and settled to the frame before the next row.
    """
    follower = _follower(table, settings, interval, table.extent)
    forgotten = settings.track.memory_frames + (settings.track.hits + 3) * interval
    for number in _frames(table, interval, forgotten):
        yield from follower.take(_of(table, number))
    yield from follower.end()


def _frames(table: DetectionTable, interval: int, forgotten: int) -> Iterator[int]:
    """Each `interval`-th frame from the first to the last row, but for most of a stretch without rows.

    Of that come those of its first `forgotten` frames and its last one: one stray row must not cost a million looks.
    """
    if not len(table):
        return
    start, last = table.first + -(table.first - 1) % interval, table.last - (table.last - 1) % interval
    for row in np.union1d(table.frame[is_sampled(table.frame, interval)], [last]).tolist():
        quiet = range(start, min(row, start + forgotten), interval)
        yield from quiet
        yield from range(max(start + len(quiet) * interval, row - interval), row + 1, interval)
        start = row + interval


def _follower(table: DetectionTable, settings: Settings, interval: int, size: tuple[float, float] | None) -> "Follower":
    """A table that `dddas detect` wrote is followed as the clip's own detections are."""
    return Follower(_for_own(settings) if table.own else settings, interval, size, table.certain)


def _of(
    table: DetectionTable,
    number: int,
    frame: Frame | None = None,
    now_from_before: np.ndarray | None = None,
    cause: str = "",
    seconds: dict[str, float] | None = None,
) -> TrackedFrame:
    lines = table.line[table.rows(number)]
    return TrackedFrame(
        number, frame, table.at(number), Tracks(number), now_from_before, lines, cause, seconds=seconds or {}
    )


def _unread(table: DetectionTable, number: int) -> TrackedFrame:
    return _of(table, number, cause="the frame could not be read")


class Follower:
    """The tracker, and the frames it was fed that it has not settled yet."""

    def __init__(
        self,
        settings: Settings,
        interval: int,
        size: tuple[float, float] | None,
        certain: bool = False,
        pictures: bool = True,
    ) -> None:
        """size: (width, height) of the pictures, None where there are none. certain: feed the score 1 for all.

        pictures: whether the frames that it yields still have theirs; those that wait are most of a long run's memory.
        """
        self.interval = interval
        self.tracker = _tracker(settings, interval, size)
        self.likeness = _likeness(settings)
        self.certain, self.pictures = certain, pictures
        self.spent = 0.0  # seconds on pictures, this frame's and, where a doubt asks for it later, the one before
        self.waiting: deque[TrackedFrame] = deque()

    def take(self, followed: TrackedFrame) -> Iterator[TrackedFrame]:
        """Feed a frame, whose tracks are not known yet; yields the frames that are settled by it."""
        detections, frame, before = followed.detections, followed.frame, self.spent
        if self.certain:
            detections = replace(detections, score=np.ones(len(detections)))

        def appearance() -> np.ndarray:
            assert frame is not None
            start = time.perf_counter()
            found = self.likeness(frame.image, detections.box_px)
            self.spent += time.perf_counter() - start
            return found

        start = time.perf_counter()
        apart = max(self.interval, frame.skipped + 1) if frame is not None and frame.skipped else None
        settled = self.tracker.feed(
            followed.number, detections, followed.now_from_before, appearance if frame is not None else None, apart
        )
        spent = self.spent - before
        took = {"appearance": spent, "track": time.perf_counter() - start - spent}
        if frame is not None and not self.pictures:
            followed = replace(followed, frame=without_picture(frame))
        self.waiting.append(replace(followed, seconds=followed.seconds | took))
        yield from self._settle(settled)

    def end(self) -> Iterator[TrackedFrame]:
        """The frames that were still waiting."""
        yield from self._settle(self.tracker.end())

    def _settle(self, settled: list[Tracks]) -> Iterator[TrackedFrame]:
        for tracks in settled:
            followed = self.waiting.popleft()
            assert followed.number == tracks.frame, "the tracker settles frames in the order in which they were fed"
            yield replace(followed, tracks=_as_given(tracks, followed.detections))


def without_picture(frame: Frame) -> Frame:
    """The frame with a black picture of the same size in place of its own, which takes no memory."""
    return replace(frame, image=np.broadcast_to(np.uint8(0), frame.image.shape))


def _as_given(tracks: Tracks, given: Detections) -> Tracks:
    """The tracks with the scores that were given, where they are detections; their boxes may have been smoothed."""
    seen = tracks.row >= 0
    score = np.array(tracks.score, float)
    score[seen] = given.score[tracks.row[seen]]
    return replace(tracks, score=score)


def _tracker(settings: Settings, interval: int, size: tuple[float, float] | None) -> "Tracker | PaperTracker":
    if settings.track.mode == "paper":
        from torchvision_dddas.tracking.source_tracker import PaperTracker

        return PaperTracker(settings, interval, size)
    return Tracker(settings, interval, size)


def _likeness(settings: Settings) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """What the boxes of a picture look like: (image, (N, 4) boxes) -> (N, D)."""
    if settings.track.mode == "paper":
        from torchvision_dddas.tracking.histograms import rgb_histograms

        return rgb_histograms
    from torchvision_dddas.tracking.appearance import strips

    return strips
