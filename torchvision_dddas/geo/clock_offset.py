"""Find the offset between the clock of a log and that of its clip from the camera's turns, which both record.

Compare the turns over one second in the log with the turns from the clip's registrations, for each clock offset. The
clip is interpolated at the times of the log, not the reverse: the noise of an interpolated log is smallest halfway
between two samples, which would pull the offset there. Scale and mean are free in each axis, because a focal length may
be guessed. The standard deviation is computed from the residuals, which need be neither white nor stationary.
"""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.geo.aerial_locator import AerialLocator
from torchvision_dddas.geometry import axes_of
from torchvision_dddas.types import Camera, Elevation, Float, Telemetry

# Offsets tried first: their range and step; how many of the best are refined; and the Gauss-Newton steps for each.
_REACH_S, _STEP_S, _BEST, _REFINEMENTS = 30.0, 0.1, 6, 5
# Turns are compared over _SPAN_S, smoothed over _SMOOTH_S, and at least _LEAST of them are needed.
_SPAN_S, _SMOOTH_S, _LEAST = 1.0, 0.2, 20
# Residuals further apart than _MEMORY_S are independent, and so are blocks of _BLOCK_S.
_MEMORY_S, _BLOCK_S, _LEAST_BLOCKS = 3.0, 2.0, 5
# Limits of the ratio of the clip's turns to the log's; a wrong focal length makes them differ.
_LEAST_SCALE, _MOST_SCALE = 0.5, 2.0
# Required margin in log likelihood over all other offsets: four standard deviations.
_MARGIN = 8.0
_TINY = 1e-12


def describe_clock_offset(locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]) -> str:
    """Return a message that says how to align log and clip; empty if they are aligned or the data do not show it.

    seen: time of each frame, s, and (3, 3) pixel homography from the frame before, NaN if unknown.
    """
    if (found := measure_clock_offset(locator, seen)) is None:
        return ""
    offset_s, sigma_s = found
    when = f"{abs(offset_s):.3f} s {'later' if offset_s > 0 else 'earlier'} in the pictures than in the log"
    return (
        f"{locator.rate_warning}log and clip are not synchronised: the camera turns {when} (sigma {sigma_s:.3f} s); "
        f"set aerial.clock_offset_s={locator.settings.aerial.clock_offset_s + offset_s:.3f}"
    )


def measure_clock_offset(
    locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]
) -> tuple[float, float] | None:
    """Return the seconds to add to the log's times, and their standard deviation; None if aligned or not known.

    seen: as in `describe_clock_offset`.
    """
    telemetry, camera = locator.site.telemetry, locator.camera
    # A heading from the course, or from the nose of a vehicle with a gimbal, does not turn with the camera.
    if telemetry is None or telemetry.heading_from or len(seen) < _LEAST:
        return None
    time_s, turned = np.array([time for time, _ in seen]), seen_turns(camera, [motion for _, motion in seen])
    found = find_clock_offset(time_s, turned, telemetry.time_s, logged_turns(telemetry, locator.site.elevation))
    # The time of a picture is known only to within half a frame interval.
    if found is None or abs(found[0]) <= max(3 * found[1], float(np.median(np.diff(time_s))) / 2):
        return None
    return found[0], max(found[1], 0.001)


def seen_turns(camera: Camera, motions: Sequence[np.ndarray]) -> Float[np.ndarray, "N 3"]:
    """Return the apparent turn of the ground between two pictures, in the axes of `logged_turns`.

    motions: (3, 3) pixel homographies from the frame before, NaN if unknown.
    """
    (fu, fv), (u, v) = camera.focal_px, camera.centre_px
    pixel_from_ray = np.array([[fu, 0, u], [0, fv, v], [0, 0, 1]])
    return _angles(np.linalg.inv(pixel_from_ray) @ np.array(motions) @ pixel_from_ray)


def logged_turns(telemetry: Telemetry, elevation: Elevation | None = None) -> Float[np.ndarray, "N 3"]:
    """Return the apparent turn of level ground between two samples of the log, by the camera's turn and motion.

    telemetry: in local metres. Return angles about right, down and forward, rad; NaN if unknown.
    """
    height = telemetry.altitude_m
    if elevation is not None:
        height = np.where(np.isfinite(height), height, telemetry.above_sea_m - elevation.base_m)
    axes = axes_of(telemetry.heading_rad, telemetry.pitch_rad, np.nan_to_num(telemetry.roll_rad))
    place = np.column_stack([telemetry.place, height])
    # Ground at unknown depth is treated as infinitely far away.
    shift = np.where(height[:-1, None] > 0, (place[:-1] - place[1:]) / np.maximum(height[:-1, None], _TINY), 0.0)
    plane = axes[:-1] - np.nan_to_num(shift)[:, :, None] * axes[:-1, 2:]
    return np.concatenate([np.full((1, 3), np.nan), _angles(np.swapaxes(axes[1:], 1, 2) @ plane)])


def _angles(now_from_before: np.ndarray) -> np.ndarray:
    """Return (N, 3) small angles about right, down and forward of homographies (N, 3, 3) between camera rays."""
    h = now_from_before / now_from_before[:, 2:, 2:]
    return np.stack([h[:, 1, 2], -h[:, 0, 2], (h[:, 0, 1] - h[:, 1, 0]) / 2], axis=1)


class Turn:
    """A turn as a function of time: smoothed, and linear between samples."""

    def __init__(self, time_s: np.ndarray, steps: np.ndarray, step_s: float, every: int = 1) -> None:
        """steps: (N, 3) turns from the sample before, NaN if unknown. step_s: their interval. every: keep each n-th."""
        unknown = ~np.isfinite(steps).all(axis=1)
        # The last column counts the unknown steps, so that turns across an unknown step can be discarded.
        sums = np.cumsum(np.column_stack([np.where(unknown[:, None], 0.0, steps), unknown]), axis=0)
        box = np.ones(2 * round(_SMOOTH_S / step_s / 2) + 1)
        weights = np.convolve(box, box) / len(box) ** 2
        self.time_s, *self._turn = (np.convolve(c, weights, "valid")[::every] for c in (time_s, *sums.T))

    def between(self, begin_s: np.ndarray, end_s: np.ndarray) -> np.ndarray:
        """Return the (N, 3) turns between times (N,) and (N,); NaN if unknown."""
        ends = ((np.interp(t, self.time_s, c, np.nan, np.nan) for t in (begin_s, end_s)) for c in self._turn)
        *turn, unknown = (end - begin for begin, end in ends)
        return np.where(unknown < 1e-9, turn, np.nan).T


def find_clock_offset(
    time_s: Float[np.ndarray, "N"],
    turned_rad: Float[np.ndarray, "N 3"],
    log_s: Float[np.ndarray, "M"],
    logged_rad: Float[np.ndarray, "M 3"],
) -> tuple[float, float] | None:
    """Return the time in seconds to add to a log so that its turns match the clip's turns, and its standard deviation.

    turned_rad, logged_rad: turns from the frame or sample before, in the same axes, NaN if unknown. Return None if no
    offset stands out, for example if the camera does not turn, or turns periodically.
    """
    frame_s, sample_s = (float(np.median(np.diff(t))) if len(t) > 1 else 0.0 for t in (time_s, log_s))
    if not (frame_s > 0 and sample_s > 0) or min(np.ptp(time_s), np.ptp(log_s)) < 2 * _SPAN_S:
        return None
    every = max(round(_STEP_S / sample_s), 1)
    step_s = every * sample_s
    clip, log = Turn(time_s, turned_rad, frame_s), Turn(log_s, logged_rad, sample_s, every)
    near = log.time_s[(log.time_s > time_s[0] - _REACH_S) & (log.time_s < time_s[-1] + _REACH_S)]
    ahead = max(round(_SPAN_S / step_s), 1)
    begin, end = near[:-ahead], near[ahead:]
    logged = log.between(begin, end)
    logged[end - begin > 1.5 * ahead * step_s] = np.nan  # spans a gap of the log
    least = max(min(np.ptp(time_s), np.ptp(log_s)) / step_s / 2, _LEAST)

    def seen(offset_s: float) -> np.ndarray:
        return clip.between(begin + offset_s, end + offset_s)

    def refine(offset_s: float) -> tuple[float, float, float, float]:
        """Search near an offset. Return the best likelihood, offset and sigma, and the number of independent turns."""
        sigma_s = count = 0.0
        for _ in range(_REFINEMENTS):
            slope = (seen(offset_s + _STEP_S / 10) - seen(offset_s - _STEP_S / 10)) / (_STEP_S / 5)
            change_s, sigma_s, count = _improve(logged, seen(offset_s), slope, step_s)
            offset_s += float(np.clip(change_s, -_STEP_S, _STEP_S))
        return _fit(logged, seen(offset_s), least)[0], offset_s, sigma_s, count

    tried = np.arange(-int(_REACH_S / _STEP_S) - 1, int(_REACH_S / _STEP_S) + 2) * _STEP_S
    likelihood = np.array([_fit(logged, seen(offset), least)[0] for offset in tried])
    inner = likelihood[1:-1]
    peaks = 1 + np.flatnonzero((inner > 0) & (inner >= likelihood[:-2]) & (inner >= likelihood[2:]))
    found = sorted((refine(float(tried[k])) for k in peaks[np.argsort(-likelihood[peaks])][:_BEST]), reverse=True)
    if not found or found[0][0] <= 0:
        return None
    best, offset_s, sigma_s, count = found[0]
    rival = max((one[0] for one in found if abs(one[1] - offset_s) > _STEP_S / 5), default=0.0)
    return (offset_s, sigma_s) if count * (best - rival) > _MARGIN else None


def _fit(logged: np.ndarray, seen: np.ndarray, least: float) -> tuple[float, np.ndarray]:
    """Return the likelihood of a log's turns (N, 3), given a clip's turns (N, 3), and the scale between them (3,).

    The likelihood is a logarithm for one turn, with normal residuals of unknown variance in each axis. least: with
    fewer common turns the likelihood is 0.
    """
    known = np.isfinite(logged + seen).all(axis=1)
    if known.sum() < least:
        return 0.0, np.zeros(3)
    logged, seen = (turn[known] - turn[known].mean(axis=0) for turn in (logged, seen))
    both = (seen * logged).sum(axis=0)
    scale = both / np.maximum((seen**2).sum(axis=0), _TINY)
    scale = np.where((scale > _LEAST_SCALE) & (scale < _MOST_SCALE), scale, 0.0)
    explained = scale * both / np.maximum((logged**2).sum(axis=0), _TINY)
    return -float(np.log1p(-explained.clip(0, 1 - _TINY)).sum()) / 2, scale


def _improve(logged: np.ndarray, seen: np.ndarray, slope: np.ndarray, step_s: float) -> tuple[float, float, float]:
    """Return the change of an offset that fits the turns better, its standard deviation, s, and the independent turns.

    slope: (N, 3) derivative of `seen` by the offset. The variance is the largest of three estimates: for white
    residuals, for stationary residuals of any correlation, and by blocks, which holds if turning adds noise.
    """
    scale, known = _fit(logged, seen, 1)[1], np.isfinite(logged + seen + slope).all(axis=1)
    if (n := int(known.sum())) < _LEAST:
        return 0.0, np.inf, 0.0
    logged, seen, slope = (turn[known] - turn[known].mean(axis=0) for turn in (logged, seen, slope))
    slope = slope - seen * ((seen * slope).sum(axis=0) / np.maximum((seen**2).sum(axis=0), _TINY))
    left = logged - scale * seen
    spread = np.sqrt(np.maximum((left**2).mean(axis=0), _TINY))
    left, slope = left / spread, scale * slope / spread
    memory, blocks = min(round(_MEMORY_S / step_s), n // 4), max(round(n * step_s / _BLOCK_S), _LEAST_BLOCKS)
    alike = [(left[j:] * left[: n - j]).mean(axis=0) @ (slope[j:] * slope[: n - j]).sum(axis=0) for j in range(memory)]
    weights = np.r_[1, (4 - 4 * np.arange(1, memory) / memory).clip(0, 2)]
    scores = np.bincount(np.arange(n) * blocks // n, (left * slope).sum(axis=1), blocks)
    information = max(float((slope**2).sum()), _TINY)
    excess = max(information, float(weights @ alike), float(scores @ scores)) / information * blocks / (blocks - 2)
    return float(scores.sum()) / information, float(np.sqrt(excess / information)), n / min(excess, _MEMORY_S / step_s)
