"""The safety rules of commanding a vehicle, as pure logic: times and reports come in, verdicts go out.

No rule depends on a link, a thread or a clock, so that a property-based test can try any sequence of inputs. The page
docs/commanding.md states the same rules in words.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.zone_files import read_zones

Kind = Literal["reposition", "roi", "gimbal", "claim"]
"""Fly to a place; look at a place; turn the gimbal; take control of a gimbal that nobody controls."""

NUMBERS: dict[Kind, int] = {"reposition": 192, "roi": 195, "gimbal": 1000, "claim": 1001}
"""MAV_CMD of each kind. No other command is ever sent, so that nothing arms motors or changes the mode."""

DRY_RUN = "dry run"
TOO_SOON, UNANSWERED = "too soon after the last command", "the last command is not acknowledged yet"

EVERY_S: dict[Kind, float] = {"reposition": 1.0, "roi": 0.5, "gimbal": 0.5, "claim": 5.0}
"""Shortest time between two commands of a kind."""
LINK_S, POSITION_S, DECISION_S, ACK_S = 3.0, 2.0, 3.0, 1.5
"""Longest age of a heartbeat, of a position and of a decision, and longest wait for an acknowledgement."""
APART_M = 200.0
"""Longest distance of the camera's place, as the pictures are located, from the place that the vehicle reports."""
MOST_MISSES = 3
"""Successive commands without acknowledgement that end commanding, and refusals that end a kind of command."""

_ACCEPTED, _NEVER = {0, 5}, {3, 7, 8}  # MAV_RESULT: accepted or in progress; unsupported in this form
_RADIUS_M = (1.0, 100_000.0)
_HEIGHT_M = (-500.0, 10_000.0)


class Fence:
    """Places where the vehicle may fly: the inside of a circle, or of any of several polygons."""

    def __init__(self, outlines_deg: Sequence[Sequence[np.ndarray]] = (), circle: Sequence[float] = ()) -> None:
        """outlines_deg: rings (N, 2) of each polygon, longitude and latitude. circle: longitude, latitude, metres."""
        self._radius_m = circle[2] if circle else math.nan
        self._origin = (circle[0], circle[1]) if circle else tuple(np.asarray(outlines_deg[0][0])[0].tolist())
        self._polygons = [
            geometry.edges_of([geometry.east_north(np.asarray(ring, float), self._origin) for ring in rings], True)
            for rings in outlines_deg
        ]

    def holds(self, from_deg: tuple[float, float], to_deg: tuple[float, float]) -> bool:
        """Return whether the straight way from a place to another lies inside."""
        ends = geometry.east_north(np.array([from_deg, to_deg], float), self._origin)
        if math.isfinite(self._radius_m):
            return bool((np.linalg.norm(ends, axis=1) <= self._radius_m).all())
        return any(
            bool(geometry.is_inside(ends, edges).all()) and math.isnan(geometry.crossings(ends[0], ends[1], edges)[1])
            for edges in self._polygons
        )


@dataclass(frozen=True)
class Limits:
    """The operator's limits. allow: commands may leave. altitude_m: lowest and highest above home.

    No command leaves without a fence and a band. system: number of the vehicle; 0: the only one that is heard.
    """

    allow: bool = False
    fence: Fence | None = None
    altitude_m: tuple[float, float] | None = None
    system: int = 0


@dataclass(frozen=True)
class Proposal:
    """A command that the program would like to send.

    lonlat_deg: the place to fly to or to look at. decided_s: time of the picture. altitude_m: above home, to fly to.
    camera_deg: the place of the camera, NaN if unknown; None if the vehicle's camera gave no picture.
    """

    kind: Kind
    lonlat_deg: tuple[float, float]
    decided_s: float
    altitude_m: float = math.nan
    camera_deg: tuple[float, float] | None = None


class CommandSafety:
    """Decides about each command. All times are of one steady clock.

    ended: why commanding ended; "" while it goes on. It never becomes "" again. system: the vehicle's number, 0 if
    unknown. place_deg, altitude_m: the latest report of the vehicle; altitude above home.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits, self.system, self.ended = limits, limits.system, ""
        self.place_deg, self.altitude_m = (math.nan, math.nan), math.nan
        self._identity: tuple[int, int] | None = None  # MAV_TYPE and MAV_AUTOPILOT
        self._mode: int | None = None  # the mode in which the vehicle was handed over
        self._stations = set[int]()
        self._other, self._heard_s, self._placed_s, self._time_ms = 0, -math.inf, -math.inf, -1
        self._quickest_s = math.inf  # of all reports, the smallest difference of the rules' clock and the vehicle's
        self._waiting: dict[Kind, float] = {}
        self._last_s: dict[Kind, float] = {}
        self._misses, self._refusals, self._blocked = 0, Counter[Kind](), set[Kind]()

    def end(self, reason: str) -> None:
        """End commanding for good. The first reason is kept."""
        self.ended = self.ended or reason

    def hear_vehicle(
        self, now_s: float, system: int, identity: tuple[int, int], mode: int, is_guided: bool, is_armed: bool
    ) -> None:
        """Take the heartbeat of an autopilot. is_guided: it follows commands of computers in this mode."""
        self.check(now_s)
        if not self.limits.system and self.system not in (0, system):
            self.end(f"two vehicles, {self.system} and {system}, are heard; give ?system=N")
        self.system = self.system or system
        if system != self.system:
            self._other = system
            return
        if self._identity not in (None, identity):
            self.end(f"another vehicle reports as system {system}")
        self._identity, self._heard_s = identity, now_s
        if self._mode is None:
            self._mode = mode if is_guided and is_armed else None
        elif mode != self._mode or not is_guided:
            self.end(f"the pilot changed the mode from {self._mode} to {mode}")
        elif not is_armed:
            self.end("the vehicle was disarmed")

    def hear_position(
        self, now_s: float, system: int, time_ms: int, place_deg: tuple[float, float], altitude_m: float
    ) -> bool:
        """Take a position. Return whether it is news: a repeated report with the same time is not.

        time_ms: the vehicle's clock. A clock that runs back belongs to another vehicle, or to one that restarted. A
        report that took POSITION_S longer than the quickest report is no news either: the link is filling up.
        """
        self.check(now_s)
        is_known = all(map(math.isfinite, (*place_deg, altitude_m))) and any(place_deg) and abs(place_deg[1]) <= 90
        if system != self.system or not system or not is_known or time_ms == self._time_ms:
            return False
        late_s = now_s - time_ms / 1000
        if time_ms < self._time_ms - 1000 * POSITION_S:
            self._quickest_s = late_s
            if self._mode is not None:
                self.end(f"the clock of system {system} runs back: two vehicles have this number, or it restarted")
        self._quickest_s = min(self._quickest_s, late_s)
        if late_s > self._quickest_s + POSITION_S:
            return False
        self.place_deg, self.altitude_m, self._placed_s, self._time_ms = place_deg, altitude_m, now_s, time_ms
        return True

    def hear_station(self, now_s: float, system: int, steers: bool) -> None:
        """Take a command that another system sent. steers: it moves the vehicle or its gimbal, or sets the mode."""
        self.check(now_s)
        self._stations.add(system)
        if len(self._stations) > 1:
            self.end(f"several stations command: {', '.join(map(str, sorted(self._stations)))}")
        if steers and self._mode is not None:
            self.end(f"system {system} steers the vehicle")

    def hear_answer(self, now_s: float, number: int, result: int) -> str:
        """Take the acknowledgement of a MAV_CMD by the vehicle. Return a refusal in words; "" for none."""
        self.check(now_s)
        kind = next((kind for kind in self._waiting if NUMBERS[kind] == number), None)
        if kind is None:
            return ""
        del self._waiting[kind]
        self._misses = 0
        if result in _ACCEPTED:
            self._refusals[kind] = 0
            return ""
        self._refusals[kind] += 1
        if result in _NEVER or self._refusals[kind] >= MOST_MISSES:
            self._blocked.add(kind)
        return f"the vehicle refuses {kind}, MAV_RESULT {result}" + "; not sent again" * (kind in self._blocked)

    def check(self, now_s: float) -> None:
        """End commanding if the vehicle was handed over and is silent, or does not answer."""
        if self._mode is not None:
            if now_s - self._heard_s > LINK_S:
                self.end(f"the link is lost: no heartbeat of system {self.system} for {LINK_S:g} s")
            if -math.inf < self._placed_s < now_s - POSITION_S:
                self.end(f"the position of system {self.system} is older than {POSITION_S:g} s")
        for kind in [kind for kind, sent_s in self._waiting.items() if now_s - sent_s > ACK_S]:
            del self._waiting[kind]
            self._misses += 1
            if self._misses >= MOST_MISSES:
                self.end(f"the vehicle did not acknowledge {MOST_MISSES} commands within {ACK_S:g} s each")

    def permit(self, proposal: Proposal, now_s: float) -> str:
        """Return "" if the command may leave now: the caller then sends it once. Otherwise return the reason.

        DRY_RUN is the reason if all rules but `allow` are met.
        """
        self.check(now_s)
        kind, fence, band = proposal.kind, self.limits.fence, self.limits.altitude_m
        if kind not in NUMBERS or kind in self._blocked:
            return self.ended or f"the vehicle does not take {kind}"
        if reason := self.ended or self.waiting_for():
            return reason
        if not -0.1 <= now_s - proposal.decided_s <= DECISION_S:
            return f"the decision is older than {DECISION_S:g} s"
        camera_deg = self.place_deg if proposal.camera_deg is None else proposal.camera_deg
        apart_m = float(geometry.great_circle_m(np.array([self.place_deg]), np.array(camera_deg))[0])
        if math.isnan(apart_m):
            return "the place of the camera is unknown"
        if apart_m > APART_M:
            self.end(f"the pictures are taken more than {APART_M:g} m away from system {self.system}")
            return self.ended
        if reason := self.outside():
            return reason
        if not all(map(math.isfinite, proposal.lonlat_deg)):
            return "the place is unknown"
        if kind == "reposition" and fence is not None and not fence.holds(self.place_deg, proposal.lonlat_deg):
            return "the way leads outside the geofence"
        if kind == "reposition" and band is not None and not band[0] <= proposal.altitude_m <= band[1]:
            return "the goal is outside the altitude band"
        if now_s - self._last_s.get(kind, -math.inf) < EVERY_S[kind]:
            return TOO_SOON
        if kind in self._waiting:
            return UNANSWERED
        self._last_s[kind] = now_s
        if not self.limits.allow:
            return DRY_RUN
        self._waiting[kind] = now_s
        return ""

    def waiting_for(self) -> str:
        """Return what is missing before the vehicle is handed over; "" once it was."""
        if not self.system or self._identity is None:
            return f"system {self.system} is not heard, but {self._other} is" if self._other else "no vehicle is heard"
        if self._mode is None:
            return "the vehicle is not armed in guided mode"
        return "" if self._placed_s > -math.inf else "the vehicle reports no position"

    def outside(self) -> str:
        """Return the limit that the vehicle itself does not keep now; "" for none. Only a dry run needs no limits."""
        fence, band = self.limits.fence, self.limits.altitude_m
        if self.limits.allow and (fence is None or band is None):
            return "no geofence or no altitude band is given"
        if fence is not None and not fence.holds(self.place_deg, self.place_deg):
            return "the vehicle is outside the geofence"
        if band is not None and not band[0] <= self.altitude_m <= band[1]:
            return "the vehicle is outside the altitude band"
        return ""


def read_fence(text: str) -> Fence:
    """Read a geofence: a GeoJSON or KML file with polygons in degrees, or LONGITUDE,LATITUDE,RADIUS_M.

    Raise InputError: neither of them, or no polygon in degrees.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) == 3:
        longitude, latitude, radius_m = numbers
        if not (abs(longitude) <= 180 and abs(latitude) <= 90 and _RADIUS_M[0] <= radius_m <= _RADIUS_M[1]):
            raise InputError(
                f"--geofence {text}: wanted longitude,latitude in degrees and a radius of "
                f"{_RADIUS_M[0]:g} to {_RADIUS_M[1]:g} m"
            )
        return Fence(circle=numbers)
    zones, _ = read_zones(text)
    areas = [zone for zone in zones if not zone.is_line]
    if not areas or any(zone.unit != "deg" for zone in areas):
        raise InputError(f"--geofence {text}: wanted polygons in longitude and latitude; got none, or other units")
    return Fence([zone.rings for zone in areas])


def parse_band(text: str) -> tuple[float, float]:
    """Parse LOWEST,HIGHEST in metres above home. Raise InputError otherwise."""
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low = high = math.nan
    if not _HEIGHT_M[0] <= low < high <= _HEIGHT_M[1]:
        raise InputError(f"--altitude-band {text}: wanted LOWEST,HIGHEST in metres above home, such as 30,120")
    return low, high
