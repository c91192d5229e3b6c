"""The motion detector takes frames of a moving camera and returns scenes with targets a few frames later."""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from torchvision_dddas.chain import View, Window, near_gaps
from torchvision_dddas.config import Settings, check_settings, uses_tracklets
from torchvision_dddas.detection.candidates import Candidates
from torchvision_dddas.detection.engine import Engine
from torchvision_dddas.detection.fragments import Ground, join_fragments
from torchvision_dddas.detection.frame_buffer import FrameBuffer, Slot
from torchvision_dddas.detection.interval import (
    choose_pairs,
    look_ahead,
    settling_delay,
    small_gap_follows_distance,
    with_logged_focal,
)
from torchvision_dddas.detection.interval_controller import IntervalController
from torchvision_dddas.detection.motion_history import MotionHistory
from torchvision_dddas.detection.observation import (
    Target,
    build_detections,
    draw_blobs,
    draw_chosen,
    observe,
)
from torchvision_dddas.detection.opencv_engine import OpenCVEngine
from torchvision_dddas.detection.repeats import RepeatRule
from torchvision_dddas.detection.small_tracks import SmallTracks, find_small_boxes
from torchvision_dddas.detection.tracklet_scores import BLOB, BLOB_SIZED, BLOB_TINY, choose, score_tracklets
from torchvision_dddas.detection.tracklets import LOOKS_AFTER, LOOKS_BEFORE, follow
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import read_ignored
from torchvision_dddas.runtime import wants_torch
from torchvision_dddas.types import Adjustment, Frame, Registration, Scene, Telemetry, as_picture

Retune = Callable[[Frame], tuple[Settings, tuple[Adjustment, ...]]]
"""Called before each frame. It returns the settings from this frame on, and the adjustments that it made."""

_MIN_FRAMES = 3  # the fewest frames that make a window
_JUDGED_FRAMES = 5  # frames that the search for small targets uses: the frame, two before and two after it
_TORCH_BATCH = 8
# Most repeats of a picture that are held back until a different picture comes: for recordings, and for live sources,
# whose user waits for the results.
_MOST_REPEATS, _MOST_REPEATS_LIVE = 1000, 3
_STILL = Registration(np.eye(3), 0, 0, 0.0, 0.0)


def detect_motion(
    source: Iterable[Frame | np.ndarray],
    settings: Settings | None = None,
    backend: str | Engine = "auto",
    telemetry: Telemetry | None = None,
    batch: int | None = None,
    retune: Retune | None = None,
) -> Iterator[Scene]:
    """Yield a scene for every frame number of a source, in order. The other arguments are those of `MotionDetector`.

    source: frames or images. It may have these attributes: `rate_hz` (default 10); `count`, the number of frames;
    `last`, the number of its last frame, even if that frame could not be read; and a method `telemetry`, which returns
    the telemetry reported so far and replaces the argument `telemetry`. retune: called before each frame; see `Retune`.
    Raises InputError for fewer than three frames, and for telemetry that does not overlap the source in time.
    """
    rate_hz, count = getattr(source, "rate_hz", 10.0), getattr(source, "count", None)
    if telemetry is not None and isinstance(count, int) and count:  # the `count` of a list is a method
        telemetry.check_overlap((count - 1) / rate_hz)
    detector = MotionDetector(settings, backend=backend, rate_hz=rate_hz, telemetry=telemetry, batch=batch)
    live_telemetry = getattr(source, "telemetry", None)
    if live_telemetry is not None:  # the source is controlled by the results, so each frame needs its result at once
        detector._most_repeats = 0
    for image in source:
        frame = detector._as_frame(image)
        if live_telemetry is not None:
            detector.telemetry = live_telemetry()
        adjustments: tuple[Adjustment, ...] = ()
        if retune is not None:
            new, adjustments = retune(frame)
            detector.change_settings(new)
        yield from detector._settle(frame, adjustments)
    if telemetry is not None:
        telemetry.check_overlap(detector._last.time_s)
    yield from detector._settle_rest(getattr(source, "last", 0))


def load_engine(backend: str, settings: Settings) -> Engine:
    """Return the engine for a backend: `torch`, `onboard` or `auto`.

    `auto` is torch if it is installed, and onboard for settings at half resolution, which torch does not support.
    Raises InputError for an unknown or missing backend (see `wants_torch`), and for torch at half resolution.
    """
    if not wants_torch(backend) or (backend == "auto" and (settings.registration.halved or settings.difference.halved)):
        return OpenCVEngine(settings)
    from torchvision_dddas.detection.torch_engine import TorchEngine

    return TorchEngine(settings)


def check_length(frames: int) -> None:
    """Raise InputError if a clip with this number of frames is too short for a window."""
    if frames < _MIN_FRAMES:
        few = "no frame" if frames == 0 else f"{frames} frame" + "s" * (frames > 1)
        raise InputError(f"the clip has {few} that can be read; a window needs at least {_MIN_FRAMES}")


class MotionDetector:
    """Finds targets that move against the background in the frames of a moving camera.

    Pass every frame in order to `update`. It returns the scenes that no later frame can change, at most two detection
    intervals after their frame. At the end `flush` returns the remaining scenes. A frame that repeats the frame before
    gets a copy of that frame's scene, and does not count in the interval.

    >>> coarse = np.random.default_rng(0).integers(0, 256, (30, 40), np.uint8)
    >>> ground = coarse.repeat(4, 0).repeat(4, 1)
    >>> detector, scenes = td.MotionDetector(td.load_settings("fast"), backend="onboard"), []
    >>> for k in range(6):  # a camera that pans by 1 px a frame
    ...     scenes += detector.update(np.ascontiguousarray(ground[:, k : k + 128]))
    >>> len(scenes), detector.delay_frames
    (4, 2)
    >>> scenes += detector.flush()
    >>> len(scenes), float(scenes[2].camera_motion[0, 2].round())
    (6, -1.0)
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        backend: str | Engine = "auto",
        rate_hz: float = 10.0,
        telemetry: Telemetry | None = None,
        batch: int | None = None,
    ) -> None:
        """Set up the detector. backend: auto, onboard, torch, or an engine. rate_hz: frames a second.

        telemetry: controls the interval and the gates. batch: windows that the engine computes at once, by default 8
        for torch and 1 otherwise. The scenes do not depend on it.
        """
        self.settings = check_settings(settings)
        self.engine = load_engine(backend, self.settings) if isinstance(backend, str) else backend
        self.batch = batch or (_TORCH_BATCH if self.engine.name == "torch" else 1)
        if not rate_hz > 0 or not isinstance(telemetry, Telemetry | None):
            got = f"{rate_hz} and {type(telemetry).__name__}"
            raise InputError(
                f"rate_hz must be positive and telemetry must come from td.read_telemetry(path), got {got}"
            )
        self.rate_hz = rate_hz
        self._controller = IntervalController(self.settings, rate_hz, telemetry)
        self._buffer = FrameBuffer()
        self._memory = _memory_frames(self.settings, telemetry is not None)
        # Frames below each index are registered, observed, have targets, are in the history, or were returned.
        self._registered = self._observed = self._drawn = self._remembered = self._emitted = 0
        self._last = Frame(0, 0.0, np.zeros((0, 0), np.uint8))  # the latest frame that came
        self._returned = self._last  # the frame of the latest scene that was returned
        self._skipped = 0  # frames so far that were skipped on purpose or are repeats
        self._passed = 0  # frames since the latest slot that were skipped on purpose or are repeats
        self._repeats, self._most_repeats = RepeatRule(), _MOST_REPEATS
        self._held: tuple[Adjustment, ...] = ()  # adjustments that came with repeated frames
        self._ended = False
        self._mask: tuple[str, np.ndarray | None] | None = None
        self._small_tracks = SmallTracks(self.settings.small, uses_tracklets(self.settings))
        self._history = MotionHistory(self.settings.history.duration_frames)

    @property
    def interval(self) -> int:
        """The current detection interval, frames."""
        return self._controller.interval

    @property
    def delay_frames(self) -> int:
        """Delay in frames from a frame to the return of its scene, at the current interval: at most two intervals.

        Batches of several windows make scenes wait for whole batches. The value is then the longest wait. Repeated
        pictures add to it.
        """
        used = self._controller.distance.settings
        batches = math.ceil((look_ahead(self.interval, used) - 1) / self.batch) + 1
        return self.batch * batches + settling_delay(self.interval, used)

    @property
    def telemetry(self) -> Telemetry | None:
        """The telemetry that controls the interval and the gates. It may be replaced between two frames."""
        return self._controller.telemetry

    @telemetry.setter
    def telemetry(self, telemetry: Telemetry | None) -> None:
        self._controller.telemetry = telemetry

    def update(self, frame: Frame | np.ndarray, *, adjustments: tuple[Adjustment, ...] = ()) -> list[Scene]:
        """Take one frame, and return the scenes that no later frame can change, oldest first. Often there are none.

        frame: a Frame, or an image (H, W) or (H, W, 3) BGR uint8, which is taken as the next frame.
        adjustments: changes of parameters before this frame, which its scene records.
        Raises InputError for an image of another type or shape, and if its size differs from the images before.
        """
        return list(self._settle(self._as_frame(frame), adjustments))

    def flush(self, last_number: int = 0) -> list[Scene]:
        """End the clip, and return all remaining scenes.

        last_number: number of the clip's last frame, even if that frame could not be read.
        Raises InputError if there were fewer than three frames.
        """
        return list(self._settle_rest(last_number))

    def change_settings(self, settings: Settings) -> None:
        """Use other settings from the next frame on. Small tracks and the motion history are kept."""
        if settings is self.settings:
            return
        self.settings = self.engine.parameters = settings
        self._memory = max(self._memory, _memory_frames(settings, self.telemetry is not None))
        self._controller.change_settings(settings)

    def _as_frame(self, frame: Frame | np.ndarray) -> Frame:
        image = as_picture(frame.image if isinstance(frame, Frame) else frame)
        size, before = image.shape[1::-1], self._last.image.shape[1::-1]
        if self._total and size != before:
            raise InputError(
                f"a frame of {size[0]}x{size[1]} follows frame {self._last.number} of {before[0]}x{before[1]}; all "
                "frames of a clip must have one size; use a new MotionDetector for frames of another size"
            )
        if isinstance(frame, Frame):
            return frame if image is frame.image else replace(frame, image=image)
        return Frame(self._last.number + 1, self._last.number / self.rate_hz, image)

    def _settle(self, frame: Frame, adjustments: tuple[Adjustment, ...] = ()) -> Iterator[Scene]:
        """Take one frame as `update` does, but yield one scene at a time."""
        start = time.perf_counter()
        if not self._total:
            self.change_settings(with_logged_focal(self.settings, self.telemetry, frame.image.shape[1::-1])[0])
        view = self.engine.prepare(frame.image)
        view.ignored = self._ignored(view.size)
        repeats = self._buffer[self._total - 1].repeats if self._total else []
        most = _MOST_REPEATS_LIVE if np.isfinite(frame.taken_s) else self._most_repeats
        if self._repeats.is_repeat(view.grey) and len(repeats) < most:
            self._last = replace(frame, image=self._last.image)  # all repeats share one picture in memory
            repeats.append(self._last)
            self._passed += frame.skipped + 1
            self._held += adjustments
            return
        self._add(frame, view, self._held + adjustments, time.perf_counter() - start)
        if self._total - self._registered > self.batch:
            yield from self._advance()

    def _ignored(self, size: tuple[int, int]) -> np.ndarray | None:
        """Return (H, W) uint8, 255 at the pixels that settings exclude, or None. Raises InputError for a bad mask."""
        if self._mask is None or self._mask[0] != self.settings.difference.ignore:
            file = self.settings.difference.ignore
            self._mask = file, read_ignored(Path(file), size) if file else None
        return self._mask[1]

    def _add(self, frame: Frame, view: View, adjustments: tuple[Adjustment, ...], prepare_s: float) -> None:
        passed, self._passed, self._held = self._passed + frame.skipped, 0, ()
        self._skipped += passed
        self._last, look, seconds = frame, frame.number - self._skipped, {"prepare": prepare_s}
        self._buffer.append(Slot(frame, view, look, passed, self._controller.distance, adjustments, seconds))

    def _settle_rest(self, last_number: int = 0) -> Iterator[Scene]:
        """End the clip as `flush` does, but yield one scene at a time."""
        if 0 < self._total < _MIN_FRAMES:  # the clip has nothing but repeated frames: count each copy as a look
            last, few = self._buffer[self._total - 1], _MIN_FRAMES - self._total
            repeats, last.repeats, self._passed = last.repeats, [], 0
            for frame in repeats[:few]:
                self._add(frame, last.view, (), 0.0)
            self._buffer[self._total - 1].repeats += repeats[few:]
        check_length(self._total)
        self._ended = True
        yield from self._advance()
        yield from self._fill_gap(last_number + 1, None, self.interval)

    def _advance(self) -> Iterator[Scene]:
        self._register()
        while ready := self._find_ready():
            self._observe(ready)
            for index in ready:
                if self.settings.small.on:
                    self._follow_small(index)
                self._observed = index + 1
                self._draw()
                yield from self._emit()  # after every frame, so that the scenes do not depend on the batch

    @property
    def _total(self) -> int:
        return self._buffer.total

    def _register(self) -> None:
        """Register all successive frames that are in the buffer and not yet registered."""
        slots = self._buffer.span(self._registered, self._total)
        if len(slots) < 2:
            return
        start = time.perf_counter()
        steps: list[Registration] = []
        for i in range(0, len(slots) - 1, self.batch):
            part = slots[i : i + self.batch + 1]
            steps += self.engine.register([(a.view, b.view) for a, b in pairwise(part)])
        self._buffer.set_steps(self._registered, steps, (time.perf_counter() - start) / len(steps))
        self._registered += len(steps)

    def _find_ready(self) -> list[int]:
        """Return the indices of up to `batch` frames whose windows are complete."""
        ready: list[int] = []
        for index in range(self._observed, min(self._observed + self.batch, self._total)):
            slot = self._buffer[index]
            if not slot.interval:
                if slot.step is None and not self._ended:
                    break
                if self.telemetry is not None:
                    self._memory = max(self._memory, _memory_frames(self.settings, True))
                self._controller.steer(self._buffer, index)
            if not self._ended and self._registered < index + look_ahead(slot.interval, slot.distance.settings):
                break
            ready.append(index)
        # While the clip runs, return whole batches only: a batching engine takes as long for four windows as for eight.
        return ready if self._ended or len(ready) == self.batch else []

    def _observe(self, indices: list[int]) -> None:
        start = time.perf_counter()
        made = [(index, window) for index in indices if (window := self._build_window(index)) is not None]
        foregrounds = self.engine.foreground([window for _, window in made]) if made else []
        seconds = (time.perf_counter() - start) / max(len(made), 1)
        for (index, window), foreground in zip(made, foregrounds, strict=True):
            slot = self._buffer[index]
            start = time.perf_counter()
            history = None
            if self.settings.history.on:
                history = self._history
                for i in range(max(self._remembered, self._buffer.first), index + 1):
                    history.move(self._buffer[i].look, self._buffer.this_from_last(i))
                self._remembered = index + 1
            slot.observation = observe(window, foreground, slot.distance.settings, history)
            slot.seconds |= {"foreground": seconds, "blobs": time.perf_counter() - start}

    def _build_window(self, index: int) -> Window | None:
        slot, settings = self._buffer[index], self._buffer[index].distance.settings
        before = self._buffer.step_before(index)
        if before is not None and not before.reliable:  # report a cut or a blank picture once, at this frame
            slot.cause = before.cause
        parameters = self.settings.difference
        back = index - max(parameters.wide_frames, 2 * slot.interval, 2 * max(parameters.near_frames))
        first, last = self._buffer.linked(index, back, min(self._registered, index + 2 * slot.interval))
        near, wide, small = choose_pairs(index, slot.interval, first, last, settings)
        if not near:
            is_cut = slot.step is not None and not slot.step.reliable
            alone = slot.step.cause if slot.step and is_cut else "too few frames are registered to this frame"
            slot.cause = slot.cause or alone
            return None
        used = sorted({i for pair in [*near, wide, small] if pair for i in pair})
        place = {i: k for k, i in enumerate(used)}
        matrices = [self._motion_between(index, other) for other in used]
        return Window(
            slot.view,
            tuple(self._buffer[i].view for i in used),
            np.array(matrices),
            tuple(i - index for i in used),
            tuple((place[a], place[b]) for a, b in near),
            (place[wide[0]], place[wide[1]]) if wide else None,
            (place[small[0]], place[small[1]]) if small else None,
            settings.morphology.close_px,
            settings,
            slot.view.ignored,
        )

    def _motion_between(self, index: int, other: int) -> np.ndarray:
        """Return the homography (3, 3) of the background between two frames, registered directly or chained."""
        if self.settings.registration.direct:
            (step,) = self.engine.register([(self._buffer[index].view, self._buffer[other].view)])
            if step.reliable:
                return step.later_from_earlier
        return self._buffer.motion(index, other)

    def _follow_small(self, index: int) -> None:
        start, observation, boxes = time.perf_counter(), self._buffer[index].observation, []
        if observation.foreground is not None and observation.foreground.small is not None:
            boxes = find_small_boxes(observation.foreground.small, self.settings.small)
            observation.foreground = replace(observation.foreground, small=None)  # the map is not needed again
        self._small_tracks.step(index, self._buffer.this_from_last(index), boxes)
        self._buffer[index].seconds["small"] = time.perf_counter() - start

    def _draw(self) -> None:
        """Draw the targets of all frames for which the later looks that tracklets need are observed."""
        followers = LOOKS_AFTER if uses_tracklets(self.settings) else 0
        while self._drawn < self._observed and (self._drawn + followers < self._observed or self._all_observed):
            index, start = self._drawn, time.perf_counter()
            slot = self._buffer[index]
            slot.observation.targets = self._judge(index)
            slot.observation.window = slot.observation.foreground = None
            slot.seconds["outline"] = time.perf_counter() - start
            self._drawn += 1

    def _judge(self, index: int) -> list[Target]:
        """Return the targets of a frame: the candidates that tracklets accept, or all blobs without tracklets."""
        slot = self._buffer[index]
        observation, settings, candidates = slot.observation, slot.distance.settings, slot.observation.candidates
        if candidates is None:
            return draw_blobs(observation, observation.blobs, observation.velocities_px, settings)
        others = self._looks_about(index)
        tracklets = follow(candidates, others, slot.view.size)
        worth, close_px = BLOB_SIZED if slot.distance.person_px else BLOB, settings.morphology.close_px
        if slot.distance.tiny:  # a person is narrower than any closing
            worth, close_px = BLOB_TINY, 0
        seen = {offset: there for offset, (there, _) in others.items()}
        scores = score_tracklets(candidates, tracklets, seen, hits=worth.hits)
        scores += slot.distance.score_sizes(candidates.box_px, slot.view.size[1])
        chosen = choose(candidates, scores, settings.tracklets.accept, close_px, worth)
        return draw_chosen(observation, chosen, tracklets.velocity_px, scores, settings)

    def _looks_about(self, index: int) -> dict[int, tuple[Candidates, np.ndarray]]:
        """Return the looks that a frame's tracklets may use: by offset, candidates and the homography to the frame."""
        others = {}
        first, last = self._buffer.linked(index, index - LOOKS_BEFORE, min(index + LOOKS_AFTER, self._observed - 1))
        for other in range(first, last + 1):
            seen = self._buffer[other].observation.candidates
            if other != index and seen is not None:
                others[other - index] = seen, self._buffer.motion(other, index)
        return others

    @property
    def _all_observed(self) -> bool:
        return self._ended and self._observed == self._total

    def _emit(self) -> Iterator[Scene]:
        """Yield the scenes that no later frame can change, and drop the frames that no later window needs."""
        while self._emitted < self._drawn:
            slot = self._buffer[self._emitted]
            delay = settling_delay(slot.interval, slot.distance.settings)
            if not self._all_observed and self._emitted + delay >= self._observed:
                break
            scene = self._build_scene(slot, self._emitted)
            copy = replace(scene, repeats=slot.frame.number, step=_STILL, adjustments=(), seconds={})
            for made in (scene, *(replace(copy, frame=frame) for frame in slot.repeats)):
                yield from self._fill_gap(made.frame.number - made.frame.skipped, made.frame, slot.interval)
                self._returned = made.frame
                yield made
            slot.repeats = []
            # Drop the colour picture, which takes most of the memory: the scene keeps it, and windows use the view.
            slot.frame = replace(slot.frame, image=slot.view.grey)
            self._emitted += 1
            self._buffer.drop_colours(self._emitted - 1 - self.settings.difference.wide_frames)
            self._buffer.drop_before(min(self._emitted - LOOKS_BEFORE, self._observed - self._memory))

    def _fill_gap(self, until: int, following: Frame | None, interval: int) -> Iterator[Scene]:
        """Yield empty scenes for unreadable frame numbers below `until`. following: the next frame that was read."""
        before, step_s = self._returned, 1 / self.rate_hz
        if following is not None and before.number:
            step_s = (following.time_s - before.time_s) / (following.number - before.number)
        for number in range(before.number + 1, until):
            image = np.zeros_like(self._last.image)
            time_s = before.time_s + (number - before.number) * step_s if before.number else (number - 1) * step_s
            detections, mask, _ = build_detections([], (image.shape[1], image.shape[0]))
            missing = Frame(number, time_s, image)
            yield Scene(missing, mask, detections, interval, False, "the frame could not be read")

    def _build_scene(self, slot: Slot, index: int) -> Scene:
        self._controller.add_cost(slot)
        targets = slot.observation.targets
        targets = join_fragments(targets + self._small_targets(index, targets), slot.view.grey, self._grounds(index))
        if slot.passed:  # convert velocities from px a look to px a frame
            targets = [replace(t, velocity_px=t.velocity_px / (slot.passed + 1)) for t in targets]
        if slot.distance.gates is not None:
            targets = [t for t in targets if slot.distance.gates.admit(t.box[2], t.box[3], t.velocity_px)]
        detections, mask, core = build_detections(targets, slot.view.size)
        return Scene(
            frame=slot.frame,
            mask=mask,
            detections=detections,
            interval_frames=slot.interval,
            reliable=not slot.cause,
            cause=slot.cause,
            adjustments=slot.adjustments,
            seconds=slot.seconds,
            step=self._buffer.step_before(index),
            core=core,
        )

    def _grounds(self, index: int) -> list[Ground]:
        """Return the earliest and the latest picture around a frame that are always registered when it is settled."""
        ahead = max(2 * self._buffer[index].interval, 2)
        ends = self._buffer.linked(index, index - LOOKS_BEFORE, min(index + ahead, self._registered))
        others = [other for other in ends if other != index]
        return [
            Ground(self._buffer[other].view.grey, other - index, self._buffer.motion(index, other)) for other in others
        ]

    def _small_targets(self, index: int, targets: list[Target]) -> list[Target]:
        """Return the confirmed small tracks that have a box in this frame and that no other target covers."""
        parameters = self.settings.small
        if not parameters.on:
            return []
        slots = self._buffer.span(index - 2, min(index + 3, self._observed))
        errors = [slot.step.error_px for slot in slots if slot.step is not None]
        blobs = np.median([len(slot.observation.blobs) for slot in slots])
        if blobs > parameters.max_blobs and errors and np.median(errors) > parameters.parallax_px:
            return []
        found = []
        for track in self._small_tracks.tracks:
            if track.confirmed and index in track.frames:
                x, y, width, height = box = track.boxes[track.frames.index(index)]
                u, v, full = x + width / 2, y + height / 2, np.ones((height, width), bool)
                boxes = (target.box for target in targets)
                if not any(left <= u <= left + w and top <= v <= top + h for left, top, w, h in boxes):
                    found.append(Target(box, full, track.velocity_px, 0.5, full))
        return found


def _memory_frames(settings: Settings, has_telemetry: bool) -> int:
    """Return how many frames before the observed frame later windows may still use."""
    parameters, longest = settings.difference, 2 * max(settings.interval.maximum_frames, settings.interval.frames)
    if parameters.kind in ("between_later", "to_next"):
        return max(longest, _JUDGED_FRAMES)
    # At the ends of a clip a wide or small pair looks in one direction only, and then twice as far.
    small = 0
    if settings.small.on:
        is_any = has_telemetry and small_gap_follows_distance(settings)
        small = longest // 2 if is_any else settings.small.gap_frames
    widest = 2 * max(parameters.wide_frames, small)
    near = near_gaps(parameters.near_frames, parameters.wide_frames, longest // 2)
    return max(min(widest, longest), parameters.wide_frames, *near, _JUDGED_FRAMES)
