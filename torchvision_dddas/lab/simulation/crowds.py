"""People in crowds: they stay together, keep distance, walk, join, split and scatter.

A crowd has a moving middle. Each member follows its own slot about that middle, strays a little, and gives way to
others. Behaviours and speeds are those of appendix A, section V.
"""

from dataclasses import dataclass, fields

import numpy as np

from torchvision_dddas.lab.simulation.movement import Obstacles, heading_vector, near_pairs, wrap_angle
from torchvision_dddas.lab.simulation.scenario import CrowdPlan, Happening

# The source does not state its time unit in seconds. With 2 s, 1.11 to 3.34 m per unit is walking speed.
UNIT_S = 2.0
SLOWEST_M, FASTEST_M = 1.11, 3.34  # speed of a random crowd along east and along north, metres per time unit
BODY_M = 0.5  # least distance between the middles of two people
_ROUNDS = 8  # most iterations per step that move people apart
_MARGIN_M = 10.0
_PERSONAL_M = 0.8
_WARY_M, _TOUCH_M = 2.0, 0.3  # distance from vehicles at which people turn away; least distance from vehicles
_LOOSE_S = 2.5  # time constant with which people return to their slots
# Straying speed along each axis, walking and standing, and correlation time of its direction.
_STRAY_M_S, _STRAY_S = (0.2, 0.03), 3.0
_PATIENCE_S = 120.0
# Speeds of people who run away, and the time constant with which they slow down to a walk.
_RUN_M_S, _TIRED_S, _WALK_M_S = (2.5, 4.0), 20.0, 1.4
_STAND, _HEADING, _WAY, _RANDOM, _MEET = range(5)
_SHIRTS = np.array(
    [
        [225, 225, 225], [200, 205, 210], [60, 60, 62], [40, 38, 38], [95, 82, 72], [120, 100, 86], [78, 82, 108],
        [90, 110, 130], [140, 150, 160], [75, 95, 85], [110, 120, 105], [165, 150, 140], [82, 86, 118], [150, 134, 112],
    ],
    float,
)  # fmt: skip


@dataclass
class _Groups:
    """Crowds, one row each. way: (G, W, 2) waypoints, of which the first `places` are valid. at: current waypoint.

    step: +1 or -1 along the way. course: clockwise from north. unit: time unit of the last random velocity. runs: bool.
    """

    number: np.ndarray
    middle: np.ndarray
    velocity: np.ndarray
    radius: np.ndarray
    behaviour: np.ndarray
    speed: np.ndarray
    course: np.ndarray
    from_s: np.ndarray
    way: np.ndarray
    places: np.ndarray
    at: np.ndarray
    step: np.ndarray
    unit: np.ndarray
    meeting: np.ndarray
    runs: np.ndarray

    @classmethod
    def planned(cls, plans: tuple[CrowdPlan, ...], limit_m: float) -> "_Groups":
        """Return the planned crowds, numbered from 1, with waypoints limited to limit_m from the world's middle."""
        many = len(plans)
        way = np.zeros((many, max([1, *(len(plan.way_m) for plan in plans)]), 2))
        for row, plan in enumerate(plans):
            way[row, : len(plan.way_m)] = np.array(plan.way_m, float).reshape(-1, 2)
        kinds = {"stand": _STAND, "random": _RANDOM}

        def each(name: str) -> np.ndarray:
            return np.array([getattr(plan, name) for plan in plans], float)

        return cls(
            number=np.arange(1, many + 1),
            middle=each("start_m").reshape(-1, 2),
            velocity=np.zeros((many, 2)),
            radius=np.array([_radius(plan.people, plan.radius_m) for plan in plans]),
            behaviour=np.array([kinds.get(p.behaviour, _WAY if p.way_m else _HEADING) for p in plans], int),
            speed=each("speed_m_s"),
            course=np.radians(each("heading_deg")),
            from_s=each("from_s"),
            way=way.clip(-limit_m, limit_m),
            places=np.array([max(len(plan.way_m), 1) for plan in plans], int),
            at=np.zeros(many, int),
            step=np.ones(many, int),
            unit=np.full(many, -1),
            meeting=np.zeros((many, 2)),
            runs=np.zeros(many, bool),
        )

    def add(self, row: int, count: int) -> np.ndarray:
        """Append copies of a crowd and return their rows."""
        before = len(self.number)
        for one in fields(self):
            values = getattr(self, one.name)
            setattr(self, one.name, np.concatenate([values, np.repeat(values[row : row + 1], count, axis=0)]))
        return np.arange(before, before + count)


@dataclass
class _Meeting:
    """Crowds that walk to a common place until a time at the latest, and the joined crowd's later behaviour."""

    rows: list[int]
    place: np.ndarray
    until_s: float
    behaviour: int
    speed_m_s: float
    course_rad: float


class Crowds:
    """All people of a world as arrays: place, velocity (N, 2), facing, phase, height (N,), colour (N, 3).

    group: (N,) row of each person's crowd. next_number: number of the next new crowd.
    """

    def __init__(
        self,
        plans: tuple[CrowdPlan, ...],
        happenings: tuple[Happening, ...],
        side_m: float,
        obstacles: Obstacles,
        seed: int,
        next_number: int,
    ) -> None:
        self._half, self._obstacles, self._next = side_m / 2, obstacles, next_number
        self._margin = min(_MARGIN_M, side_m / 8)
        self._rng = rng = np.random.default_rng([seed, 10])
        self._happenings = sorted(happenings, key=lambda one: one.time_s)
        self._meetings: list[_Meeting] = []
        self._groups = groups = _Groups.planned(plans, self._half - self._margin)
        self.group = np.repeat(np.arange(len(plans)), [plan.people for plan in plans])
        count = len(self.group)
        slots = [np.zeros((0, 2)), *(_slots(plan.people, plan.radius_m, rng) for plan in plans)]
        edge, middle = self._half - 1.0, groups.middle[self.group]
        place = (middle + np.concatenate(slots)).clip(-edge, edge)
        for _ in range(30):
            place = obstacles.outside(_move_apart(place, near_pairs(place, BODY_M), 0.55))
        self.place, self._slot = place, place - middle
        self.velocity = np.zeros((count, 2))
        facing = groups.course[self.group] + rng.normal(0, 0.4, count)
        standing = groups.behaviour[self.group] == _STAND
        self.facing = np.where(standing, rng.uniform(-np.pi, np.pi, count), facing) % (2 * np.pi)
        self.phase = rng.uniform(0, 1, count)
        self.height = rng.normal(1.72, 0.08, count).clip(1.5, 1.95)
        shade = rng.uniform(0.85, 1.15, (count, 1))
        self.colour = (_SHIRTS[rng.integers(0, len(_SHIRTS), count)] * shade).clip(0, 255)
        self._stray = rng.normal(0, 1, (count, 2))

    def __len__(self) -> int:
        return len(self.place)

    @property
    def target(self) -> np.ndarray:
        """(N,) int64, the number of each person's crowd."""
        return self._groups.number[self.group]

    def step(self, time_s: float, seconds: float, vehicles: np.ndarray) -> list[str]:
        """Advance by `seconds` to time_s. Return the events in words.

        vehicles: (V, 5) vehicles that people avoid: east, north, course, half the length, half the width.
        """
        events = self._happen(time_s)
        if not len(self):
            return events
        self._lead(time_s, seconds)
        groups, mine = self._groups, self.group
        started = (time_s >= groups.from_s) & (groups.behaviour != _STAND)
        goal = groups.middle[mine] + self._slot
        wanted = groups.velocity[mine] + (goal - self.place) / _LOOSE_S
        # People who fall behind walk faster, up to a limit.
        most = np.where(started, 1.5 * groups.speed + 0.4, 0.4)[mine]
        wanted = wanted * np.minimum(1.0, most / np.maximum(np.hypot(*wanted.T), 1e-9))[:, None]
        kept = np.exp(-seconds / _STRAY_S)
        self._stray = kept * self._stray + np.sqrt(1 - kept**2) * self._rng.standard_normal(self._stray.shape)
        wanted = wanted + np.where(started, *_STRAY_M_S)[mine, None] * self._stray
        near = near_pairs(self.place, _PERSONAL_M)
        wanted = self._obstacles.steer(self.place, wanted, 0.5) + self._push_away(near)
        wanted = wanted + self._push_off_vehicles(vehicles)
        velocity = wanted + (self.velocity - wanted) * np.exp(-seconds / 0.35)
        place = _move_apart(self.place + seconds * velocity, near, BODY_M)
        for vehicle in vehicles:
            away, distance, touched = _from_box(place, vehicle, _TOUCH_M)
            if len(touched):
                place = place.copy()
                place[touched] += away * (_TOUCH_M - distance)[:, None]
        place = self._obstacles.outside(place).clip(-self._half + 1, self._half - 1)
        self.velocity = (place - self.place) / seconds
        self.place = place
        # The gait's phase follows the distance walked. Faces turn to the direction of motion.
        speed = np.hypot(*self.velocity.T)
        stride = 0.8 * self.height * np.sqrt(np.clip(speed / 1.4, 0.25, 4.0))
        self.phase = (self.phase + speed * seconds / stride) % 1.0
        error = wrap_angle(np.arctan2(self.velocity[:, 0], self.velocity[:, 1]) - self.facing)
        turned = error * (1 - np.exp(-seconds / 0.3)) * np.clip((speed - 0.1) / 0.4, 0, 1)
        self.facing = (self.facing + turned) % (2 * np.pi)
        return events

    def _push_away(self, near: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Return (N, 2) velocities away from people who come too near."""
        away = self.place[near[0]] - self.place[near[1]]
        distance = np.maximum(np.hypot(*away.T), 1e-6)
        push = away * (0.8 * (1 - distance / _PERSONAL_M) / distance)[:, None]
        return _sum_pairs(push, near, len(self))

    def _push_off_vehicles(self, vehicles: np.ndarray) -> np.ndarray:
        """Return (N, 2) velocities away from nearby vehicles."""
        push = np.zeros_like(self.place)
        for vehicle in vehicles:
            away, distance, near = _from_box(self.place, vehicle, _WARY_M)
            push[near] += away * (1.5 * (1 - np.clip(distance, 0, None) / _WARY_M))[:, None]
        return push

    def _lead(self, time_s: float, seconds: float) -> None:
        """Move the middles of the crowds."""
        groups = self._groups
        # Crowds that move at random draw a new velocity each time unit.
        unit = np.floor((time_s - 1e-9) / UNIT_S).astype(int)
        due = (groups.behaviour == _RANDOM) & (groups.unit != unit)
        if many := int(due.sum()):
            steps = self._rng.uniform(SLOWEST_M, FASTEST_M, (many, 2)) * self._rng.choice([-1.0, 1.0], (many, 2))
            groups.speed[due] = np.hypot(*steps.T) / UNIT_S
            groups.course[due] = np.arctan2(steps[:, 0], steps[:, 1])
            groups.unit[due] = unit
        rows = np.arange(len(groups.number))
        tired = groups.runs * (1 - np.exp(-seconds / _TIRED_S))
        groups.speed = groups.speed + tired * (_WALK_M_S - groups.speed)
        goal = np.where((groups.behaviour == _MEET)[:, None], groups.meeting, groups.way[rows, groups.at])
        to = goal - groups.middle
        distance = np.hypot(*to.T)
        aimed = (groups.behaviour == _WAY) | (groups.behaviour == _MEET)
        heading = heading_vector(np.where(aimed, np.arctan2(to[:, 0], to[:, 1]), groups.course))
        going = (groups.behaviour != _STAND) & (time_s >= groups.from_s)
        speed = np.where(going, groups.speed, 0.0)
        speed = np.where(aimed, np.minimum(speed, distance / max(seconds, 0.1)), speed)
        # The middle waits for people who fall behind.
        late = np.linalg.norm(groups.middle[self.group] + self._slot - self.place, axis=1)
        count = np.maximum(np.bincount(self.group, minlength=len(rows)), 1)
        late = np.bincount(self.group, late, minlength=len(rows)) / count
        speed = speed * np.clip(1 - (late - 1.5) / 3, 0, 1)
        limit = np.maximum(self._half - self._margin - groups.radius, 1.0)[:, None]
        # Crowds are reflected at the world's edge.
        out = (np.abs(groups.middle) > limit) & (np.sign(heading) == np.sign(groups.middle)) & ~aimed[:, None]
        heading = np.where(out, -heading, heading)
        groups.course = np.arctan2(heading[:, 0], heading[:, 1])
        groups.velocity = self._obstacles.steer(groups.middle, heading * speed[:, None], 1.0)
        groups.middle = groups.middle + seconds * groups.velocity
        reached = (groups.behaviour == _WAY) & (distance < np.maximum(0.5, groups.speed * seconds)) & going
        ahead = groups.at + groups.step
        turn = reached & ((ahead < 0) | (ahead >= groups.places))
        groups.step = np.where(turn, -groups.step, groups.step)
        groups.at = np.where(reached, (groups.at + groups.step).clip(0, groups.places - 1), groups.at)

    def _happen(self, time_s: float) -> list[str]:
        events = []
        while self._happenings and self._happenings[0].time_s <= time_s + 1e-9:
            happening = self._happenings.pop(0)
            rows = [one - 1 for one in happening.crowds]
            if happening.what == "join":
                events += self._begin_meeting(rows, time_s)
                continue
            for row in rows:
                events += self._split(row, happening.turn_deg) if happening.what == "split" else self._scatter(row)
        return events + self._end_meetings(time_s)

    def _begin_meeting(self, rows: list[int], time_s: float) -> list[str]:
        groups = self._groups
        rows = [row for row in rows if (self.group == row).any()]
        if len(rows) < 2:
            return []
        place, first = groups.middle[rows].mean(axis=0), rows[0]
        then = int(groups.behaviour[first]), float(groups.speed[first]), float(groups.course[first])
        self._meetings.append(_Meeting(rows, place, time_s + _PATIENCE_S, *then))
        groups.meeting[rows] = place
        groups.behaviour[rows] = _MEET
        groups.speed[rows] = np.maximum(groups.speed[rows], 1.0)
        groups.from_s[rows] = np.minimum(groups.from_s[rows], time_s)
        return [f"crowds {_join_numbers(groups.number[rows])} walk towards each other"]

    def _end_meetings(self, time_s: float) -> list[str]:
        """Join the crowds that have met into one crowd."""
        groups, events = self._groups, []
        for meeting in list(self._meetings):
            rows, first = meeting.rows, meeting.rows[0]
            reach = np.sqrt((groups.radius[rows] ** 2).sum())
            away = np.linalg.norm(groups.middle[rows] - meeting.place, axis=1)
            if (away > np.maximum(0.5 * reach, 1.0)).any() and time_s < meeting.until_s:
                continue
            self._meetings.remove(meeting)
            mine = np.isin(self.group, rows)
            if mine.any():
                self.group[mine] = first
                self._gather(first)
                groups.behaviour[first], groups.speed[first] = meeting.behaviour, meeting.speed_m_s
                groups.course[first], groups.unit[first] = meeting.course_rad, -1
                numbers = groups.number[rows]
                events.append(f"crowds {_join_numbers(numbers)} join into crowd {numbers[0]}")
        return events

    def _gather(self, row: int) -> None:
        """Set a crowd's middle and slots from its people's places. Slots far from the middle move nearer."""
        mine = np.flatnonzero(self.group == row)
        middle = self.place[mine].mean(axis=0)
        away = self.place[mine] - middle
        far = np.hypot(*away.T)
        radius = max(0.4 * np.sqrt(len(mine)), float(np.median(far)) * np.sqrt(2))
        self._groups.middle[row], self._groups.radius[row] = middle, radius
        self._slot[mine] = away * np.minimum(1.0, radius / np.maximum(far, 1e-9))[:, None]

    def _split(self, row: int, turn_deg: float) -> list[str]:
        groups, mine = self._groups, np.flatnonzero(self.group == row)
        if len(mine) < 2:
            return []
        course = groups.course[row]
        aside = (self.place[mine] - self.place[mine].mean(axis=0)) @ [np.cos(course), -np.sin(course)]
        # The right half turns to the right.
        leaving = mine[np.argsort(aside, kind="stable")[len(mine) - len(mine) // 2 :]]
        new = int(groups.add(row, 1)[0])
        self.group[leaving] = new
        old, number = groups.number[row], self._next
        self._next += 1
        groups.number[new], groups.course[new], groups.from_s[new] = number, course + np.radians(turn_deg), 0.0
        if groups.behaviour[row] in (_STAND, _WAY, _MEET):
            groups.behaviour[new] = _HEADING
        if groups.speed[new] <= 0:
            groups.speed[new] = 1.4
        self._gather(row)
        self._gather(new)
        return [f"crowd {old} splits: {len(leaving)} of {len(mine)} are now crowd {number}"]

    def _scatter(self, row: int) -> list[str]:
        groups, mine = self._groups, np.flatnonzero(self.group == row)
        if not len(mine):
            return []
        new, number = groups.add(row, len(mine)), groups.number[row]
        away = self.place[mine] - self.place[mine].mean(axis=0)
        self.group[mine], self._slot[mine] = new, 0.0
        groups.number[new] = self._next + np.arange(len(mine))
        self._next += len(mine)
        groups.middle[new], groups.radius[new], groups.from_s[new] = self.place[mine], 0.0, 0.0
        groups.behaviour[new] = _HEADING
        groups.course[new] = np.arctan2(away[:, 0], away[:, 1]) + self._rng.normal(0, 0.4, len(mine))
        groups.speed[new], groups.runs[new] = self._rng.uniform(*_RUN_M_S, len(mine)), True
        return [f"the {len(mine)} people of crowd {number} scatter"]


def _radius(people: int, radius_m: float) -> float:
    """Return the radius of a disc with room for a number of people; 0 for one person."""
    return max(radius_m, 0.36 * float(np.sqrt(people))) if people > 1 else 0.0


def _slots(people: int, radius_m: float, rng: np.random.Generator) -> np.ndarray:
    """Return (N, 2) separate places in a disc (sunflower pattern), turned at random for each crowd."""
    reach = _radius(people, radius_m)
    away = reach * np.sqrt((np.arange(people) + 0.5) / people)
    turn = np.arange(people) * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi)
    slots = np.stack([away * np.cos(turn), away * np.sin(turn)], axis=1)
    return slots + rng.uniform(-0.5, 0.5, slots.shape) * reach / np.sqrt(people)


def _move_apart(place: np.ndarray, near: tuple[np.ndarray, np.ndarray], least_m: float) -> np.ndarray:
    """Move each person of a pair that is too near by half the missing distance. Return the places (N, 2)."""
    for _ in range(_ROUNDS):
        away = place[near[0]] - place[near[1]]
        distance = np.maximum(np.hypot(*away.T), 1e-6)
        short = np.clip(least_m - distance, 0, None)
        if not (short > 0.01).any():
            break
        place = _sum_pairs(away * (0.5 * short / distance)[:, None], near, len(place), place)
    return place


def _sum_pairs(
    push: np.ndarray, near: tuple[np.ndarray, np.ndarray], count: int, start: float | np.ndarray = 0.0
) -> np.ndarray:
    """Return (count, 2) sums of the pushes (P, 2) of pairs: added to the first row, subtracted from the second."""
    first, second = (
        np.stack([np.bincount(rows, push[:, axis], minlength=count) for axis in (0, 1)], axis=1) for rows in near
    )
    return start + first - second


def _from_box(place: np.ndarray, vehicle: np.ndarray, within_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions (n, 2) away from a vehicle's sides, metres (n,) to them (negative inside), and rows (n,)."""
    east, north, course, length, width = vehicle
    near = np.flatnonzero(np.abs(place - (east, north)).max(axis=1) < np.hypot(length, width) + within_m)
    ahead = heading_vector(course)
    right = np.array([ahead[1], -ahead[0]])
    to = place[near] - (east, north)
    own = np.stack([to @ ahead, to @ right], axis=1)
    beyond = np.abs(own) - (length, width)
    outside = np.maximum(beyond, 0.0)
    # People inside the box leave by the nearest side.
    inside = (beyond < 0).all(axis=1)
    outside[inside] = np.where(beyond[inside] == beyond[inside].max(axis=1, keepdims=True), 1e-9, 0.0)
    size = np.maximum(np.hypot(*outside.T), 1e-12)
    distance = np.where(inside, beyond.max(axis=1), size)
    way = outside / size[:, None] * np.where(own < 0, -1.0, 1.0)
    kept = distance < within_m
    away = way[:, :1] * ahead + way[:, 1:] * right
    return away[kept], distance[kept], near[kept]


def _join_numbers(numbers: np.ndarray) -> str:
    return " and ".join(str(int(number)) for number in numbers)
