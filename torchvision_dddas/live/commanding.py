"""Send the decisions of `control` to a vehicle over MAVLink, as far as the rules of `command_safety` permit them.

Every command passes `_transmit`. Without permission to send, it becomes an event: a dry run.
Source: the Command, Gimbal v2 and Camera protocols of the MAVLink specification (common.xml).
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.control import Steering
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import AerialLocator
from torchvision_dddas.io.mavlink_link import MavlinkLink, open_mavlink, take_systems
from torchvision_dddas.live.command_safety import (
    DRY_RUN,
    NUMBERS,
    TOO_SOON,
    UNANSWERED,
    CommandSafety,
    Kind,
    Limits,
    Proposal,
    parse_band,
    read_fence,
)
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.mavlink_component import MavlinkComponent, is_autopilot
from torchvision_dddas.live.runner import Feed
from torchvision_dddas.types import FrameResult

_TICK_S = 0.05
_TROUBLE_S = 30.0  # for which the end of commanding is a trouble
_NEAR = 1.0  # a command differs from the last one by at least this many metres or degrees
_FIRST_NAV, _LAST_NAV = 16, 95  # numbers of MAV_CMD_NAV_...
# Commands of others that steer: modes, speed, heading, altitude, home, places, views, missions, arming, the gimbal.
_STEERING = {115, 176, 177, 178, 179, 185, 186, 189, 191, 192, 193, 195, 196, 197, 201, 204, 205, 224, 252, 300, 400}
_STEERING |= {1000, 1001, 3000, 43000, 43001, 43002}
_STEERING_MESSAGES = (
    *("SET_MODE", "SET_POSITION_TARGET_GLOBAL_INT", "SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET"),
    *("GIMBAL_MANAGER_SET_PITCHYAW", "GIMBAL_MANAGER_SET_ATTITUDE", "GIMBAL_MANAGER_SET_MANUAL_CONTROL"),
    *("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"),
    # ArduPilot flies to the item of a mission in guided mode. The band counts from home.
    *("MISSION_COUNT", "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_SET_CURRENT", "SET_HOME_POSITION"),
)
_TRACKING = {2004, 2005, 2010}
# The mode in which the firmware follows commands of computers: ArduPilot's GUIDED, by MAV_TYPE; PX4's hold.
_ARDUPILOT, _PX4, _PX4_HOLD = 3, 12, 4 << 16 | 3 << 24
_GUIDED_WINGS_AND_ROVERS, _GUIDED = 15, 4
_WINGS_AND_ROVERS = {1, 10, 11, *range(19, 26)}
_GUIDED_FLAG, _ARMED_FLAG = 0x08, 0x80
_LOCKED = 4 | 8 | 16  # the gimbal's roll, pitch and yaw count from the horizon and from north


@dataclass(frozen=True)
class CommandOptions:
    """The options of a run that commands, as given.

    link: as `open_mavlink` takes it; ?system=N is the UAV's number, and ?NAME=N that of a ground vehicle.
    """

    link: str
    allow: bool = False
    fence: str | None = None
    band: str | None = None


@dataclass(frozen=True)
class _Decision:
    """A decision for a vehicle, places in degrees.

    up_m, camera_deg: height of the UAV above the ground plane, and place of its camera, at that time; NaN if unknown.
    camera_deg is None for a ground vehicle.
    """

    taken_s: float
    look_at: np.ndarray | None
    go_to: np.ndarray | None
    altitude_m: float | None = None
    up_m: float = math.nan
    speed_m_s: float = -1.0
    camera_deg: tuple[float, float] | None = None

    def propose(self, kind: Kind, place: tuple[float, float], altitude_m: float = math.nan) -> Proposal:
        """Return a command to a place as the safety rules judge it."""
        return Proposal(kind, place, self.taken_s, altitude_m, self.camera_deg)


class _CommandedVehicle:
    """A vehicle with its rules, its last reports, and the last commands. name: "" for the UAV."""

    def __init__(self, name: str, limits: Limits) -> None:
        self.name, self.safety = name, CommandSafety(limits)
        self.sea_m = math.nan  # height above the sea
        self.altitude: tuple[float | None, float] = math.nan, math.nan  # as decided, and above home
        self.gimbal: tuple[int, int, int] | None = None  # component of its manager; system and component in control
        self.sent: dict[Kind, np.ndarray] = {}
        self.settled, self.told, self.is_over = set[Kind](), "", False

    def put(self, words: str) -> str:
        """Return words about this vehicle."""
        return f"{self.name}: {words}" if self.name else words


class LiveCommands:
    """The MAVLink components of a run, and its commands. A thread of its own sends while the context is open."""

    def __init__(
        self,
        link: MavlinkLink,
        limits: Limits,
        settings: Settings,
        size_px: tuple[int, int],
        rate_hz: float,
        locator: AerialLocator | None,
        health: Health,
        ground: Mapping[str, int] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """locator: places the targets; None: nothing is decided. ground: systems of ground vehicles by name.

        Raise InputError if commands are allowed without a fence, a band or places in degrees, and for unknown vehicles.
        """
        names = () if locator is None else locator.site.landmarks.names
        ground = ground or {}
        numbers = [limits.system, *ground.values()]
        if ground and (not limits.system or len(set(numbers)) < len(numbers) or not set(ground) <= set(names)):
            raise InputError(
                f"--command names the vehicles {', '.join(ground)}; wanted ?system=N of the UAV, other numbers for "
                f"ground vehicles, and names among the landmarks: {', '.join(names) or 'none'}"
            )
        if limits.allow and (limits.fence is None or limits.altitude_m is None):
            raise InputError("--allow-commands needs limits: give --geofence and --altitude-band too")
        origin = None if locator is None else locator.site.origin_deg
        if limits.allow and origin is None:
            raise InputError("--allow-commands needs places in degrees: give --telemetry or --landmarks with them")
        self.component = MavlinkComponent(link, size_px, rate_hz, health.event, limits.system)
        self.component.is_geographic = origin is not None
        self.uav = _CommandedVehicle("", limits)
        # A ground vehicle follows the ground, so that the band is of no use for it.
        free = None if limits.altitude_m is None else (-math.inf, math.inf)
        self._vehicles = [
            self.uav,
            *(_CommandedVehicle(n, replace(limits, system=s, altitude_m=free)) for n, s in ground.items()),
        ]
        self._link, self._health, self._clock, self._origin = link, health, clock, origin
        self._steering: Steering | None = None
        if locator is not None and origin is not None:
            steered = with_parameters(settings, {"steering.sampling": False, "steering.look": bool(ground)})
            self._steering = Steering(steered, locator.camera, rate_hz, names)
        self._lock, self._closing = threading.Lock(), threading.Event()
        self._decisions, self._has_begun = dict[str, _Decision](), False
        self._thread = threading.Thread(target=self._run, name="commands", daemon=True)
        link.subscribe(self._hear)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()

    def update(self, result: FrameResult, feed: Feed) -> FrameResult:
        """Decide after a result, and return it with the command. Never wait for the link, and never raise."""
        try:
            return self._decide(result, feed)
        except Exception as error:
            self._fail(error)
            return result

    def _decide(self, result: FrameResult, feed: Feed) -> FrameResult:
        self.component.show(result, feed.size)
        if feed.ended:  # results of earlier pictures still come, but who stops a run wants no further command
            self._decisions = {}
            return result
        located, locator = result.locations, feed.locator
        if self._steering is None or located is None or locator is None or self._origin is None:
            return result
        if not self._has_begun:
            # Steering counts from the altitude of its first picture, which must not be that of the ground.
            with self._lock:
                if reason := self.uav.safety.waiting_for() or self.uav.safety.outside():
                    self._tell(self.uav, f"no command leaves: {reason}")
                    return result
            self._has_begun = True
        now, now_s = result.number, located.time_s
        if feed.newest is not None:
            now, now_s = feed.newest.number, feed.newest.time_s
        flight, marks = locator.telemetry_at(now_s), locator.landmarks_at(now)
        command, made = self._steering.update(located, result.confirmed, now_s, marks, flight, None, result.crowds)
        rows = np.flatnonzero(located.positions.target == self.component.chosen)
        if self.component.chosen and len(rows):  # a station's choice comes before the program's own
            place = located.positions.east_north_m[rows[0]]
            fly_to = command.fly_to
            if fly_to is not None and command.look_at is not None:
                fly_to = fly_to + (place - command.look_at)
            command = replace(command, look_at=place, fly_to=fly_to)
        orders = tuple(replace(o, goal=self._degrees(o.goal), look_at=self._degrees(o.look_at)) for o in command.orders)
        look_at, fly_to = self._degrees(command.look_at), self._degrees(command.fly_to)
        command = replace(command, look_at=look_at, fly_to=fly_to, orders=orders)
        frame = result.frame
        taken_s = math.nan if frame is None else frame.taken_s
        pose, up_m, camera_m = located.fix.pose, math.nan, np.full(2, np.nan)
        if flight is not None:
            up_m, camera_m = flight.altitude_m, np.array(flight.place)
        if pose is not None:
            up_m = up_m if math.isfinite(up_m) else float(pose.place_m[2])
            camera_m = camera_m if np.isfinite(camera_m).all() else pose.place_m[:2]
        camera_deg = _pair(self._degrees(camera_m))
        decisions = {"": _Decision(taken_s, look_at, fly_to, command.altitude_m, up_m, camera_deg=camera_deg)}
        for order in orders:
            speed_m_s = order.speed_m_s
            decisions[order.vehicle] = _Decision(taken_s, order.look_at, order.goal, None, 0.0, speed_m_s)
        if math.isfinite(taken_s):  # a decision for a missing picture has no age; the last one stays, and becomes old
            self._decisions = decisions
        located = replace(located, adjustments=(*located.adjustments, *made))
        return replace(result, locations=located, command=command)

    def tick(self) -> None:
        """Send what is due: messages of the components, and the newest decisions."""
        now_s = self._clock()
        self.component.tick(now_s)
        with self._lock:
            decisions, self._decisions = self._decisions, {}
            for vehicle in self._vehicles:
                vehicle.safety.check(now_s)
                self._tell_end(vehicle)
                decision = decisions.get(vehicle.name)
                if vehicle.safety.ended or decision is None or not self.component.has_begun:
                    continue
                if reason := vehicle.safety.waiting_for():  # of a ground vehicle
                    self._tell(vehicle, f"no command leaves: {reason}")
                    continue
                if decision.look_at is not None:
                    self._view(vehicle, decision, _pair(decision.look_at), now_s)
                if decision.go_to is not None:
                    self._go(vehicle, decision, _pair(decision.go_to), now_s)

    def _run(self) -> None:
        while not self._closing.wait(_TICK_S):
            try:
                self.tick()
            except Exception as error:
                self._fail(error)

    def _fail(self, error: Exception) -> None:
        """End commanding after an error of this program, because its state is not known."""
        with self._lock:
            for vehicle in self._vehicles:
                vehicle.safety.end(f"an error: {type(error).__name__}: {error}")
                self._tell_end(vehicle)

    def _degrees(self, place: Any) -> Any:
        assert self._origin is not None
        return None if place is None else geometry.lonlat(np.asarray(place, float)[None], self._origin)[0]

    def _view(self, vehicle: _CommandedVehicle, decision: _Decision, place: tuple[float, float], now_s: float) -> None:
        """Point the camera at a place: by the gimbal's manager if there is one, else by a region of interest."""
        dialect, safety = self._link.dialect, vehicle.safety
        us = self.component.system, self.component.component
        if vehicle.gimbal is None:
            ground_m = vehicle.sea_m - (decision.up_m if math.isfinite(decision.up_m) else safety.altitude_m)
            message = dialect.MAVLink_command_int_message(
                safety.system, 1, 0, NUMBERS["roi"], 0, 0, 0, 0, 0, 0, *_scaled(place), ground_m
            )
            proposal = decision.propose("roi", place)
            self._transmit(vehicle, proposal, message, self._metres(place), f"look at {_words(place)}", now_s)
            return
        manager, *in_control = vehicle.gimbal
        build, target = dialect.MAVLink_command_long_message, (safety.system, manager)
        if tuple(in_control) != us and in_control[0]:
            holder = f"system {in_control[0]}, component {in_control[1]}"
            self._tell(vehicle, f"the gimbal is left to {holder}, which controls it")
        elif tuple(in_control) != us and safety.limits.allow:
            claim = build(*target, NUMBERS["claim"], 0, *us, -1, -1, 0, 0, 0)
            proposal = decision.propose("claim", place)
            self._transmit(vehicle, proposal, claim, np.full(1, now_s), "take control of the gimbal", now_s)
        elif decision.up_m > 0:
            east, north = geometry.east_north(np.array([place]), safety.place_deg)[0]
            pitch_deg = -math.degrees(math.atan2(decision.up_m, math.hypot(east, north)))
            yaw_deg = math.degrees(math.atan2(east, north))
            turn = build(*target, NUMBERS["gimbal"], 0, pitch_deg, yaw_deg, math.nan, math.nan, _LOCKED, 0, 0)
            words = f"turn the gimbal to pitch {pitch_deg:.0f}, yaw {yaw_deg:.0f} degrees"
            proposal = decision.propose("gimbal", place)
            self._transmit(vehicle, proposal, turn, np.array([pitch_deg, yaw_deg]), words, now_s)

    def _go(self, vehicle: _CommandedVehicle, decision: _Decision, place: tuple[float, float], now_s: float) -> None:
        safety, band = vehicle.safety, vehicle.safety.limits.altitude_m
        is_begun = "reposition" in vehicle.sent and math.isfinite(vehicle.altitude[1])
        if decision.altitude_m != vehicle.altitude[0] or not is_begun:
            # Keep the altitude until another one is decided, because reported altitudes are noisy.
            rise_m = 0.0 if decision.altitude_m is None else decision.altitude_m - decision.up_m
            vehicle.altitude = decision.altitude_m, safety.altitude_m + rise_m
        above_home_m = vehicle.altitude[1] if band is None else float(np.clip(vehicle.altitude[1], *band))
        # PX4 takes all altitudes as above the sea. Without the flag to change the mode, the vehicle keeps its mode.
        sea_m = vehicle.sea_m + above_home_m - safety.altitude_m
        message = self._link.dialect.MAVLink_command_int_message(
            safety.system, 1, 0, NUMBERS["reposition"], 0, 0, decision.speed_m_s, 0, 0, math.nan, *_scaled(place), sea_m
        )
        goal = np.append(self._metres(place), 0.0 if vehicle.name else above_home_m)
        words = f"drive to {_words(place)} at {decision.speed_m_s:.1f} m/s"
        if not vehicle.name:
            words = f"fly to {_words(place)} at {above_home_m:.0f} m above home"
        proposal = decision.propose("reposition", place, above_home_m)
        self._transmit(vehicle, proposal, message, goal, words, now_s)

    def _metres(self, place: tuple[float, float]) -> np.ndarray:
        assert self._origin is not None
        return geometry.east_north(np.array([place]), self._origin)[0]

    def _transmit(
        self, vehicle: _CommandedVehicle, proposal: Proposal, message: Any, value: np.ndarray, words: str, now_s: float
    ) -> None:
        """Send a command that is permitted and new, or record it in a dry run. value: what makes it new, see _NEAR."""
        kind, before = proposal.kind, vehicle.sent.get(proposal.kind)
        is_settled = kind in vehicle.settled or not vehicle.safety.limits.allow
        if before is not None and is_settled and float(np.abs(value - before).max()) < _NEAR:
            return
        reason = vehicle.safety.permit(proposal, now_s)
        if reason in (TOO_SOON, UNANSWERED):
            return
        if reason and reason != DRY_RUN:
            self._tell(vehicle, f"no command leaves: {reason}")
            return
        vehicle.sent[kind], vehicle.told = value, ""
        vehicle.settled.discard(kind)
        if not reason:
            self._link.send(message, self.component.system, self.component.component)
            self._health.count("commands")
            self._health.took("command", now_s - proposal.decided_s)
            self._health.log("command", vehicle.put(words))
        else:
            self._health.event("command", vehicle.put(f"would {words}"))

    def _tell(self, vehicle: _CommandedVehicle, words: str) -> None:
        if words != vehicle.told:
            vehicle.told = words
            self._health.event("command", vehicle.put(words))

    def _tell_end(self, vehicle: _CommandedVehicle) -> None:
        if vehicle.safety.ended and not vehicle.is_over:
            vehicle.is_over = True
            words = vehicle.put(f"commanding has ended: {vehicle.safety.ended}")
            self._health.event("command", f"{words}; it begins again only with a new run")
            self._health.trouble(f"command {vehicle.name}", words, _TROUBLE_S)

    def _hear(self, utc_s: float, message: Any) -> None:
        try:
            with self._lock:
                for vehicle in self._vehicles:
                    self._take(vehicle, message, self._clock())
                    self._tell_end(vehicle)
        except Exception as error:
            self._fail(error)

    def _take(self, vehicle: _CommandedVehicle, message: Any, now_s: float) -> None:
        """Tell the safety rules of a vehicle what a message says."""
        kind, system, component = message.get_type(), message.get_srcSystem(), message.get_srcComponent()
        safety, us = vehicle.safety, (self.component.system, self.component.component)
        if is_autopilot(message):
            armed = bool(message.base_mode & _ARMED_FLAG)
            identity = message.type, message.autopilot
            safety.hear_vehicle(now_s, system, identity, message.custom_mode, is_guided(message), armed)
        elif kind == "GLOBAL_POSITION_INT" and component == 1:
            place_deg = message.lon / 1e7, message.lat / 1e7
            # Both heights must be of one report: their difference is the height of home.
            if safety.hear_position(now_s, system, message.time_boot_ms, place_deg, message.relative_alt / 1e3):
                vehicle.sea_m = message.alt / 1e3
        elif kind == "GIMBAL_MANAGER_STATUS" and system == safety.system:
            vehicle.gimbal = component, message.primary_control_sysid, message.primary_control_compid
        elif kind == "COMMAND_ACK" and system == safety.system:
            if (message.target_system, message.target_component) in (us, (0, 0)):
                if message.result in (0, 5):
                    vehicle.settled |= {one for one, number in NUMBERS.items() if number == message.command}
                if words := safety.hear_answer(now_s, message.command, message.result):
                    self._health.event("command", vehicle.put(words))
        elif (system, component) not in (us, (safety.system, 1)):
            number = message.command if kind in ("COMMAND_LONG", "COMMAND_INT") else -1
            steers = kind in _STEERING_MESSAGES or number in _STEERING or _FIRST_NAV <= number <= _LAST_NAV
            if (steers or number in _TRACKING) and message.target_system in (0, safety.system):
                safety.hear_station(now_s, system, steers)


@contextmanager
def open_commands(
    options: CommandOptions,
    settings: Settings,
    size_px: tuple[int, int],
    rate_hz: float,
    locator: AerialLocator | None,
    health: Health,
) -> Iterator[LiveCommands]:
    """Open the link, and run its components and commands. Raise InputError for bad options and a link that fails."""
    text, systems = take_systems(options.link, "--command")
    fence = None if options.fence is None else read_fence(options.fence)
    band = None if options.band is None else parse_band(options.band)
    limits = Limits(options.allow, fence, band, systems.pop("system", 0))
    with (
        open_mavlink(text, health.event, "--command") as link,
        LiveCommands(link, limits, settings, size_px, rate_hz, locator, health, systems) as commands,
    ):
        yield commands


def _pair(place: np.ndarray) -> tuple[float, float]:
    return float(place[0]), float(place[1])


def _scaled(place: tuple[float, float]) -> tuple[int, int]:
    """Return latitude and longitude in units of 1e-7 degrees."""
    return round(1e7 * place[1]), round(1e7 * place[0])


def _words(place: tuple[float, float]) -> str:
    return f"{place[1]:.6f}, {place[0]:.6f}"


def is_guided(heartbeat: Any) -> bool:
    """Return whether the vehicle of a heartbeat is in the mode in which it follows commands of computers."""
    if heartbeat.autopilot == _ARDUPILOT:
        guided = _GUIDED_WINGS_AND_ROVERS if heartbeat.type in _WINGS_AND_ROVERS else _GUIDED
        return bool(heartbeat.custom_mode == guided)
    if heartbeat.autopilot == _PX4:
        return bool(heartbeat.custom_mode == _PX4_HOLD)
    return bool(heartbeat.base_mode & _GUIDED_FLAG)
