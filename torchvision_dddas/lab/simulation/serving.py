"""Serve a simulated world as real devices: the UAV's camera as a stream, and the UAV as a MAVLink system."""

import math
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.mavlink_link import PREFIX, MavlinkLink, open_mavlink
from torchvision_dddas.io.telemetry import encode_flight
from torchvision_dddas.lab.simulation.instrument_faults import Instruments, parse_fault
from torchvision_dddas.lab.simulation.link_conditions import DelayedWriter, LinkConditions, LinkDelay, parse_link
from torchvision_dddas.lab.simulation.scenario import Scenario
from torchvision_dddas.lab.simulation.served_camera import CameraStream, StreamSender
from torchvision_dddas.lab.simulation.served_team import ServedTeam
from torchvision_dddas.lab.simulation.served_vehicle import COMPONENT, SYSTEM, ServedVehicle
from torchvision_dddas.lab.simulation.simulator import Shot, Simulator

_SPEEDS = 0.01, 100.0
_LATE_S = 0.5  # a delay of the world up to this time is not noted


@dataclass(frozen=True)
class ServeOptions:
    """The options of a served world, as given. pictures: URL of the camera. vehicle: MAVLink link of all vehicles."""

    pictures: str | None = None
    vehicle: str | None = None
    speed: float = 1.0
    link: str | None = None
    faults: Sequence[str] = ()


class SimulatorServer:
    """The devices of a simulated world, and its clock. Call `show` for each frame, and leave the context at the end.

    late_s: time by which the world fell behind its clock, because drawing takes longer than a frame lasts.
    """

    def __init__(self, options: ServeOptions, scenario: Scenario, names: tuple[str, ...] = ()) -> None:
        """Open the devices. names: of the ground vehicles.

        Raise InputError for bad options, and for addresses that cannot be opened.
        """
        if not _SPEEDS[0] <= options.speed <= _SPEEDS[1]:
            raise InputError(f"--speed must be between {_SPEEDS[0]:g} and {_SPEEDS[1]:g}, got {options.speed:g}")
        conditions = LinkConditions() if options.link is None else parse_link(options.link)
        self._instruments = Instruments([parse_fault(fault) for fault in options.faults])
        self._clock_s, self._origin, self._speed = conditions.clock, scenario.world.origin_deg, options.speed
        self._period_s = 1 / (scenario.clip.rate_hz * options.speed)
        self._due_s, self.late_s = -math.inf, 0.0
        self._stream: CameraStream | None = None
        self._vehicle: ServedVehicle | None = None
        self._team: ServedTeam | None = None
        self.notes: list[str] = []
        delays = [LinkDelay(conditions, scenario.seed, stream) for stream in range(5)]
        with ExitStack() as opening:
            if options.pictures is not None:
                sender = StreamSender(options.pictures)
                opening.callback(sender.close)
                if not sender.is_udp and (conditions.loss or conditions.dropout[0]):
                    raise InputError("--link: TCP loses nothing; for loss and dropout give --serve udp://HOST:PORT")
                writer = opening.enter_context(DelayedWriter(sender.send, delays[0]))
                size_px = scenario.camera.width_px, scenario.camera.height_px
                self._stream = CameraStream(size_px, 1 / self._period_s, writer.send)
                opening.callback(self._stream.close)
            if options.vehicle is not None:
                address = PREFIX + options.vehicle.removeprefix(PREFIX)
                link = opening.enter_context(open_mavlink(address, self._note, "--serve-mavlink"))
                reports = opening.enter_context(DelayedWriter(partial(_send, link), delays[1]))
                self._vehicle = ServedVehicle(link, reports, delays[2])
                if names:
                    send = opening.enter_context(DelayedWriter(partial(_send_from, link), delays[3]))
                    self._team = ServedTeam(link, send, delays[4], names, scenario.team.patrol_m_s)
            self._open = opening.pop_all()

    def show(self, simulator: Simulator, shot: Shot) -> float:
        """Wait for the time of a frame, send its data, and steer the world. Return this time, seconds since 1970."""
        now_s = time.monotonic()
        time.sleep(max(0.0, self._due_s - now_s))
        # A late world goes on from where it is, and does not hurry.
        self.late_s += max(0.0, now_s - self._due_s) if math.isfinite(self._due_s) else 0.0
        self._due_s = max(self._due_s, now_s) + self._period_s
        shown_s, moment = time.time(), shot.moments[-1]
        image = None if shot.frame is None else shot.frame.image
        image, flight = self._instruments.show(moment.time_s, image, moment.flight)
        if flight is not None:  # observers measure speeds by their own clock
            flight = replace(flight, speed_m_s=self._speed * flight.speed_m_s)
        if self._stream is not None:
            self._stream.show(image, None if flight is None else encode_flight(flight, shown_s + self._clock_s))
        if self._vehicle is not None:
            place_m = moment.pose.place_m
            up_m = float(place_m[2] - simulator.world.up_m(place_m[None, :2])[0])
            command = self._vehicle.step(moment.pose, up_m, self._origin, flight)
            orders = None
            if self._team is not None:
                ground_sea_m = 0.0 if moment.flight is None else moment.flight.above_sea_m - moment.flight.altitude_m
                orders = self._team.step(moment, ground_sea_m)
            for one in (command, orders):
                if one is not None:
                    simulator.steer(one)
        return shown_s

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
        if self.late_s > _LATE_S:
            self._note("", f"the world fell {self.late_s:.1f} s behind its clock; give a lower --speed")

    def _note(self, _: str, words: str) -> None:
        self.notes.append(words)


def _send(link: MavlinkLink, message: Any) -> None:
    link.send(message, SYSTEM, COMPONENT)


def _send_from(link: MavlinkLink, item: tuple[int, Any]) -> None:
    link.send(item[1], item[0], COMPONENT)
