"""Choose the detection interval, the frames of a window and the size gates from the flight and the scene."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.chain import later_pair, near_gaps, near_pairs, next_pair, pair_about
from torchvision_dddas.config import IntervalParameters, Settings, is_set, is_tiny, uses_tracklets, with_parameters
from torchvision_dddas.detection.person_scale import TINY, person_px, pixels_per_metre, score_size
from torchvision_dddas.types import Adjustment, Flight, Telemetry

WALKER_M_S = 1.4
"""Speed of a walking person."""

# The gates are updated only when the distance has changed by more than this share.
_DISTANCE_STEP = 0.2
# A number of frames larger than the span of any window.
_FAR = 1000

Pair = tuple[int, int]


def look_cost(seconds: Sequence[float], parameters: IntervalParameters) -> tuple[float, str]:
    """Return the cost term O of eq. 2, and how it was measured in words, or "" if the settings state it.

    seconds: computing time of the latest looks. The measured O is their median, in frames at the reference rate, but at
    least 1. The lower bound is ours: the other terms are calibrated for looks that take one frame or less, and a faster
    computer must not bring the compared frames closer together.
    """
    if parameters.cost or not seconds:
        return parameters.cost or 1.0, ""
    median = float(np.median(seconds))
    return max(1.0, median * parameters.reference_rate_hz), f", a look takes {1000 * median:.0f} ms"


def interval_from_telemetry(
    distance_m: float, speed_m_s: float, rate_hz: float, cost: float, parameters: IntervalParameters
) -> float:
    """Return the detection interval in frames, before rounding and bounds: (A / 20) (5 / S) (R / 10) O.

    cost: O, from `look_cost`. Source: appendix B, eq. 2, calibrated to one frame at 20 m, 5 m/s and 10 Hz. There A is
    the altitude of a camera that looks straight down; here A is the distance to the ground along the view. The lowest
    speed is ours; it keeps the interval of a hovering vehicle finite.
    """
    speed = max(speed_m_s, parameters.lowest_speed_m_s)
    by_distance = distance_m / parameters.reference_altitude_m * parameters.reference_speed_m_s / speed
    return by_distance * rate_hz / parameters.reference_rate_hz * cost


def interval_from_flow(flows_px: Sequence[float], width: int, cost: float, parameters: IntervalParameters) -> float:
    """Return the detection interval in frames without telemetry, before rounding and bounds.

    The background flow is proportional to S / (A R), so its inverse replaces A R / S in eq. 2. flows_px: median
    background flow of the latest steps, pixels a frame. width: width of the picture, pixels.
    """
    flow = float(np.median(flows_px)) / width
    return parameters.reference_flow / max(flow, 1e-4) * cost


def adjust_interval(
    frame: int, current: int, wanted: float, cause: str, settings: Settings
) -> tuple[int, tuple[Adjustment, ...]]:
    """Return the interval from this frame on, rounded and clipped to its bounds, and the record of a change.

    The interval changes by one frame only if `wanted` differs from it by at least 0.75, so that noise does not toggle
    it. It also stays if the new interval would compare the same frames.
    """
    parameters, least = settings.interval, settings.interval.minimum_frames
    new = int(np.clip(round(min(wanted, 1e6)), least, parameters.maximum_frames))
    if new == current or (abs(new - current) == 1 and abs(wanted - current) < 0.75 and least <= current):
        return current, ()
    if compared_frames(new, settings) == compared_frames(current, settings):
        return current, ()
    return new, (Adjustment(frame, "interval.frames", current, new, cause),)


def compared_frames(interval: int, settings: Settings) -> list[Pair]:
    """Return the pairs of frames that a window compares far from the ends of a clip, relative to the reference."""
    near, wide, small = choose_pairs(0, interval, -_FAR, _FAR, settings)
    return [pair for pair in [*near, wide, small] if pair]


def look_ahead(interval: int, settings: Settings) -> int:
    """Return how many frames after its reference a window uses: at most two intervals, as in the source."""
    if settings.difference.kind == "between_later":
        return 2 * interval
    if settings.difference.kind == "to_next":
        return interval
    # At the start of a clip the window uses only the next two frames.
    near = max(2, *near_gaps(settings.difference.near_frames, settings.difference.wide_frames, interval))
    wide = min(settings.difference.wide_frames, max(2 * interval - 2, 0))
    return max(near, wide, _small_gap(interval, settings))


def settling_delay(interval: int, settings: Settings) -> int:
    """Return how many later frames must be observed before a frame is settled.

    It is 0 without tracklets and small targets. Else it is at least two, and two intervals minus `look_ahead`.
    """
    if uses_tracklets(settings) or settings.small.on:
        return max(2, 2 * interval - look_ahead(interval, settings))
    return 0


def _small_gap(interval: int, settings: Settings) -> int:
    """Return the frames between the pictures compared for small slow targets; 0 if the interval is too short."""
    small = settings.small
    return min(interval, small.gap_frames) if small.on and interval >= small.from_interval else 0


def _can_search_small(settings: Settings) -> bool:
    """Return whether small targets are searched for at any interval that these settings allow."""
    interval = settings.interval
    longest = max(interval.frames, interval.maximum_frames) if interval.rule else interval.frames
    has_both_sides = settings.difference.kind not in ("between_later", "to_next")
    return settings.small.on and has_both_sides and longest >= settings.small.from_interval


def small_gap_follows_distance(settings: Settings) -> bool:
    """Return whether `small.gap_move_px` sets the gap once the distance to the ground is known."""
    return settings.small.gap_move_px > 0 and not is_set(settings, "small.gap_frames")


def choose_pairs(
    at: int, interval: int, first: int, last: int, settings: Settings
) -> tuple[list[Pair], Pair | None, Pair | None]:
    """Return (near pairs, wide pair, small pair) of frame indices within first..last for the reference frame `at`.

    The near pairs may be empty. A pair lies on both sides of the reference if possible; at the ends of the range both
    of its frames lie on the same side.
    """
    parameters = settings.difference
    if parameters.kind == "between_later":
        return later_pair(at, interval, first, last), None, None
    if parameters.kind == "to_next":
        return next_pair(at, interval, first, last), None, None
    # Use no frames beyond `look_ahead`, even if they are there: the result must not depend on how frames are batched.
    ahead = min(last, at + look_ahead(interval, settings))
    near = near_pairs(at, near_gaps(parameters.near_frames, parameters.wide_frames, interval), first, ahead)
    wide = None
    if parameters.wide_frames and near:
        forward = min(parameters.wide_frames, max(2 * interval - 2, 0), ahead - at)
        back = min(parameters.wide_frames, at - first)
        if back >= 3 and forward >= 2:
            wide = (at - back, at + forward)
        else:
            gaps = range(parameters.wide_frames, 2, -1)
            wide = next((p for gap in gaps if (p := pair_about(at, gap, first, ahead))), None)
    gap = _small_gap(interval, settings)
    return near, wide, pair_about(at, gap, first, ahead) if gap else None


@dataclass(frozen=True)
class Gates:
    """Bounds of a target: the longer side of its box in pixels, and its speed over the background in pixels a frame."""

    min_size_px: float = 0.0
    max_size_px: float = float("inf")
    max_speed_px: float = float("inf")

    def admit(self, width_px: float, height_px: float, velocity_px: np.ndarray) -> bool:
        """Return whether a target with this box and velocity passes. An unknown (NaN) velocity passes."""
        size, speed = max(width_px, height_px), float(np.hypot(*velocity_px))
        return self.min_size_px <= size <= self.max_size_px and not speed > self.max_speed_px


@dataclass(frozen=True)
class DistanceSettings:
    """Settings and size gates for the current distance to the ground.

    settings: the user's settings with `gates.min_area_px`, `small.on`, `small.gap_frames` and `morphology.close_px`
    chosen for the distance. flight, gates: None without telemetry. person_px: size of a person, see `person_px`, 0 if
    unknown. tiny: whether the settings include those for tiny people.
    """

    settings: Settings
    flight: Flight | None = None
    gates: Gates | None = None
    person_px: float = 0.0
    tiny: bool = False

    def score_sizes(self, box_px: np.ndarray, height_px: int) -> np.ndarray:
        """Return (N,) log odds of targets from the sizes of boxes (N, 4), -inf for boxes that are too large.

        height_px: height of the picture. All values are 0 without telemetry.
        """
        if self.flight is None or self.gates is None:
            return np.zeros(len(box_px))
        scores, focal_px = np.zeros(len(box_px)), self.settings.gates.focal_px
        if is_set(self.settings, "gates.focal_px") and not self.tiny:
            scores = score_size(box_px, self.flight, focal_px, height_px)
        scores[box_px[:, 2:].max(axis=1, initial=0) > self.gates.max_size_px] = -np.inf
        return scores

    def values(self) -> dict[str, float]:
        """Return the current values by parameter name."""
        return {
            "gates.person_px": self.person_px,
            "gates.tiny": float(self.tiny),
            "gates.min_area_px": self.settings.gates.min_area_px,
            "small.on": float(self.settings.small.on),
            "small.gap_frames": self.settings.small.gap_frames,
            "morphology.close_px": self.settings.morphology.close_px,
            **{f"gates.{name}": bound for name, bound in vars(self.gates or Gates()).items()},
        }


def with_logged_focal(
    settings: Settings, telemetry: Telemetry | None, size: tuple[int, int]
) -> tuple[Settings, list[str]]:
    """Set gates.focal_px from the telemetry's field of view, unless the user has set it. Return settings and notes.

    size: (width, height) of the pictures.
    """
    known = np.zeros(0) if telemetry is None else telemetry.focal_px(size)
    if not np.isfinite(known).any() or is_set(settings, "gates.focal_px"):
        return settings, []
    focal = float(np.nanmedian(known))
    note = f"gates.focal_px is set to {focal:.0f} px from the log's field of view, so that sizes in metres are right"
    return with_parameters(settings, {"gates.focal_px": focal}), [note]


def describe_distance(flight: Flight) -> str:
    """Return the altitude in words, and the distance along the view if it differs."""
    altitude = f"altitude {flight.altitude_m:.1f} m"
    oblique = flight.distance_m > 1.02 * flight.altitude_m
    return f"{altitude}, {flight.distance_m:.1f} m along the view" if oblique else altitude


def settings_at(flight: Flight | None, rate_hz: float, base: Settings) -> DistanceSettings:
    """Return the settings and gates for a distance to the ground (appendix A, and the baseline of appendix B).

    flight: None if no altitude is known. A target in the picture's centre measures e = expected_size_m x focal /
    distance pixels; the distance is taken along the view. In an oblique view distant targets are smaller, so the bounds
    should be wide.
    - The smallest area is expected_share x e^2, limited to the range from small.min_area_px to the user's min_area_px.
    - The search for small targets is on while a person's area (e^2 if unknown) is at most small.max_box_px. It compares
      frames between which a walker moves by gap_move_px (ours). Without a known size, tracklets replace the search
      unless the user has set a parameter of `small`: on the open clips the search adds no hit to theirs, and takes a
      seventh of the time.
    - If close_m is set, closing bridges gaps of close_m, at most close_px, so that it joins no more from higher up.
    - If people are tiny, parameters that the user has not set take their values from TINY (ours).
    """
    size_px = base.gates.person_px
    if flight is not None and is_set(base, "gates.focal_px"):
        size_px = person_px(flight, base.gates.focal_px)
    tiny = is_tiny(size_px, base.gates.tiny_px, base.difference.kind)
    if tiny:
        base = with_parameters(base, {name: value for name, value in TINY.items() if not is_set(base, name)})
    if flight is None:
        if not size_px and uses_tracklets(base) and not base.small.model_fields_set:
            base = with_parameters(base, {"small.on": False})
        return DistanceSettings(base, person_px=size_px, tiny=tiny)
    gates, small, gap, close_px = base.gates, base.small, base.small.gap_frames, base.morphology.close_px
    scale = float(pixels_per_metre(flight.distance_m, gates.focal_px))
    square = (gates.expected_size_m * scale) ** 2
    if base.morphology.close_m:
        close_px = int(np.clip(round(base.morphology.close_m * scale), 1, close_px))
    if small_gap_follows_distance(base):
        most = max(base.interval.maximum_frames, base.interval.frames)
        move_px = small.gap_move_px if tiny else max(small.gap_move_px, size_px / 2)
        gap = int(np.clip(round(move_px * rate_hz / (WALKER_M_S * scale)), 1, most))
    chosen = {
        "gates.min_area_px": int(min(gates.min_area_px, max(small.min_area_px, round(gates.expected_share * square)))),
        "small.on": small.on and (size_px**2 or square) <= small.max_box_px,
        "small.gap_frames": gap,
        "morphology.close_px": close_px,
    }
    has_speed = base.history.on or uses_tracklets(base) or base.small.on
    max_speed = gates.max_speed_m_s * scale / rate_hz if has_speed else float("inf")
    bounds = Gates(gates.min_size_m * scale, gates.max_size_m * scale, max_speed)
    return DistanceSettings(with_parameters(base, chosen), flight, bounds, size_px, tiny)


def follow_distance(
    frame: int, current: DistanceSettings, flight: Flight | None, rate_hz: float, base: Settings
) -> tuple[DistanceSettings, tuple[Adjustment, ...]]:
    """Return the settings from this frame on, and the record of changes. flight: None if no altitude is known.

    The settings change when the distance or the size of people has changed by a fifth since the last change, or has
    become known or unknown.
    """
    before = current.flight
    if flight is None:
        if before is None:
            return current, ()
        cause = "no telemetry for this frame"
    else:
        if before is not None and _is_alike(flight, before):
            return current, ()
        cause = describe_distance(flight)
        cause += f", focal length {base.gates.focal_px:.0f} px" if is_set(base, "gates.focal_px") else ""
        cause += "" if before is None else f", was {before.distance_m:.1f} m"
    new, old = settings_at(flight, rate_hz, base), current.values()
    changed = {name: value for name, value in new.values().items() if value != old[name]}
    if not _can_search_small(new.settings):
        changed.pop("small.gap_frames", None)  # without a search for small targets the gap has no effect
    return new, tuple(Adjustment(frame, name, old[name], value, cause) for name, value in changed.items())


def _is_alike(flight: Flight, before: Flight) -> bool:
    """Return whether the settings chosen for the flight `before` still hold for `flight`."""
    sizes = [(max(one.distance_m, 1.0), person_px(one, 1.0)) for one in (flight, before)]
    return all(abs(now - then) <= _DISTANCE_STEP * then for now, then in zip(*sizes, strict=True))
