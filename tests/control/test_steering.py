"""What is found steers the instruments: synthetic located frames in, commands and their causes out."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from torchvision_dddas.config import Settings, SteeringParameters
from torchvision_dddas.control import Steering
from torchvision_dddas.geo.landmark_trajectories import best_spread, spread_m2
from torchvision_dddas.geo.projection import axes_of, project
from torchvision_dddas.types import (
    Adjustment,
    AerialLocations,
    Camera,
    CameraPose,
    Command,
    Confirmation,
    Fix,
    Flight,
    LandmarkObservations,
    Positions,
    Registration,
)

FOCAL_PX = 320 / np.tan(np.radians(30))
CAMERA = Camera("aerial", (640, 480), (FOCAL_PX, FOCAL_PX), (319.5, 239.5))
RATE_HZ, SAMPLED_HZ = 2.5, 5.0
"""Of the toy world, as seldom as shows what it is to show; and where frames are left out."""


def names(count: int) -> tuple[str, ...]:
    return tuple(f"ugv{k + 1}" for k in range(count))


def with_steering(**parameters: object) -> Settings:
    return Settings(steering=SteeringParameters(**parameters))  # type: ignore[arg-type]


def pose_at(place_m, altitude_m=50.0, pitch_deg=90.0, heading_rad=0.0) -> CameraPose:
    """The pose that has a place on the ground in the middle of the picture."""
    axes = axes_of(heading_rad, np.radians(pitch_deg), 0.0)
    return CameraPose(np.array([*place_m, 0.0]) - axes[:, 2] * altitude_m / -axes[2, 2], axes)


def located(frame, places, velocities=None, targets=None, pose=None, size_m=3.0, rate_hz=RATE_HZ) -> AerialLocations:
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
    return AerialLocations(
        frame, (frame - 1) / rate_hz, positions, np.arange(n), covariance, velocity, boxes, fix, LandmarkObservations()
    )


def judged(frame, *kinds) -> Confirmation:
    """What ground vehicles say of targets in order: human, not_human or unseen, or a probability."""
    chance = {"human": 0.99, "not_human": 0.01, "unseen": 0.5}
    probability = np.array([chance.get(kind, kind) for kind in kinds], float)
    words = tuple(k if isinstance(k, str) else ("human" if k >= 0.5 else "not_human") for k in kinds)
    n = len(kinds)
    nothing = np.full(n, np.nan)
    return Confirmation(
        *(frame, np.arange(n), words, probability, ((),) * n, np.zeros(n, np.int64), nothing, nothing, nothing)
    )


def team_at(places) -> LandmarkObservations:
    places = np.asarray(places, float).reshape(-1, 2)
    n = len(places)
    return LandmarkObservations(np.arange(n), np.full((n, 2), np.nan), places, np.ones(n), np.ones(n), np.zeros(n))


def flown(pose: CameraPose, speed_m_s: float = 2.0) -> Flight:
    heading, pitch, roll = pose.angles_rad
    return Flight(float(pose.place_m[2]), speed_m_s, tuple(pose.place_m[:2]), float("nan"), heading, pitch, roll)


SQUARE = np.array([[14, 14], [-14, 14], [-14, -14], [14, -14]], float)


def test_nothing_known_changes_nothing():
    steering = Steering(Settings(), CAMERA, RATE_HZ, names(4))
    for frame in range(1, 30):
        command, made = steering.update(located(frame, []), None, frame / RATE_HZ, team_at(SQUARE), None)
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
    kinds: tuple[str | float, ...] = ()
    delay_s: float = 1.0
    altitude_m: float = 50.0
    pitch_deg: float = 90.0
    hidden: Callable[[float], bool] = lambda now_s: False
    now_s: float = 0.0
    looked: np.ndarray = field(default_factory=lambda: np.zeros(2))
    commands: list[Command] = field(default_factory=list)
    made: list[Adjustment] = field(default_factory=list)
    poses: list[CameraPose] = field(default_factory=list)
    frames: list[AerialLocations] = field(default_factory=list)
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
        return np.all((pixels > 0) & (pixels < np.array(CAMERA.size_px) - 1), axis=1)

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
            command, made = self.steering.update(settled, confirmed, self.now_s, marks, flight)
            self.commands.append(command)
            self.made.extend(made)
            self._obey(command)
        self.targets = self.targets + self.velocity / RATE_HZ
        self.now_s += 1 / RATE_HZ

    def _obey(self, command: Command) -> None:
        if command.look_at is not None:
            self.looked = self.looked + towards(self.looked, command.look_at, 10.0)
        if command.altitude_m is not None:
            self.altitude_m += float(np.clip(command.altitude_m - self.altitude_m, -1 / RATE_HZ, 1 / RATE_HZ))
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


def of(made: list[Adjustment], parameter: str) -> list[Adjustment]:
    """The adjustments of a parameter."""
    return [adjustment for adjustment in made if adjustment.parameter == parameter]


# The aerial vehicle.


@pytest.mark.parametrize(("pitch_deg", "velocity"), [(90.0, (1.4, 0.0)), (90.0, (-1.2, 2.0)), (45.0, (1.0, -1.0))])
def test_a_crowd_that_walks_stays_in_the_picture_and_so_do_four_landmarks(pitch_deg, velocity):
    shown, marks = [], []

    def look(w):
        shown.append(bool(w.inside(w.targets).all()))
        marks.append(int(w.inside(w.team).sum()))

    walk = world([[0, 0]], [velocity], kinds=("human",), pitch_deg=pitch_deg)
    walk.run(30, look)
    assert np.linalg.norm(walk.targets) > 40  # it left the first picture
    assert all(shown)
    assert min(marks) >= 4


def test_it_climbs_where_crowds_part_and_comes_down_when_they_meet_again():
    apart = world([[0, 2], [0, -2]], [[0.3, 1.0], [0.3, -1.0]], kinds=("human", "human")).run(22)
    shown = apart.inside(apart.targets)
    up = of(apart.made, "uav.altitude_m")
    assert shown.all() and apart.altitude_m > 55 and all(change.new > change.old for change in up)
    assert "do not fit from 50 m" in up[0].cause
    apart.velocity = -apart.velocity
    apart.run(40)
    assert apart.altitude_m < 55
    assert len(of(apart.made, "uav.altitude_m")) < 15


def test_where_nothing_is_found_any_more_it_sees_more_from_higher_and_goes_back_at_last():
    lost = world([[0, 0]], [[0.5, 0.0]], kinds=("human",), hidden=lambda now_s: now_s > 15).run(30)
    climbs = of(lost.made, "uav.altitude_m")
    assert climbs and all("no target for" in change.cause and change.new > change.old for change in climbs)
    lost.run(40)
    assert lost.commands[-1].altitude_m == 50.0
    lost.hidden = lambda now_s: False
    lost.looked = lost.targets[0].copy()
    lost.run(10)
    assert lost.inside(lost.targets).all() and len(lost.commands[-1].orders) == 4


def test_silent_telemetry_is_survived_by_what_the_pictures_tell():
    walk = world([[0, 0]], [[1.4, 0]], kinds=("human",)).run(10)
    walk.silent = True
    walk.run(20)
    assert walk.inside(walk.targets).all()
    deaf = Steering(Settings(), CAMERA, RATE_HZ, names(4))
    for frame in range(1, 30):
        blind = replace(located(frame, [[1, 2]]), fix=Fix(frame, "", cause="nothing"))
        command, _ = deaf.update(blind, None, frame / RATE_HZ + 1, team_at(SQUARE), None)
    assert command.look_at is None and len(command.orders) == 4


# The ground vehicles.


@pytest.mark.parametrize("count", [4, 5])
def test_ground_vehicles_surround_a_crowd_that_walks_and_are_never_on_one_line(count):
    """Also where they come from all on one side, on one line."""
    spread, inside = [], []

    def look(w):
        if w.now_s > 24:
            spread.append(spread_m2(w.team[best_spread(w.team, 4)]))
            bearing = np.sort(np.arctan2(*(w.team - w.targets[0]).T))
            gaps = np.diff(np.r_[bearing, bearing[0] + 2 * np.pi])
            inside.append(gaps.max() < np.pi)

    team = np.c_[np.linspace(-16, 16, count), np.full(count, -14.0)]
    world([[0, 0]], [[0.8, 0.3]], team=team, kinds=("human",)).run(36, look)
    assert min(spread) > 40
    assert all(inside)


def test_what_nobody_has_seen_is_looked_at_first_then_what_is_least_sure():
    w = world([[0, 6], [0, -6], [5, 0]], kinds=("human", "unseen", 0.6)).run(10)

    def looked_at(row: int) -> list[bool]:
        """Whether each vehicle that has a target in reach looks at it."""
        near = np.linalg.norm(w.team - w.targets[row], axis=1) < 13
        at = np.array([order.look_at for order in w.commands[-1].orders])
        return (np.linalg.norm(at - w.targets[row], axis=1) < 2)[near].tolist()

    assert len(looked_at(1)) >= 2 and all(looked_at(1))
    w.kinds = ("human", "human", 0.6)
    w.run(6)
    assert len(looked_at(2)) >= 2 and all(looked_at(2))


def test_a_vehicle_is_sent_to_what_nobody_can_see_from_the_ring_and_called_back_when_it_has_been_seen():
    six = np.r_[SQUARE, [[0, 16], [0, -16]]]
    far = [[0, 0], [1, 0], [0, 1], [-70, -30]]
    w = world(far, team=six, kinds=("human", "human", "human", "unseen"), altitude_m=140.0).run(14)
    sent = [change for change in w.made if change.parameter.endswith(".sent_to")]
    assert [change.new for change in sent] == [4.0] and "nobody has seen it" in sent[0].cause
    apart = np.linalg.norm(w.team - w.targets[3], axis=1)
    w.run(10)
    nearer = np.linalg.norm(w.team - w.targets[3], axis=1)
    assert nearer.min() < apart.min() and nearer.min() > 4
    assert w.inside(w.team).sum() >= 4
    w.kinds = ("human",) * 4
    w.run(3)
    assert [change.new for change in w.made if change.parameter.endswith(".sent_to")] == [4.0, 0.0]


def test_a_vehicle_that_falls_silent_is_counted_on_for_a_while_and_then_the_others_close_the_ring():
    w = world([[0, 0]], [[0.5, 0]], kinds=("human",)).run(10)
    w.said = np.array([True, True, False, True])
    w.run(5)
    assert {order.vehicle for order in w.commands[-1].orders} == set(names(4))
    w.run(30)
    assert {order.vehicle for order in w.commands[-1].orders} == {"ugv1", "ugv2", "ugv4"}
    (change,) = of(w.made, "team.vehicles")
    assert (change.old, change.new, change.cause) == (4, 3, "ugv3 silent for 10 s")
    assert w.inside(w.targets).all()
    w.said = None
    w.run(1)
    assert len(w.commands[-1].orders) == 4 and len(of(w.made, "team.vehicles")) == 2


# Sampling.


def sampled_by(targets, velocity, speed_m_s=0.5, misses=None, step=None, size_m=3.0):
    """`every` after each frame, and the adjustments, for a flight over targets that stand or walk."""
    steering = Steering(with_steering(sampling=True), CAMERA, SAMPLED_HZ, names(4))
    targets, velocity = np.array(targets, float).reshape(-1, 2), np.array(velocity, float).reshape(-1, 2)
    every, made = [], []
    for frame in range(1, 110):
        here = targets + velocity * frame / SAMPLED_HZ
        gone = misses is not None and frame in misses
        seen = located(frame, [] if gone else here, [] if gone else velocity, size_m=size_m, rate_hz=SAMPLED_HZ)
        command, new = steering.update(
            seen, None, frame / SAMPLED_HZ + 1, team_at(SQUARE), flown(pose_at((0, 0)), speed_m_s), step
        )
        every.append(command.every)
        made.extend(of(list(new), "sampling.every"))
    return every, made


def test_frames_are_left_out_by_height_and_speed_as_many_as_the_rule_says():
    """50 m at 5 Hz and 1.25 m/s: 50 / 20 x 5 / 1.25 x 5 / 10 = 5 frames, and half of it by the share."""
    assert sampled_by([[0, 0]], [[0.0, 0.0]], speed_m_s=1.3)[0][-1] == 2
    every, (change,) = sampled_by([[0, 0]], [[0.0, 0.0]], speed_m_s=0.5)
    assert every[-1] == 5
    assert (change.new, change.cause) == (5.0, "altitude 50.0 m, speed 0.5 m/s")


# The whole.


def test_each_part_can_be_left_as_planned():
    def after(**parameters):
        w = world([[0, 5]], [[1.4, 0]], kinds=("unseen",), settings=with_steering(**parameters)).run(8)
        return w.commands[-1], w.made

    command, _ = after(sampling=False)
    assert command.every == 1 and command.look_at is not None and command.orders
    command, _ = after(follow=False)
    assert command.look_at is command.fly_to is command.altitude_m is None and command.orders
    command, _ = after(look=False)
    assert command.orders == () and command.look_at is not None
    assert after(sampling=True, sampling_share=2.0)[0].every > 1


def test_no_picture_is_wanted_of_what_is_out_of_reach():
    w = world([[0, 0]], team=SQUARE * 3, kinds=("unseen",))
    w.run(3)
    assert not any(order.picture for command in w.commands for order in command.orders)


def test_a_target_that_is_not_human_is_given_up_and_followed_until_then():
    car = world([[0, 5]], [[1.5, 0.0]], kinds=("unseen",)).run(10)
    assert car.looked[0] > 5
    car.kinds = ("not_human",)
    car.run(15)
    assert np.linalg.norm(car.looked - car.targets[0]) > 10
    assert car.commands[-1].orders == ()


def test_while_a_target_is_lost_every_frame_is_looked_at_and_then_fewer_again():
    every, made = sampled_by([[0, 0]], [[0.5, 0.0]], misses=range(50, 56))
    assert every[45] == 5 and every[60] == 1 and every[-1] == 5
    assert [change.cause for change in made if change.new == 1] == ["target 1 was lost"]


def test_a_weak_registration_is_looked_at_closely():
    weak = Registration(np.eye(3), 200, 40, 0.3, 0.2)
    every, _ = sampled_by([], [], step=weak)
    assert set(every) == {1}
