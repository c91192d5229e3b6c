"""The loop: frames in, scenes out, and what is found steers how the next frames are looked at."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.control import rules as control
from torchvision_dddas.detection import windows
from torchvision_dddas.detection.blob_motion import DenseFlow
from torchvision_dddas.detection.engine import Engine, View, Window
from torchvision_dddas.detection.motion_history import MotionHistory
from torchvision_dddas.detection.observation import Found, Observation, admitted, cores, draw_targets, observe, table
from torchvision_dddas.detection.small_targets import SmallTracks, candidates
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import chain
from torchvision_dddas.io.telemetry import at, check_overlap
from torchvision_dddas.types import Adjustment, Flight, Frame, Registration, Scene, Telemetry

Retune = Callable[[Frame], tuple[Settings, tuple[Adjustment, ...]]]
"""Asked before a frame is taken: the settings from then on, and the record of what changed."""


# A picture whose grey levels spread by less than this shows nothing, not even through fog.
_BLANK_LEVELS = 1.0
_FEWEST = 3  # frames that a window needs


class Clip(Protocol):
    """What the loop needs of a source."""

    @property
    def rate_hz(self) -> float:
        """Frames a second."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...


def _blank(view: View) -> bool:
    if "blank" not in view.kept:  # asked as the later frame of one step and the earlier of the next
        view.kept["blank"] = float(view.grey[::4, ::4].std()) < _BLANK_LEVELS
    blank: bool = view.kept["blank"]
    return blank


def check_length(frames: int) -> None:
    """Raises InputError where a clip of so many frames is too short for any window."""
    if frames < _FEWEST:
        few = "no frame" if frames == 0 else f"{frames} frame" + "s" * (frames > 1)
        raise InputError(f"the clip has {few} that can be read, a window needs {_FEWEST}: {_FEWEST - frames} missing")


def _memory(settings: Settings) -> int:
    """How many frames before the one observed may be looked at again."""
    parameters, longest = settings.difference, 2 * max(settings.interval.maximum_frames, settings.interval.frames)
    judged = 5  # persistence looks two frames before a frame that is drawn two frames late
    if parameters.kind == "between_later":
        return max(longest, judged)
    # Where a window can look one way only, it looks twice as far.
    widest = 2 * max(
        parameters.wide_frames, *parameters.near_frames, settings.small.gap_frames if settings.small.on else 0
    )
    return max(min(widest, longest), parameters.wide_frames, 2 * max(parameters.near_frames), judged)


@dataclass
class _Slot:
    """One frame on its way through the loop. step: registration to the next frame; None until known or at the end.

    look: its number, were the frames that are left out on purpose not there.
    """

    frame: Frame
    view: View
    look: int
    step: Registration | None = None
    interval: int = 0
    regime: control.Regime | None = None
    adjustments: tuple[Adjustment, ...] = ()
    observation: Observation | None = None
    small: list[Found] = field(default_factory=list)
    cause: str = ""
    seconds: dict[str, float] = field(default_factory=dict)


def run(
    source: Clip,
    engine: Engine,
    settings: Settings,
    telemetry: Telemetry | None = None,
    batch: int | None = None,
    retune: Retune | None = None,
) -> Iterator[Scene]:
    """A scene for every frame number of the clip, in order.

    Frames that could not be read, or whose registration cannot be trusted, give empty scenes flagged unreliable.
    batch: windows given to the back end at once; the result does not depend on it. None takes 8 for torch, else 1.
    retune: may give other settings between frames; what changed is in the scene of the frame that it was asked for.
    A source that can be steered has a method `telemetry` that tells what was reported so far, in place of a whole log.
    Raises InputError for a clip of fewer than three frames and for telemetry that does not overlap it in time.
    """
    count = getattr(source, "count", None)
    if telemetry is not None and count:
        check_overlap(telemetry, (count - 1) / source.rate_hz)
    loop = Loop(engine, settings, source.rate_hz, telemetry, batch or (8 if engine.name == "torch" else 1))
    last_s = 0.0
    live = getattr(source, "telemetry", None)
    for frame in source:
        last_s = frame.time_s
        if live is not None:
            loop.telemetry = live()
        adjustments: tuple[Adjustment, ...] = ()
        if retune is not None:
            settings, adjustments = retune(frame)
            loop.retune(settings)
        yield from loop.feed(frame, adjustments)
    if telemetry is not None:
        check_overlap(telemetry, last_s)
    yield from loop.end(getattr(source, "last", 0))


class Loop:
    """The state of a run: the frames in flight, the interval, the small tracks. Feed it frames in order."""

    def __init__(
        self, engine: Engine, settings: Settings, rate_hz: float, telemetry: Telemetry | None = None, batch: int = 1
    ) -> None:
        self.engine, self.settings, self.batch = engine, settings, batch
        self.rate_hz, self.telemetry = rate_hz, telemetry
        self.slots: deque[_Slot] = deque()
        self.memory = _memory(settings)
        self.shape: tuple[int, ...] = (0, 0)  # of the frames
        self.first = 0  # index of slots[0]; indices count frames read
        self.registered = 0  # slots below this index have their step
        self.observed = 0
        self.drawn = 0
        self.emitted = 0
        self.total = 0
        self.last_number = 0
        self.skipped = 0  # frames left out on purpose so far
        self.ended = False
        self.interval = settings.interval.frames
        self.flows: deque[float] = deque(maxlen=settings.interval.memory_frames)
        self.flow = DenseFlow()
        self.tracks = SmallTracks(settings.small)
        self.regime = control.Regime(settings)
        self.history = MotionHistory(settings.history.duration_frames)
        self.remembered = 0  # frames below this index are in the history

    def retune(self, settings: Settings) -> None:
        """Go on with other settings. How small targets and the motion's history are kept stays as it was."""
        if settings is self.settings:
            return
        self.settings = self.engine.parameters = settings
        # Frames that windows may look at are kept for the longer of the two.
        self.memory = max(self.memory, _memory(settings))
        altitude_m = self.regime.altitude_m
        self.regime = (
            control.Regime(settings) if altitude_m is None else control.regime_at(altitude_m, self.rate_hz, settings)
        )

    def feed(self, frame: Frame, adjustments: tuple[Adjustment, ...] = ()) -> Iterator[Scene]:
        """Take one frame; yields the scenes that are settled by it. adjustments: made before it, for its scene."""
        start = time.perf_counter()
        self.skipped += frame.skipped
        view = self.engine.prepare(frame.image)
        slot = _Slot(frame, view, frame.number - self.skipped, adjustments=adjustments)
        slot.seconds["prepare"] = time.perf_counter() - start
        self.shape = frame.image.shape
        self.slots.append(slot)
        self.total += 1
        if self.total - self.registered > self.batch:
            yield from self._advance()

    def end(self, last: int = 0) -> Iterator[Scene]:
        """The clip is over: settle everything that is left. last: number of the clip's last frame, read or not."""
        check_length(self.total)
        self.ended = True
        yield from self._advance()
        yield from self._gap(last + 1)

    def _advance(self) -> Iterator[Scene]:
        self._register()
        while ready := self._ready():
            yield from self._observe(ready)

    def _at(self, index: int) -> _Slot:
        return self.slots[index - self.first]

    # -- registration ------------------------------------------------------------------------------------------------

    def _register(self) -> None:
        """The steps between successive frames, all that can be had now."""
        todo = [self._at(i) for i in range(self.registered, self.total)]
        if len(todo) < 2:
            return
        steps: list[Registration] = []
        start = time.perf_counter()
        for i in range(0, len(todo) - 1, self.batch):
            part = todo[i : i + self.batch + 1]
            steps += self.engine.register([(a.view, b.view) for a, b in pairwise(part)])
        spent = (time.perf_counter() - start) / len(steps)
        for slot, after, step in zip(todo, todo[1:], steps, strict=False):
            # Keypoints can seem to be followed onto a blank picture: they stay where the search began.
            blank = _blank(slot.view) or _blank(after.view)
            slot.step = replace(step, reliable=False, cause="the picture is blank") if blank else step
            slot.seconds["register"] = spent
        self.registered += len(steps)

    def _joined(self, index: int) -> bool:
        """Whether frame `index` and the next hang together."""
        slot = self._at(index)
        return slot.step is not None and slot.step.reliable

    def _stretch(self, index: int, back: int, ahead: int) -> tuple[int, int]:
        """The first and last frame that hang together with `index`, at most so many frames away."""
        first = last = index
        while first > max(self.first, index - back) and self._joined(first - 1):
            first -= 1
        while last < min(self.registered, index + ahead) and self._joined(last):
            last += 1
        return first, last

    # -- observation -------------------------------------------------------------------------------------------------

    def _ready(self) -> list[int]:
        """Up to `batch` frames whose windows are complete."""
        ready: list[int] = []
        while len(ready) < self.batch and self.observed + len(ready) < self.total:
            index = self.observed + len(ready)
            slot = self._at(index)
            if not slot.interval:
                if slot.step is None and not self.ended:
                    break
                self._steer(index, slot)
            ahead = windows.reach(slot.interval, self.settings)
            if not self.ended and self.registered < index + ahead:
                break
            ready.append(index)
        # Whole batches only while the clip runs: an engine that batches is as quick for eight windows as for four.
        return ready if self.ended or len(ready) == self.batch else []

    def _steer(self, index: int, slot: _Slot) -> None:
        """The feedback rule for the detection interval."""
        parameters = self.settings.interval
        flight = self._flight(slot)
        # A log may tell one of them and not the other, or fall silent for a while.
        altitude = flight.altitude_m if flight is not None and np.isfinite(flight.altitude_m) else None
        number = slot.frame.number
        self.regime, moved = control.steered(number, self.regime, altitude, self.rate_hz, self.settings)
        slot.adjustments += moved
        slot.regime = self.regime
        apart = slot.frame.skipped + 1  # frames from look to look
        if slot.step is not None and slot.step.reliable:
            after = self._at(index + 1).frame.skipped + 1
            self.flows.append(slot.step.flow_px / after)
        if parameters.rule:
            wanted, why = None, ""
            if flight is not None and altitude is not None and np.isfinite(flight.speed_m_s):
                wanted = control.interval_from_telemetry(altitude, flight.speed_m_s, self.rate_hz, parameters)
                why = f"altitude {altitude:.1f} m, speed {flight.speed_m_s:.1f} m/s"
            if wanted is None and self.flows:
                wanted = control.interval_from_flow(self.flows, slot.view.size[0], parameters)
                why = f"background flow {np.median(self.flows):.2f} px a frame"
            if wanted is not None:
                self.interval, moved = control.adjusted(number, self.interval, wanted / apart, why, parameters)
                slot.adjustments += moved
        slot.interval = self.interval

    def _flight(self, slot: _Slot) -> Flight | None:
        """What the telemetry tells at a frame; None outside its span."""
        return at(self.telemetry, slot.frame.time_s) if self.telemetry is not None else None

    def _observe(self, ready: list[int]) -> Iterator[Scene]:
        start = time.perf_counter()
        made: list[tuple[int, Window]] = []
        for index in ready:
            window = self._window(index)
            if window is None:
                self._at(index).observation = Observation(None, None)
            else:
                made.append((index, window))
        foregrounds = self.engine.foreground([window for _, window in made]) if made else []
        spent = (time.perf_counter() - start) / max(len(made), 1)
        for (index, window), foreground in zip(made, foregrounds, strict=True):
            slot = self._at(index)
            start = time.perf_counter()
            slot.observation = observe(window, foreground, self.flow, self._settings(slot), self._history(index))
            slot.seconds |= {"foreground": spent, "blobs": time.perf_counter() - start}
        for index in ready:
            self._follow_small(index)
            self.observed = index + 1
            self._draw()
            yield from self._settle()  # after every frame: what is settled must not depend on the batch

    def _settings(self, slot: _Slot) -> Settings:
        """Those in force at a frame."""
        return slot.regime.settings if slot.regime else self.settings

    def _history(self, index: int) -> MotionHistory | None:
        """The motion history, moved on to a frame."""
        if not self.settings.history.on:
            return None
        for i in range(max(self.remembered, self.first), index + 1):
            self.history.move(self._at(i).look, self._step(i - 1) if i > self.first else None)
        self.remembered = index + 1
        return self.history

    def _window(self, index: int) -> Window | None:
        slot = self._at(index)
        before = self._at(index - 1).step if index > self.first else None
        if before is not None and not before.reliable:  # a cut, or a picture that shows nothing: said once, here
            slot.cause = before.cause
            return None
        back = max(
            self.settings.difference.wide_frames, 2 * slot.interval, 2 * max(self.settings.difference.near_frames)
        )
        first, last = self._stretch(index, back, 2 * slot.interval)
        near, wide, small = windows.pairs(index, slot.interval, first, last, self._settings(slot))
        if not near:
            slot.cause = self._why_alone(index)
            return None
        used = sorted({i for pair in [*near, wide, small] if pair for i in pair})
        place = {i: k for k, i in enumerate(used)}
        places = lambda pair: (place[pair[0]], place[pair[1]])  # noqa: E731
        return Window(
            slot.view,
            tuple(self._at(i).view for i in used),
            np.array([self._neighbour_from_reference(index, i) for i in used]),
            tuple(i - index for i in used),
            tuple(places(pair) for pair in near),
            places(wide) if wide else None,
            places(small) if small else None,
            self._settings(slot).morphology.close_px,
        )

    def _neighbour_from_reference(self, index: int, other: int) -> np.ndarray:
        low, high = min(index, other), max(index, other)
        steps = [self._at(i).step for i in range(low, high)]
        high_from_low = chain([step.later_from_earlier for step in steps if step is not None])
        return high_from_low if other > index else np.linalg.inv(high_from_low)

    def _why_alone(self, index: int) -> str:
        step = self._at(index).step
        return step.cause if step is not None and not step.reliable else "too few frames hang together with it"

    def _follow_small(self, index: int) -> None:
        slot = self._at(index)
        if not self.settings.small.on:
            return
        start = time.perf_counter()
        before = self._at(index - 1).step if index > self.first else None
        linked = before is not None and before.reliable
        observation = slot.observation
        boxes = []
        if observation is not None and observation.foreground is not None and observation.foreground.small is not None:
            boxes = candidates(observation.foreground.small, self.settings.small)
            observation.foreground = replace(observation.foreground, small=None)  # nobody looks at it again
        self.tracks.step(index, before.later_from_earlier if before is not None and linked else None, boxes)
        slot.seconds["small"] = time.perf_counter() - start

    # -- targets -----------------------------------------------------------------------------------------------------

    def _draw(self) -> None:
        """Draw the targets of frames whose followers, as far as they have a say, have been observed."""
        followers = 2 if self.settings.persistence.on else 0
        while self.drawn < self.observed and (self.drawn + followers < self.observed or self._all_observed()):
            index = self.drawn
            start = time.perf_counter()
            low = max(index - 2, self.first)
            around = range(low, min(index + 3, self.observed))
            observations = [self._at(i).observation or Observation(None, None) for i in around]
            steps = [self._step(i) for i in around]
            slot = self._at(index)
            assert slot.observation is not None
            slot.observation.targets = draw_targets(observations, steps, index - low, self._settings(slot))
            slot.observation.window = slot.observation.foreground = None
            slot.seconds["outline"] = time.perf_counter() - start
            self.drawn += 1

    def _all_observed(self) -> bool:
        return self.ended and self.observed == self.total

    def _step(self, index: int) -> np.ndarray | None:
        step = self._at(index).step
        return step.later_from_earlier if step is not None and step.reliable else None

    def _settle(self) -> Iterator[Scene]:
        """Yield the scenes on which no later frame has a say any more, and forget what no window needs again."""
        while self.emitted < self.drawn:
            slot = self._at(self.emitted)
            if not self._all_observed() and self.emitted + windows.delay(slot.interval, self.settings) >= self.observed:
                break
            yield from self._gap(slot.frame.number - slot.frame.skipped)
            self.last_number = slot.frame.number
            yield self._scene(slot, self.emitted)
            # Colour is most of a run's memory: who took the scene has it, and windows look at the view's only.
            slot.frame = replace(slot.frame, image=slot.view.grey)
            self.emitted += 1
            self._forget()

    def _forget(self) -> None:
        """Let go of what no window looks at again."""
        if (old := self.emitted - 1 - self.settings.difference.wide_frames) >= self.first:
            view = self._at(old).view
            view.image = view.grey
        while self.first < min(self.emitted - 2, self.observed - self.memory):
            self.slots.popleft()
            self.first += 1

    def _gap(self, until: int) -> Iterator[Scene]:
        """Empty scenes for the frame numbers below `until` that could not be read."""
        for number in range(self.last_number + 1, until):
            missing = Frame(number, (number - 1) / self.rate_hz, np.zeros(self.shape, np.uint8))
            detections, mask = table([], (self.shape[1], self.shape[0]))
            yield Scene(missing, mask, detections, self.interval, False, "the frame could not be read")
        self.last_number = until

    def _scene(self, slot: _Slot, index: int) -> Scene:
        observation = slot.observation
        assert observation is not None
        found = list(observation.targets or [])
        found += self._small_targets(index, found)
        if slot.frame.skipped:  # what moved from look to look, for each frame of it
            found = [replace(f, velocity_px=f.velocity_px / (slot.frame.skipped + 1)) for f in found]
        found = admitted(found, slot.regime.gates if slot.regime else None)
        detections, mask = table(found, slot.view.size)
        return Scene(
            frame=slot.frame,
            mask=mask,
            detections=detections,
            interval_frames=slot.interval,
            reliable=not slot.cause,
            cause=slot.cause,
            adjustments=slot.adjustments,
            seconds=slot.seconds,
            step=self._at(index - 1).step if index > self.first else None,
            core=cores(found, slot.view.size),
        )

    def _small_targets(self, index: int, found: list[Found]) -> list[Found]:
        """Confirmation small tracks seen in this frame, where no other target covers them."""
        if not self.settings.small.on:
            return []
        near = range(max(index - 2, self.first), min(index + 3, self.observed))
        blobs = [len(o.blobs) for i in near if (o := self._at(i).observation) is not None]
        misses = [step.error_px for i in near if (step := self._at(i).step) is not None]
        parameters = self.settings.small
        if np.median(blobs) > parameters.max_blobs and misses and np.median(misses) > parameters.parallax_px:
            return []
        extra = []
        for track in self.tracks.confirmed():
            if index not in track.frames:
                continue
            x, y, width, height = box = track.boxes[track.frames.index(index)]
            centre = x + width / 2, y + height / 2
            if any(
                f.box[0] <= centre[0] <= f.box[0] + f.box[2] and f.box[1] <= centre[1] <= f.box[1] + f.box[3]
                for f in found
            ):
                continue
            extra.append(Found(box, np.ones((height, width), bool), track.velocity_px, 0.5))
        return extra


def scenes(frames: Iterable[Frame], engine: Engine, settings: Settings, rate_hz: float = 10.0) -> Iterator[Scene]:
    """`run` on frames at hand."""
    loop = Loop(engine, settings, rate_hz)
    for frame in frames:
        yield from loop.feed(frame)
    yield from loop.end()
