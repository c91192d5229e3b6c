"""Decisions become MAVLink commands that a vehicle accepts, and nothing leaves without permission."""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import east_north, lonlat
from torchvision_dddas.live.command_safety import Fence, Limits
from torchvision_dddas.live.commanding import LiveCommands, is_guided
from torchvision_dddas.live.health import Health
from torchvision_dddas.types import Detections, Frame, FrameResult, TrackedFrame, Tracks

pytest.importorskip("pymavlink")
from tests.control.test_steering import CAMERA, SQUARE, flown, located, pose_at, team_at
from tests.live.mavlink_peers import Wire, command, dialect, heartbeat, position

HOME, GROUND_M, UP_M, RATE_HZ = (-110.95, 31.6), 1300.0, 50.0, 10.0
CIRCLE, BAND = Fence(circle=(*HOME, 200.0)), (30.0, 120.0)
ROVER_GUIDED = 15
TARGETS = np.array([[25.0, 0.0], [28.0, 4.0]])


@pytest.fixture(scope="module", autouse=True)
def lasting_troubles() -> Iterator[None]:
    """Keep troubles, however slow the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchvision_dddas.live.commanding._TROUBLE_S", math.inf)
        yield


class Rig:
    """A run with a vehicle on the other side of the link, which reports and acknowledges."""

    def __init__(self, allow: bool = True, answers: bool = True, ground: Any = None, **limits: Any) -> None:
        self.wire, self.health, self.now_s, self.frame = Wire(), Health(), 500.0, 0
        self.answers, self.mode, self.place_m, self.up_m = answers, 4, np.zeros(2), UP_M
        self.pose = pose_at((0, 0), UP_M)
        self.ground, self.has_ended, self.has_pictures = ground or {}, False, True
        site = SimpleNamespace(origin_deg=HOME, landmarks=SimpleNamespace(names=tuple(self.ground)))
        locator: Any = SimpleNamespace(
            site=site,
            camera=CAMERA,
            rate_hz=RATE_HZ,
            telemetry_at=lambda now_s: flown(self.pose),
            landmarks_at=lambda frame: team_at(SQUARE[: len(self.ground)]),
        )
        self.locator, wire = locator, cast(Any, self.wire)
        chosen = replace(Limits(allow, CIRCLE, BAND), **limits)
        self.commands = LiveCommands(
            wire, chosen, Settings(), CAMERA.size_px, RATE_HZ, self.locator, self.health, ground, lambda: self.now_s
        )
        self.obeyed = list[Any]()

    def fly(self, seconds: float, targets: Any = TARGETS) -> None:
        for _ in range(round(seconds * RATE_HZ)):
            self.now_s += 1 / RATE_HZ
            if self.frame % 10 == 0:
                self.wire.say(heartbeat(self.mode))
            place = lonlat(self.place_m[None], HOME)[0]
            time_ms = round(1000 * self.now_s)
            self.wire.say(position((place[0], place[1]), self.up_m, time_ms, GROUND_M + self.up_m))
            for k, system in enumerate(self.ground.values()):
                if self.frame % 10 == 0:
                    self.wire.say(heartbeat(ROVER_GUIDED, kind=10), system)
                at = lonlat(SQUARE[k][None], HOME)[0]
                self.wire.say(position((at[0], at[1]), 0.0, time_ms, GROUND_M), system)
            self.frame += 1
            self.show(targets)
            self.commands.tick()
            self.obey()

    def show(self, targets: Any) -> FrameResult:
        here = located(self.frame, targets, pose=self.pose, rate_hz=RATE_HZ)
        count = len(here.positions)
        tracks = Tracks(self.frame, np.arange(1, count + 1), here.box_px, np.ones(count), np.arange(count))
        newest = Frame(self.frame, (self.frame - 1) / RATE_HZ, np.zeros((1, 1), np.uint8), taken_s=self.now_s)
        shown = newest if self.has_pictures else None
        result = FrameResult(TrackedFrame(self.frame, shown, Detections(), tracks), here)
        feed: Any = SimpleNamespace(size=CAMERA.size_px, locator=self.locator, newest=newest, ended=self.has_ended)
        return self.commands.update(result, feed)

    def obey(self) -> None:
        for kind in ("COMMAND_INT", "COMMAND_LONG"):
            for message in self.wire.take(kind):
                self.obeyed.append(message)
                if self.answers:
                    us = self.commands.component
                    ack = dialect.MAVLink_command_ack_message(message.command, 0, 0, 0, us.system, us.component)
                    self.wire.say(ack, message.target_system)

    def taken(self, number: int) -> list[Any]:
        return [message for message in self.obeyed if message.command == number]

    def events(self) -> list[str]:
        return [event.text for event in self.health.snapshot().events if event.kind == "command"]

    def logged(self) -> list[str]:
        return [event.text for event in self.health.take_adjusted() if event.kind == "command"]


def metres(message: Any) -> np.ndarray:
    return east_north(np.array([[message.y / 1e7, message.x / 1e7]]), HOME)[0]


def test_the_decision_becomes_a_region_of_interest_and_a_reposition() -> None:
    rig = Rig()
    rig.fly(8.0)
    roi, flights = rig.taken(dialect.MAV_CMD_DO_SET_ROI_LOCATION), rig.taken(dialect.MAV_CMD_DO_REPOSITION)
    assert roi and flights
    assert {(m.target_system, m.target_component, m.frame) for m in (*roi, *flights)} == {(1, 1, 0)}
    assert np.allclose([m.z for m in roi], GROUND_M, atol=0.01)  # the ground, above the sea
    last = flights[-1]
    assert (last.param1, last.param2) == (-1, 0)  # its own speed; without the flag that changes the mode
    assert math.isnan(last.param4)
    assert math.isclose(last.z, GROUND_M + UP_M, abs_tol=0.01)
    # The view moves from below the vehicle towards the targets, and so does the vehicle, which looks straight down.
    assert 5.0 < metres(last)[0] <= 27.0
    assert np.allclose(metres(last), metres(roi[-1]), atol=1.5)
    assert rig.health.snapshot().counts["commands"] == len(rig.obeyed)
    assert rig.logged()[0].startswith("look at 31.6")


def test_nothing_is_sent_while_the_components_listen() -> None:
    rig = Rig()
    rig.fly(1.9)
    assert not rig.wire.sent and not rig.obeyed
    rig.fly(2.0)
    assert rig.obeyed


def test_results_of_missing_pictures_are_not_fresh() -> None:
    rig = Rig()
    rig.has_pictures = False
    rig.fly(8.0)
    assert not rig.obeyed
    rig.has_pictures = True
    rig.fly(2.0)
    assert rig.obeyed


def test_results_and_streams_get_the_command_in_degrees() -> None:
    rig = Rig()
    rig.fly(3.0)
    result = rig.show(TARGETS)
    assert result.command is not None and result.command.look_at is not None
    assert np.allclose(result.command.look_at, HOME, atol=1e-3)


def test_a_dry_run_records_what_it_would_send() -> None:
    rig = Rig(allow=False)
    rig.fly(8.0)
    assert rig.obeyed == []
    events = rig.events()
    assert any(text.startswith("would look at 31.6") for text in events)
    assert any(text.startswith("would fly to 31.6") and text.endswith("at 50 m above home") for text in events)


def test_an_unchanged_decision_is_not_repeated() -> None:
    rig = Rig()
    rig.fly(20.0, targets=np.array([[1.0, 1.0]]))  # in the leash about the middle of the picture
    assert len(rig.taken(dialect.MAV_CMD_DO_REPOSITION)) == 1
    assert len(rig.taken(dialect.MAV_CMD_DO_SET_ROI_LOCATION)) == 1


def test_a_goal_beyond_the_fence_is_refused_with_one_event() -> None:
    rig = Rig(fence=Fence(circle=(*HOME, 3.0)))
    rig.fly(20.0)
    assert all(np.linalg.norm(metres(m)) <= 3.0 for m in rig.taken(dialect.MAV_CMD_DO_REPOSITION))
    refused = [text for text in rig.events() if "the way leads outside the geofence" in text]
    assert 1 <= len(refused) <= len(rig.taken(dialect.MAV_CMD_DO_SET_ROI_LOCATION)) + 1


def test_the_altitude_is_kept_in_the_band() -> None:
    rig = Rig(altitude_m=(30.0, 55.0))
    rig.fly(30.0, targets=np.array([[60.0, 0.0], [-60.0, 0.0]]))  # they fit into one picture from higher only
    goals = [m.z - GROUND_M for m in rig.taken(dialect.MAV_CMD_DO_REPOSITION)]
    assert goals and max(goals) <= 55.01


def test_the_altitude_does_not_drift_with_the_noise_of_reports() -> None:
    rig, noise = Rig(), np.random.default_rng(1)
    for _ in range(80):
        rig.up_m = UP_M + noise.normal(0, 0.3)
        rig.fly(0.1)
    above_home_m = [float(text.split(" at ")[1].split()[0]) for text in rig.logged() if text.startswith("fly to")]
    assert above_home_m and np.ptp(above_home_m) == 0


def test_the_altitude_is_that_at_which_the_vehicle_was_handed_over() -> None:
    rig = Rig()
    rig.up_m, rig.pose = 3.0, pose_at((0, 0), 3.0)
    rig.fly(3.0)
    assert rig.events() == ["no command leaves: the vehicle is outside the altitude band"]
    rig.up_m, rig.pose = UP_M, pose_at((0, 0), UP_M)
    rig.fly(6.0)
    rig.fly(40.0, targets=TARGETS[:0])  # after a time without targets the vehicle returns to its first altitude
    goals = [m.z - GROUND_M for m in rig.taken(dialect.MAV_CMD_DO_REPOSITION)]
    assert goals and min(goals) >= UP_M - 0.1


def test_a_gimbal_manager_is_claimed_and_then_turned() -> None:
    rig = Rig()
    status = dialect.MAVLink_gimbal_manager_status_message
    rig.wire.say(heartbeat())
    rig.wire.say(status(0, 0, 0, 0, 0, 0, 0))  # nobody is in control
    rig.fly(4.0)
    (claim,) = rig.taken(dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE)
    assert (claim.param1, claim.param2, claim.param3) == (1, 191, -1)
    assert rig.taken(dialect.MAV_CMD_DO_SET_ROI_LOCATION) == []
    rig.wire.say(status(0, 0, 0, 1, 191, 0, 0))
    rig.fly(8.0)
    turn = rig.taken(dialect.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW)[-1]
    look = rig.show(TARGETS).command.look_at  # type: ignore[union-attr]
    east, north = east_north(np.array([look]), HOME)[0]
    assert math.isclose(turn.param1, -math.degrees(math.atan2(UP_M, math.hypot(east, north))), abs_tol=2.0)
    assert math.isclose(turn.param2, math.degrees(math.atan2(east, north)), abs_tol=2.0)
    assert int(turn.param5) & dialect.GIMBAL_MANAGER_FLAGS_YAW_LOCK


def test_a_gimbal_that_another_controls_is_left_alone() -> None:
    rig = Rig()
    rig.wire.say(heartbeat())
    rig.wire.say(dialect.MAVLink_gimbal_manager_status_message(0, 0, 0, 255, 190, 0, 0))
    rig.fly(6.0)
    assert rig.taken(dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE) == []
    assert rig.taken(dialect.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW) == []
    assert "the gimbal is left to system 255, component 190, which controls it" in rig.events()
    assert rig.taken(dialect.MAV_CMD_DO_REPOSITION)


def test_a_target_that_a_station_chose_comes_before_the_own_choice() -> None:
    rig = Rig()
    far = np.array([[0.0, 20.0], [0.0, -20.0]])
    rig.fly(4.0, targets=far)
    box = located(rig.frame, far, pose=rig.pose, rate_hz=RATE_HZ).box_px[1]
    at = (box[:2] + box[2:] / 2) / np.array(CAMERA.size_px)
    rig.wire.say(command(dialect.MAV_CMD_CAMERA_TRACK_POINT, *at.tolist(), 0.02), 255, 190)
    assert rig.commands.component.chosen == 2
    rig.fly(4.0, targets=far)
    assert np.allclose(metres(rig.taken(dialect.MAV_CMD_DO_SET_ROI_LOCATION)[-1]), far[1], atol=0.5)


ENDINGS = {
    "mode": (lambda rig: rig.wire.say(heartbeat(mode=5)), "the pilot changed the mode from 4 to 5"),
    "steered": (
        lambda rig: rig.wire.say(command(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH, component=1), 255, 190),
        "system 255 steers the vehicle",
    ),
    "steered by a message": (
        lambda rig: rig.wire.say(dialect.MAVLink_set_mode_message(1, 1, 6), 254, 190),
        "system 254 steers the vehicle",
    ),
    "flown to the item of a mission": (
        lambda rig: rig.wire.say(
            dialect.MAVLink_mission_item_int_message(1, 1, 0, 6, 16, 2, 1, 0, 0, 0, 0, 316000000, -1109500000, 50), 255
        ),
        "system 255 steers the vehicle",
    ),
    "another home": (
        lambda rig: rig.wire.say(command(dialect.MAV_CMD_DO_SET_HOME, 1, component=1), 255, 190),
        "system 255 steers the vehicle",
    ),
    "steered by another computer": (
        lambda rig: rig.wire.say(command(dialect.MAV_CMD_DO_REPOSITION, component=1), 1, 192),
        "system 1 steers the vehicle",
    ),
    "two stations": (
        lambda rig: [rig.wire.say(command(dialect.MAV_CMD_CAMERA_STOP_TRACKING), system, 190) for system in (255, 252)],
        "several stations command: 252, 255",
    ),
    "second vehicle": (
        lambda rig: rig.wire.say(heartbeat(), 2),
        "two vehicles, 1 and 2, are heard; give ?system=N",
    ),
}


def test_nothing_is_sent_for_the_last_results_of_a_run_that_stops() -> None:
    rig = Rig()
    rig.fly(3.0)
    rig.show(TARGETS + 40.0)  # decided, and not sent yet
    rig.has_ended, before = True, len(rig.obeyed)
    rig.fly(3.0, targets=TARGETS + 40.0)
    assert len(rig.obeyed) == before


def test_a_report_without_a_place_does_not_change_the_height_above_the_sea() -> None:
    rig = Rig()
    rig.fly(1.0)
    rig.wire.say(position((0.0, 0.0), 0.0, round(1000 * rig.now_s) + 1, 0.0))  # a receiver that lost its fix
    assert (rig.commands.uav.sea_m, rig.commands.uav.safety.altitude_m) == (GROUND_M + UP_M, UP_M)
    rig.fly(8.0)
    assert {round(m.z) for m in rig.taken(dialect.MAV_CMD_DO_REPOSITION)} == {round(GROUND_M + UP_M)}


@pytest.mark.parametrize("name", ENDINGS)
def test_an_ending_condition_on_the_link_ends_commanding_with_one_event(name: str) -> None:
    happen, reason = ENDINGS[name]
    rig = Rig()
    rig.fly(4.0)
    before = len(rig.obeyed)
    assert before
    happen(rig)
    rig.fly(10.0)
    assert len(rig.obeyed) == before
    told = [text for text in rig.events() if "commanding has ended" in text]
    assert told == [f"commanding has ended: {reason}; it begins again only with a new run"]
    assert f"commanding has ended: {reason}" in rig.health.snapshot().troubles


def test_a_vehicle_that_is_not_where_the_pictures_are_taken_is_not_commanded() -> None:
    rig = Rig(fence=Fence(circle=(*HOME, 2000.0)))
    rig.place_m = np.array([900.0, 0.0])
    rig.fly(8.0)
    assert rig.obeyed == []
    assert rig.commands.uav.safety.ended == "the pictures are taken more than 200 m away from system 1"


def test_silence_on_the_link_ends_commanding() -> None:
    rig = Rig()
    rig.fly(4.0)
    before = len(rig.obeyed)
    for _ in range(50):
        rig.now_s += 0.1
        rig.frame += 1
        rig.show(TARGETS)
        rig.commands.tick()
    assert len(rig.obeyed) == before
    assert rig.commands.uav.safety.ended.startswith("the position of system 1 is older")


def test_an_error_of_the_program_ends_commanding_and_not_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    rig.fly(4.0)

    def fail(*_: Any) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr(rig.commands._steering, "update", fail)
    before = len(rig.obeyed)
    rig.fly(4.0)
    assert len(rig.obeyed) == before
    assert rig.commands.uav.safety.ended == "an error: LinAlgError: singular"


def test_a_vehicle_that_does_not_answer_is_given_up() -> None:
    rig = Rig(answers=False)
    rig.fly(20.0)
    assert rig.commands.uav.safety.ended == "the vehicle did not acknowledge 3 commands within 1.5 s each"
    assert len(rig.obeyed) <= 6


def test_refused_commands_are_told_and_tried_again() -> None:
    rig = Rig(answers=False)
    rig.fly(3.0)
    us = rig.commands.component
    rig.wire.say(dialect.MAVLink_command_ack_message(192, 2, 0, 0, us.system, us.component))
    assert "the vehicle refuses reposition, MAV_RESULT 2" in rig.events()


def test_requests_of_stations_are_no_commands_to_the_vehicle() -> None:
    rig = Rig()
    for station in (255, 254):
        rig.wire.say(command(dialect.MAV_CMD_REQUEST_MESSAGE, 259), station, 190)
        rig.wire.say(command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 1e5, component=1), station, 190)
    rig.fly(4.0)
    assert rig.obeyed and not rig.commands.uav.safety.ended


@pytest.mark.parametrize(
    ("kind", "autopilot", "base", "mode", "guided"),
    [
        (2, 3, 217, 4, True),  # ArduPilot: copter, plane, rover
        (2, 3, 217, 15, False),
        (1, 3, 217, 15, True),
        (10, 3, 217, 15, True),
        (10, 3, 217, 4, False),
        (2, 12, 157, 4 << 16 | 3 << 24, True),  # PX4 in hold, and in a mission
        (2, 12, 157, 4 << 16 | 4 << 24, False),
        (2, 0, 0x88, 0, True),  # others tell it by a flag
        (2, 0, 0x80, 0, False),
    ],
)
def test_guided_modes_of_firmware(kind: int, autopilot: int, base: int, mode: int, guided: bool) -> None:
    assert is_guided(heartbeat(mode, base, kind, autopilot)) is guided


TEAM = {"ugv1": 11, "ugv2": 12, "ugv3": 13, "ugv4": 14}


def test_ground_vehicles_are_commanded_as_systems_of_their_own() -> None:
    rig = Rig(ground=TEAM, system=1)
    rig.fly(10.0)
    orders = [m for m in rig.taken(dialect.MAV_CMD_DO_REPOSITION) if m.target_system != 1]
    assert {m.target_system for m in orders} == set(TEAM.values())
    assert all(m.param1 > 0 and m.param2 == 0 and m.z == GROUND_M for m in orders)
    views = [m for m in rig.taken(dialect.MAV_CMD_DO_SET_ROI_LOCATION) if m.target_system == 12]
    assert np.linalg.norm(metres(views[-1]) - TARGETS, axis=1).min() < 2.0
    assert any(text.startswith("ugv2: drive to 31.6") for text in rig.logged())
    assert rig.health.snapshot().troubles == ()


def test_the_pilot_of_a_ground_vehicle_ends_its_commands_alone() -> None:
    rig = Rig(ground=TEAM, system=1)
    rig.fly(4.0)
    rig.wire.say(heartbeat(0, kind=10), 12)
    before = {system: sum(m.target_system == system for m in rig.obeyed) for system in (1, 12)}
    rig.fly(10.0, targets=TARGETS + 10)
    after = {system: sum(m.target_system == system for m in rig.obeyed) for system in (1, 12)}
    assert after[12] == before[12] and after[1] > before[1]
    assert "ugv2: commanding has ended: the pilot changed the mode from 15 to 0" in rig.health.snapshot().troubles


@pytest.mark.parametrize(("ground", "system"), [(TEAM, 0), (TEAM, 12), ({"ugv1": 11, "ugv2": 11}, 1)])
def test_ground_vehicles_need_numbers_of_their_own(ground, system: int) -> None:
    with pytest.raises(InputError, match=r"wanted \?system=N of the UAV, other numbers for ground vehicles"):
        Rig(ground=ground, system=system)


def test_an_unknown_ground_vehicle_is_refused() -> None:
    wire: Any = Wire()
    with pytest.raises(InputError, match=r"names the vehicles truck; .* among the landmarks: none"):
        LiveCommands(wire, Limits(system=1), Settings(), CAMERA.size_px, RATE_HZ, None, Health(), {"truck": 3})


def test_permission_needs_limits_and_degrees() -> None:
    with pytest.raises(InputError, match=r"give --geofence and --altitude-band too"):
        Rig(fence=None)
    with pytest.raises(InputError, match=r"give --geofence and --altitude-band too"):
        Rig(altitude_m=None)
    wire: Any = Wire()
    limits = Limits(True, CIRCLE, BAND)
    with pytest.raises(InputError, match=r"needs places in degrees"):
        LiveCommands(wire, limits, Settings(), CAMERA.size_px, RATE_HZ, None, Health())


def test_without_places_the_components_alone_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchvision_dddas.live.mavlink_component._LISTEN_S", 0.1)
    wire: Any = Wire()
    commands = LiveCommands(wire, Limits(), Settings(), CAMERA.size_px, RATE_HZ, None, Health())
    with commands:
        end_s = time.monotonic() + 20
        while not wire.take("HEARTBEAT"):
            assert time.monotonic() < end_s
            time.sleep(0.05)
    sent = len(wire.sent)
    time.sleep(0.2)
    assert len(wire.sent) == sent  # the thread has ended


def _change_mode(rig: Rig, mode: int) -> None:
    rig.mode = mode
    rig.wire.say(heartbeat(mode))


HAPPENINGS: dict[str, Any] = {
    "fly": lambda rig: None,
    "fly on": lambda rig: None,
    "leave": lambda rig: setattr(rig, "place_m", np.array([250.0, 0.0])),
    "return": lambda rig: setattr(rig, "place_m", np.zeros(2)),
    "climb": lambda rig: setattr(rig, "up_m", 130.0),
    "descend": lambda rig: setattr(rig, "up_m", UP_M),
    "other mode": lambda rig: _change_mode(rig, 5),
    "guided": lambda rig: _change_mode(rig, 4),
    "no answers": lambda rig: setattr(rig, "answers", False),
    "answers": lambda rig: setattr(rig, "answers", True),
    "silence": lambda rig: setattr(rig, "now_s", rig.now_s + 4.0),
    "second vehicle": lambda rig: rig.wire.say(heartbeat(), 2),
    "station": lambda rig: rig.wire.say(command(dialect.MAV_CMD_CAMERA_TRACK_POINT, 0.9, 0.5, 0.2), 255, 190),
    "other station": lambda rig: rig.wire.say(command(dialect.MAV_CMD_CAMERA_STOP_TRACKING), 254, 190),
    "arm": lambda rig: rig.wire.say(command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1, component=1), 255, 190),
    "refusal": lambda rig: rig.wire.say(dialect.MAVLink_command_ack_message(192, 4, 0, 0, 1, 191)),
    "garbage": lambda rig: rig.wire.say(dialect.MAVLink_statustext_message(6, b"hello"), 9, 7),
}


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    allow=st.sampled_from([True, True, True, False]), names=st.lists(st.sampled_from(sorted(HAPPENINGS)), max_size=16)
)
def test_whatever_happens_on_the_link_only_permitted_commands_leave(allow: bool, names: list[str]) -> None:
    rig = Rig(allow)
    for name in ["fly", *names]:
        HAPPENINGS[name](rig)
        before, over = len(rig.obeyed), bool(rig.commands.uav.safety.ended)
        rig.fly(0.6)
        new = rig.obeyed[before:]
        assert not new or (allow and not over)
        assert {m.command for m in new} <= {192, 195, 1000, 1001}
        for message in new:
            assert rig.mode == 4 and np.linalg.norm(rig.place_m) <= 200.0 and BAND[0] <= rig.up_m <= BAND[1]
            if message.command == 192:
                assert np.linalg.norm(metres(message)) <= 200.0
                assert BAND[0] - 0.1 <= message.z - GROUND_M <= BAND[1] + 0.1
