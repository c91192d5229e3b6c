"""What flight and scene decide about detection: the interval, the frames of a window, and the sizes of targets."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.chain import later_pair, near_gaps, near_pairs, next_pair, pair_about
from torchvision_dddas.config import IntervalParameters, Settings, is_set, with_parameters
from torchvision_dddas.types import Adjustment, Flight, Telemetry

WALKER_M_S = 1.4
"""Speed of a person who walks."""

# A smaller relative change of distance does not move the gates.
_DISTANCE_STEP = 0.2
# More frames than any window spans.
_FAR = 1000

Pair = tuple[int, int]


def look_cost(seconds: Sequence[float], parameters: IntervalParameters) -> tuple[float, str]:
    """O of eq. 2, and what it was measured from in words, "" where it is stated.

    seconds: time that the latest looks took. Measured it is their median in frames at the reference rate, at least one:
    the calibration of the other terms holds where a look takes no longer, and a fast computer must not bring the
    compared frames closer together. The lowest value is ours.
    """
    if parameters.cost or not seconds:
        return parameters.cost or 1.0, ""
    median = float(np.median(seconds))
    return max(1.0, median * parameters.reference_rate_hz), f", a look takes {1000 * median:.0f} ms"


def interval_from_telemetry(
    distance_m: float, speed_m_s: float, rate_hz: float, cost: float, parameters: IntervalParameters
) -> float:
    """The detection interval in frames before rounding and bounds: (A / 20) (5 / S) (R / 10) O.

    Source: appendix B, eq. 2, calibrated to one frame at 20 m, 5 m/s and 10 Hz. Its A, the altitude of a camera that
    looks straight down, is the distance to the ground along the view. The lowest speed, which keeps the interval of a
    hovering vehicle finite, is ours. cost: O, as of `look_cost`.
    """
    speed = max(speed_m_s, parameters.lowest_speed_m_s)
    by_distance = distance_m / parameters.reference_altitude_m * parameters.reference_speed_m_s / speed
    return by_distance * rate_hz / parameters.reference_rate_hz * cost


def interval_from_flow(flows_px: Sequence[float], width: int, cost: float, parameters: IntervalParameters) -> float:
    """The same without telemetry: the background flow is proportional to S / (A R), so its inverse replaces A R / S.

    flows_px: median background flow of the latest steps, pixels a frame. width: of the picture, pixels.
    """
    flow = float(np.median(flows_px)) / width
    return parameters.reference_flow / max(flow, 1e-4) * cost


def adjust_interval(
    frame: int, current: int, wanted: float, cause: str, settings: Settings
) -> tuple[int, tuple[Adjustment, ...]]:
    """The interval from this frame on, rounded and within its bounds, and the record of its change, if any.

    A change by one frame happens only when the rule is a quarter of a frame past the middle, so that noise does not
    make the interval flutter. The interval stays where the new one compares the same frames.
    """
    parameters, least = settings.interval, settings.interval.minimum_frames
    new = int(np.clip(round(min(wanted, 1e6)), least, parameters.maximum_frames))
    if new == current or (abs(new - current) == 1 and abs(wanted - current) < 0.75 and least <= current):
        return current, ()
    if compared_frames(new, settings) == compared_frames(current, settings):
        return current, ()
    return new, (Adjustment(frame, "interval.frames", current, new, cause),)


def compared_frames(interval: int, settings: Settings) -> list[Pair]:
    """The pairs of frames that are compared, counted from the reference frame, far from the ends of a clip."""
    near, wide, small = choose_pairs(0, interval, -_FAR, _FAR, settings)
    return [pair for pair in [*near, wide, small] if pair]


def look_ahead(interval: int, settings: Settings) -> int:
    """How many frames ahead of its reference a window looks: at most two intervals, as in the source."""
    if settings.difference.kind == "between_later":
        return 2 * interval
    if settings.difference.kind == "to_next":
        return interval
    # At the start of a range the window looks ahead only, to the next two frames.
    near = max(2, *near_gaps(settings.difference.near_frames, settings.difference.wide_frames, interval))
    wide = min(settings.difference.wide_frames, max(2 * interval - 2, 0))
    return max(near, wide, _small_gap(interval, settings))


def settling_delay(interval: int, settings: Settings) -> int:
    """How many further frames are observed before a frame is settled; with `look_ahead`, at most two intervals."""
    if settings.persistence.on or settings.small.on:
        return max(2, 2 * interval - look_ahead(interval, settings))
    return 0


def _small_gap(interval: int, settings: Settings) -> int:
    """Frames between the pictures that show small slow targets; 0: the interval is too short to show any."""
    small = settings.small
    return min(interval, small.gap_frames) if small.on and interval >= small.from_interval else 0


def _can_search_small(settings: Settings) -> bool:
    """Whether small targets are searched for at any interval that can come."""
    interval = settings.interval
    longest = max(interval.frames, interval.maximum_frames) if interval.rule else interval.frames
    has_both_sides = settings.difference.kind not in ("between_later", "to_next")
    return settings.small.on and has_both_sides and longest >= settings.small.from_interval


def small_gap_follows_distance(settings: Settings) -> bool:
    """Whether `small.gap_move_px` sets the gap once the distance to the ground is known."""
    return settings.small.gap_move_px > 0 and not is_set(settings, "small.gap_frames")


def choose_pairs(
    at: int, interval: int, first: int, last: int, settings: Settings
) -> tuple[list[Pair], Pair | None, Pair | None]:
    """(near pairs, wide pair, small pair) of frame indices for reference `at`, within first..last; near may be empty.

    A window looks both ways where it can; at the ends of the range it looks one way only.
    """
    parameters = settings.difference
    if parameters.kind == "between_later":
        return later_pair(at, interval, first, last), None, None
    if parameters.kind == "to_next":
        return next_pair(at, interval, first, last), None, None
    # No further than `look_ahead`, even if more is known: the result must not depend on how frames are batched.
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
    """Bounds of a target: the longer side of its box in pixels, its speed over the background in pixels a frame."""

    min_size_px: float = 0.0
    max_size_px: float = float("inf")
    max_speed_px: float = float("inf")

    def admit(self, width_px: float, height_px: float, velocity_px: np.ndarray) -> bool:
        """Whether a target of this box and velocity passes. An unknown (NaN) velocity passes."""
        size, speed = max(width_px, height_px), float(np.hypot(*velocity_px))
        return self.min_size_px <= size <= self.max_size_px and not speed > self.max_speed_px


@dataclass(frozen=True)
class DistanceSettings:
    """Settings and size gates for the current distance to the ground. distance_m, gates: None without telemetry.

    settings: those of the user with `gates.min_area_px`, `small.on`, `small.gap_frames` and `morphology.close_px`
    chosen for the distance.
    """

    settings: Settings
    distance_m: float | None = None
    gates: Gates | None = None

    def values(self) -> dict[str, float]:
        """The numbers in force, by name."""
        return {
            "gates.min_area_px": self.settings.gates.min_area_px,
            "small.on": float(self.settings.small.on),
            "small.gap_frames": self.settings.small.gap_frames,
            "morphology.close_px": self.settings.morphology.close_px,
            **{f"gates.{name}": bound for name, bound in vars(self.gates or Gates()).items()},
        }


def pixels_per_metre(distance_m: float, focal_px: float) -> float:
    """Scale of what is at a distance. One below 1 m counts as 1 m, so that it stays finite on landing."""
    return focal_px / max(distance_m, 1.0)


def with_logged_focal(
    settings: Settings, telemetry: Telemetry | None, size: tuple[int, int]
) -> tuple[Settings, list[str]]:
    """Set gates.focal_px by the telemetry's field of view, unless it is set. Returns settings and notes.

    size: (width, height) of the pictures.
    """
    known = np.zeros(0) if telemetry is None else telemetry.focal_px(size)
    if not np.isfinite(known).any() or is_set(settings, "gates.focal_px"):
        return settings, []
    focal = float(np.nanmedian(known))
    note = f"gates.focal_px is {focal:.0f} px by the log's field of view, so that sizes in metres hold"
    return with_parameters(settings, {"gates.focal_px": focal}), [note]


def describe_distance(flight: Flight) -> str:
    """The altitude, and the distance along the view where it is another, in words."""
    altitude = f"altitude {flight.altitude_m:.1f} m"
    oblique = flight.distance_m > 1.02 * flight.altitude_m
    return f"{altitude}, {flight.distance_m:.1f} m along the view" if oblique else altitude


def settings_at(distance_m: float, rate_hz: float, base: Settings) -> DistanceSettings:
    """The settings and gates for a distance to the ground along the view (appendix A, and the baseline of appendix B).

    A target measures e = expected_size_m x focal / distance pixels in the picture's middle. Obliquely the far side of
    the picture is smaller, so the bounds are meant to be wide. The smallest area is expected_share x e^2,
    between that of the small path and the user's. The small path is on while e^2 is at most its largest box, and
    compares frames between which a walker moves by gap_move_px (ours). Gaps of close_m, if it is set, are closed up to
    close_px, which would join ever more from a greater height.
    """
    gates, small, gap, close_px = base.gates, base.small, base.small.gap_frames, base.morphology.close_px
    scale = pixels_per_metre(distance_m, gates.focal_px)
    square = (gates.expected_size_m * scale) ** 2
    if base.morphology.close_m:
        close_px = int(np.clip(round(base.morphology.close_m * scale), 1, close_px))
    if small_gap_follows_distance(base):
        most = max(base.interval.maximum_frames, base.interval.frames)
        gap = int(np.clip(round(small.gap_move_px * rate_hz / (WALKER_M_S * scale)), 1, most))
    chosen = {
        "gates.min_area_px": int(min(gates.min_area_px, max(small.min_area_px, round(gates.expected_share * square)))),
        "small.on": small.on and square <= small.max_box_px,
        "small.gap_frames": gap,
        "morphology.close_px": close_px,
    }
    has_speed = base.history.on or base.persistence.on or base.refine.on or base.small.on
    max_speed = gates.max_speed_m_s * scale / rate_hz if has_speed else float("inf")
    bounds = Gates(gates.min_size_m * scale, gates.max_size_m * scale, max_speed)
    return DistanceSettings(with_parameters(base, chosen), distance_m, bounds)


def follow_distance(
    frame: int, current: DistanceSettings, flight: Flight | None, rate_hz: float, base: Settings
) -> tuple[DistanceSettings, tuple[Adjustment, ...]]:
    """The settings from this frame on, and the record of what changed. flight: None where no altitude is known.

    They change when the distance has changed by a fifth since their last change, or became known or unknown.
    """
    before_m = current.distance_m
    if flight is None:
        new, cause = DistanceSettings(base), "no telemetry for this frame"
        if before_m is None:
            return current, ()
    else:
        distance_m = flight.distance_m
        if before_m is not None and abs(distance_m - before_m) <= _DISTANCE_STEP * max(before_m, 1.0):
            return current, ()
        new, cause = settings_at(distance_m, rate_hz, base), describe_distance(flight)
        cause += "" if before_m is None else f", was {before_m:.1f} m"
    old = current.values()
    changed = {name: value for name, value in new.values().items() if value != old[name]}
    if not _can_search_small(new.settings):
        changed.pop("small.gap_frames", None)  # it has no effect
    return new, tuple(Adjustment(frame, name, old[name], value, cause) for name, value in changed.items())
