"""Find times at which a log and the pictures contradict each other: a sensor is stuck, leaps, or works wrongly.

The apparent turn of the ground over a few seconds is known twice, as for the clock offset: from the log, by the
camera's turn and motion over level ground, and from the clip's registrations. Both may be somewhat wrong. A wrong focal
length or height changes all turns by a factor, a clock offset shifts them, and noise of the positions adds to them.
Only a difference that none of these explains is a contradiction.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchvision_dddas.geo.aerial_locator import AerialLocator
from torchvision_dddas.geo.clock_offset import Turn, logged_turns, seen_turns
from torchvision_dddas.types import Telemetry

# Turns are compared over each of _SPANS_S, every _STEP_S, for clock offsets up to _SHIFT_S. Differences count if they
# last for _LEAST_S at least.
_SPANS_S, _STEP_S, _SHIFT_S, _LEAST_S = (3.0, 6.0, 12.0), 0.25, 1.0, 0.5
# The allowed difference: a constant, so many standard deviations of a position, and a share of the larger turn.
_ALLOWED_RAD, _SIGMAS, _SHARE = 0.06, 4.0, 0.4
_ZOOM = 1.2  # a field of view that changes by a larger factor says that the camera zooms


class Contradiction(NamedTuple):
    """A time, s, in which log and pictures disagree, and the turns, degrees, over the span where it is largest."""

    begin_s: float
    end_s: float
    span_s: float
    seen_deg: float
    logged_deg: float

    def describe(self) -> str:
        """Return the turns in words."""
        return (
            f"within {self.span_s:g} s the view turns or shifts by {self.seen_deg:.0f} degrees in the pictures, and by "
            f"{self.logged_deg:.0f} in the telemetry: a sensor may be stuck or wrong, or the picture turned"
        )


def describe_contradictions(locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]) -> str:
    """Return a message on the first contradiction of log and pictures, and the number of others; empty without any.

    seen: as in `find_contradictions`.
    """
    if not (found := find_contradictions(locator, seen)):
        return ""
    first, others = found[0], f"; {len(found) - 1} more times" if len(found) > 1 else ""
    when = f"from {first.begin_s:.1f} to {first.end_s:.1f} s"
    return f"log and pictures contradict each other {when}: {first.describe()}{others}"


def find_contradictions(locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]) -> list[Contradiction]:
    """Return the times at which a log and the pictures contradict each other, in order.

    seen: time of each frame, s, and (3, 3) pixel homography from the frame before, NaN if unknown. A log without the
    camera's own angles is not judged, because a course or a vehicle's nose does not turn with the camera. Neither is
    one of a camera that zooms.
    """
    telemetry = locator.site.telemetry
    if telemetry is None or telemetry.heading_from or locator.settings.aerial.mode != "pose":
        return []
    wide = telemetry.hfov_rad[np.isfinite(telemetry.hfov_rad)]
    if min(len(seen), len(telemetry)) < 2 or (len(wide) and wide.max() > _ZOOM * wide.min()):
        return []
    time_s = np.array([time for time, _ in seen])
    steps_s = [float(np.median(np.diff(times))) for times in (time_s, telemetry.time_s)]
    if min(steps_s) <= 0:
        return []
    clip = Turn(time_s, seen_turns(locator.camera, seen), steps_s[0])
    log = Turn(telemetry.time_s, logged_turns(telemetry, locator.site.elevation), steps_s[1])
    end_s = np.arange(time_s[0], time_s[-1] + _STEP_S / 2, _STEP_S)
    allowed = _ALLOWED_RAD + _position_noise(telemetry, locator.settings.aerial.position_sigma_m, end_s)
    shifts = np.arange(-_SHIFT_S, _SHIFT_S + _STEP_S / 2, _STEP_S)
    excess, turns, found_s = [], [], np.zeros(0)
    for span_s in _SPANS_S:
        in_clip = clip.between(end_s - span_s, end_s)
        in_log = np.stack([log.between(end_s - span_s + shift, end_s + shift) for shift in shifts])
        larger = np.maximum(np.abs(in_clip), np.abs(in_log))
        over = np.abs(in_clip - in_log) - allowed - _SHARE * larger
        # An unknown turn contradicts nothing. A leap that a shorter span shows is over when that span is over.
        had = np.array([((found_s > end - span_s - _SHIFT_S) & (found_s <= end)).any() for end in end_s])
        unknown = np.isnan(over).any(axis=0) | had[:, None]
        excess.append(np.where(unknown, -np.inf, over.min(axis=0)))
        found_s = np.r_[found_s, end_s[(excess[-1] > 0).any(axis=1)]]
        turns.append((in_clip, in_log[len(shifts) // 2]))
    found = []
    worst = np.max(excess, axis=(0, 2))
    for run in _runs(worst > 0):
        if len(run) * _STEP_S > _LEAST_S:
            row = run[worst[run].argmax()]
            span, axis = np.unravel_index(np.stack(excess)[:, row].argmax(), (len(_SPANS_S), 3))
            seen_deg, logged_deg = (abs(float(np.degrees(turn[row, axis]))) for turn in turns[span])
            found.append(
                Contradiction(float(end_s[run[0]]), float(end_s[run[-1]]), _SPANS_S[span], seen_deg, logged_deg)
            )
    return found


def _position_noise(telemetry: Telemetry, sigma_m: float, when_s: np.ndarray) -> np.ndarray:
    """Return (N, 3) turns, rad, that noise of the positions adds about right, down and forward."""
    height_m = np.maximum(np.nan_to_num(telemetry.altitude_m), 1.0)
    # Seen from straight above, a shift is no turn about the line of sight.
    level = np.abs(np.cos(np.nan_to_num(telemetry.pitch_rad)))
    noise = _SIGMAS * sigma_m / height_m[:, None] * np.column_stack([np.ones_like(level), np.ones_like(level), level])
    return np.column_stack([np.interp(when_s, telemetry.time_s, column) for column in noise.T])


def _runs(holds: np.ndarray) -> list[np.ndarray]:
    """Return the indices of each run of consecutive true values."""
    rows = np.flatnonzero(holds)
    return [run for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(run)]
