"""Align a stored log of telemetry with live pictures."""

from dataclasses import replace
from math import isfinite

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.maps.ground_tracks import iso_utc
from torchvision_dddas.types import Landmarks, Telemetry

_OLD_S = 60.0  # a log that ended this long before the first picture is from another time


def align_log(log: Telemetry, start_utc_s: float, clock_offset_s: float) -> Telemetry:
    """Return a log with a clock, its times counted from the first picture.

    start_utc_s: seconds since 1970 at the first picture, by the machine's clock. clock_offset_s: delay of a picture
    after its exposure, as in aerial.clock_offset_s.
    """
    start_utc_s -= clock_offset_s
    return replace(log, time_s=log.time_s + (log.start_utc_s - start_utc_s), start_utc_s=start_utc_s)


def describe_log(log: Telemetry, is_recording: bool, now_utc_s: float, clock_offset_s: float) -> str:
    """Return a note on how a log is aligned with the pictures of a live run.

    now_utc_s: seconds since 1970 at the first picture. Raise InputError for a log from another time, because its places
    would be sent as current places.
    """
    has_clock = isfinite(log.start_utc_s)
    if is_recording:
        return f"times of day are those of {'its telemetry' if has_clock else 'playing it'}: this is a recording"
    if not has_clock:
        if log.latest_utc_s + log.time_s[-1] < now_utc_s - _OLD_S:
            (first,) = iso_utc(np.array([log.latest_utc_s + log.time_s[0]]))
            raise InputError(
                f"the telemetry {log.origin} is from {first[:10]} or before, by its dates, which lack a time zone: its "
                "places are not current. Give a log of the time of the pictures, or leave --telemetry out"
            )
        return (
            f"the telemetry {log.origin} gives no time of day: its time 0 is taken as the first picture's, which is "
            "right for a camera that stands still; otherwise give a log with times of day"
        )
    first_s, last_s = align_log(log, now_utc_s, clock_offset_s).time_s[[0, -1]].tolist()
    first, last, now = iso_utc(np.append(log.start_utc_s + log.time_s[[0, -1]], now_utc_s))
    if last_s < -_OLD_S:
        raise InputError(
            f"the telemetry {log.origin} ends at {last}, {-last_s:.0f} s before the first picture ({now} by this "
            "machine's clock): its places are not current. Give a log of the time of the pictures, set the clock, "
            "or leave --telemetry out; for a recorded clip give the file of the clip, not an address"
        )
    outside = f", and the first picture is of {now}: before and after the log nothing is located by it"
    return f"the telemetry is aligned by the clock, {first} to {last}{outside if not first_s <= 0 <= last_s else ''}"


def describe_landmarks(landmarks: Landmarks) -> list[str]:
    """Return a note for a live run with moving landmarks: a stored table does not know their current places."""
    known = landmarks[np.isfinite(landmarks.place).all(axis=1)]
    moved = (np.ptp(known.place[known.landmark == k], axis=0).any() for k in np.unique(known.landmark))
    words = f"reports in {landmarks.path} count from the first picture: moving landmarks are placed at another time"
    return [words] if any(moved) else []
