"""The sensor of a camera, the errors of satellite receivers, and the faults of a scenario."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.scenario import CameraParameters, Fault

SIGMAS_95 = 2.4477  # 95 % radius of a circular normal distribution, in standard deviations along an axis
_BAND, _BLOCK = 32, 16  # rows
_SPARE_PX = 192  # margin of the noise tile, so that the start of the crop can vary


class Sensor:
    """The sensor of a camera. stream: distinguishes cameras with the same seed.

    The changes to a picture depend only on the seed, the stream, and the picture's number and time.
    """

    def __init__(self, parameters: CameraParameters, size_px: tuple[int, int], seed: int, stream: int = 0) -> None:
        self.parameters, self._key = parameters, [seed, 71, stream]
        rng = np.random.default_rng(self._key)
        self._phase = rng.uniform(0, 2 * np.pi, 3)
        shape = (size_px[1] + _SPARE_PX, size_px[0] + _SPARE_PX, 3)
        is_noisy = parameters.shot_noise > 0 or parameters.read_noise > 0
        self._tile = rng.standard_normal(shape, np.float32) if is_noisy else None

    def gain(self, time_s: float) -> float:
        """Return the relative exposure: a sum of slow waves, from 1 - drift to 1 + drift."""
        waves = np.sin(2 * np.pi * time_s / np.array([11.0, 4.3, 27.0]) + self._phase)
        return 1 + self.parameters.drift * float(waves @ (0.5, 0.2, 0.3))

    def expose(self, picture: np.ndarray, number: int, time_s: float) -> np.ndarray:
        """Return the camera's picture of a scene, both (H, W, 3) uint8. number: number of the picture."""
        parameters = self.parameters
        levels = np.asarray(np.arange(256) * self.gain(time_s), np.float32)
        sigma = np.asarray(np.sqrt(parameters.shot_noise * levels + parameters.read_noise**2), np.float32)
        grain, turned = None, False
        if self._tile is not None:
            rng = np.random.default_rng([*self._key, number])
            y, x = rng.integers(0, _SPARE_PX, 2)
            grain = self._tile[y : y + picture.shape[0], x : x + picture.shape[1]]
            # Mirror the noise and change its sign at random, so that no pattern reappears in a shifted place.
            flip = int(rng.integers(0, 4))
            grain = grain[::-1] if flip in (0, 1) else grain
            turned = flip in (0, 2)
            sigma = -sigma if rng.integers(0, 2) else sigma
        if parameters.sharpness_px > 0:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), parameters.sharpness_px))
        developed = np.empty_like(picture)

        def develop(part: slice) -> None:
            if grain is None:
                cv2.LUT(picture[part], np.asarray(np.clip(np.round(levels), 0, 255), np.uint8), dst=developed[part])
            else:
                # Process bands of rows that fit the processor's cache.
                for first in range(part.start, part.stop, _BAND):
                    rows = slice(first, min(first + _BAND, part.stop))
                    noise = cv2.LUT(picture[rows], sigma)
                    pattern = np.asarray(cv2.flip(grain[rows], 1)) if turned else grain[rows]
                    np.multiply(noise, pattern, out=noise)
                    cv2.add(cv2.LUT(picture[rows], levels), noise, dst=developed[rows], dtype=cv2.CV_8U)
            if parameters.quality < 100:
                _, file = cv2.imencode(".jpg", developed[part], [cv2.IMWRITE_JPEG_QUALITY, parameters.quality])
                developed[part] = cv2.imdecode(file, cv2.IMREAD_COLOR)

        # Develop two halves in parallel. They share no block of the compression.
        middle, height = len(picture) // 2 // _BLOCK * _BLOCK, len(picture)
        with ThreadPoolExecutor(1) as other:
            upper = other.submit(develop, slice(0, middle)) if middle else None
            develop(slice(middle, height))
            if upper is not None:
                upper.result()
        return developed


class Receivers:
    """The errors of K receivers, report by report.

    A share white_share of the variance is new in each report. The rest is a stationary Gauss-Markov process with time
    constant correlation_s. All receivers share a further process with standard deviation common_m.
    """

    def __init__(
        self,
        count: int,
        error95_m: float,
        white_share: float,
        correlation_s: float,
        common_m: float,
        rng: np.random.Generator,
    ) -> None:
        self.sigma_m = error95_m / SIGMAS_95
        self._white = self.sigma_m * np.sqrt(white_share)
        self._slow = self.sigma_m * np.sqrt(1 - white_share)
        self._correlation_s, self._common, self._rng = correlation_s, common_m, rng
        # The last row is the shared error.
        self._state = rng.standard_normal((count + 1, 2))
        self._new = rng.standard_normal((count, 2))

    def advance(self, seconds: float) -> None:
        """Advance to the next report, `seconds` later."""
        kept = np.exp(-seconds / self._correlation_s)
        self._state = kept * self._state + np.sqrt(1 - kept**2) * self._rng.standard_normal(self._state.shape)
        self._new = self._rng.standard_normal(self._new.shape)

    @property
    def lasting_m(self) -> np.ndarray:
        """(K, 2) east, north: the lasting part of the errors, including the shared part."""
        return self._slow * self._state[:-1] + self._common * self._state[-1]

    @property
    def error_m(self) -> np.ndarray:
        """(K, 2) east, north: the errors of this report."""
        return self.lasting_m + self._white * self._new


_EVENTS = {
    "ugv_lost": ("{who} is lost", "{who} is back"),
    "gps_dropout": ("{who} has no GPS", "{who} has GPS again"),
    "gps_jump": ("the GPS of {who} is off by {size:g} m", "the GPS of {who} is correct again"),
    "frozen": ("the UAV's camera repeats a picture", "the UAV's camera works again"),
    "dropped": ("pictures of the UAV are missing", "the UAV's pictures are back"),
    "gust": ("a gust pushes the UAV at {size:g} m/s", "the gust is over"),
    "cut": ("the film jumps to another place", "the film jumps back"),
    "landmark_hidden": ("the marker of {who} is covered", "the marker of {who} is visible again"),
    "telemetry_silent": ("the UAV sends no telemetry", "the UAV sends telemetry again"),
}
_EARLY_S = 1e-9  # tolerance for rounded frame times, so that a fault begins at the frame of its time


@dataclass(frozen=True)
class ActiveFaults:
    """The faults at a moment. Vehicles are given by their rows, from 0.

    jumped: metres, by vehicle. gusts: (row of the fault, seconds since its start, size). cut_m: shift of the
    camera to the east. picture: "", "frozen" or "dropped".
    """

    lost: frozenset[int]
    silent: frozenset[int]
    covered: frozenset[int]
    jumped: dict[int, float]
    gusts: tuple[tuple[int, float, float], ...]
    cut_m: float
    picture: str
    is_mute: bool


def active_faults(faults: tuple[Fault, ...], time_s: float) -> ActiveFaults:
    """Return the faults that are active at a time. The end of a fault is excluded."""
    now = [
        (row, fault)
        for row, fault in enumerate(faults)
        if fault.time_s - _EARLY_S <= time_s < fault.time_s + fault.seconds - _EARLY_S
    ]
    kinds = [fault.what for _, fault in now]

    def vehicles(what: str) -> dict[int, float]:
        return {fault.vehicle - 1: fault.size for _, fault in now if fault.what == what}

    return ActiveFaults(
        frozenset(vehicles("ugv_lost")),
        frozenset(vehicles("gps_dropout")),
        frozenset(vehicles("landmark_hidden")),
        vehicles("gps_jump"),
        tuple((row, time_s - fault.time_s, fault.size) for row, fault in now if fault.what == "gust"),
        sum(fault.size for _, fault in now if fault.what == "cut"),
        next((what for what in ("dropped", "frozen") if what in kinds), ""),
        "telemetry_silent" in kinds,
    )


def fault_events(faults: tuple[Fault, ...], before_s: float, now_s: float) -> list[str]:
    """Return the starts and ends of faults after before_s and until now_s, in words."""
    events = []
    for fault in faults:
        for words, time_s in zip(_EVENTS[fault.what], (fault.time_s, fault.time_s + fault.seconds), strict=True):
            if before_s < time_s - _EARLY_S <= now_s:
                events.append((time_s, words.format(who=f"ugv{fault.vehicle}", size=fault.size)))
    return [words for _, words in sorted(events)]
