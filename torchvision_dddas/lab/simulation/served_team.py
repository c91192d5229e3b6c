"""The simulated ground vehicles as MAVLink systems: each reports its place, and obeys commands of other systems.

Source: the Heartbeat and Command protocols of the MAVLink specification (common.xml).
"""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np

from torchvision_dddas.io.mavlink_link import MavlinkLink
from torchvision_dddas.lab.simulation.agents import Moment
from torchvision_dddas.lab.simulation.link_conditions import DelayedWriter, LinkDelay
from torchvision_dddas.lab.simulation.served_vehicle import (
    ACCEPTED,
    BEAT_S,
    DENIED,
    REPOSITION,
    ROI,
    UNSUPPORTED,
    CommandInbox,
    command_place,
)
from torchvision_dddas.types import Command, Order

FIRST_SYSTEM = 11
"""MAVLink system of the first ground vehicle. The others have the next numbers."""

# A rover with an autopilot of no known firmware, armed and in guided mode, active; version 3 of the protocol.
_HEARTBEAT = (10, 0, 0x80 | 0x08, 0, 4, 3)


class ServedTeam:
    """Ground vehicles on a MAVLink connection. Call `step` for each frame of the world."""

    def __init__(
        self, link: MavlinkLink, reports: DelayedWriter, commands: LinkDelay, names: tuple[str, ...], speed_m_s: float
    ) -> None:
        """reports: sends pairs of a system and a message. speed_m_s: speed of commands that give none."""
        self._link, self._reports, self._names, self._speed_m_s = link, reports, names, speed_m_s
        self._inbox = CommandInbox(link, commands, range(FIRST_SYSTEM, FIRST_SYSTEM + len(names)))
        self._begin_s, self._beat_s = time.monotonic(), -math.inf
        self._orders = dict[int, Order]()  # by row

    def step(self, moment: Moment, ground_sea_m: float) -> Command | None:
        """Send reports that are due, and return the orders that arrived, for the next step of the world.

        ground_sea_m: height of the ground above the sea, for all vehicles.
        """
        now_s = time.monotonic()
        if now_s >= self._beat_s + BEAT_S:
            self._beat_s = now_s
            for row in range(len(self._names)):
                self._say(row, "heartbeat", *_HEARTBEAT)
        newest = {report.vehicle: report for report in moment.reports if not report.planned}
        boot_ms, height_mm = round(1e3 * (now_s - self._begin_s)) & 0xFFFFFFFF, round(1e3 * ground_sea_m)
        for row, report in newest.items():
            longitude, latitude = (round(1e7 * degrees) for degrees in report.lonlat_deg)
            heading_rad = float(moment.reported_heading_rad[row])
            course = round(100 * math.degrees(heading_rad)) % 36000 if math.isfinite(heading_rad) else 65535
            self._say(row, "global_position_int", boot_ms, latitude, longitude, height_mm, 0, 0, 0, 0, course)
        orders = []
        for message in self._inbox.due(now_s):
            row = message.target_system - FIRST_SYSTEM
            result = self._obey(message, row, moment.reported_lonlat_deg[row])
            sender = message.get_srcSystem(), message.get_srcComponent()
            self._say(row, "command_ack", message.command, result, 0, 0, *sender)
            orders += [self._orders[row]] if result == ACCEPTED else []
        return Command(orders=tuple({order.vehicle: order for order in orders}.values())) if orders else None

    def _obey(self, message: Any, row: int, here_deg: np.ndarray) -> int:
        """Change the vehicle's order by a command. Return the MAV_RESULT."""
        if message.command not in (REPOSITION, ROI):
            return UNSUPPORTED
        place = command_place(message)
        before = self._orders.get(row, Order(self._names[row], here_deg, self._speed_m_s))
        if place is None or not np.isfinite(before.goal).all():
            return DENIED
        if message.command == ROI:
            self._orders[row] = replace(before, look_at=place)
        else:
            speed_m_s = float(message.param1) if message.param1 > 0 else self._speed_m_s
            self._orders[row] = replace(before, goal=place, speed_m_s=speed_m_s)
        return ACCEPTED

    def _say(self, row: int, name: str, *fields: Any) -> None:
        message = getattr(self._link.dialect, f"MAVLink_{name}_message")(*fields)
        self._reports.send((FIRST_SYSTEM + row, message))
