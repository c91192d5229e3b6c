"""Landmarks that report their places during a run are where they were at the time of each picture."""

import json
import time

import numpy as np
import pytest

from tests.live.test_live_telemetry import Script, until
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import AerialLocator
from torchvision_dddas.live import live_landmarks
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.live_landmarks import LiveLandmarks
from torchvision_dddas.types import Camera

CAMERA = Camera("uav", (640, 480), (600.0, 600.0), (319.5, 239.5))


@pytest.fixture
def opened(monkeypatch):
    monkeypatch.setattr(live_landmarks, "_WAIT_S", 0.3)
    monkeypatch.setattr(live_landmarks, "_SETTLING_S", 0.0)
    made: list[LiveLandmarks] = []

    def open_with(systems=None):
        script, health = Script(), Health()
        made.append(LiveLandmarks("udp:x", script, systems or {}, health))
        return made[-1], script, health

    yield open_with
    for one in made:
        one.close()


def report(name: str, utc_s: float, east_m: float) -> bytes:
    return json.dumps({"landmark": name, "time_s": utc_s, "east_m": east_m, "north_m": 0, "sigma_m": 0.5}).encode()


def texts(health: Health) -> list[str]:
    return [event.text for event in health.snapshot().events]


def test_a_landmark_is_where_it_was_when_the_picture_was_taken_and_goes_on_for_a_while(opened):
    marks, script, health = opened()
    now_s = time.time()
    for k in range(21):  # 2 m/s to the east
        script.reports += [
            (now_s, report(name, now_s + k / 10, start + k / 5)) for name, start in (("a", 0), ("b", 40))
        ]
    marks.wait(None)
    until(lambda: not script.reports)
    locator = AerialLocator(CAMERA, None, marks.record(now_s, 10.0), rate_hz=10.0)
    assert locator.site.landmarks.names == ("a", "b")
    time.sleep(0.05)
    marks.place(locator, now_s, 10.0)
    for frame, east_m in ((1, 0.0), (11, 2.0), (21, 4.0), (26, 5.0)):
        seen = locator.landmarks_at(frame)
        np.testing.assert_allclose(seen.east_north_m[:, 0], [east_m, 40 + east_m], atol=0.05)
    assert locator.landmarks_at(26).sigma_m[0] > locator.landmarks_at(21).sigma_m[0] == 0.5
    assert len(locator.landmarks_at(10_000)) == 0  # an old report is no current place
    assert texts(health) == []


def test_new_reports_move_the_landmarks_of_the_locator_once_each(opened):
    marks, script, _ = opened()
    now_s = time.time()
    script.reports += [(now_s, report("a", now_s, 0.0)), (now_s, report("b", now_s, 9.0))]
    marks.wait(None)
    until(lambda: not script.reports)
    locator = AerialLocator(CAMERA, None, marks.record(now_s, 10.0), rate_hz=10.0)
    script.reports.append((now_s + 1, report("a", now_s + 1, 3.0)))

    def moved() -> bool:
        marks.place(locator, now_s, 10.0)
        return bool(np.isclose(locator.landmarks_at(11).east_north_m[0, 0], 3.0))

    until(moved)
    site = locator.site
    marks.place(locator, now_s, 10.0)
    assert locator.site is site  # nothing new came
    marks.place(None, now_s, 10.0)


def test_reports_of_csv_count_by_their_reception_without_times_of_day(opened):
    marks, script, _ = opened()
    now_s = time.time()
    rows = (
        b"landmark,longitude_deg,latitude_deg",
        b"a,11.5,48",
        b"b,11.6,48.1",
        b"landmark,longitude_deg,latitude_deg",
    )
    script.reports += [(now_s, row) for row in rows]
    marks.wait(None)
    until(lambda: not script.reports)
    table = marks.record(now_s - 1, 10.0)
    assert table.names == ("a", "b") and table.geographic and np.isnan(table.sigma_m).all()
    np.testing.assert_allclose(table.place, [[11.5, 48], [11.6, 48.1]])
    np.testing.assert_allclose(table.frame, 11, atol=1e-4)


def test_vehicles_are_told_apart_by_their_mavlink_systems(opened):
    dialect = pytest.importorskip("pymavlink.dialects.v20.all")
    marks, script, _ = opened({11: "ugv1", 12: "ugv2"})
    now_s = time.time()
    for system in (11, 12, 13):
        packer = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
        message = dialect.MAVLink_global_position_int_message(0, 480_000_000 + system, 115_000_000, 0, 0, 0, 0, 0, 0)
        script.reports.append((now_s, bytes(message.pack(packer))))
    marks.wait(None)
    table = marks.record(now_s, 10.0)
    assert table.names == ("ugv1", "ugv2")
    np.testing.assert_allclose(table.place, [[11.5, 48.0000011], [11.5, 48.0000012]], atol=1e-9)


def test_vehicles_that_never_report_are_named(opened):
    marks, _, _ = opened({11: "ugv1", 12: "ugv2"})
    with pytest.raises(InputError, match=r"no place of ugv1, ugv2 comes for 0\.3 s"):
        marks.wait(None)


def test_damaged_reports_and_landmarks_that_join_later_are_events_and_left_out(opened):
    marks, script, health = opened()
    now_s = time.time()
    script.reports.append((now_s, report("a", now_s, 0.0)))
    marks.wait(None)
    bad = (
        b"{",
        b'{"landmark": "a"}',
        report("new", now_s, 1.0),
        b'{"landmark": "a", "longitude_deg": 1, "latitude_deg": 95}',
    )
    for content in (*bad, *bad):
        script.reports.append((now_s, content))
    script.reports.append((now_s + 1, report("a", now_s + 1, 5.0)))
    until(lambda: marks.record(now_s, 10.0).place[-1, 0] == 5.0)
    said = texts(health)
    assert len(said) == 4
    assert "gives no place of a landmark" in said[0] and "new was not there at the start" in said[2]
    assert "off the globe" in said[3]
    assert marks.record(now_s, 10.0).names == ("a",)


@pytest.mark.parametrize(
    "damaged",
    [
        b'{"a":' * 10_000,
        b'{"landmark":"a","east_m":1' + b"0" * 400 + b',"north_m":0}',
        b"landmark,east_m,north_m\rb,1,2",
    ],
)
def test_reports_follow_a_damaged_one(opened, damaged: bytes):
    marks, script, health = opened()
    now_s = time.time()
    script.reports += [(now_s, damaged), (now_s, report("a", now_s, 1.0))]
    marks.wait(None)
    assert marks.record(now_s, 10.0).names == ("a",)
    assert texts(health)[0].endswith("gives no place of a landmark: such reports are left out")
