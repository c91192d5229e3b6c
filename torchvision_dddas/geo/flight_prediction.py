"""Continue the reports of a vehicle for a moment beyond the newest one, with standard deviations that grow."""

import math
from dataclasses import replace

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.types import COLUMNS_OF_TELEMETRY, Telemetry

# Reports are continued over three of their intervals, within these limits, by so many rows.
_LEAST_S, _MOST_S, _ROWS = 2.0, 6.0, 8
# A rate is that over _RATE_S. The errors of predictions are those of the last _PAST_S, if there are _LEAST of them.
_RATE_S, _PAST_S, _LEAST = 1.0, 20.0, 5
_TRIED = 400  # about so many of these predictions are tried, so that a flood of reports costs no more time
# Growth of the standard deviation in a second if the past does not show it. A known past reduces it to the share _SURE.
_GROWTH = {
    "place": 2.0,
    **dict.fromkeys(("altitude_m", "above_sea_m", "above_ellipsoid_m"), 1.0),
    **dict.fromkeys(("heading_rad", "vehicle_heading_rad"), math.radians(5)),
    **dict.fromkeys(("pitch_rad", "roll_rad"), math.radians(3)),
}
_SURE = 0.1


def predict_flight(log: Telemetry, parameters: AerialParameters) -> Telemetry:
    """Return the log with rows after its last one, whose standard deviations grow.

    log: in local metres. Each quantity is kept, or continued at its rate over the last second, whichever predicted the
    last 20 s of the log better. The errors of these predictions are the growth of its standard deviation. A quantity
    that is reported less often than others is continued from its own last report.
    """
    if len(log) < 2:
        return log
    reach_s = float(np.clip(3 * np.median(np.diff(log.time_s)), _LEAST_S, _MOST_S))
    time_s = np.concatenate([log.time_s, log.time_s[-1] + reach_s * np.arange(1, _ROWS + 1) / _ROWS])
    columns, growth = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name in COLUMNS_OF_TELEMETRY:
        values = np.asarray(getattr(log, name))
        columns[name], growth[name] = _continue(log.time_s, values, time_s, name)
    usual_m = np.hypot(parameters.altitude_sigma * columns["altitude_m"], parameters.altitude_sigma_m)
    heights = [growth[name] for name in ("altitude_m", "above_sea_m", "above_ellipsoid_m")]
    has_pitch = np.where(np.isfinite(columns["pitch_rad"]), 1.0, np.nan)  # without it the tilt is a guess
    for name, usual, grown in (
        ("position_sigma_m", parameters.position_sigma_m, growth["place"]),
        ("heading_sigma_rad", math.radians(parameters.heading_sigma_deg), growth["heading_rad"]),
        ("tilt_sigma_rad", math.radians(parameters.tilt_sigma_deg) * has_pitch, growth["pitch_rad"]),
        ("altitude_sigma_m", usual_m, np.max(heights, axis=0)),
    ):
        known = np.isfinite(columns[name])
        columns[name] = np.hypot(np.where(known, columns[name], usual), grown)
    return replace(log, time_s=time_s, **columns)  # type: ignore[arg-type]


def _continue(time_s: np.ndarray, values: np.ndarray, until_s: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a quantity (N,) or (N, 2) at all times until_s (M,), which begin with time_s (N,); and its errors (M,)."""
    whole, errors = np.full((len(until_s), *values.shape[1:]), np.nan), np.zeros(len(until_s))
    whole[: len(values)] = values
    wide = whole.reshape(len(whole), -1)
    rows = np.flatnonzero(np.isfinite(wide[: len(values)]).all(axis=1) & (time_s >= time_s[-1] - _PAST_S))
    if not len(rows) or time_s[-1] - time_s[rows[-1]] > _LEAST_S:
        return whole, errors
    # A reader repeats the value of a slower quantity until its next report.
    changes = 1 + np.flatnonzero((np.diff(wide[rows], axis=0) != 0).any(axis=1))
    if len(changes) and time_s[rows[-1]] - time_s[rows[changes[-1]]] < _RATE_S:
        rows = rows[: changes[-1] + 1]
    later = np.arange(rows[-1] + 1, len(whole))
    wide[later] = wide[rows[-1]]
    if name in _GROWTH:
        moved, errors[later] = _predict(time_s[rows], wide[rows], until_s[later] - time_s[rows[-1]], name)
        wide[later] += moved
    return whole, errors


def _predict(time_s: np.ndarray, values: np.ndarray, ahead_s: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the movement (A, D) beyond the last of values (N, D), and its standard deviation (A,)."""
    if name.endswith("_rad"):
        values = np.unwrap(values, axis=0)

    def at(when: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(when, time_s, column, np.nan, np.nan) for column in values.T], axis=-1)

    step = max(1, len(time_s) // _TRIED)
    tried = slice((len(time_s) - 1) % step, None, step)  # with the last one
    begin_s, begin = time_s[tried], values[tried]
    rate = (begin - at(begin_s - _RATE_S)) / _RATE_S
    moved, later = rate[:, None] * ahead_s[:, None], at(begin_s[:, None] + ahead_s) - begin[:, None]
    errors = [np.linalg.norm(later - shift, axis=-1) for shift in (0 * moved, moved)]
    grown = ahead_s * _GROWTH[name]
    is_moving = bool(np.isfinite(rate[-1]).all())
    if is_moving and np.isfinite(errors[1]).sum(axis=0).min() >= _LEAST:
        spread = [np.sqrt(np.nanmean(error**2, axis=0)) for error in errors]
        is_moving = bool(spread[1][-1] < spread[0][-1])
        grown = np.maximum.accumulate(np.maximum(spread[is_moving], _SURE * grown))
    return moved[-1] if is_moving else np.zeros_like(moved[-1]), grown
