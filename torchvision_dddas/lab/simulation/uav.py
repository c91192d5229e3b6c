"""The UAV: its flight, its camera's pose, the effect of gusts on both, and the errors of its telemetry."""

from collections.abc import Callable

import numpy as np

from torchvision_dddas.lab.simulation.movement import Waypoints, heading_vector, wrap_angle
from torchvision_dddas.lab.simulation.scenario import AircraftParameters
from torchvision_dddas.lab.simulation.sensors import Receivers
from torchvision_dddas.types import CameraPose

ACCELERATION_M_S2 = 3.0
# Greatest rates of the picture's middle and of the picture's rotation by the gimbal. The total stays below 60 deg/s.
_AIM_RAD_S, _TURN_RAD_S = np.radians(35.0), np.radians(15.0)
# The upper edge turns to the view if the camera looks further aside than this share of its height.
_SLANTED = 0.35
_GUST_S, _SHAKE_S = 1.5, 0.5  # time constants of the place and of the angles
_HELD = 0.3  # speed of a UAV that holds its place, as a share of the gust's speed
_NEW = 0.1  # share of the telemetry's errors that is new in each report


class Swaying:
    """Values (n,) that sway smoothly about 0: a critically damped spring with random pushes (Matern 3/2 process).

    rate is the true derivative of value. sigma: (n,) stationary standard deviations. constant_s: time constant.
    """

    def __init__(self, sigma: np.ndarray, constant_s: float, rng: np.random.Generator) -> None:
        self._sigma, self._rate, self._rng = np.asarray(sigma, float), 1 / constant_s, rng
        self._steps: dict[float, tuple[np.ndarray, np.ndarray]] = {}
        drawn = rng.standard_normal((2, len(self._sigma)))
        self.value, self.rate = self._sigma * drawn[0], self._sigma * self._rate * drawn[1]

    def step(self, seconds: float, push: np.ndarray | float = 0.0, rougher: float = 1.0) -> None:
        """Advance exactly by `seconds`. push: constant acceleration. rougher: factor of the random pushes."""
        if seconds not in self._steps:
            k, t = self._rate, seconds
            step = np.exp(-k * t) * np.array([[1 + k * t, t], [-(k**2) * t, 1 - k * t]])
            lasting = np.diag([1.0, k**2])
            self._steps[seconds] = step, np.linalg.cholesky(lasting - step @ lasting @ step.T + 1e-15 * np.eye(2))
        step, factor = self._steps[seconds]
        rest = np.asarray(push) / self._rate**2  # the value at which a constant push holds the system
        moved = step @ np.stack([self.value - rest, self.rate])
        noise = factor @ self._rng.standard_normal((2, len(self._sigma))) * self._sigma * rougher
        self.value, self.rate = moved[0] + noise[0] + rest, moved[1] + noise[1]


class _Pursuer:
    """A point that follows another with bounded speed and acceleration."""

    def __init__(self, place: np.ndarray, velocity: np.ndarray) -> None:
        self.place, self.velocity = place, velocity

    def step(self, goal: np.ndarray, going: np.ndarray, fastest: float, hardest: float, seconds: float) -> None:
        """Step towards a goal that moves at velocity `going`, with constant acceleration over the step."""
        gap = goal - self.place
        distance = float(np.linalg.norm(gap))
        # Move no faster than it can brake, and slow down gently at the end.
        closing = min(np.sqrt(hardest * distance), distance / 0.8)
        wanted = going + gap / max(distance, 1e-9) * closing
        wanted *= min(1.0, fastest / max(float(np.linalg.norm(wanted)), 1e-9))
        push = (wanted - self.velocity) / max(0.3, seconds)
        push *= min(1.0, hardest / max(float(np.linalg.norm(push)), 1e-9))
        self.place = self.place + seconds * self.velocity + seconds**2 / 2 * push
        self.velocity = self.velocity + seconds * push


class Aircraft:
    """A UAV that flies along its way or follows commands. Pose and rates are those of its camera.

    Without commands it looks at a point that moves along the way, always from the same side and at the same angle.
    """

    def __init__(
        self, parameters: AircraftParameters, half_m: float, up_m: Callable[[np.ndarray], np.ndarray], seed: int
    ) -> None:
        self._parameters, self._half, self._up = parameters, half_m, up_m
        self._way = Waypoints(np.array([parameters.start_m, *parameters.way_m], float), parameters.speed_m_s)
        self._altitude = parameters.altitude_m
        self._fly_to: np.ndarray | None = None
        self._look_at: np.ndarray | None = None
        self._heading, self._turning = float(np.radians(parameters.heading_deg)), 0.0
        self._cotangent = float(1 / np.tan(np.radians(parameters.pitch_deg))) if parameters.pitch_deg < 90 else 0.0
        point, going = self._way.at(0.0)
        ahead, level = heading_vector(self._heading), self._altitude * self._cotangent
        back = level
        for _ in range(8):  # iterate, because the distance depends on the ground's heights
            rise = self._altitude + self._ground(point - back * ahead) - self._ground(point)
            back = max(rise, 1.0) * self._cotangent
        self._relief_m = back - level
        place = point - back * ahead
        still = np.append(going, 0.0)
        self._craft = _Pursuer(np.append(place, self._altitude + self._ground(place)), still)
        self._aim = _Pursuer(np.append(point, self._ground(point)), still)
        gust = parameters.wind_m_s * _HELD * _GUST_S * np.array([1.0, 1.0, 0.5])
        self._blown = Swaying(gust, _GUST_S, np.random.default_rng([seed, 50]))
        shake = np.full(3, np.radians(parameters.shake_deg))
        self._shaken = Swaying(shake, _SHAKE_S, np.random.default_rng([seed, 51]))

    def _ground(self, place_m: np.ndarray) -> float:
        return float(self._up(place_m[None, :2])[0])

    def steer(self, fly_to: np.ndarray | None, look_at: np.ndarray | None, altitude_m: float | None) -> None:
        """Change the goals that are not None. Places (2,) are in local metres and are clipped to the world."""
        if fly_to is not None:
            self._fly_to = np.clip(fly_to, -self._half, self._half)
        if look_at is not None:
            self._look_at = np.clip(look_at, -self._half, self._half)
        if altitude_m is not None:
            self._altitude = float(np.clip(altitude_m, 2.0, 2000.0))

    def step(self, time_s: float, seconds: float, push: np.ndarray | float = 0.0, rougher: float = 1.0) -> None:
        """Advance by `seconds` to time_s. push: (3,) acceleration by gusts, m/s2. rougher: factor of the shaking."""
        point, going = self._way.at(time_s - seconds)
        back_m = self._altitude * self._cotangent + self._relief_m * (self._cotangent > 0)
        back = back_m * heading_vector(self._heading)
        fastest, still = self._parameters.maximum_m_s, np.zeros(3)
        if self._fly_to is None:
            goal, goal_going = point - back, np.append(going, 0.0)
            fastest = max(fastest, self._parameters.speed_m_s)
        else:
            goal, goal_going, point = self._fly_to, still, self._fly_to + back
        craft, aim = self._craft, self._aim
        goal = np.append(goal, self._altitude + self._ground(craft.place))
        craft.step(goal, goal_going, fastest, ACCELERATION_M_S2, seconds)
        aim_up = self._ground(aim.place)
        if self._look_at is None:
            # The view angle stays, so the middle of the picture moves with the UAV.
            aim.step(np.append(point, aim_up), goal_going, fastest, ACCELERATION_M_S2, seconds)
        else:
            swift = _AIM_RAD_S * max(craft.place[2] - aim.place[2], 1.0)
            aim.step(np.append(self._look_at, aim_up), still, swift, 3 * swift, seconds)
        # Turn the picture's upper edge to the view's direction if the view is oblique and was commanded.
        to, error = aim.place - craft.place, 0.0
        if self._look_at is not None and np.hypot(to[0], to[1]) > _SLANTED * abs(to[2]):
            error = float(wrap_angle(np.arctan2(to[0], to[1]) - self._heading))
        wanted = float(np.clip(1.5 * error, -_TURN_RAD_S, _TURN_RAD_S))
        turn = float(np.clip((wanted - self._turning) / max(0.3, seconds), -1.0, 1.0))
        self._heading += seconds * self._turning + seconds**2 / 2 * turn
        self._turning += seconds * turn
        self._blown.step(seconds, push, rougher)
        self._shaken.step(seconds, 0.0, rougher)

    def _pose(self, ahead_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the camera's place and axes, extrapolated by ahead_s seconds."""
        craft = self._craft.place + ahead_s * self._craft.velocity
        aim = self._aim.place + ahead_s * self._aim.velocity
        heading = self._heading + ahead_s * self._turning
        forward = (aim - craft) / np.linalg.norm(aim - craft)
        right = _cross(forward, np.append(heading_vector(heading), 0.0))
        right /= np.linalg.norm(right)
        hung = np.stack([right, _cross(forward, right), forward], axis=1)
        shaken = rotation_matrix(self._shaken.value + ahead_s * self._shaken.rate)
        return craft + self._blown.value + ahead_s * self._blown.rate, hung @ shaken

    def pose(self) -> tuple[CameraPose, np.ndarray, np.ndarray]:
        """Return the pose, the velocity (3,) m/s and the rotation rates (3,) rad/s about east, north, up."""
        place, hung = self._pose(0.0)
        tiny = 1e-5
        change = (self._pose(tiny)[1] - self._pose(-tiny)[1]) / (2 * tiny) @ hung.T
        turn = np.array([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]]) / 2
        return CameraPose(place, hung), self._craft.velocity + self._blown.rate, turn


class ReportedPose:
    """Errors of the UAV's telemetry: lasting errors with the parameters' sigmas, and new errors a tenth as large.

    If the camera looks straight down, a tiny tilt changes the reported heading much; the roll changes equally.
    """

    def __init__(self, parameters: AircraftParameters, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 52])
        tilt, heading = np.radians(parameters.angle_error_deg), np.radians(parameters.heading_error_deg)
        self._sigma = np.array([tilt, tilt, heading, parameters.altitude_error])
        self._lasting = self._sigma * self._rng.standard_normal(4)
        self._receiver = Receivers(1, parameters.place_error95_m, 0.02, 60.0, 0.0, self._rng)

    def errors(self, seconds: float) -> np.ndarray:
        """Return errors (6,) `seconds` later: rotation about east, north, up (rad); altitude share; east, north (m)."""
        self._receiver.advance(seconds)
        wrong = self._lasting + _NEW * self._sigma * self._rng.standard_normal(4)
        return np.array([wrong[0], wrong[1], -wrong[2], wrong[3], *self._receiver.error_m[0]])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors (3,). np.cross takes ten times as long for one pair."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) about a vector (3,) by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    cross = cross_matrix(vector / angle)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the matrix M (3, 3) for which M @ w is the cross product of a vector (3,) with w."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
