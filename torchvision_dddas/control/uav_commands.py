"""Choose the view and the altitude of the aerial vehicle: keep crowds, and enough landmarks, in its picture."""

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.control.footprint import CameraMount
from torchvision_dddas.control.prediction import Prediction
from torchvision_dddas.control.rules import AdjustmentLog, count_of

# Number of landmarks that a picture needs for its fix.
NEEDED = 4
# Margins of the targets inside the picture, as shares of half the picture: the smallest, the one after a climb, and the
# one required for a descent.
_LEAST, _AIMED, _EASY = 0.1, 0.2, 0.35
# Smallest margin of landmarks.
_LANDMARK = 0.08
# The view moves when the targets are further from the picture's centre than this share of half the picture.
_LEASH = 0.12
# Highest speed of the view: half the picture in _CROSSING_S, or _FASTER times the targets' speed. In a picture that
# sweeps over the ground no motion is detected.
_CROSSING_S, _FASTER = 5.0, 1.5
# Targets should stay in the picture for this time.
_AHEAD_S = 3.0
# Factor of one step of altitude, and the time between a change of altitude and a step down.
_STEP, _SETTLED_S = 1.1, 5.0
# Without targets the UAV climbs by two steps every _WIDEN_S, and returns to the team after _GIVEN_UP_S.
_WIDEN_S, _GIVEN_UP_S = 4.0, 30.0
# Smallest size in the picture of a target of expected_size_m. It limits the altitude.
_LEAST_PX = 6.0
# A motion of the view by at least this share of half the picture is logged.
_NOTED = 0.5


class UavSteering:
    """Computes the commanded view and altitude of the aerial vehicle; None leaves them to the vehicle."""

    def __init__(self, settings: Settings, log: AdjustmentLog) -> None:
        self.settings, self._log = settings, log
        self.look_at: np.ndarray | None = None
        self.altitude_m: float | None = None
        self.home_m = 0.0  # altitude at the start
        self._home_at: np.ndarray | None = None  # centre of the view at the first command
        self._now_s = 0.0
        self._moved_s = -np.inf  # time of the last change of altitude
        self._found_s: float | None = None  # time at which a target was predicted last
        self._group: set[int] = set()

    def update(
        self,
        prediction: Prediction,
        team_m: np.ndarray,
        mount: CameraMount | None,
        ground_in_middle: np.ndarray | None,
        now_s: float,
    ) -> None:
        """Update view and altitude by the predicted targets and the positions (V, 2) of the team's vehicles.

        ground_in_middle: (2,) ground position in the centre of the picture. Without a mount nothing is commanded.
        """
        lapse_s, self._now_s = now_s - self._now_s, now_s
        if mount is None:
            return
        self.home_m = self.home_m or mount.altitude_m
        altitude = self.altitude_m or mount.altitude_m
        rows = np.flatnonzero(prediction.wanted)
        if len(rows) and self.look_at is None:
            self._home_at = self.look_at = ground_in_middle
            lapse_s = 0.0
        if self.look_at is None:
            return
        if not len(rows):
            self._search(prediction, team_m, altitude, mount, lapse_s)
            return
        self._found_s = now_s
        rows = self._choose(prediction, rows, mount)
        points, velocity = prediction.east_north_m[rows], prediction.velocity_m_s[rows]
        # Aim at the current and the future positions of the targets, because climbing takes time.
        goal, height, why = self._aim(np.r_[points, points + _AHEAD_S * velocity], team_m, altitude, mount)
        east, north = points.mean(axis=0)
        why = f"{count_of(len(rows), 'target')} around ({east:.0f}, {north:.0f}) m: {why}"
        self._climb(height, altitude, mount, why)
        speed = float(np.linalg.norm(velocity.mean(axis=0)))
        self._look(goal, mount.half_m(self.altitude_m or altitude), speed, lapse_s, why)

    def followed(self, prediction: Prediction) -> np.ndarray:
        """Return the rows of the targets to follow: the chosen group, or all wanted targets if it is gone."""
        rows = np.flatnonzero(prediction.wanted)
        held = rows[np.isin(prediction.target[rows], list(self._group))]
        return held if len(held) else rows

    def highest_m(self, mount: CameraMount) -> float:
        """Return the highest allowed altitude, at which a target of the expected size still measures _LEAST_PX.

        It is also limited by the settings, or else by twice the initial altitude.
        """
        limit = self.settings.steering.maximum_altitude_m or 2 * self.home_m
        size_m = self.settings.gates.expected_size_m
        return float(max(self.home_m, min(limit, size_m * float(np.mean(mount.camera.focal_px)) / _LEAST_PX)))

    def _choose(self, prediction: Prediction, rows: np.ndarray, mount: CameraMount) -> np.ndarray:
        """Return all wanted targets if they fit into one picture, else the heaviest group, with hysteresis."""
        highest, places = self.highest_m(mount), prediction.east_north_m
        groups = [rows]
        if mount.centre(places[rows], highest)[1] < _LEAST:
            groups = []
            for seed in rows.tolist():
                # A group is a target and its nearest neighbours, as long as all fit into one picture.
                group = [seed]
                for row in rows[np.argsort(np.linalg.norm(places[rows] - places[seed], axis=1), kind="stable")]:
                    if row != seed and mount.centre(places[[*group, row]], highest)[1] >= _LEAST:
                        group.append(int(row))
                groups.append(np.array(group))
        # Recognized people weigh more than targets that no vehicle has seen yet, and large crowds more than small ones.
        weights = prediction.probability * np.maximum(prediction.radius_m, 0.5)
        members = [set(prediction.target[group].tolist()) for group in groups]
        held = max(len(self._group & group) for group in members)
        values = [
            weights[group].sum() * (1.5 if held and len(self._group & names) == held else 1.0)
            for group, names in zip(groups, members, strict=True)
        ]
        best = int(np.argmax(values))
        self._group = members[best]
        return groups[best]

    def _aim(
        self, points: np.ndarray, team_m: np.ndarray, altitude: float, mount: CameraMount
    ) -> tuple[np.ndarray, float, str]:
        """Return the position to look at and the altitude that show targets and landmarks, and the reason in words."""
        needed, highest, height = min(NEEDED, len(team_m)), self.highest_m(mount), altitude
        while True:
            place = _between(points, team_m, needed, height, mount, _LEAST if height == altitude else _AIMED)
            if place is not None and height > altitude:
                return place, height, f"they and {needed} landmarks do not fit from {altitude:.0f} m"
            if place is not None:
                lower = max(height / _STEP, self.home_m)
                can = lower < 0.99 * height and self.altitude_m is not None
                if can and _between(points, team_m, needed, lower, mount, _EASY) is not None:
                    return place, lower, "they also fit well from a lower altitude"
                return place, height, f"in the picture with {needed} landmarks" if needed else "in the picture"
            if height >= highest - 1e-6:
                break
            height = min(height * _STEP, highest)
        place = _between(points, team_m, needed, altitude, mount, -np.inf)
        if place is not None:
            return place, altitude, f"waiting for {needed} landmarks"
        return mount.centre(points, altitude)[0], altitude, f"no place shows {needed} landmarks"

    def _climb(self, height: float, altitude: float, mount: CameraMount, why: str) -> None:
        if height == altitude or (height < altitude and self._now_s - self._moved_s < _SETTLED_S):
            return
        self.altitude_m, self._moved_s = height, self._now_s
        self._log.set("uav.altitude_m", round(height, 1), why, old=round(mount.altitude_m, 1))

    def _look(self, goal: np.ndarray, half: float, speed: float, lapse_s: float, why: str) -> None:
        """Move the view towards the goal if the goal is further away than the leash."""
        assert self.look_at is not None
        before, apart = self.look_at, goal - self.look_at
        distance = float(np.linalg.norm(apart))
        way = np.zeros(2) if distance <= _LEASH * half else goal - apart / distance * (_LEASH * half) - before
        pace = max(half / _CROSSING_S, _FASTER * speed) * lapse_s
        self.look_at = before + way * min(1.0, pace / max(float(np.linalg.norm(way)), 1e-9))
        for axis, name in enumerate(("east", "north")):
            value, old = round(float(self.look_at[axis]), 1), round(float(before[axis]), 1)
            self._log.set(f"uav.look_{name}_m", value, why, old=old, least=_NOTED * half)

    def _search(
        self, prediction: Prediction, team_m: np.ndarray, altitude: float, mount: CameraMount, lapse_s: float
    ) -> None:
        """Without targets, wait over the last target, then climb to see more, and at last return to the team."""
        gone_s = np.inf if self._found_s is None else self._now_s - self._found_s
        if self._group & set(prediction.target.tolist()):
            why = f"target {min(self._group)} is still there, but is not human"
        elif gone_s > _GIVEN_UP_S:
            why = f"no target for {_GIVEN_UP_S:.0f} s"
        else:
            highest = self.highest_m(mount)
            if gone_s > _WIDEN_S and self._now_s - self._moved_s > _WIDEN_S and altitude < highest - 1e-6:
                self._climb(min(altitude * _STEP**2, highest), altitude, mount, f"no target for {gone_s:.0f} s")
            return
        self._found_s = None
        assert self._home_at is not None
        rest = mount.centre(team_m, self.home_m)[0] if len(team_m) >= NEEDED else self._home_at
        self._climb(self.home_m, altitude, mount, why)
        self._look(rest, mount.half_m(altitude), 0.0, lapse_s, why)


def _between(
    points: np.ndarray, team_m: np.ndarray, needed: int, altitude: float, mount: CameraMount, margin: float
) -> np.ndarray | None:
    """Return the position nearest the targets' centre that shows them and `needed` landmarks, or None.

    margin: smallest margin of the targets inside the picture.
    """
    middle, within = mount.centre(points, altitude)
    if within < margin:
        return None
    if not needed:
        return middle
    nearest = np.argsort(np.linalg.norm(team_m - middle, axis=1), kind="stable")[:needed]
    landmarks, _ = mount.centre(team_m[nearest], altitude)
    for share in np.linspace(0, 1, 11):
        place = middle + share * (landmarks - middle)
        shown = int((mount.inside(team_m, place, altitude) >= _LANDMARK).sum())
        if shown >= needed and mount.inside(points, place, altitude).min() >= margin:
            return place
    return None
