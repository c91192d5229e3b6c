"""The part of level ground (up = 0) that an aerial camera shows for a given viewing direction and altitude."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.geometry import axes_of
from torchvision_dddas.types import Camera, CameraPose, Fix, Flight

# A camera within 8 degrees of straight down counts as looking straight down.
_DOWN = float(np.cos(np.radians(8)))
# A camera less than 10 degrees below the horizon shows the horizon, and has no footprint.
_LEVEL = float(np.sin(np.radians(10)))


@dataclass(frozen=True)
class CameraMount:
    """The state of an aerial camera: its height above up = 0, the axes of its view (see CameraPose), and its lens."""

    altitude_m: float
    axes: np.ndarray
    camera: Camera

    @property
    def down(self) -> float:
        """The sine of the angle of the optical axis below the horizon."""
        return float(-self.axes[2, 2])

    def pose(self, look_at_m: np.ndarray, altitude_m: float) -> CameraPose:
        """Return the pose that shows a position (2,) in the picture's centre, with the same direction of view."""
        place = np.array([*look_at_m, 0.0]) - self.axes[:, 2] * altitude_m / self.down
        return CameraPose(place, self.axes)

    def inside(self, points_m: np.ndarray, look_at_m: np.ndarray, altitude_m: float) -> np.ndarray:
        """Return the (N,) margins of positions (N, 2) in the picture, see the function `inside`."""
        return inside(points_m, self.pose(look_at_m, altitude_m), self.camera)

    def half_m(self, altitude_m: float) -> float:
        """Return half the length, on the ground, of the picture's shorter side."""
        return altitude_m / self.down * min(self.camera.size_px) / 2 / float(np.mean(self.camera.focal_px))

    def centre(self, points_m: np.ndarray, altitude_m: float) -> tuple[np.ndarray, float]:
        """Return the position (2,) to look at with the largest minimal margin of positions (N, 2), and that margin."""
        # Direction on the ground towards the picture's upper edge.
        ahead = -self.axes[:2, 1] if self.down > _DOWN else self.axes[:2, 2]
        ahead = ahead / np.linalg.norm(ahead)
        turn = np.stack([[ahead[1], -ahead[0]], ahead])  # axes to the right and ahead
        along = np.asarray(points_m, float) @ turn.T
        low, high = along.min(axis=0), along.max(axis=0)
        # In an oblique view, near ground takes more of the picture than far ground, so try several shifts.
        shifts = np.linspace(-0.5, 0.5, 9) if self.down < _DOWN and len(along) > 1 else np.zeros(1)
        tried = [((low + high) / 2 + [0.0, shift * (high[1] - low[1])]) @ turn for shift in shifts]
        within = [float(self.inside(points_m, place, altitude_m).min()) for place in tried]
        best = int(np.argmax(within))
        return tried[best], within[best]


def inside(points_m: np.ndarray, pose: CameraPose, camera: Camera) -> np.ndarray:
    """Return (N,) margins of ground points (N, 2) in the picture: 1 at the centre, 0 at the border, else negative."""
    points = np.asarray(points_m, float).reshape(-1, 2)
    # The distortion of the lens is ignored, because it moves the border by less than the margins that are used.
    right, down, depth = ((points - pose.place_m[:2]) @ pose.axes[:2] - pose.place_m[2] * pose.axes[2]).T
    slope = np.array(camera.size_px) / 2 / camera.focal_px
    within = 1 - np.maximum(np.abs(right) / slope[0], np.abs(down) / slope[1]) / np.maximum(depth, 1e-9)
    return np.where(depth > 0, within, -10.0)


def update_mount(flight: Flight | None, fix: Fix, before: CameraMount | None, camera: Camera) -> CameraMount | None:
    """Return the state of the camera from telemetry, or else from the pose of the located picture.

    before: the previous state. After steering begins, a gimbal moves before the vehicle does, so the pitch of the
    beginning is kept. In an oblique view the heading of the beginning is kept too, because the vehicle shall return to
    the same side of the target. In a view straight down the heading may change.
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
        # Near straight down, the heading of the picture's upper edge differs from the heading of the optical axis.
        pitch, axes = np.pi / 2, None if fix.pose is None else fix.pose.axes
        if flight is not None and np.isfinite([flight.heading_rad, flight.pitch_rad, flight.roll_rad]).all():
            axes = axes_of(flight.heading_rad, flight.pitch_rad, flight.roll_rad)
        if axes is not None:
            heading = float(np.arctan2(-axes[0, 1], -axes[1, 1]))
    return CameraMount(altitude, axes_of(heading, pitch, 0.0), camera)


def ground_in_middle(flight: Flight | None, fix: Fix, mount: CameraMount) -> np.ndarray | None:
    """Return the ground position (2,) in the picture's centre; None if neither picture nor telemetry give it."""
    if fix.pose is not None and -fix.pose.axes[2, 2] > _LEVEL:
        ahead = fix.pose.axes[:, 2]
        return fix.pose.place_m[:2] + ahead[:2] * fix.pose.place_m[2] / -ahead[2]
    if flight is not None and np.isfinite(flight.place).all():
        return np.array(flight.place, float) + mount.axes[:2, 2] * mount.altitude_m / mount.down
    return None
