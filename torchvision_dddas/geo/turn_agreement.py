"""Find times at which a log and the pictures contradict each other: a sensor is stuck, leaps, or works wrongly.

The apparent turn of the ground over a few seconds is known twice, as for the clock offset: from the log, by the
camera's turn and motion over level ground, and from the clip's registrations. Both may be somewhat wrong. A wrong focal
length or height changes all turns by a factor, a clock offset shifts them, and noise of the positions adds to them.
Only a difference that none of these explains is a contradiction.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from torchvision_dddas.geo.aerial_locator import AerialLocator
from torchvision_dddas.geo.clock_offset import Turn, logged_turns, measure_clock_offset, seen_turns
from torchvision_dddas.types import Telemetry

# Turns are compared over each of _SPANS_S, every _STEP_S, for clock offsets up to _SHIFT_S. Differences count if they
# last for _LEAST_S at least.
_SPANS_S, _STEP_S, _SHIFT_S, _LEAST_S = (3.0, 6.0, 12.0), 0.25, 1.0, 0.5
# After a leap, log and pictures are compared with those before the leap for so long. The sum of large turns is not
# exact: a leap is undone if less than this share of it is left beyond what is allowed.
_LEAP_S, _UNDONE = 60.0, 0.2
# The allowed difference: a constant, so many standard deviations of a position, and a share of the larger turn.
_ALLOWED_RAD, _SIGMAS, _SHARE = 0.06, 4.0, 0.4
# A mended clock must leave this share of the spans to compare; the leap itself may look like a wrong clock.
_MENDED = 0.8
_LONGEST_S = 1e5  # longer clips have wrong time stamps
_ZOOM = 1.2  # a field of view that changes by a larger factor says that the camera zooms
# A log is resampled, because its turns are exact only for small steps. Turns over longer gaps, larger turns between two
# pictures, and turns near the ground are unknown.
_SAMPLE_S, _GAP_S, _LARGEST_RAD, _LOWEST_M = 0.1, 1.5, 0.3, 3.0


class Contradiction(NamedTuple):
    """A time in which log and pictures disagree, s, and both motions of the view over span_s.

    The motions are angles by which the ground turns or shifts in the view, degrees: a shift by the flying height is 57
    degrees. If the log leaps, begin_s is the time of the leap, and until end_s the log differs from before the leap.
    Otherwise the log moves too little or too much from begin_s to end_s.
    """

    begin_s: float
    end_s: float
    span_s: float
    seen_deg: float
    logged_deg: float

    @property
    def leaps(self) -> bool:
        """Whether the log moves more than the pictures within a short time."""
        return self.logged_deg > self.seen_deg and self.span_s == _SPANS_S[0]

    def describe(self, height_m: float) -> str:
        """Return what disagrees, in words. height_m: the flying height."""
        seen, logged = (
            f"by {np.radians(angle) * height_m:.0f} m or turns by {f'{angle:.0f}' if angle < 90 else 'over 90'} degrees"
            for angle in (self.seen_deg, self.logged_deg)
        )
        what = "the log leaps, so places before or after the leap are wrong"
        if not self.leaps:
            what = f"the log moves {'more' if self.logged_deg > self.seen_deg else 'less'} than the pictures: "
            what += "a sensor is stuck or wrong, or the height above the ground is wrong"
        return f"{what} (within {self.span_s:g} s the ground shifts {seen} in the pictures, and {logged} in the log)"


def describe_contradictions(locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]) -> str:
    """Return a message on the first contradiction of log and pictures, and the number of others; empty without any.

    seen: as in `find_contradictions`.
    """
    if not (found := find_contradictions(locator, seen)):
        return ""
    first, others = found[0], f"; and {len(found) - 1} more" if len(found) > 1 else ""
    when = f"from {first.begin_s:.1f} to {first.end_s:.1f} s"
    words = f"log and pictures contradict each other {when}: {first.describe(flying_height(locator))}{others}"
    return f"{locator.rate_warning}{words}"


def flying_height(locator: AerialLocator) -> float:
    """Return the median height of a log above the ground, m; NaN if unknown."""
    telemetry = locator.site.telemetry
    known = np.zeros(0) if telemetry is None else telemetry.altitude_m[np.isfinite(telemetry.altitude_m)]
    return float(np.median(known)) if len(known) else np.nan


def find_contradictions(locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]) -> list[Contradiction]:
    """Return the times at which a log and the pictures contradict each other, in order.

    seen: time of each frame, s, and (3, 3) pixel homography from the frame before, NaN if unknown. A log without the
    camera's own angles is not judged, because a course or a vehicle's nose does not turn with the camera. Neither is
    one of a camera that zooms, or one that agrees when its clock is mended.
    """
    telemetry = locator.site.telemetry
    if telemetry is None or telemetry.heading_from or locator.settings.aerial.mode != "pose":
        return []
    seen = [(when_s, motion) for when_s, motion in seen if np.isfinite(when_s)]
    time_s = np.array([when_s for when_s, _ in seen])
    if min(len(seen), len(telemetry)) < 2 or np.ptp(time_s) > _LONGEST_S or _zooms(telemetry):
        return []
    if min(float(np.median(np.diff(times))) for times in (time_s, telemetry.time_s)) <= 0:
        return []
    found, compared = _find(locator, telemetry, time_s, seen)
    if found and (offset := measure_clock_offset(locator, seen)) is not None:
        shifted = replace(telemetry, time_s=telemetry.time_s + offset[0])
        left, compared_then = _find(locator, shifted, time_s, seen)
        return found if left or compared_then < _MENDED * compared else []
    return found


def _find(
    locator: AerialLocator, telemetry: Telemetry, time_s: np.ndarray, seen: Sequence[tuple[float, np.ndarray]]
) -> tuple[list[Contradiction], int]:
    """Return the contradictions, and the number of short spans that were compared."""
    both = _BothTurns(locator, telemetry, time_s, seen)
    end_s = np.arange(time_s[0], time_s[-1] + _STEP_S / 2, _STEP_S)
    found, compared = list[Contradiction](), 0
    for span_s in _SPANS_S:
        # A leap that a shorter span shows needs no longer span.
        free_s = end_s[[not any(one.begin_s - 1e-6 < end < one.end_s + span_s for one in found) for end in end_s]]
        excess, in_clip, in_log = both.compare(free_s - span_s, free_s)
        compared = compared or int(np.isfinite(excess[:, 0]).sum())
        for run in _runs(np.max(excess, axis=1) > 0, free_s):
            if len(run) * _STEP_S > _LEAST_S:
                row, axis = run[excess[run].max(axis=1).argmax()], excess[run].max(axis=0).argmax()
                turns = abs(float(np.degrees(in_clip[row, axis]))), abs(float(np.degrees(in_log[row, axis])))
                one = Contradiction(float(free_s[run[0]]) - span_s, float(free_s[run[-1]]), span_s, *turns)
                found.append(_follow(one, both, end_s) if one.leaps else one)
    return _merge(found), compared


def _zooms(telemetry: Telemetry) -> bool:
    wide = telemetry.hfov_rad[np.isfinite(telemetry.hfov_rad)]
    narrowest, widest = np.quantile(wide, [0.05, 0.95]) if len(wide) else (1.0, 1.0)
    return bool(widest > _ZOOM * narrowest)


def _follow(leap: Contradiction, both: "_BothTurns", end_s: np.ndarray) -> Contradiction:
    """Return a leap that begins at its own time and ends when it is undone, after _LEAP_S or with the clip."""
    # All clock offsets see the leap only _SHIFT_S after it.
    at_s = leap.begin_s + leap.span_s - _SHIFT_S
    later_s = end_s[(end_s > leap.end_s) & (end_s <= at_s + _LEAP_S)]
    before_s = np.full(len(later_s), at_s - _SHIFT_S - _STEP_S)
    least = _UNDONE * np.radians(leap.logged_deg)
    undone_s = later_s[~(both.compare(before_s, later_s)[0] > least).any(axis=1)]
    # A clock offset shows that the leap is undone up to _SHIFT_S before that.
    last_s = undone_s[0] + _SHIFT_S if len(undone_s) else max([leap.end_s, *later_s])
    return leap._replace(begin_s=at_s, end_s=min(float(last_s), float(end_s[-1])))


def _merge(found: Sequence[Contradiction]) -> list[Contradiction]:
    """Return contradictions in order, without those that begin in an earlier one, such as the leap back."""
    kept: list[Contradiction] = []
    for one in sorted(found):
        if not kept or one.begin_s > kept[-1].end_s + _SHIFT_S:
            kept.append(one)
        elif not (one.leaps or kept[-1].leaps):
            kept[-1] = kept[-1]._replace(end_s=max(one.end_s, kept[-1].end_s))
    return kept


class _BothTurns:
    """The turns of the ground by pictures and by log, as functions of time."""

    def __init__(
        self,
        locator: AerialLocator,
        telemetry: Telemetry,
        time_s: np.ndarray,
        seen: Sequence[tuple[float, np.ndarray]],
    ) -> None:
        motions = [motion if np.isfinite(motion).all() else np.full((3, 3), np.nan) for _, motion in seen]
        turned = seen_turns(locator.camera, motions)
        turned[np.diff(time_s, prepend=time_s[0]) > _GAP_S] = np.nan
        turned[(np.abs(turned) > _LARGEST_RAD).any(axis=1)] = np.nan
        self._clip = Turn(time_s, turned, float(np.median(np.diff(time_s))))
        log = _resample(telemetry, locator, time_s)
        is_unknown = ~(np.isfinite(log.place + log.roll_rad[:, None]).all(axis=1) & (log.altitude_m > _LOWEST_M))
        full = np.where(is_unknown[:, None], np.nan, logged_turns(log))
        self._log = Turn(log.time_s, full, _SAMPLE_S)
        # Ground that is infinitely far away shows the camera's own turn alone.
        self._own = Turn(log.time_s, logged_turns(replace(log, altitude_m=np.full(len(log), np.nan))), _SAMPLE_S)
        stated_m = np.full(len(log), locator.settings.aerial.position_sigma_m)
        sigma_m = np.where(np.isfinite(log.position_sigma_m), log.position_sigma_m, stated_m)
        # Seen from straight above, a shift is no turn about the line of sight.
        level = np.abs(np.cos(np.nan_to_num(log.pitch_rad)))
        ones = np.ones_like(level)
        share = np.column_stack([ones, ones, level])
        shift = (sigma_m / np.maximum(np.nan_to_num(log.altitude_m), 1.0))[:, None] * share
        # An error that stays the same turns nothing; that of predicted rows grows.
        sigma_rad = np.nan_to_num(np.fmax(log.heading_sigma_rad, log.tilt_sigma_rad))
        angle = np.maximum(sigma_rad - np.median(sigma_rad), 0.0)[:, None]
        self._time_s, self._noise = log.time_s, _SIGMAS * (shift + angle)

    def compare(self, begin_s: np.ndarray, end_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for N spans by how much the turns differ too much, rad, the pictures' turns and the log's, (N, 3)."""
        shifts = np.arange(-_SHIFT_S, _SHIFT_S + _STEP_S / 2, _STEP_S)
        in_clip = self._clip.between(begin_s, end_s)
        in_log, own = (
            np.stack([turn.between(begin_s + shift, end_s + shift) for shift in shifts])
            for turn in (self._log, self._own)
        )
        # A wrong scale changes the shift of the ground alone, which the camera's own turn may hide.
        turns = [in_clip[None], in_log, in_clip - own, in_log - own]
        larger = np.max(np.broadcast_arrays(*(np.abs(turn) for turn in turns)), axis=0)
        excess = np.abs(in_clip - in_log) - _ALLOWED_RAD - self._noise_within(begin_s, end_s) - _SHARE * larger
        # An unknown turn contradicts nothing.
        return np.where(np.isnan(excess).any(axis=0), -np.inf, excess.min(axis=0)), in_clip, in_log[len(shifts) // 2]

    def _noise_within(self, begin_s: np.ndarray, end_s: np.ndarray) -> np.ndarray:
        """Return (N, 3) turns, rad, that noise of positions and angles adds about right, down and forward."""
        times = (begin_s, (begin_s + end_s) / 2, end_s)
        return np.max(
            [np.column_stack([np.interp(t, self._time_s, column) for column in self._noise.T]) for t in times], axis=0
        )


def _resample(telemetry: Telemetry, locator: AerialLocator, time_s: np.ndarray) -> Telemetry:
    """Return a log with a row every _SAMPLE_S of a clip, unknown within gaps, and with heights above the ground alone.

    time_s: of the frames.
    """
    begin_s = max(telemetry.time_s[0], time_s[0] - 2 * _SHIFT_S)
    end_s = min(telemetry.time_s[-1], time_s[-1] + 2 * _SHIFT_S)
    when_s = np.arange(begin_s, max(end_s, begin_s) + _SAMPLE_S / 2, _SAMPLE_S)
    after = np.diff(telemetry.time_s, append=np.inf)
    in_gap = after[np.searchsorted(telemetry.time_s, when_s, "right") - 1] > _GAP_S
    in_gap[when_s >= telemetry.time_s[-1]] = False

    def at(values: np.ndarray) -> np.ndarray:
        return np.where(in_gap, np.nan, np.interp(when_s, telemetry.time_s, values))

    def angle(values: np.ndarray) -> np.ndarray:
        known = np.isfinite(values)
        unwrapped = np.full(len(values), np.nan)
        unwrapped[known] = np.unwrap(values[known])
        return at(unwrapped)

    height_m, elevation = telemetry.altitude_m, locator.site.elevation
    if elevation is not None:
        height_m = np.where(np.isfinite(height_m), height_m, telemetry.above_sea_m - elevation.base_m)
    return Telemetry(
        when_s,
        altitude_m=at(height_m),
        speed_m_s=np.zeros(len(when_s)),
        place=np.column_stack([at(column) for column in telemetry.place.T]),
        geographic=telemetry.geographic,
        heading_rad=angle(telemetry.heading_rad),
        pitch_rad=at(telemetry.pitch_rad),
        roll_rad=angle(telemetry.roll_rad),
        heading_sigma_rad=at(telemetry.heading_sigma_rad),
        tilt_sigma_rad=at(telemetry.tilt_sigma_rad),
        position_sigma_m=at(telemetry.position_sigma_m),
    )


def _runs(holds: np.ndarray, when_s: np.ndarray) -> list[np.ndarray]:
    """Return the indices of each run of true values (N,) at consecutive times (N,)."""
    rows = np.flatnonzero(holds)
    apart = np.flatnonzero(np.diff(when_s[rows]) > 1.5 * _STEP_S) + 1
    return [run for run in np.split(rows, apart) if len(run)]
