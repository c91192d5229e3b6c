"""What an aerial camera would show of the ground if it looked at a place from a height. The ground is level, up = 0."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.geometry import axes_of
from torchvision_dddas.types import Camera, CameraPose, Fix, Flight

# A camera that looks down more steeply counts as looking straight down.
_DOWN = float(np.cos(np.radians(8)))
# A camera that looks down less steeply shows the horizon, and has no footprint.
_LEVEL = float(np.sin(np.radians(10)))


@dataclass(frozen=True)
class CameraMount:
    """How an aerial camera is carried: its height above up = 0, the axes of its view (CameraPose), and its lens."""

    altitude_m: float
    axes: np.ndarray
    camera: Camera

    @property
    def down(self) -> float:
        """The sine of how far it looks below the horizon."""
        return float(-self.axes[2, 2])

    def pose(self, look_at_m: np.ndarray, altitude_m: float) -> CameraPose:
        """Where it is when it has a place (2,) in the middle of its picture, looking in the same direction."""
        place = np.array([*look_at_m, 0.0]) - self.axes[:, 2] * altitude_m / self.down
        return CameraPose(place, self.axes)

    def inside(self, points_m: np.ndarray, look_at_m: np.ndarray, altitude_m: float) -> np.ndarray:
        """(N,) how far within the picture places (N, 2) are: 1 in the middle, 0 at the border, below 0 outside."""
        return inside(points_m, self.pose(look_at_m, altitude_m), self.camera)

    def half_m(self, altitude_m: float) -> float:
        """Half the shorter side of the picture over the ground, across the view."""
        return altitude_m / self.down * min(self.camera.size_px) / 2 / float(np.mean(self.camera.focal_px))

    def centre(self, points_m: np.ndarray, altitude_m: float) -> tuple[np.ndarray, float]:
        """The place (2,) to look at so that places (N, 2) are as far within the picture as can be, and how far."""
        # Over the ground to the picture's upper edge.
        ahead = -self.axes[:2, 1] if self.down > _DOWN else self.axes[:2, 2]
        ahead = ahead / np.linalg.norm(ahead)
        turn = np.stack([[ahead[1], -ahead[0]], ahead])  # to the right, and ahead
        along = np.asarray(points_m, float) @ turn.T
        low, high = along.min(axis=0), along.max(axis=0)
        # Seen at a slant, near ground takes more of the picture than far ground.
        shifts = np.linspace(-0.5, 0.5, 9) if self.down < _DOWN and len(along) > 1 else np.zeros(1)
        tried = [((low + high) / 2 + [0.0, shift * (high[1] - low[1])]) @ turn for shift in shifts]
        within = [float(self.inside(points_m, place, altitude_m).min()) for place in tried]
        best = int(np.argmax(within))
        return tried[best], within[best]


def inside(points_m: np.ndarray, pose: CameraPose, camera: Camera) -> np.ndarray:
    """(N,) margin of ground points (N, 2) inside the picture: 1 at the centre, 0 at the border, negative outside."""
    points = np.asarray(points_m, float).reshape(-1, 2)
    # The lens's distortion is left out: it moves no border by more than the margins that are kept.
    right, down, depth = ((points - pose.place_m[:2]) @ pose.axes[:2] - pose.place_m[2] * pose.axes[2]).T
    slope = np.array(camera.size_px) / 2 / camera.focal_px
    within = 1 - np.maximum(np.abs(right) / slope[0], np.abs(down) / slope[1]) / np.maximum(depth, 1e-9)
    return np.where(depth > 0, within, -10.0)


def update_mount(flight: Flight | None, fix: Fix, before: CameraMount | None, camera: Camera) -> CameraMount | None:
    """How the camera is carried: by the telemetry, else by the picture that was located; before: as known till now.

    Once it is steered a gimbal runs ahead of the vehicle: how it looks down is that of the beginning. So is its heading
    where it looks aslant, since the vehicle is to come to the same side; straight down the picture may turn.
    """
    if flight is not None and np.isfinite([flight.altitude_m, flight.heading_rad, flight.pitch_rad]).all():
        altitude, heading, pitch = flight.altitude_m, flight.heading_rad, flight.pitch_rad
    elif fix.pose is not None:
        altitude, (heading, pitch, _) = float(fix.pose.place_m[2]), fix.pose.angles_rad
    else:
        return before
    if altitude <= 0:
        return before
    if before is not None and before.down < _DOWN:
        return CameraMount(altitude, before.axes, camera)
    if before is None and np.sin(pitch) < _LEVEL:
        return None
    if before is not None or np.sin(pitch) > _DOWN:
        # Near straight down the heading of the picture's upper edge is not that of where the camera looks.
        pitch, axes = np.pi / 2, None if fix.pose is None else fix.pose.axes
        if flight is not None and np.isfinite([flight.heading_rad, flight.pitch_rad, flight.roll_rad]).all():
            axes = axes_of(flight.heading_rad, flight.pitch_rad, flight.roll_rad)
        if axes is not None:
            heading = float(np.arctan2(-axes[0, 1], -axes[1, 1]))
    return CameraMount(altitude, axes_of(heading, pitch, 0.0), camera)


def ground_in_middle(flight: Flight | None, fix: Fix, mount: CameraMount) -> np.ndarray | None:
    """(2,) the ground that is in the middle of the picture; None where neither picture nor telemetry tell."""
    if fix.pose is not None and -fix.pose.axes[2, 2] > _LEVEL:
        ahead = fix.pose.axes[:, 2]
        return fix.pose.place_m[:2] + ahead[:2] * fix.pose.place_m[2] / -ahead[2]
    if flight is not None and np.isfinite(flight.place).all():
        return np.array(flight.place, float) + mount.axes[:2, 2] * mount.altitude_m / mount.down
    return None
