"""The simulated ground vehicles as MAVLink systems of their own."""

import math
from typing import Any, cast

import numpy as np
import pytest

from tests.lab.simulation.test_served_vehicle import GOAL, STATION, command_int
from tests.live.mavlink_peers import Wire, command
from torchvision_dddas.lab.simulation.link_conditions import DelayedWriter, LinkConditions, LinkDelay
from torchvision_dddas.lab.simulation.scenario import load_scenario
from torchvision_dddas.lab.simulation.served_team import FIRST_SYSTEM, ServedTeam
from torchvision_dddas.lab.simulation.simulator import Simulator, open_simulator

REPOSITION, ROI, ARM = 192, 195, 400
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3


class Driven:
    """A world with two ground vehicles on a wire."""

    def __init__(self) -> None:
        changes = [
            "team.ugvs=2",
            "clip.located_by='telemetry'",
            "camera.width_px=64",
            "camera.height_px=64",
            "clip.seconds=5",
        ]
        self.simulator: Simulator = open_simulator(load_scenario("leaving", changes))
        self.wire = cast(Any, Wire())
        perfect = LinkConditions()
        reports = DelayedWriter(lambda item: self.wire.send(item[1], item[0], 1), LinkDelay(perfect, 0, 3))
        self.team = ServedTeam(self.wire, reports, LinkDelay(perfect, 0, 4), self.simulator.names, 1.5)
        self.step()

    def step(self) -> Any:
        shot = self.simulator.next()
        assert shot is not None
        self.moment = shot.moments[-1]
        orders = self.team.step(self.moment, 1300.0)
        if orders is not None:
            self.simulator.steer(orders)
        return orders

    def order(self, message: Any) -> tuple[int, Any]:
        self.wire.take("COMMAND_ACK")
        self.wire.say(message, *STATION)
        orders = self.step()
        (answer,) = [sent for sent in self.wire.sent if sent[0].get_type() == "COMMAND_ACK"]
        assert answer[1] == message.target_system
        return answer[0].result, orders


@pytest.fixture(scope="module")
def driven() -> Driven:
    return Driven()


def test_each_vehicle_reports_its_place_as_a_system_of_its_own(driven: Driven) -> None:
    driven.wire.sent.clear()
    driven.team._beat_s = -math.inf
    driven.step()
    said = {(system, message.get_type()) for message, system, _ in driven.wire.sent}
    kinds = ("HEARTBEAT", "GLOBAL_POSITION_INT")
    assert said == {(FIRST_SYSTEM + row, kind) for row in range(2) for kind in kinds}
    places = {system: message for message, system, _ in driven.wire.sent if message.get_type() == kinds[1]}
    for report in driven.moment.reports:
        if not report.planned:
            told = places[FIRST_SYSTEM + report.vehicle]
            assert np.array([told.lon, told.lat]) / 1e7 == pytest.approx(report.lonlat_deg, abs=1e-7)
            assert (told.alt, told.relative_alt) == (1_300_000, 0)


def test_a_vehicle_drives_where_it_is_told(driven: Driven) -> None:
    result, orders = driven.order(command_int(REPOSITION, GOAL, math.nan, system=FIRST_SYSTEM + 1))
    (order,) = orders.orders
    assert (result, order.vehicle, order.speed_m_s) == (ACCEPTED, "ugv2", 1.5)
    assert order.goal == pytest.approx(GOAL, abs=1e-6)
    result, orders = driven.order(command_int(ROI, (-110.95, 31.6), 0.0, system=FIRST_SYSTEM + 1))
    assert result == ACCEPTED
    assert orders.orders[0].goal == pytest.approx(GOAL, abs=1e-6)  # it goes on
    assert orders.orders[0].look_at == pytest.approx((-110.95, 31.6), abs=1e-6)


def test_other_commands_and_wrong_places_are_refused(driven: Driven) -> None:
    assert driven.order(command_int(REPOSITION, (0.0, 0.0), 0.0, system=FIRST_SYSTEM)) == (DENIED, None)
    assert driven.order(command(ARM, 1, system=FIRST_SYSTEM, component=1)) == (UNSUPPORTED, None)


def test_commands_to_other_systems_are_left_alone(driven: Driven) -> None:
    driven.wire.take("COMMAND_ACK")
    driven.wire.say(command_int(REPOSITION, GOAL, 0.0, system=1), *STATION)
    assert driven.step() is None
    assert not driven.wire.take("COMMAND_ACK")
