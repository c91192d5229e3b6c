"""Advice before a run, from some frames of a clip and its log: sizes, motion, delay, cost, and options to set."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchvision_dddas.config import is_tiny
from torchvision_dddas.detection import DistanceSettings, pixels_per_metre, settings_at
from torchvision_dddas.pipeline.assembly import Assembly
from torchvision_dddas.pipeline.pipeline import Pipeline
from torchvision_dddas.types import Frame, Scene, Source

VEHICLE_M = 4.5
_LOG_SAMPLES = 50  # moments of the log over the length of the clip
_QUICKER = ("fast", "half")  # configurations in the order in which they are tried


@dataclass
class ClipSurvey:
    """Facts from the first frames of a clip, filled while a pipeline processes them.

    sides_px, squares_px: longer side of the box and root of the area of each detection. flows_px: background motion of
    each reliable step. causes: causes of unreliable frames, with counts. delay_frames: longest delay of a result, None
    if no result came before the end. rate_hz: frames processed per second, without reading.
    """

    frames: int = 0
    sides_px: list[float] = field(default_factory=list)
    squares_px: list[float] = field(default_factory=list)
    flows_px: list[float] = field(default_factory=list)
    causes: Counter[str] = field(default_factory=Counter)
    delay_frames: int | None = None
    rate_hz: float = float("nan")

    def see(self, scene: Scene) -> None:
        """Add the facts of a scene."""
        self.frames += 1
        self.sides_px += scene.detections.box_px[:, 2:].max(axis=1).tolist()
        self.squares_px += np.sqrt(scene.detections.area_px).tolist()
        if not scene.reliable:
            self.causes[scene.cause] += 1
        elif scene.step is not None and np.isfinite(scene.step.flow_px):
            self.flows_px.append(scene.step.flow_px)


class _Excerpt:
    """The first frames of a source. taken: frames read so far. waited_s: seconds spent on reading."""

    def __init__(self, source: Source, frames: int) -> None:
        self._source, self.most, self.taken, self.last = source, min(frames, source.count or frames), 0, 0
        self.count, self.waited_s = self.most, 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def __iter__(self) -> Iterator[Frame]:
        start = time.perf_counter()
        for frame in self._source:
            self.waited_s += time.perf_counter() - start
            self.taken, self.last = self.taken + 1, frame.number
            yield frame
            if self.taken == self.most:
                return
            start = time.perf_counter()


def look_at(source: Source, ready: Assembly, frames: int, tick: Callable[[], None] = lambda: None) -> ClipSurvey:
    """Process the first frames of a clip. tick: called after each result. Raise InputError for fewer than 3 frames."""
    excerpt, look, begun = _Excerpt(source, frames), ClipSurvey(), (time.perf_counter(), 0, 0.0)
    for result in Pipeline.from_assembly(ready, seen=look.see, pictures=False)(excerpt):
        if not begun[1]:  # do not time loading and warming up before the first result
            begun = time.perf_counter(), excerpt.taken, excerpt.waited_s
        if excerpt.taken < excerpt.most:
            look.delay_frames = max(look.delay_frames or 0, excerpt.taken - result.number)
        tick()
    seconds = time.perf_counter() - begun[0] - excerpt.waited_s + begun[2]
    if excerpt.taken > begun[1]:
        look.rate_hz = (excerpt.taken - begun[1]) / max(seconds, 1e-6)
    return look


def distances_over(ready: Assembly, source: Source, frames: int) -> list[DistanceSettings]:
    """Return the settings that detection will use, at moments all over the clip with a logged height above ground."""
    if ready.telemetry is None:
        return []
    moments_s = np.linspace(0, (source.count or frames) / source.rate_hz, _LOG_SAMPLES)
    flights = [ready.telemetry.at(moment) for moment in moments_s]
    return [settings_at(f, source.rate_hz, ready.settings) for f in flights if f is not None and f.altitude_m > 0]


def describe_sizes(look: ClipSurvey, ready: Assembly, distances: list[DistanceSettings]) -> list[str]:
    """Return lines on the sizes of targets that follow from the log, and on the sizes that were found."""
    known = [at for at in distances if at.person_px and at.flight is not None]
    if known:
        focal = ready.settings.gates.focal_px
        vehicles = [VEHICLE_M * pixels_per_metre(at.flight.distance_m, focal) for at in known if at.flight]
        people = _range([at.person_px for at in known])
        tiny = sum(at.tiny for at in known) / len(known)
        used = f"; the settings for tiny people are used in {tiny:.0%} of the clip" if tiny else ""
        lines = [f"sizes by the log: a person covers a square of {people} px, a vehicle of {VEHICLE_M} m is "]
        lines[0] += f"{_range(vehicles)} px long{used}"
    else:
        missing = "without --telemetry FILE" if ready.telemetry is None else "by this log"
        if distances:
            missing += ", which has a height but no focal length; give --camera FILE"
        elif ready.telemetry is not None:
            missing += ", which has no height above ground for this clip"
        lines = [f"sizes in metres: unknown {missing}"]
    if not look.sides_px:
        return [*lines, f"found: nothing moves in {look.frames} frames, so the sizes of targets are unknown"]
    low, middle_px, high = np.percentile(look.sides_px, [25, 50, 75])
    found = f"found: {len(look.sides_px) / look.frames:.1f} targets per frame, {middle_px:.0f} px long"
    found += f" (quartiles {low:.0f} to {high:.0f})"
    return [*lines, found + ("" if known else "; sizes in pixels do not distinguish people from vehicles")]


def describe_clip(look: ClipSurvey, source: Source) -> list[str]:
    """Return lines on the camera's motion, the delay of the results, and the cost on this machine."""
    rate_hz, lines = source.rate_hz, []
    if look.flows_px:
        middle, high = np.percentile(look.flows_px, [50, 95])
        lines.append(f"camera: the background moves {middle:.1f} px per frame, {high:.1f} px in the fastest 5 %")
    if look.causes:
        cause, count = look.causes.most_common(1)[0]
        lines.append(f"unreliable: {look.causes.total()} of {look.frames} frames; {count} because {cause}")
    assumed = " (assumed; state it with --rate)" if getattr(source, "assumes_rate", False) else ""
    delay = f"more than {look.frames} frames"
    if look.delay_frames is not None:
        delay = f"up to {look.delay_frames} frames ({look.delay_frames / rate_hz:.1f} s)"
    lines.append(f"rate: {rate_hz:g} frames/s{assumed}; delay of a result: {delay}")
    cost = f"cost: {look.rate_hz:.1f} frames/s on this machine with its present load, without reading the clip"
    if math.isnan(look.rate_hz):
        cost = f"cost: not measured, because {look.frames} frames are too few"
    if source.count and look.rate_hz > 0:
        cost += f"; {source.count} frames take {source.count / look.rate_hz / 60:.1f} min"
    return [*lines, cost]


def choose_options(
    look: ClipSurvey,
    ready: Assembly,
    distances: list[DistanceSettings],
    *,
    rate_hz: float,
    live: bool,
    look_with: Callable[[str], ClipSurvey],
) -> tuple[dict[str, str], list[str]]:
    """Return options of `dddas run` with their reasons, and remarks. live: whether the source is a stream.

    look_with: processes the first frames with a configuration. As in detection, `gates.tiny_px` defines tiny people.
    """
    options, remarks, gates = dict[str, str](), list[str](), ready.settings.gates
    size_px = float(np.median(look.squares_px)) if look.squares_px else 0.0
    tiny = is_tiny(gates.person_px, gates.tiny_px, "normalized") or any(at.tiny for at in distances)
    if not (gates.person_px or any(at.person_px for at in distances)):
        if is_tiny(size_px, gates.tiny_px, ready.settings.difference.kind):
            tiny, reason = True, f"the median target covers a square of {size_px:.1f} px; people of this size or less"
            options[f"--set gates.person_px={size_px:.1f}"] = f"{reason} need the settings for tiny people"
        elif not size_px:
            remarks.append(f"if people are smaller than {gates.tiny_px:g} px in this clip, give --config patrol")
    if not look.rate_hz < rate_hz:
        return options, remarks
    slow = f"the clip has {rate_hz:g} frames/s, and this machine processes {look.rate_hz:.1f}"
    if tiny:
        remarks.append(f"with --live, pictures are dropped: {slow}; fast and half have no settings for tiny people")
        return options, remarks
    for name in _QUICKER:
        quick = look_with(name)
        slow += f", with {name} {quick.rate_hz:.1f}"
        if quick.rate_hz >= rate_hz:
            break
    else:
        slow += ", so no configuration keeps up"
    if live:
        options[f"--config {name}"] = slow
    else:
        need = f"run --live with such a stream needs --config {name}"
        remarks.append(f"{need}: {slow}; for this file without --live, no picture is dropped")
    return options, remarks


def _range(values: list[float]) -> str:
    low, high = f"{min(values):.0f}", f"{max(values):.0f}"
    return low if low == high else f"{low} to {high}"
