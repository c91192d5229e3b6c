"""The onboard computer and its camera answer a ground station as the MAVLink specification says."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.geometry import lonlat
from torchvision_dddas.live.mavlink_component import MavlinkComponent, track_at, track_in
from torchvision_dddas.types import Detections, FrameResult, Positions, TrackedFrame, Tracks

pytest.importorskip("pymavlink")
from tests.geo.test_fusion import aerial
from tests.live.mavlink_peers import Wire, command, dialect, heartbeat, station_heartbeat

SIZE = (640, 480)
BOXES = np.array([[100.0, 100, 40, 20], [90.0, 90, 100, 100], [500.0, 300, 20, 40]])


def result_of(boxes=BOXES, located=None) -> FrameResult:
    count = len(boxes)
    tracks = Tracks(1, np.arange(1, count + 1), boxes, np.ones(count), np.zeros(count, int))
    return FrameResult(TrackedFrame(1, None, Detections(), tracks), located)


class Onboard:
    def __init__(self, system: int = 0) -> None:
        self.wire, self.events, self.now_s = Wire(), list[str](), 100.0
        self.result: FrameResult | None = None
        wire: Any = self.wire
        self.component = MavlinkComponent(wire, SIZE, 25.0, lambda kind, text: self.events.append(text), system)

    def pass_s(self, seconds: float) -> None:
        for _ in range(round(seconds * 20)):
            self.now_s += 0.05
            if self.result is not None:
                self.component.show(self.result, SIZE)
            self.component.tick(self.now_s)

    def ask(self, number: int, *params: float, **how: int) -> int | None:
        """Send a command of a ground station. Return the result of its acknowledgement."""
        self.wire.say(command(number, *params, **how), 255, 190)
        acks = self.wire.take("COMMAND_ACK")
        assert all((ack.command, ack.target_system, ack.target_component) == (number, 255, 190) for ack in acks)
        return acks[0].result if acks else None


@pytest.fixture
def onboard() -> Onboard:
    it = Onboard()
    it.component.tick(it.now_s)
    it.wire.say(heartbeat(), 7)
    it.pass_s(3.0)
    it.wire.sent.clear()
    it.result = result_of()
    it.component.show(it.result, SIZE)

    ask = it.ask
    it.ask = lambda number, *params, **how: ask(number, *params, **({"system": 7} | how))  # type: ignore[method-assign]
    return it


def test_heartbeats_come_once_a_second_with_the_number_of_the_vehicle(onboard: Onboard) -> None:
    onboard.pass_s(5.0)
    beats = [(m.type, m.autopilot, *sender) for m, *sender in onboard.wire.sent if m.get_type() == "HEARTBEAT"]
    assert beats.count((dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 7, 191)) == 5
    assert beats.count((dialect.MAV_TYPE_CAMERA, dialect.MAV_AUTOPILOT_INVALID, 7, 100)) == 5
    assert len(beats) == 10


def test_nothing_is_sent_until_others_had_time_to_speak_and_their_numbers_are_left_to_them() -> None:
    onboard = Onboard()
    onboard.pass_s(0.1)
    onboard.wire.say(heartbeat(), 3)
    for component, kind in ((100, dialect.MAV_TYPE_CAMERA), (191, dialect.MAV_TYPE_ONBOARD_CONTROLLER)):
        onboard.wire.say(heartbeat(kind=kind, autopilot=8), 3, component)
    onboard.pass_s(1.5)
    assert onboard.wire.sent == []
    onboard.pass_s(2.0)
    assert {(system, component) for _, system, component in onboard.wire.sent} == {(3, 192), (3, 101)}


def test_a_given_system_is_kept_and_a_station_is_no_vehicle() -> None:
    given, free = Onboard(system=9), Onboard()
    for onboard in (given, free):
        onboard.wire.say(heartbeat(), 4)
        onboard.wire.say(station_heartbeat(), 255, 190)
        onboard.pass_s(5.0)
    assert given.component.system == 9
    assert free.component.system == 4


def test_a_vehicle_that_comes_late_gives_its_number() -> None:
    onboard = Onboard()
    onboard.pass_s(10.0)
    assert onboard.component.system == 1
    onboard.wire.say(heartbeat(), 6)
    assert onboard.component.system == 6


def test_the_camera_describes_itself(onboard: Onboard) -> None:
    assert onboard.ask(dialect.MAV_CMD_REQUEST_MESSAGE, 259) == dialect.MAV_RESULT_ACCEPTED
    (camera,) = onboard.wire.take("CAMERA_INFORMATION")
    assert bytes(camera.vendor_name).rstrip(b"\0") == b"torchvision_dddas"
    assert (camera.resolution_h, camera.resolution_v) == SIZE
    assert camera.flags & dialect.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT
    assert camera.flags & dialect.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
    assert not camera.flags & dialect.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    assert not camera.flags & dialect.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
    assert math.isnan(camera.focal_length)


def test_a_video_stream_is_described_only_where_there_is_one(onboard: Onboard) -> None:
    assert onboard.ask(dialect.MAV_CMD_REQUEST_MESSAGE, 269) == dialect.MAV_RESULT_UNSUPPORTED
    onboard.component.video_uri = "rtsp://10.0.0.2:8554/annotated"
    assert onboard.ask(dialect.MAV_CMD_REQUEST_MESSAGE, 269) == dialect.MAV_RESULT_ACCEPTED
    (video,) = onboard.wire.take("VIDEO_STREAM_INFORMATION")
    assert (video.type, video.count, video.framerate) == (dialect.VIDEO_STREAM_TYPE_RTSP, 1, 25.0)
    assert video.uri == "rtsp://10.0.0.2:8554/annotated"
    onboard.component.video_uri = "udp://10.0.0.9:5600"
    onboard.ask(dialect.MAV_CMD_REQUEST_MESSAGE, 269)
    (video,) = onboard.wire.take("VIDEO_STREAM_INFORMATION")
    assert (video.type, video.uri) == (3, "5600"), "MPEG-TS, whose name in pymavlink has changed"
    onboard.ask(dialect.MAV_CMD_REQUEST_CAMERA_INFORMATION, 1)  # the older request
    (camera,) = onboard.wire.take("CAMERA_INFORMATION")
    assert camera.flags & dialect.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM


@pytest.mark.parametrize(
    ("number", "params", "chosen"),
    [
        (dialect.MAV_CMD_CAMERA_TRACK_POINT, (120 / 640, 110 / 480, 0.01), 1),  # the smaller of two boxes
        (dialect.MAV_CMD_CAMERA_TRACK_POINT, (180 / 640, 180 / 480, 0.01), 2),
        (dialect.MAV_CMD_CAMERA_TRACK_POINT, (528 / 640, 320 / 480, math.nan), 3),  # beside the box, in reach
        (dialect.MAV_CMD_CAMERA_TRACK_RECTANGLE, (480 / 640, 280 / 480, 540 / 640, 360 / 480), 3),
    ],
)
def test_a_station_chooses_the_target_there(onboard: Onboard, number: int, params: tuple[float, ...], chosen: int):
    assert onboard.ask(number, *params) == dialect.MAV_RESULT_ACCEPTED
    assert onboard.component.chosen == chosen
    assert onboard.events == [f"system 255 chose target {chosen}"]
    assert onboard.ask(dialect.MAV_CMD_CAMERA_STOP_TRACKING) == dialect.MAV_RESULT_ACCEPTED
    assert onboard.component.chosen == 0
    assert onboard.wire.take("CAMERA_TRACKING_IMAGE_STATUS")[-1].tracking_status == 0


@pytest.mark.parametrize(
    ("params", "result"),
    [
        ((0.95, 0.05, 0.01), dialect.MAV_RESULT_FAILED),
        ((1.5, 0.5, 0.01), dialect.MAV_RESULT_DENIED),
        ((math.nan, 0.5, 0.01), dialect.MAV_RESULT_DENIED),
    ],
)
def test_a_choice_without_a_target_keeps_the_one_before(onboard: Onboard, params, result: int) -> None:
    onboard.ask(dialect.MAV_CMD_CAMERA_TRACK_POINT, 120 / 640, 110 / 480, 0.01)
    assert onboard.ask(dialect.MAV_CMD_CAMERA_TRACK_POINT, *params) == result
    assert onboard.component.chosen == 1


def test_the_status_follows_the_target_at_the_asked_interval(onboard: Onboard) -> None:
    onboard.pass_s(2.0)
    assert onboard.wire.take("CAMERA_TRACKING_IMAGE_STATUS") == []  # it is sent while a target is tracked
    onboard.ask(dialect.MAV_CMD_CAMERA_TRACK_POINT, 120 / 640, 110 / 480, 0.01)
    onboard.pass_s(4.0)
    status = onboard.wire.take("CAMERA_TRACKING_IMAGE_STATUS")
    assert 8 <= len(status) <= 9
    assert (status[0].tracking_status, status[0].tracking_mode, status[0].target_data) == (1, 2, 4)
    corners = [status[0].rec_top_x, status[0].rec_top_y, status[0].rec_bottom_x, status[0].rec_bottom_y]
    assert np.allclose(corners, [100 / 640, 100 / 480, 140 / 640, 120 / 480])
    for interval_us, least, most in ((1e6, 4, 5), (1.0, 35, 41), (-1, 0, 0), (0, 8, 9)):
        assert onboard.ask(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 275, interval_us) == dialect.MAV_RESULT_ACCEPTED
        onboard.pass_s(4.0)
        assert least <= len(onboard.wire.take("CAMERA_TRACKING_IMAGE_STATUS")) <= most
    assert onboard.ask(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 275, math.nan) == dialect.MAV_RESULT_DENIED
    assert onboard.ask(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 1e6) == dialect.MAV_RESULT_UNSUPPORTED


def test_a_bridged_target_coasts_and_a_lost_one_is_given_up_with_an_event(onboard: Onboard) -> None:
    onboard.ask(dialect.MAV_CMD_CAMERA_TRACK_POINT, 120 / 640, 110 / 480, 0.01)
    bridged = result_of()
    tracks = replace(bridged.tracks, row=np.array([-1, 0, 0]))
    onboard.result = replace(bridged, tracked=replace(bridged.tracked, tracks=tracks))
    onboard.pass_s(1.0)
    assert onboard.wire.take("CAMERA_TRACKING_IMAGE_STATUS")[-1].tracking_status == 1 | 8
    onboard.result = result_of(BOXES[:0])
    onboard.pass_s(2.0)
    assert onboard.wire.take("CAMERA_TRACKING_IMAGE_STATUS")[-1].tracking_status == 2
    onboard.pass_s(5.0)
    assert onboard.component.chosen == 0
    assert onboard.events[-1] == "target 1, which a ground station chose, is lost"
    assert onboard.wire.take("CAMERA_TRACKING_IMAGE_STATUS")[-1].tracking_status == 0


def test_the_place_of_the_target_is_told_in_degrees_with_its_accuracy(onboard: Onboard) -> None:
    origin = (-110.95, 31.6)
    located = aerial(4.0, ((30.0, 40.0), (1.0, 2.0)))
    places = located.positions
    count = len(places)
    places = replace(
        places,
        target=np.arange(1, count + 1),
        origin_deg=origin,
        lonlat_deg=lonlat(places.east_north_m, origin),
        covariance_m2=np.tile(np.diag([4.0, 1.0]), (count, 1, 1)),
        above_sea_m=np.full(count, 1302.0),
    )
    assert isinstance(places, Positions)
    located = replace(located, positions=places, velocity_m_s=np.tile([3.0, 0.0], (count, 1)))
    onboard.result = result_of(located=located)
    onboard.pass_s(0.1)
    onboard.ask(dialect.MAV_CMD_CAMERA_TRACK_POINT, 120 / 640, 110 / 480, 0.01)
    onboard.pass_s(0.1)
    (geo,) = onboard.wire.take("CAMERA_TRACKING_GEO_STATUS")
    assert places.lonlat_deg is not None
    assert np.allclose([geo.lon / 1e7, geo.lat / 1e7], places.lonlat_deg[0], atol=1e-7, rtol=0)
    assert (geo.h_acc, geo.alt, geo.vel_n, geo.vel_e) == (2.0, 1302.0, 0.0, 3.0)
    assert math.isclose(geo.hdg, math.pi / 2, rel_tol=1e-6)


def test_commands_for_others_are_not_answered(onboard: Onboard) -> None:
    assert onboard.ask(dialect.MAV_CMD_CAMERA_TRACK_POINT, 0.2, 0.2, 0.1, system=8) is None
    assert onboard.ask(dialect.MAV_CMD_CAMERA_TRACK_POINT, 0.2, 0.2, 0.1, component=101) is None
    assert onboard.ask(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1, component=0) is None
    assert onboard.ask(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1, component=191) == dialect.MAV_RESULT_UNSUPPORTED
    assert onboard.ask(dialect.MAV_CMD_REQUEST_MESSAGE, 259, component=0) == dialect.MAV_RESULT_ACCEPTED


def test_a_camera_without_results_has_no_target_to_choose() -> None:
    assert track_at(Tracks(0), np.zeros(2), 100.0) == 0
    assert track_in(Tracks(0), np.array([0.0, 0, 10, 10])) == 0
    assert track_in(result_of().tracks, np.array([600.0, 0, 10, 10])) == 0
