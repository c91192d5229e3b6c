"""Detect failures of sensors: vehicles whose reports stop or leap, and pictures that repeat or jerk."""

import math
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.types import Frame, Landmarks, Registration, Telemetry

# A vehicle is silent if it has not reported for this time, or for _SLOWER times the usual time between its reports if
# that is longer.
_SILENT_S = 2.0
_SLOWER = 3.0
# A report is a leap if its distance from the last report exceeds the sum of _LEAP_M, _LEAP_SIGMAS standard deviations,
# and the distance that a vehicle drives at _FASTEST_M_S.
_LEAP_M, _LEAP_SIGMAS, _FASTEST_M_S = 3.0, 6.0, 5.0
# A jerk, for example by a gust, is a change of the ground's velocity in the picture's centre by more than _JERK_M_S
# from the median of the last _USUAL_S.
_JERK_M_S, _USUAL_S = 4.0, 2.0


@dataclass(frozen=True)
class Notice:
    """A failure or a recovery of a sensor, noticed at a frame."""

    frame: int
    time_s: float
    text: str


class SensorMonitor:
    """Compares reports and pictures with earlier reports and pictures. Call its checks once for each scene."""

    def __init__(self, names: tuple[str, ...], rate_hz: float) -> None:
        """Start without reports. names: names of the ground vehicles. rate_hz: frames a second."""
        self._names, self._rate_hz = names, rate_hz
        self._picture: np.ndarray | None = None
        self._repeated = 0
        self._usual: list[tuple[float, np.ndarray]] = []
        self._jerked_s = -math.inf
        self._silent: dict[str, float] = {}
        self._last: dict[int, tuple[float, np.ndarray]] = {}
        self._notices: list[Notice] = []

    def notices(self) -> list[Notice]:
        """Return the notices since the last call, in the order of frames."""
        new, self._notices = sorted(self._notices, key=lambda notice: notice.frame), []
        return new

    def check_reports(self, now: int, landmarks: Landmarks, telemetry: Telemetry) -> None:
        """Check the reports of all vehicles up to frame `now`. Positions are in local metres."""
        placed = np.isfinite(landmarks.place).all(axis=1)
        for which, name in enumerate(self._names):
            own = landmarks.landmark == which
            rows = np.flatnonzero(own & ~landmarks.planned & (landmarks.frame <= now) & placed)
            when_s = (landmarks.frame[rows] - 1) / self._rate_hz
            ahead = (own & landmarks.planned & (landmarks.frame > now)).any()
            bridge = "its planned waypoints are used" if ahead else "it has no planned waypoints"
            self._check_silence(
                now, name, when_s, f"{name} reports no position", bridge, f"{name} reports its position again"
            )
            self._check_leaps(which, now, when_s, landmarks.place[rows], landmarks.sigma_m[rows])
        when_s = telemetry.time_s[np.isfinite(telemetry.place).all(axis=1)]
        silent, bridge = "the UAV sends no telemetry", "only landmarks give its position"
        self._check_silence(now, "uav", when_s, silent, bridge, "the UAV reports again")

    def check_picture(self, frame: Frame, step: Registration | None, metres_per_px: float) -> None:
        """Check the next picture. step: the background's motion since the picture before.

        metres_per_px: scale on the ground in the picture's centre, NaN if unknown.
        """
        same = self._picture is not None and np.array_equal(self._picture, frame.image)
        self._picture = frame.image
        if same:
            self._repeated += 1
            if self._repeated == 1:
                self._say(frame.number, "the picture repeats the one before: the camera is frozen")
        elif self._repeated:
            count = f"{self._repeated} picture{'s' if self._repeated > 1 else ''}"
            self._say(frame.number, f"the camera works again: {count} repeated the one before")
            self._repeated = 0  # do not check for a jerk here, because this step covers all of the frozen time
        elif step is not None and step.reliable and math.isfinite(metres_per_px):
            self._check_jerk(frame, step, metres_per_px)

    def _check_silence(self, now: int, who: str, when_s: np.ndarray, silent: str, bridge: str, back: str) -> None:
        """Notice whether a vehicle falls silent or reports again. when_s: times of all its reports."""
        now_s = (now - 1) / self._rate_hz
        last_s = float(when_s[-1]) if len(when_s) else 0.0
        usual_s = float(np.median(np.diff(when_s))) if len(when_s) > 2 else 0.0
        if who in self._silent:
            if last_s > self._silent[who]:
                self._say(now, f"{back}, after {last_s - self._silent.pop(who):.1f} s")
        elif now_s - last_s > max(_SILENT_S, _SLOWER * usual_s):
            self._silent[who] = last_s
            self._say(now, f"{silent} for {now_s - last_s:.1f} s: {bridge}")

    def _check_leaps(self, which: int, now: int, when_s: np.ndarray, place_m: np.ndarray, sigma_m: np.ndarray) -> None:
        """Notice reports that are further from the report before than the vehicle can have driven."""
        for time_s, place, sigma in zip(when_s.tolist(), place_m, np.nan_to_num(sigma_m).tolist(), strict=True):
            before_s, before = self._last.get(which, (-math.inf, place))
            if time_s <= before_s:
                continue
            away, lapse_s = float(np.linalg.norm(place - before)), time_s - before_s
            if away > _LEAP_M + _LEAP_SIGMAS * sigma + _FASTEST_M_S * lapse_s:
                self._say(now, f"{self._names[which]}'s reports leap by {away:.1f} m within {lapse_s:.1f} s")
            self._last[which] = time_s, place

    def _check_jerk(self, frame: Frame, step: Registration, metres_per_px: float) -> None:
        """Notice a sudden change of the ground's velocity in the picture's centre."""
        middle = np.array([(frame.image.shape[1] - 1) / 2, (frame.image.shape[0] - 1) / 2, 1.0])
        moved = step.later_from_earlier @ middle
        speed = (moved[:2] / moved[2] - middle[:2]) * metres_per_px * self._rate_hz / (frame.skipped + 1)
        self._usual = [(t, v) for t, v in self._usual if t > frame.time_s - _USUAL_S]
        if len(self._usual) >= 3 and frame.time_s - self._jerked_s > _USUAL_S:
            usual = np.median([v for _, v in self._usual], axis=0)
            if (change := float(np.linalg.norm(speed - usual))) > _JERK_M_S:
                self._jerked_s = frame.time_s
                what = f"the picture jerks by {change:.1f} m/s over the ground"
                self._say(frame.number, f"{what}: a gust, or a quick turn of the camera")
        self._usual.append((frame.time_s, speed))

    def _say(self, frame: int, text: str) -> None:
        self._notices.append(Notice(frame, (frame - 1) / self._rate_hz, text))
