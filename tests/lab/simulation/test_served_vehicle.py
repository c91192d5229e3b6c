"""The simulated UAV as a MAVLink system, in the words of the specification."""

import math
import struct
import time
from typing import Any, cast

import numpy as np
import pytest

from tests.live.mavlink_peers import Wire, command, dialect
from torchvision_dddas import geometry
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.lab.simulation.link_conditions import DelayedWriter, LinkConditions, LinkDelay
from torchvision_dddas.lab.simulation.served_vehicle import ServedVehicle
from torchvision_dddas.types import CameraPose, Flight

PERFECT = LinkConditions()
ORIGIN = -110.95, 31.6
GOAL = -110.949, 31.601
STATION = 255, 190
FLIGHT = Flight(50.0, 3.0, ORIGIN, 1350.0, 0.5, 0.9, 0.02, 0.8)
LOOKING_DOWN = CameraPose(np.array([10.0, 20.0, 40.0]), np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]))
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
REPOSITION, ROI, PITCH_YAW, CONFIGURE = 192, 195, 1000, 1001


class Flown:
    """A vehicle on a wire, and a station that commands it."""

    def __init__(self, conditions=PERFECT):
        self.wire = cast(Any, Wire())
        writer = DelayedWriter(lambda message: self.wire.send(message, 1, 1), LinkDelay(conditions, 0, 1))
        self.vehicle = ServedVehicle(self.wire, writer, LinkDelay(conditions, 0, 2))
        self.step()

    def step(self, flight=FLIGHT):
        return self.vehicle.step(LOOKING_DOWN, 40.0, ORIGIN, flight)

    def order(self, message, sender=STATION):
        """Return the result in the acknowledgement, and the command to the world."""
        self.wire.say(message, *sender)
        steered = self.step()
        (answer,) = self.wire.take("COMMAND_ACK")
        assert (answer.target_system, answer.target_component) == sender
        assert answer.command == message.command
        return answer.result, steered


def command_int(number, lonlat, height_m, frame=0, system=1):
    place = round(1e7 * lonlat[1]), round(1e7 * lonlat[0])
    return dialect.MAVLink_command_int_message(system, 1, frame, number, 0, 0, 0, 0, 0, math.nan, *place, height_m)


def long(number, *params):
    return command(number, *params, component=1)


def test_reports_are_those_of_the_flight(tmp_path):
    log = b""
    packer = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    flown = Flown()
    for k in range(3):
        flown.vehicle._reported_s = -math.inf
        flown.step()
        for message, *_ in flown.wire.sent:
            log += struct.pack(">Q", 1_767_225_600_000_000 + 100_000 * k) + bytes(message.pack(packer))
    path = tmp_path / "flight.tlog"
    path.write_bytes(log)
    read = read_telemetry(path)
    now = read.at(float(read.time_s[-1]))
    assert now is not None
    assert now.place == pytest.approx(ORIGIN, abs=1e-6)
    assert (now.altitude_m, now.above_sea_m) == pytest.approx((50.0, 1350.0), abs=0.01)
    found = now.heading_rad, now.pitch_rad, now.roll_rad, now.hfov_rad, now.vehicle_heading_rad
    assert found == pytest.approx((0.5, 0.9, 0.02, 0.8, 0.5), abs=1e-4)


def test_the_clock_of_the_vehicle_has_its_offset():
    flown = Flown(LinkConditions(clock=3600.0))
    (said,) = flown.wire.take("SYSTEM_TIME")
    assert said.time_unix_usec / 1e6 - time.time() == pytest.approx(3600, abs=60)


def test_unknown_values_are_not_reported():
    flown = Flown()
    flown.wire.sent.clear()
    flown.vehicle._reported_s = -math.inf
    nan = math.nan
    flown.step(Flight(nan, nan, (nan, nan), nan, nan, nan, nan, 0.8))
    kinds = {message.get_type() for message, *_ in flown.wire.sent}
    assert kinds == {"SYSTEM_TIME", "CAMERA_FOV_STATUS"}


def test_a_region_of_interest_is_looked_at():
    for message in (command_int(ROI, GOAL, 1300.0), long(ROI, 0, 0, 0, 0, GOAL[1], GOAL[0], 0)):
        result, steered = Flown().order(message)
        assert result == ACCEPTED
        assert steered.look_at == pytest.approx(GOAL, abs=1e-5)
        assert steered.fly_to is None


@pytest.mark.parametrize(("frame", "height_m"), [(0, 1380.0), (5, 1380.0), (3, 80.0), (6, 80.0)])
def test_a_reposition_has_its_height_above_the_sea_or_home(frame, height_m):
    result, steered = Flown().order(command_int(REPOSITION, GOAL, height_m, frame))
    assert result == ACCEPTED
    assert steered.fly_to == pytest.approx(GOAL, abs=1e-6)
    assert steered.altitude_m == pytest.approx(80.0)


def test_a_reposition_without_height_keeps_the_height():
    result, steered = Flown().order(command_int(REPOSITION, GOAL, math.nan))
    assert (result, steered.altitude_m) == (ACCEPTED, None)


@pytest.mark.parametrize(
    ("message", "result"),
    [
        (command_int(REPOSITION, (0.0, 0.0), 80.0), DENIED),
        (command_int(REPOSITION, (11.0, 99.0), 80.0), DENIED),
        (command_int(REPOSITION, GOAL, 80.0, frame=1), DENIED),
        (long(ROI, 0, 0, 0, 0, math.nan, math.nan, 0), DENIED),
        (long(400, 1), UNSUPPORTED),
    ],
)
def test_other_commands_are_refused_and_change_nothing(message, result):
    assert Flown().order(message) == (result, None)


def test_the_gimbal_turns_for_the_system_that_took_control_of_it():
    flown = Flown()
    turn = long(PITCH_YAW, -45.0, 90.0, math.nan, math.nan, 16)
    assert flown.order(turn)[0] == DENIED
    assert flown.order(long(CONFIGURE, *STATION, -1, -1))[0] == ACCEPTED
    result, steered = flown.order(turn)
    assert result == ACCEPTED
    # 40 m above the ground, the view meets the ground 40 m to the east.
    assert geometry.east_north(steered.look_at[None], ORIGIN)[0] == pytest.approx([50.0, 20.0], abs=0.1)
    assert flown.step().look_at == pytest.approx(steered.look_at)  # held while the vehicle moves
    assert flown.order(turn, (254, 1))[0] == DENIED
    assert flown.order(long(PITCH_YAW, 10.0, 90.0, math.nan, math.nan, 16))[0] == DENIED
    flown.vehicle._beat_s = -math.inf
    flown.step()
    (status,) = flown.wire.take("GIMBAL_MANAGER_STATUS")
    assert (status.primary_control_sysid, status.primary_control_compid) == STATION
    result, steered = flown.order(command_int(ROI, GOAL, 0.0))
    assert (result, flown.step()) == (ACCEPTED, None)  # a region of interest ends the held angles


def test_commands_to_other_systems_are_left_alone():
    flown = Flown()
    flown.wire.say(command_int(ROI, GOAL, 0.0, system=7), *STATION)
    assert flown.step() is None
    assert not flown.wire.take("COMMAND_ACK")


def test_a_late_command_waits_for_its_arrival():
    flown = Flown(LinkConditions(latency=50.0))
    flown.wire.say(command_int(ROI, GOAL, 0.0), *STATION)
    assert flown.step() is None
    flown.vehicle._inbox._waiting[0] = -math.inf, flown.vehicle._inbox._waiting[0][1]
    assert flown.step().look_at == pytest.approx(GOAL, abs=1e-6)
