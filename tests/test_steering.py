"""What is found steers the instruments: synthetic located frames in, commands and their causes out."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas.settings import Settings, SteeringKnobs
from torchvision_dddas.steering import Steering
from torchvision_dddas.targets.projection import axes_of, project
from torchvision_dddas.types import (
    Adjustment,
    Camera,
    CameraPose,
    Command,
    Confirmed,
    Fix,
    Flight,
    Grounded,
    Marks,
    Positions,
)

FOCAL_PX = 320 / np.tan(np.radians(30))
CAMERA = Camera("aerial", (640, 480), (FOCAL_PX, FOCAL_PX), (319.5, 239.5))
RATE_HZ = 10.0


def names(count: int) -> tuple[str, ...]:
    return tuple(f"ugv{k + 1}" for k in range(count))


def with_steering(**knobs: object) -> Settings:
    return Settings(steering=SteeringKnobs(**knobs))  # type: ignore[arg-type]


def pose_at(place_m, altitude_m=50.0, pitch_deg=90.0, heading_rad=0.0) -> CameraPose:
    """The pose that has a place on the ground in the middle of the picture."""
    axes = axes_of(heading_rad, np.radians(pitch_deg), 0.0)
    return CameraPose(np.array([*place_m, 0.0]) - axes[:, 2] * altitude_m / -axes[2, 2], axes)


def located(frame, places, velocities=None, targets=None, pose=None, size_m=3.0) -> Grounded:
    """A located frame: what stands at places (N, 2), as large as size_m."""
    places = np.asarray(places, float).reshape(-1, 2)
    n, pose = len(places), pose or pose_at((0, 0))
    velocity = np.zeros((n, 2)) if velocities is None else np.asarray(velocities, float).reshape(-1, 2)
    target = np.arange(1, n + 1) if targets is None else np.asarray(targets, np.int64)
    side = size_m * FOCAL_PX / np.maximum((np.c_[places, np.zeros(n)] - pose.place_m) @ pose.axes[:, 2], 1.0)
    boxes = np.c_[project(np.c_[places, np.zeros(n)], pose, CAMERA) - side[:, None] / 2, side, side]
    covariance = np.tile(0.1 * np.eye(2), (n, 1, 1))
    positions = Positions(np.full(n, frame), target, places, covariance, np.ones(n))
    fix = Fix(frame, "pose", pose)
    return Grounded(frame, (frame - 1) / RATE_HZ, positions, np.arange(n), covariance, velocity, boxes, fix, Marks())


def judged(frame, *kinds) -> Confirmed:
    """What ground vehicles say of targets in order: human, not_human or unseen, or a probability."""
    chance = {"human": 0.99, "not_human": 0.01, "unseen": 0.5}
    probability = np.array([chance.get(kind, kind) for kind in kinds], float)
    words = tuple(k if isinstance(k, str) else ("human" if k >= 0.5 else "not_human") for k in kinds)
    n = len(kinds)
    nothing = np.full(n, np.nan)
    return Confirmed(
        *(frame, np.arange(n), words, probability, ((),) * n, np.zeros(n, np.int64), nothing, nothing, nothing)
    )


def team_at(places) -> Marks:
    places = np.asarray(places, float).reshape(-1, 2)
    n = len(places)
    return Marks(np.arange(n), np.full((n, 2), np.nan), places, np.ones(n), np.ones(n), np.zeros(n))


def flown(pose: CameraPose, speed_m_s: float = 2.0) -> Flight:
    heading, pitch, roll = pose.angles_rad
    return Flight(float(pose.place_m[2]), speed_m_s, tuple(pose.place_m[:2]), float("nan"), heading, pitch, roll)


SQUARE = np.array([[14, 14], [-14, 14], [-14, -14], [14, -14]], float)


def test_nothing_known_changes_nothing():
    steering = Steering(Settings(), CAMERA, RATE_HZ, names(4))
    for frame in range(1, 30):
        command, made = steering.step(located(frame, []), None, frame / RATE_HZ, team_at(SQUARE), None)
        assert (command.every, command.look_at, command.fly_to, command.altitude_m, command.orders) == (
            1,
            *3 * [None],
            (),
        )
        assert made == ()


@dataclass
class World:
    """A toy: targets walk, the aerial vehicle and the ground vehicles go where they are asked, frames settle late."""

    steering: Steering
    targets: np.ndarray
    velocity: np.ndarray
    team: np.ndarray
    kinds: tuple[str, ...] = ()
    delay_s: float = 1.0
    altitude_m: float = 50.0
    pitch_deg: float = 90.0
    hidden: Callable[[float], bool] = lambda now_s: False
    now_s: float = 0.0
    looked: np.ndarray = field(default_factory=lambda: np.zeros(2))
    commands: list[Command] = field(default_factory=list)
    made: list[Adjustment] = field(default_factory=list)
    poses: list[CameraPose] = field(default_factory=list)
    frames: list[Grounded] = field(default_factory=list)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))
    said: np.ndarray | None = None  # (V,) bool: which vehicles report
    silent: bool = False

    def run(self, seconds: float, check: Callable[["World"], None] | None = None) -> "World":
        for _ in range(round(seconds * RATE_HZ)):
            self._frame()
            if check is not None:
                check(self)
        return self

    def inside(self, places: np.ndarray) -> np.ndarray:
        """Whether the picture shows them now."""
        pixels = project(np.c_[places, np.zeros(len(places))], self.poses[-1], CAMERA)
        return ((pixels > 0) & (pixels < np.array(CAMERA.size_px) - 1)).all(axis=1)

    def _frame(self) -> None:
        pose = pose_at(self.looked, self.altitude_m, self.pitch_deg)
        self.poses.append(pose)
        number = len(self.poses)
        shown = self.inside(self.targets) & (not self.hidden(self.now_s))
        noise = self.rng.normal(0, 0.3, self.targets.shape)
        ids = np.arange(1, len(self.targets) + 1)
        self.frames.append(located(number, (self.targets + noise)[shown], self.velocity[shown], ids[shown], pose))
        late = number - 1 - round(self.delay_s * RATE_HZ)
        if late >= 0:
            settled = self.frames[late]
            kinds = [self.kinds[k - 1] for k in settled.positions.target] if self.kinds else None
            reported = np.ones(len(self.team), bool) if self.said is None else self.said
            places = self.team + self.rng.normal(0, 0.5, self.team.shape)
            marks = team_at(places)
            marks = replace(marks, landmark=marks.landmark[reported], east_north_m=places[reported])
            flight = None if self.silent else flown(pose)
            confirmed = judged(settled.frame, *kinds) if kinds else None
            command, made = self.steering.step(settled, confirmed, self.now_s, marks, flight)
            self.commands.append(command)
            self.made.extend(made)
            self._obey(command)
        self.targets = self.targets + self.velocity / RATE_HZ
        self.now_s += 1 / RATE_HZ

    def _obey(self, command: Command) -> None:
        if command.look_at is not None:
            self.looked = self.looked + towards(self.looked, command.look_at, 10.0)
        if command.altitude_m is not None:
            self.altitude_m += float(np.clip(command.altitude_m - self.altitude_m, -0.2, 0.2))
        for order in command.orders:
            k = int(order.vehicle.removeprefix("ugv")) - 1
            self.team[k] += towards(self.team[k], order.goal, order.speed_m_s)


def towards(place: np.ndarray, goal: np.ndarray, speed_m_s: float) -> np.ndarray:
    """The step of one frame."""
    way = goal - place
    return way * min(1.0, speed_m_s / RATE_HZ / max(float(np.linalg.norm(way)), 1e-9))


def world(targets, velocity=None, team=SQUARE, settings=None, **more) -> World:
    targets = np.array(targets, float).reshape(-1, 2)
    velocity = np.zeros_like(targets) if velocity is None else np.array(velocity, float).reshape(-1, 2)
    steering = Steering(settings or Settings(), CAMERA, RATE_HZ, names(len(team)))
    return World(steering, targets, velocity, np.array(team, float), **more)
