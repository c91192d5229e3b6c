"""Results steer the instruments: synthetic located frames in, commands and their causes out."""

from dataclasses import replace

import numpy as np
import pytest

from torchvision_dddas.config import IntervalParameters, Settings, SteeringParameters
from torchvision_dddas.control import Steering
from torchvision_dddas.geo.landmark_trajectories import best_spread, spread_m2
from torchvision_dddas.geometry.projection import axes_of, project
from torchvision_dddas.types import (
    AerialLocations,
    Camera,
    CameraPose,
    Command,
    Confirmation,
    Fix,
    Flight,
    GroundCrowds,
    LandmarkObservations,
    Positions,
    Registration,
)

FOCAL_PX = 320 / np.tan(np.radians(30))
CAMERA = Camera("aerial", (640, 480), (FOCAL_PX, FOCAL_PX), (319.5, 239.5))
# Frames a second of the toy world, and where frames are left out.
RATE_HZ, SAMPLED_HZ = 2.5, 5.0
NAMES = tuple(f"ugv{k + 1}" for k in range(6))
SQUARE = np.array([[14, 14], [-14, 14], [-14, -14], [14, -14]], float)


def steering(count=4, rate_hz=RATE_HZ, **parameters) -> Steering:
    return Steering(Settings(steering=SteeringParameters(**parameters)), CAMERA, rate_hz, NAMES[:count])


def pose_at(place_m, altitude_m=50.0, pitch_deg=90.0) -> CameraPose:
    """The pose that has a place on the ground in the middle of the picture."""
    axes = axes_of(0.0, np.radians(pitch_deg), 0.0)
    return CameraPose(np.array([*place_m, 0.0]) - axes[:, 2] * altitude_m / -axes[2, 2], axes)


def located(frame, places, velocity=0.0, targets=None, pose=None, rate_hz=RATE_HZ) -> AerialLocations:
    """A located frame: what stands at places (N, 2), 3 m large."""
    places = np.asarray(places, float).reshape(-1, 2)
    n, pose = len(places), pose or pose_at((0, 0))
    target = np.arange(1, n + 1) if targets is None else targets
    ground = np.c_[places, np.zeros(n)]
    side = 3.0 * FOCAL_PX / np.maximum((ground - pose.place_m) @ pose.axes[:, 2], 1.0)
    boxes = np.c_[project(ground, pose, CAMERA) - side[:, None] / 2, side, side]
    covariance = np.tile(0.1 * np.eye(2), (n, 1, 1))
    positions = Positions(np.full(n, frame), target, places, covariance, np.ones(n))
    velocity, fix = np.broadcast_to(velocity, (n, 2)), Fix(frame, "pose", pose)
    when_s = (frame - 1) / rate_hz
    return AerialLocations(
        frame, when_s, positions, np.arange(n), covariance, velocity, boxes, fix, LandmarkObservations()
    )


def judged(frame, kinds) -> Confirmation:
    """What ground vehicles say of targets in order: human, not_human or unseen, or a probability."""
    chance, n = {"human": 0.99, "not_human": 0.01, "unseen": 0.5}, len(kinds)
    words = tuple(k if isinstance(k, str) else "human" for k in kinds)
    nothing = [np.full(n, np.nan)] * 3
    probability = np.array([chance.get(kind, kind) for kind in kinds], float)
    return Confirmation(frame, np.arange(n), words, probability, ((),) * n, np.zeros(n, np.int64), *nothing)


def team_at(places, rows=slice(None)) -> LandmarkObservations:
    n, unseen = len(places), np.full((len(places), 2), np.nan)
    return LandmarkObservations(np.arange(n), unseen, places, np.ones(n), np.ones(n), np.zeros(n))[rows]


def flown(pose, speed_m_s=2.0) -> Flight:
    return Flight(float(pose.place_m[2]), speed_m_s, tuple(pose.place_m[:2]), float("nan"), *pose.angles_rad)


def step_to(place, goal, speed_m_s):
    """The place one frame later."""
    way = goal - place
    return place + way * min(1.0, speed_m_s / RATE_HZ / max(float(np.linalg.norm(way)), 1e-9))


class World:
    """A toy: targets walk, the aerial vehicle and the ground vehicles go where they are asked, frames settle late."""

    def __init__(self, start, pace=0.0, kinds=(), team=SQUARE, altitude_m=50.0, pitch_deg=90.0, **parameters):
        self.targets, self.team = np.array(start, float), team.copy()
        self.velocity = np.broadcast_to(np.array(pace, float), self.targets.shape)
        self.kinds, self.altitude_m, self.pitch_deg = kinds, altitude_m, pitch_deg
        self.reporting: slice | list[int] = slice(None)
        self.hidden = self.silent = False
        self.by_ground = False  # whether ground vehicles see what the air does not
        self.steering = steering(len(team), **parameters)
        self.now_s, self.looked, self.rng = 0.0, np.zeros(2), np.random.default_rng(7)
        self.commands, self.made, self.frames = [], [], []

    def run(self, seconds, check=lambda world: None) -> "World":
        for _ in range(round(seconds * RATE_HZ)):
            self._frame()
            check(self)
        return self

    def inside(self, places) -> np.ndarray:
        """Whether the last picture shows them."""
        pixels = project(np.c_[places, np.zeros(len(places))], self.pose, CAMERA)
        return np.all((pixels > 0) & (pixels < np.array(CAMERA.size_px) - 1), axis=1)

    def changes(self, parameter):
        return [change for change in self.made if change.parameter.endswith(parameter)]

    def ordered(self) -> set[str]:
        return {order.vehicle for order in self.commands[-1].orders}

    def _frame(self) -> None:
        self.pose = pose_at(self.looked, self.altitude_m, self.pitch_deg)
        shown = np.flatnonzero(self.inside(self.targets) & (not self.hidden))
        noisy = self.targets + self.rng.normal(0, 0.3, self.targets.shape)
        self.frames.append(located(len(self.frames) + 1, noisy[shown], self.velocity[shown], shown + 1, self.pose))
        late = len(self.frames) - 1 - round(RATE_HZ)
        if late >= 0:
            settled = self.frames[late]
            kinds = [self.kinds[k - 1] for k in settled.positions.target] if self.kinds else []
            marks = team_at(self.team + self.rng.normal(0, 0.5, self.team.shape), self.reporting)
            confirmed = judged(settled.frame, kinds) if kinds else None
            flight = None if self.silent else flown(self.pose)
            missing = self.steering.missing(settled)
            at = self.targets[missing.target - 1] - self.velocity[missing.target - 1]  # it settled a second late
            count, by = np.full(len(missing), 5), np.full(len(missing), "ugv1;ugv2", object)
            crowds = GroundCrowds(missing.target, at, self.velocity[missing.target - 1], count, by, by == by)
            told = crowds if self.by_ground else None
            command, made = self.steering.update(settled, confirmed, self.now_s, marks, flight, None, told)
            self.commands.append(command)
            self.made.extend(made)
            self._obey(command)
        self.targets = self.targets + self.velocity / RATE_HZ
        self.now_s += 1 / RATE_HZ

    def _obey(self, command: Command) -> None:
        if command.look_at is not None:
            self.looked = step_to(self.looked, command.look_at, 10.0)
        if command.altitude_m is not None:
            self.altitude_m += float(np.clip(command.altitude_m - self.altitude_m, -1 / RATE_HZ, 1 / RATE_HZ))
        for order in command.orders:
            k = NAMES.index(order.vehicle)
            self.team[k] = step_to(self.team[k], order.goal, order.speed_m_s)


def test_nothing_known_changes_nothing_and_without_a_view_of_the_ground_only_ground_vehicles_are_asked():
    one, blind = steering(), steering()
    for frame in range(1, 30):
        now_s, team = frame / RATE_HZ, team_at(SQUARE)
        assert one.update(located(frame, []), None, now_s, team, None) == (Command(), ())
        unplaced = replace(located(frame, [[1, 2]]), fix=Fix(frame, "", cause="nothing"))
        command, _ = blind.update(unplaced, None, now_s + 1, team, None)
    assert command.look_at is None and len(command.orders) == 4


@pytest.mark.parametrize(("pitch_deg", "velocity"), [(90.0, (-1.2, 2.0)), (45.0, (1.0, -1.0))])
def test_a_crowd_that_walks_stays_in_the_picture_with_four_landmarks_also_where_telemetry_falls_silent(
    pitch_deg, velocity
):
    def look(w):
        w.silent = w.now_s > 15
        assert w.inside(w.targets).all() and w.inside(w.team).sum() >= 4

    walk = World([[0, 0]], velocity, ("human",), pitch_deg=pitch_deg).run(30, look)
    assert np.linalg.norm(walk.targets) > 40  # it left the first picture


def test_it_climbs_where_crowds_part_and_comes_down_when_they_meet_again():
    apart = World([[0, 2], [0, -2]], [[0.3, 1.0], [0.3, -1.0]], ("human", "human")).run(22)
    up = apart.changes("uav.altitude_m")
    assert apart.inside(apart.targets).all() and apart.altitude_m > 55
    assert all(change.new > change.old for change in up) and "do not fit from 50 m" in up[0].cause
    apart.velocity = -apart.velocity
    apart.run(40)
    assert apart.altitude_m < 55 and len(apart.changes("uav.altitude_m")) < 15


def test_where_nothing_is_found_any_more_it_sees_more_from_higher_and_goes_back_at_last():
    lost = World([[0, 0]], (0.5, 0.0), ("human",)).run(15)
    lost.hidden = True
    climbs = lost.run(15).changes("uav.altitude_m")
    assert climbs and all("no target for" in change.cause and change.new > change.old for change in climbs)
    assert lost.run(40).commands[-1].altitude_m == 50.0
    lost.hidden, lost.looked = False, lost.targets[0].copy()
    lost.run(10)
    assert lost.inside(lost.targets).all() and len(lost.ordered()) == 4


def test_a_crowd_that_only_ground_vehicles_see_is_followed_and_the_log_says_so():
    """As one that stops, or walks under trees, while the air sees nothing of it for longer than a target is kept."""
    ways = {}
    for by_ground in (False, True):
        w = World([[0, 0]], (1.0, 0.0), ("human",)).run(12)
        w.hidden, w.by_ground, w.velocity = True, by_ground, np.array([[0.0, 1.0]])
        ways[by_ground] = w.run(25)
    lost, kept = ways[False], ways[True]
    assert np.linalg.norm(lost.looked - lost.targets[0]) > 15 and not lost.ordered()
    assert np.linalg.norm(kept.looked - kept.targets[0]) < 8 and kept.ordered() == set(NAMES[:4])
    assert np.linalg.norm(kept.team - kept.targets[0], axis=1).max() < 20
    kept.hidden = False
    began, ended = kept.run(3).changes("team.by_ground")
    assert (began.new, ended.new) == (1, 0)
    assert began.cause.startswith("target 1 is not located from the air: 5 of its people seen by ugv1 and ugv2 around")
    assert began.cause.endswith("moving at 1.0 m/s") and ended.cause == "target 1 is located from the air again"


def test_a_target_is_looked_for_once_it_is_lost_for_a_while_and_does_not_go_on_under_another_number():
    one, there = steering(), [[0, 0], [20, 0]]

    def update(frame, seen):
        one.update(seen, None, frame / RATE_HZ, team_at(SQUARE), None)

    for frame in range(1, 6):
        update(frame, located(frame, there))
    for frame in range(6, 12):  # a short gap is bridged by the course
        assert not len(one.missing(located(frame, there[1:], targets=np.array([2]))))
        update(frame, located(frame, there[1:], targets=np.array([2])))
    assert one.missing(located(14, there[1:], targets=np.array([2]))).target.tolist() == [1]
    assert one.missing(located(14, [[0, 1], [20, 0]], targets=np.array([3, 2]))).target.tolist() == []


def test_a_target_that_is_not_human_is_given_up_and_followed_until_then():
    car = World([[0, 5]], (1.5, 0.0), ("unseen",)).run(10)
    assert car.looked[0] > 5
    car.kinds = ("not_human",)
    car.run(15)
    assert np.linalg.norm(car.looked - car.targets[0]) > 10 and not car.ordered()


@pytest.mark.parametrize("count", [4, 5])
def test_ground_vehicles_from_one_side_surround_a_crowd_that_walks_and_are_never_on_one_line(count):
    def look(w):
        if w.now_s > 24:
            bearing = np.sort(np.arctan2(*(w.team - w.targets[0]).T))
            assert np.diff(np.r_[bearing, bearing[0] + 2 * np.pi]).max() < np.pi
            assert spread_m2(w.team[best_spread(w.team, 4)]) > 40

    team = np.c_[np.linspace(-16, 16, count), np.full(count, -14.0)]
    World([[0, 0]], (0.8, 0.3), ("human",), team).run(36, look)


def test_what_nobody_has_seen_is_looked_at_first_then_what_is_least_sure():
    w = World([[0, 6], [0, -6], [5, 0]], 0.0, ("human", "unseen", 0.6)).run(10)
    for row, kinds, seconds in ((1, ("human", "human", 0.6), 6), (2, w.kinds, 0)):
        # Two or more vehicles have it in reach, and all that have look at it.
        near = np.linalg.norm(w.team - w.targets[row], axis=1) < 13
        at = np.array([order.look_at for order in w.commands[-1].orders])
        assert near.sum() >= 2 and (np.linalg.norm(at - w.targets[row], axis=1) < 2)[near].all()
        w.kinds = kinds
        w.run(seconds)


def test_a_vehicle_is_sent_to_what_nobody_can_see_from_the_ring_and_called_back_when_it_has_been_seen():
    far, team = [[0, 0], [1, 0], [0, 1], [-70, -30]], np.r_[SQUARE, [[0, 16], [0, -16]]]
    w = World(far, 0.0, ("human", "human", "human", "unseen"), team, altitude_m=140.0).run(14)
    (sent,) = w.changes(".sent_to")
    assert sent.new == 4.0 and "not yet seen by a ground vehicle" in sent.cause
    apart = np.linalg.norm(w.team - w.targets[3], axis=1)
    nearer = np.linalg.norm(w.run(10).team - w.targets[3], axis=1)
    assert 4 < nearer.min() < apart.min() and w.inside(w.team).sum() >= 4
    w.kinds = ("human",) * 4
    assert [change.new for change in w.run(3).changes(".sent_to")] == [4.0, 0.0]


def test_a_vehicle_that_falls_silent_is_counted_on_for_a_while_and_then_the_others_close_the_ring():
    w = World([[0, 0]], (0.5, 0), ("human",)).run(10)
    w.reporting = [0, 1, 3]
    assert w.run(5).ordered() == set(NAMES[:4])
    assert w.run(30).ordered() == {"ugv1", "ugv2", "ugv4"} and w.inside(w.targets).all()
    (change,) = w.changes("team.vehicles")
    assert (change.old, change.new, change.cause) == (4, 3, "ugv3 silent for 10 s")
    w.reporting = slice(None)
    assert len(w.run(1).ordered()) == 4 and len(w.changes("team.vehicles")) == 2


def sampled_by(targets, velocity=0.0, speed_m_s=0.5, misses=(), step=None, look_s=0.1, cost=1.0):
    """`every` after each frame, and the adjustments, for a flight over targets that stand or walk."""
    settings = Settings(steering=SteeringParameters(sampling=True), interval=IntervalParameters(cost=cost))
    one, every, made = Steering(settings, CAMERA, SAMPLED_HZ, NAMES[:4]), [], []
    flight = flown(pose_at((0, 0)), speed_m_s)
    for frame in range(1, 110):
        here = np.array(targets, float)[: 0 if frame in misses else None] + np.array(velocity) * frame / SAMPLED_HZ
        seen = replace(located(frame, here, velocity, rate_hz=SAMPLED_HZ), seconds={"detect": look_s})
        command, new = one.update(seen, None, frame / SAMPLED_HZ + 1, team_at(SQUARE), flight, step)
        every.append(command.every)
        made += [change for change in new if change.parameter == "sampling.every"]
    return every, made


def test_frames_are_left_out_by_height_and_speed_but_while_a_target_is_lost_or_the_registration_weak():
    """50 m at 5 Hz and 1.3 m/s: 50 / 20 x 5 / 1.3 x 5 / 10 = 4.8 frames, half of it by the share; 12.5 at 0.5 m/s."""
    assert sampled_by([[0, 0]], speed_m_s=1.3)[0][-1] == 2
    every, made = sampled_by([[0, 0]], (0.5, 0.0), misses=range(50, 56))
    assert every[45] == 6 and every[60] == 1 and every[-1] == 6
    assert (made[0].new, made[0].cause) == (6.0, "altitude 50.0 m, speed 0.5 m/s")
    assert [change.cause for change in made if change.new == 1] == ["target 1 was lost"]
    assert set(sampled_by([], step=Registration(np.eye(3), 200, 40, 0.3, 0.2))[0]) == {1}


def test_looks_that_take_long_leave_out_more_frames_if_their_cost_is_measured():
    """As above 2.4 frames; 3.6 where a look takes 1.5 times as long as a frame at the reference rate."""
    for look_s, cost, wanted in ((0.15, 0.0, 4), (0.15, 1.0, 2), (0.02, 0.0, 2)):
        every, made = sampled_by([[0, 0]], speed_m_s=1.3, look_s=look_s, cost=cost)
        assert every[-1] == wanted and ("a look takes" in made[-1].cause) == (cost == 0)


def test_no_picture_is_wanted_of_what_is_out_of_reach():
    w = World([[0, 0]], 0.0, ("unseen",), SQUARE * 3).run(3)
    assert not any(order.picture for command in w.commands for order in command.orders)


def test_each_part_can_be_left_as_planned():
    def after(**parameters):
        return World([[0, 5]], (1.4, 0), ("unseen",), **parameters).run(8).commands[-1]

    command = after(sampling=False)
    assert command.every == 1 and command.look_at is not None and command.orders
    command = after(follow=False)
    assert command.look_at is command.fly_to is command.altitude_m is None and command.orders
    command = after(look=False)
    assert command.orders == () and command.look_at is not None
    assert after(sampling=True, sampling_share=2.0).every > 1
