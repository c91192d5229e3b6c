"""Where the aerial vehicle should look and fly: the crowds stay in its picture, and landmarks enough to locate them."""

import numpy as np

from torchvision_dddas.settings import Settings
from torchvision_dddas.steering.footprint import Stand
from torchvision_dddas.steering.outlook import Outlook
from torchvision_dddas.steering.record import Record

# How far within the picture what is followed should be, as a share of its half: at least; where the altitude changes;
# and so that it may come down again.
_LEAST, _AIMED, _EASY = 0.1, 0.2, 0.35
# The same of landmarks, which their receivers place.
_LANDMARK = 0.08
# Landmarks that a picture needs to lie on the ground.
NEEDED = 4
# The middle of the picture is drawn along by what is followed once that is further off than this share of its half.
_LEASH = 0.12
# One step of altitude, and the time between a step and the next one down.
_STEP, _SETTLED_S = 1.1, 5.0
# Without targets: it climbs after so long, and again, and goes back to its plan.
_WIDEN_S, _GIVEN_UP_S = 4.0, 30.0
# At the highest a body of the expected size measures so much.
_LEAST_PX = 6.0
# A change of the middle of the picture by this share of its half is a line in the record.
_NOTED = 0.5


class Follow:
    """Where the aerial vehicle was asked to look, and how high to be."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.look_at: np.ndarray | None = None
        self.altitude_m: float | None = None  # None: as it is
        self.home_m = 0.0  # its altitude at the start
        self._moved_s = -np.inf  # when the altitude was changed last
        self._found_s: float | None = None  # when there was something to follow
        self._group: set[int] = set()

    def step(self, outlook: Outlook, team_m: np.ndarray, stand: Stand | None, now_s: float, record: Record) -> None:
        """Move on what is asked, by the targets expected now and the places (V, 2) of the team's vehicles."""
        if stand is None:
            return
        self.home_m = self.home_m or stand.altitude_m
        altitude = self.altitude_m or stand.altitude_m
        rows = np.flatnonzero(outlook.wanted)
        if not len(rows):
            self._without(outlook, altitude, stand, now_s, record)
            return
        self._found_s = now_s
        rows = self._chosen(outlook, rows, stand)
        points = outlook.east_north_m[rows]
        wanted, height, why = self._aim(points, team_m, altitude, stand)
        what = f"{_count(len(rows), 'target')} expected about {_place(points.mean(axis=0))}"
        self._climb(height, altitude, stand, now_s, f"{what}: {why}", record)
        half = stand.half_m(self.altitude_m or altitude)
        start = self.look_at if self.look_at is not None else wanted
        self._look(leashed(start, wanted, _LEASH * half), half, f"{what}, {why}", record)

    def _chosen(self, outlook: Outlook, rows: np.ndarray, stand: Stand) -> np.ndarray:
        """All that is wanted, where it can be in one picture; else the group that weighs most, not lightly another."""
        highest = self.highest_m(stand)
        if stand.centre(outlook.east_north_m[rows], highest)[1] >= _LEAST:
            self._group = set(outlook.target[rows].tolist())
            return rows
        groups = [_grown(seed, rows, outlook, stand, highest) for seed in rows]
        # People that were recognized count more than what nobody has seen yet; large crowds more than small ones.
        weights = outlook.probability * np.maximum(outlook.radius_m, 0.5)
        held = [len(self._group & set(outlook.target[group].tolist())) for group in groups]
        values = [
            weights[group].sum() * (1.5 if kept == max(held) > 0 else 1.0)
            for group, kept in zip(groups, held, strict=True)
        ]
        best = groups[int(np.argmax(values))]
        self._group = set(outlook.target[best].tolist())
        return best

    def _aim(
        self, points: np.ndarray, team_m: np.ndarray, altitude: float, stand: Stand
    ) -> tuple[np.ndarray, float, str]:
        """Where to look so that targets and four landmarks are in the picture; the altitude it takes; why."""
        needed = min(NEEDED, len(team_m))
        for height in self._ladder(altitude, stand):
            margin = _LEAST if height == altitude else _AIMED
            found = _between(points, team_m, needed, height, stand, margin)
            if found is not None:
                lower = max(height / _STEP, self.home_m)
                easy = height == altitude > self.home_m and _between(points, team_m, needed, lower, stand, _EASY)
                if easy:
                    return found, lower, "all fit into the picture from lower, too"
                return found, height, "all are in the picture" if height == altitude else "they do not fit otherwise"
        middle = stand.centre(points, altitude)[0]
        found = _between(points, team_m, needed, altitude, stand, -np.inf)
        if found is None:
            return middle, altitude, f"no place shows {needed} landmarks"
        return found, altitude, f"waiting for {needed} landmarks"

    def highest_m(self, stand: Stand) -> float:
        """How high it may go: by the settings, twice the altitude at the start, and while bodies measure enough."""
        limit = self.settings.steering.maximum_altitude_m or 2 * self.home_m
        size_m = self.settings.gates.expected_size_m
        return float(max(self.home_m, min(limit, size_m * float(np.mean(stand.camera.focal_px)) / _LEAST_PX)))

    def _ladder(self, altitude: float, stand: Stand) -> list[float]:
        highest, steps = self.highest_m(stand), [altitude]
        while steps[-1] < highest - 1e-6:
            steps.append(min(steps[-1] * _STEP, highest))
        return steps

    def _climb(self, height: float, altitude: float, stand: Stand, now_s: float, why: str, record: Record) -> None:
        if height == altitude or (height < altitude and now_s - self._moved_s < _SETTLED_S):
            return
        self.altitude_m, self._moved_s = height, now_s
        record.set("uav.altitude_m", round(height, 1), why, old=round(stand.altitude_m, 1))

    def _look(self, place: np.ndarray, half: float, why: str, record: Record) -> None:
        self.look_at = place
        for axis, name in enumerate(("east", "north")):
            record.set(f"uav.look_{name}_m", round(float(place[axis]), 1), why, least=_NOTED * half)

    def _without(self, outlook: Outlook, altitude: float, stand: Stand, now_s: float, record: Record) -> None:
        """Nothing to follow: wait where it was last, see more from higher, and at last give up."""
        if self._found_s is None:
            return
        gone_s = now_s - self._found_s
        if gone_s > _GIVEN_UP_S or len(outlook):  # what there is was found not to be human
            self._found_s = self.look_at = None
            return
        highest = self.highest_m(stand)
        if gone_s > _WIDEN_S and now_s - self._moved_s > _WIDEN_S and altitude < highest - 1e-6:
            self._climb(
                min(altitude * _STEP**2, highest), altitude, stand, now_s, f"no target for {gone_s:.0f} s", record
            )


def leashed(place: np.ndarray, to: np.ndarray, length: float) -> np.ndarray:
    """A place that is drawn along by another once that is further off than the length of the leash."""
    apart = to - place
    distance = float(np.linalg.norm(apart))
    return place if distance <= length else to - apart / distance * length


def _between(
    points: np.ndarray, team_m: np.ndarray, needed: int, altitude: float, stand: Stand, margin: float
) -> np.ndarray | None:
    """The place nearest the targets' middle that shows them, and so many landmarks; None where there is none."""
    middle, within = stand.centre(points, altitude)
    if within < margin:
        return None
    if not needed:
        return middle
    nearest = np.argsort(np.linalg.norm(team_m - middle, axis=1), kind="stable")[:needed]
    landmarks, _ = stand.centre(team_m[nearest], altitude)
    for share in np.linspace(0, 1, 11):
        place = middle + share * (landmarks - middle)
        seen = int((stand.inside(team_m, place, altitude) >= _LANDMARK).sum())
        if seen >= needed and stand.inside(points, place, altitude).min() >= margin:
            return place
    return None


def _grown(seed: int, rows: np.ndarray, outlook: Outlook, stand: Stand, altitude: float) -> np.ndarray:
    """A target and those nearest to it, as long as all are in one picture."""
    places = outlook.east_north_m
    group = [seed]
    for row in rows[np.argsort(np.linalg.norm(places[rows] - places[seed], axis=1), kind="stable")]:
        if row != seed and stand.centre(places[[*group, row]], altitude)[1] >= _LEAST:
            group.append(int(row))
    return np.array(group)


def _count(n: int, what: str) -> str:
    return f"{n} {what}" + ("" if n == 1 else "s")


def _place(place: np.ndarray) -> str:
    return f"({place[0]:.0f}, {place[1]:.0f}) m"
