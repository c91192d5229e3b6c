"""What an aerial camera would show of the ground if it looked at a place from a height. The ground is level, up = 0."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.targets.projection import axes_of, project
from torchvision_dddas.types import Camera, CameraPose, Fix, Flight


@dataclass(frozen=True)
class Stand:
    """How an aerial camera is carried: its height above up = 0, the axes of its view (CameraPose), and its lens."""

    altitude_m: float
    axes: np.ndarray
    camera: Camera

    def pose(self, look_at_m: np.ndarray, altitude_m: float) -> CameraPose:
        """Where it is when it has a place (2,) in the middle of its picture, looking in the same direction."""
        reach = altitude_m / max(-self.axes[2, 2], 0.05)
        place = np.array([*look_at_m, 0.0]) - self.axes[:, 2] * reach
        return CameraPose(place, self.axes)

    def inside(self, points_m: np.ndarray, look_at_m: np.ndarray, altitude_m: float) -> np.ndarray:
        """(N,) how far within the picture places (N, 2) are: 1 in the middle, 0 at the border, below 0 outside."""
        points = np.asarray(points_m, float).reshape(-1, 2)
        pixels = project(np.c_[points, np.zeros(len(points))], self.pose(look_at_m, altitude_m), self.camera)
        half = np.array(self.camera.size_px) / 2
        inside = 1 - np.abs((pixels + 0.5 - half) / half).max(axis=1)
        return np.where(np.isfinite(inside), inside, -10.0)

    def half_m(self, altitude_m: float) -> float:
        """Half the shorter side of the picture over the ground, across the view."""
        reach = altitude_m / max(-self.axes[2, 2], 0.05)
        return reach * min(self.camera.size_px) / 2 / float(np.mean(self.camera.focal_px))

    def centre(self, points_m: np.ndarray, altitude_m: float) -> tuple[np.ndarray, float]:
        """The place (2,) to look at so that places (N, 2) are as far within the picture as can be, and how far."""
        up = self.axes[:2, 2] if np.hypot(*self.axes[:2, 2]) > 0.1 else -self.axes[:2, 1]
        ahead = up / np.linalg.norm(up)
        turn = np.stack([[ahead[1], -ahead[0]], ahead])  # right and ahead of the picture's middle
        along = np.asarray(points_m, float) @ turn.T
        low, high = along.min(axis=0), along.max(axis=0)
        # Seen at a slant what is near takes more of the picture than what is far.
        shifts = np.linspace(-0.5, 0.5, 9) if -self.axes[2, 2] < 0.98 else np.zeros(1)
        tried = [(low + high) / 2 + [0.0, shift * max(high[1] - low[1], 0.0)] for shift in shifts]
        within = [float(self.inside(points_m, place @ turn, altitude_m).min()) for place in tried]
        best = int(np.argmax(within))
        return tried[best] @ turn, within[best]


def stand_of(flight: Flight | None, fix: Fix, before: Stand | None, camera: Camera) -> Stand | None:
    """How the camera is carried now: by the telemetry, else by the latest picture that was located, else as before."""
    if flight is not None and np.isfinite([flight.altitude_m, flight.heading_rad, flight.pitch_rad]).all():
        roll = flight.roll_rad if np.isfinite(flight.roll_rad) else 0.0
        axes, altitude = axes_of(flight.heading_rad, flight.pitch_rad, roll), flight.altitude_m
    elif fix.pose is not None:
        axes, altitude = fix.pose.axes, float(fix.pose.place_m[2])
    else:
        return before
    if altitude <= 0 or -axes[2, 2] < 0.1:  # at the horizon there is no footprint
        return before
    return Stand(altitude, axes, camera)
