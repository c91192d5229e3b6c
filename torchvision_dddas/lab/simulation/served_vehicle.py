"""The simulated UAV as a MAVLink system: it reports its state, and obeys commands of other systems.

Source: the Heartbeat, Command and Gimbal v2 protocols of the MAVLink specification (common.xml).
"""

import math
import threading
import time
from collections import deque
from collections.abc import Container
from typing import Any

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.io.mavlink_link import MavlinkLink
from torchvision_dddas.lab.simulation.link_conditions import DelayedWriter, LinkDelay
from torchvision_dddas.types import CameraPose, Command, Flight

SYSTEM, COMPONENT = 1, 1
"""Numbers of the vehicle and of its autopilot, which is the manager of gimbal device 1 too."""

_GIMBAL = 1
REPOSITION, ROI, _PITCH_YAW, _CONFIGURE = 192, 195, 1000, 1001  # MAV_CMD
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3  # MAV_RESULT
# A quadrotor with an autopilot of no known firmware, armed and in guided mode, active; version 3 of the protocol.
_HEARTBEAT = (2, 0, 0x80 | 0x08, 0, 4, 3)
_YAW_LOCK, _HELD = 16, 4 | 8 | 16 | 64  # of a gimbal: held against the horizon and north; yaw counts from north
_STEEPEST_DEG, _FLATTEST_DEG = -89.9, -2.0  # the gimbal does not look at the sky
_ABOVE_SEA, _ABOVE_HOME = {0, 5}, {3, 6, 10, 11}  # heights, by MAV_FRAME
_UNKNOWN = 2**31 - 1  # of a place
_REPORT_S, BEAT_S = 0.099, 1.0
_MOST_WAITING = 100


class CommandInbox:
    """Keeps the commands to some systems until they arrive."""

    def __init__(self, link: MavlinkLink, delay: LinkDelay, systems: Container[int]) -> None:
        self._delay, self._systems, self._lock = delay, systems, threading.Lock()
        self._waiting: deque[tuple[float, Any]] = deque(maxlen=_MOST_WAITING)
        link.subscribe(self._take)

    def due(self, now_s: float) -> list[Any]:
        """Return and forget the commands that have arrived."""
        with self._lock:
            return [self._waiting.popleft()[1] for arrival_s, _ in tuple(self._waiting) if arrival_s <= now_s]

    def _take(self, utc_s: float, message: Any) -> None:
        """Keep a command. Called in the link's thread."""
        if message.get_type() in ("COMMAND_LONG", "COMMAND_INT") and message.target_system in self._systems:
            with self._lock:
                arrival_s = self._delay.arrival_s(time.monotonic())
                if not math.isnan(arrival_s):
                    self._waiting.append((arrival_s, message))


def command_place(message: Any) -> np.ndarray | None:
    """Return longitude and latitude of a COMMAND_INT or COMMAND_LONG; None if they are no place."""
    is_int = message.get_type() == "COMMAND_INT"
    lonlat = (message.y / 1e7, message.x / 1e7) if is_int else (message.param6, message.param5)
    is_place = abs(lonlat[0]) <= 180 and abs(lonlat[1]) <= 90 and any(lonlat)  # False for NaN
    return np.array(lonlat) if is_place else None


class ServedVehicle:
    """A UAV on a MAVLink connection. Call `step` for each frame of the world.

    It sends GIMBAL_MANAGER_STATUS after a station has configured the gimbal, and only the holder turns the gimbal.
    """

    def __init__(self, link: MavlinkLink, reports: DelayedWriter, commands: LinkDelay) -> None:
        """reports: sends messages. commands: decides when commands arrive."""
        self._link, self._reports, self._inbox = link, reports, CommandInbox(link, commands, (0, SYSTEM))
        self._clock_s = commands.conditions.clock
        self._begin_s, self._reported_s, self._beat_s = time.monotonic(), -math.inf, -math.inf
        self._home_sea_m = math.nan
        self._before = -math.inf, (math.nan, math.nan)  # time and place of the last report
        self._held: tuple[float, float] | None = None  # pitch upwards and yaw of the gimbal, degrees
        self._holder: tuple[int, int] | None = None  # system and component in control of the gimbal

    def step(
        self, pose: CameraPose, up_m: float, origin_deg: tuple[float, float], flight: Flight | None
    ) -> Command | None:
        """Send reports that are due, and return the commands that arrived, for the next step of the world.

        pose: the camera's true pose. up_m: its height above the ground. flight: the report; None: no report is sent.
        """
        now_s = time.monotonic()
        if math.isnan(self._home_sea_m) and flight is not None:
            self._home_sea_m = flight.above_sea_m - flight.altitude_m
        if now_s >= self._beat_s + BEAT_S:
            self._beat_s = now_s
            self._say("heartbeat", *_HEARTBEAT)
            if self._holder is not None:
                self._say("gimbal_manager_status", self._boot_ms(now_s), _HELD, _GIMBAL, *self._holder, 0, 0)
        if flight is not None and now_s >= self._reported_s + _REPORT_S:
            self._reported_s = now_s
            self._report(flight, now_s)
        steering: dict[str, Any] = {}
        for message in self._inbox.due(now_s):
            result = self._obey(message, steering, math.degrees(pose.angles_rad[0]))
            sender = message.get_srcSystem(), message.get_srcComponent()
            self._say("command_ack", message.command, result, 0, 0, *sender)
        if self._held is not None:
            pitch_rad, yaw_rad = np.radians(self._held)
            place_m = pose.place_m[:2] + up_m / math.tan(-pitch_rad) * np.array([math.sin(yaw_rad), math.cos(yaw_rad)])
            steering["look_at"] = geometry.lonlat(place_m[None], origin_deg)[0]
        return Command(**steering) if steering else None

    def _obey(self, message: Any, steering: dict[str, Any], heading_deg: float) -> int:
        """Add what a command says to the steering. Return the MAV_RESULT."""
        number, is_int = message.command, message.get_type() == "COMMAND_INT"
        sender = message.get_srcSystem(), message.get_srcComponent()
        if number in (REPOSITION, ROI):
            lonlat = command_place(message)
            height_m, frame = (message.z, message.frame) if is_int else (message.param7, 0)
            if lonlat is None or frame not in _ABOVE_SEA | _ABOVE_HOME:
                return DENIED
            if number == ROI:
                self._held, steering["look_at"] = None, lonlat
                return ACCEPTED
            height_m -= self._home_sea_m if frame in _ABOVE_SEA else 0.0
            steering |= {"fly_to": lonlat, "altitude_m": height_m if math.isfinite(height_m) else None}
            return ACCEPTED
        if number == _CONFIGURE:
            # -1 keeps the holder, -2 makes the sender the holder, -3 gives the gimbal up if the sender holds it.
            wanted, holder = (int(message.param1), int(message.param2)), self._holder or (0, 0)
            given_up = (0, 0) if holder == sender else holder
            self._holder = {-1: holder, -2: sender, -3: given_up}.get(wanted[0], wanted)
            return ACCEPTED
        if number != _PITCH_YAW:
            return UNSUPPORTED
        pitch_deg, yaw_deg = message.param1, message.param2  # NaN keeps the angle
        flags = message.x if is_int else int(message.param5)
        yaw_deg += 0.0 if flags & _YAW_LOCK else heading_deg
        held = self._held or (math.nan, heading_deg)
        angles = held[0] if math.isnan(pitch_deg) else pitch_deg, held[1] if math.isnan(yaw_deg) else yaw_deg
        if sender != self._holder or not -90 <= angles[0] <= _FLATTEST_DEG:
            return DENIED
        self._held = max(angles[0], _STEEPEST_DEG), angles[1]
        return ACCEPTED

    def _report(self, flight: Flight, now_s: float) -> None:
        boot_ms, clock_s = self._boot_ms(now_s), time.time() + self._clock_s
        self._say("system_time", round(1e6 * clock_s), boot_ms)
        heading_rad = flight.heading_rad if math.isnan(flight.vehicle_heading_rad) else flight.vehicle_heading_rad
        longitude, latitude = flight.place
        if math.isfinite(longitude + latitude + flight.above_sea_m):
            before_s, before_deg = self._before
            self._before = now_s, flight.place
            speed_m_s = np.nan_to_num(geometry.east_north(np.array([flight.place]), before_deg)[0] / (now_s - before_s))
            east, north = np.clip(np.round(100 * speed_m_s), -32767, 32767).astype(int).tolist()
            heights = round(1e3 * flight.above_sea_m), round(1e3 * (flight.above_sea_m - self._home_sea_m))
            place = round(1e7 * latitude), round(1e7 * longitude), *heights
            course = round(100 * math.degrees(heading_rad)) % 36000 if math.isfinite(heading_rad) else 65535
            self._say("global_position_int", boot_ms, *place, north, east, 0, course)
        if math.isfinite(heading_rad + flight.heading_rad):
            self._say("attitude", boot_ms, 0.0, 0.0, math.remainder(heading_rad, 2 * math.pi), 0.0, 0.0, 0.0)
            turned = _quaternion(flight.heading_rad, -flight.pitch_rad, flight.roll_rad)
            still = 0.0, 0.0, 0.0, 0, 0.0, 0.0
            self._say("gimbal_device_attitude_status", 0, 0, boot_ms, _HELD, turned, *still, _GIMBAL)
        hfov_deg, unknown = math.degrees(flight.hfov_rad), [math.nan] * 4
        self._say("camera_fov_status", boot_ms, *[_UNKNOWN] * 6, unknown, hfov_deg, math.nan)

    def _boot_ms(self, now_s: float) -> int:
        return round(1e3 * (now_s - self._begin_s)) & 0xFFFFFFFF

    def _say(self, name: str, *fields: Any) -> None:
        self._reports.send(getattr(self._link.dialect, f"MAVLink_{name}_message")(*fields))


def _quaternion(yaw_rad: float, pitch_rad: float, roll_rad: float) -> list[float]:
    """Return w, x, y, z of a body that is yawed, then pitched upwards, then rolled, against north, east, down."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a / 2), math.sin(a / 2)) for a in (yaw_rad, pitch_rad, roll_rad))
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    return [w, x, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy]
