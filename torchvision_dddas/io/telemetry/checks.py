"""What of a log can be, what cannot, and what is missing from it."""

import numpy as np

from torchvision_dddas.io.telemetry.log import OWN, Log

# A barometer's zero drifts by metres in a flight; below this the altitude is none above ground.
_DEEP_M = -5.0
# What lies beyond these is damage, not flight.
_SANE = {"altitude_m": (-1e4, 1e5), "above_sea_m": (-1e4, 1e5), "speed_m_s": (0.0, 1e3), "hfov_rad": (1e-3, np.pi)}


def in_order(log: Log, rows: np.ndarray) -> np.ndarray:
    """Sorted by time; of samples at the same time the last. A single time that no other goes with is left out."""
    rows = rows[np.isfinite(rows[:, 0])]
    rows = rows[~_stray(rows[:, 0], log.jitter_s)]
    back = np.diff(rows[:, 0])
    if len(back) and back.min() < -log.jitter_s:
        i = int(np.argmax(back < -log.jitter_s))
        raise log.refuse(
            f"time runs back from {rows[i, 0]:.3f} to {rows[i + 1, 0]:.3f} s; are these two recordings in one file?",
            int(rows[i + 1, 2]),
        )
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return rows[np.append(np.diff(rows[:, 0]) > 0, True)] if len(rows) else rows


def _stray(times: np.ndarray, jitter_s: float) -> np.ndarray:
    """Which times are out of order though those around them are not: a damaged one, not another recording."""
    stray = np.zeros(len(times), bool)
    if len(times) < 3 or not np.isfinite(jitter_s):
        return stray
    before, after = times[:-2], times[2:]
    around = (before <= after) & ((times[1:-1] < before - jitter_s) | (times[1:-1] > after + jitter_s))
    stray[1:-1] = around
    stray[0] = times[0] > times[1] + jitter_s and times[1] <= times[2]
    stray[-1] = times[-1] < times[-2] - jitter_s and times[-3] <= times[-2]
    # A day without a sample, then one: its time is damaged.
    stray[-1] |= times[-1] > times[-2] + 86_400
    return stray


def sane(log: Log, said: dict[str, np.ndarray]) -> None:
    """What cannot be is unknown."""
    for name, rows in said.items():
        if (endless := np.isinf(rows[:, 1])).any():
            where = int(rows[np.argmax(endless), 2])
            log.note(f"{log.where} {where}: {name} is infinite, which cannot be; {endless.sum()} left out")
            rows[endless, 1] = np.nan
    for name, (least, most) in _SANE.items():
        if name in said:
            rows = said[name]
            with np.errstate(invalid="ignore"):
                wrong = ~((rows[:, 1] >= least) & (rows[:, 1] <= most)) & ~np.isnan(rows[:, 1])
            if wrong.any():
                _, value, where = rows[np.argmax(wrong)]
                log.note(f"{log.where} {int(where)}: {name} is {value:g}, which cannot be; {wrong.sum()} left out")
                rows[wrong, 1] = np.nan


def on_the_globe(log: Log, said: dict[str, np.ndarray]) -> None:
    """Raises InputError for degrees that are none; longitude and latitude 0 stand for no fix."""
    for name, most in (("latitude_deg", 90.0), ("longitude_deg", 180.0)):
        if name not in said:
            continue
        wrong = np.abs(said[name][:, 1]) > most
        if wrong.any():
            _, value, where = said[name][np.argmax(wrong)]
            hint = "; are longitude and latitude swapped?" if name == "latitude_deg" and abs(value) <= 180 else ""
            raise log.refuse(f"{name} is {value:g}; wanted -{most:g} to {most:g}{hint}", int(where))
    if {"longitude_deg", "latitude_deg"} <= set(said):
        longitude, latitude = said["longitude_deg"], said["latitude_deg"]
        if len(longitude) == len(latitude):
            nowhere = (longitude[:, 1] == 0) & (latitude[:, 1] == 0)
            longitude[nowhere, 1] = latitude[nowhere, 1] = np.nan
            if nowhere.any():
                log.note(f"{nowhere.sum()} of {len(nowhere)} places are 0, 0: no fix; unknown there")


def note_lacks(log: Log, said: dict[str, np.ndarray]) -> None:
    """Where no place or no altitude is told, or one that is below the ground."""
    if not {"latitude_deg", "east_m"} & set(said) and log.kind != OWN:
        log.note("no place is told anywhere")
    if "altitude_m" not in said:
        log.note("no altitude above ground is told anywhere")
        return
    deep = said["altitude_m"][:, 1] < _DEEP_M
    if deep.any():
        _, value, where = said["altitude_m"][np.argmax(deep)]
        log.note(
            f"{log.where} {int(where)}: the altitude above ground is {value:g} m, below the ground; "
            f"{deep.sum()} of {len(deep)} are below {_DEEP_M:g} m; is it counted from another place?"
        )


def longest_silence_s(known: np.ndarray, bridge_s: float) -> float:
    """How long a quantity may be silent and still be taken to go on evenly."""
    return max(1.5 * float(np.median(np.diff(known))), bridge_s) if len(known) > 1 else bridge_s


def note_silence(log: Log, said: dict[str, np.ndarray]) -> None:
    """Where the place is unknown for a while between its samples."""
    for name in ("latitude_deg", "east_m"):
        known = said[name][np.isfinite(said[name][:, 1]), 0] if name in said else np.zeros(0)
        steps = np.diff(known)
        gaps = np.flatnonzero(steps > longest_silence_s(said[name][:, 0], log.bridge_s)) if len(steps) else steps
        if len(gaps):
            longest = gaps[np.argmax(steps[gaps])]
            log.note(
                f"the place is unknown for a while {len(gaps)} time{'s' * (len(gaps) > 1)}, the longest for "
                f"{steps[longest]:.1f} s after {known[longest]:.1f} s"
            )
