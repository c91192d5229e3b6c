"""Targets in metres over time: how fast each goes, by its identity.

A constant-velocity Kalman filter for each, driven by white acceleration. Its measurement noise is each place's own, of
the pixel; what the camera's pose puts on all places of a frame alike moves slowly and hardly touches a velocity.
"""

import numpy as np

from torchvision_dddas.types import Float, Int

ACCELERATION_M_S2 = 0.5
"""Of people and vehicles, from second to second."""

KNOWN_M_S = 1.0
"""A velocity whose standard deviation, east or north, is more is not known yet."""

FASTEST_M_S = 10.0
"""Standard deviation of the velocity of a target that appears."""

FORGET_S = 5.0
"""A target not seen for so long begins anew."""


class Movers:
    """The velocities of targets, frame by frame."""

    def __init__(self) -> None:
        self._tracks: dict[int, _Track] = {}

    def step(
        self,
        time_s: float,
        identity: Int[np.ndarray, " N"],
        east_north_m: Float[np.ndarray, "N 2"],
        covariance_m2: Float[np.ndarray, "N 2 2"],
    ) -> Float[np.ndarray, "N 2"]:
        """East and north in m/s; NaN where they are not known yet, or for a target without identity (below 1).

        covariance_m2: of what errs anew from frame to frame; where it is unknown a metre is taken.
        """
        covariance_m2 = np.where(np.isfinite(covariance_m2), covariance_m2, np.eye(2))
        velocity = np.full((len(identity), 2), np.nan)
        for row, name in enumerate(identity.tolist()):
            if name < 1:
                continue
            track = self._tracks.get(name)
            if track is None or not 0 < time_s - track.time_s <= FORGET_S:
                self._tracks[name] = _Track(time_s, east_north_m[row], covariance_m2[row])
                continue
            track.step(time_s, east_north_m[row], covariance_m2[row])
            if track.covariance.diagonal()[2:].max() < KNOWN_M_S**2:
                velocity[row] = track.state[2:]
        self._tracks = {name: track for name, track in self._tracks.items() if time_s - track.time_s <= FORGET_S}
        return velocity


class _Track:
    """state: (4,) east, north and their velocities."""

    def __init__(self, time_s: float, place: np.ndarray, covariance: np.ndarray) -> None:
        self.time_s = time_s
        self.state = np.array([*place, 0.0, 0.0])
        self.covariance = np.zeros((4, 4))
        self.covariance[:2, :2] = covariance
        self.covariance[2:, 2:] = FASTEST_M_S**2 * np.eye(2)

    def step(self, time_s: float, place: np.ndarray, covariance: np.ndarray) -> None:
        lapse = time_s - self.time_s
        move = np.kron([[1.0, lapse], [0.0, 1.0]], np.eye(2))
        drive = np.kron([[lapse**3 / 3, lapse**2 / 2], [lapse**2 / 2, lapse]], np.eye(2)) * ACCELERATION_M_S2**2
        state, spread = move @ self.state, move @ self.covariance @ move.T + drive
        # A place that is said to be exact would leave nothing to invert.
        total = spread[:2, :2] + covariance + 1e-12 * np.eye(2)
        gain = spread[:, :2] @ np.linalg.inv(total)
        self.state = state + gain @ (place - state[:2])
        self.covariance = spread - gain @ spread[:2]
        self.time_s = time_s
