"""What the operator's page is told of a result, and the stream of annotated pictures."""

import json
import socket
import threading
from contextlib import closing
from dataclasses import replace
from itertools import islice
from typing import Any

import cv2
import numpy as np
import pytest

from tests.zoned import ABOVE, ORIGIN, result
from torchvision_dddas import live
from torchvision_dddas.io.output import MapSite, finite
from torchvision_dddas.io.streams import About
from torchvision_dddas.live import operator_view
from torchvision_dddas.live.operator_view import MOST_TARGETS, MOST_WATCHERS, OperatorView
from torchvision_dddas.live.server import HealthServer, health_pages
from torchvision_dddas.types import (
    Camera,
    Confirmation,
    Detections,
    Fix,
    Frame,
    LandmarkObservations,
    TrackedFrame,
    Tracks,
    Zone,
)

CAMERA = Camera("uav", (320, 240), (300.0, 300.0), (159.5, 119.5))
SITE = MapSite(("ugv1", "ugv2"), ORIGIN, camera=CAMERA)


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def begun(site=SITE, zones=(), interval=1):
    view = OperatorView()
    view.begin(interval, About(1.6e9, True, ("ugv1", "ugv2")), site, zones)
    return view


def frame(number, image=None):
    return Frame(number, number / 5, np.full((240, 320, 3), 90, np.uint8) if image is None else image)


# -- facts -------------------------------------------------------------------------------------------------------------


def test_a_located_target_has_its_degrees_speed_class_and_category_of_error():
    view, shown = begun(), result(6, [[0, 0], [30, 40]], labels={2: "car"}, sigma_m=10.0)
    located = replace(shown.locations, velocity_m_s=np.array([[3.0, 4.0], [np.nan, np.nan]]))
    one = np.ones(1)
    said = Confirmation(6, np.array([1]), ("not_human",), 0.1 * one, (("ugv1",),), np.array([0]), one, one, one)
    view.show(replace(shown, locations=located, confirmed=said), None)
    facts = view.facts()
    first, second = facts["targets"]
    assert facts["frame"] == 6 and facts["utc"] == "2020-09-13T12:26:41.000Z"
    assert first["place"] == "{1:.5f}, {0:.5f}".format(*ORIGIN) and first["speed"] == "5.0 m/s"
    # A circle of 2.146 sigma holds 90 %: 21.5 m, which is 70 ft.
    assert (first["error"], first["error_m"], first["kind"]) == ("CAT III", pytest.approx(21.5), "mover")
    assert (second["kind"], second["speed"]) == ("car, not human", "")


def test_without_an_origin_places_are_metres_and_without_locations_pixels():
    view = begun(MapSite((), None))
    view.show(result(1, [[2, -3]], origin=None), None)
    assert view.facts()["targets"][0]["place"] == "east 2.0 m, north −3.0 m"
    view = begun(None)
    view.show(result(1, [[2, 3]], located=False), None)
    facts = view.facts()
    row = facts["targets"][0]
    assert facts["map"] is None
    assert (row["place"], row["error"]) == ("pixel 20, 167", "") and json.loads(json.dumps(finite(row)))[
        "error_m"
    ] is None


def test_a_target_that_is_bridged_is_said_to_be_unseen_and_people_are_rows_too():
    view, shown = begun(None), result(1, [[2, 3]], located=False)
    tracks = replace(shown.tracks, row=np.array([-1]))
    box = np.array([[10.0, 20, 8, 30]])
    people = TrackedFrame(
        1, None, Detections(box, np.ones(1), kind="person"), Tracks(1, np.array([7]), box, np.ones(1), np.zeros(1, int))
    )
    view.show(replace(shown, tracked=replace(shown.tracked, tracks=tracks)), people)
    first, second = view.facts()["targets"]
    assert first["kind"] == "mover, not seen now"
    assert (second["id"], second["kind"], second["place"]) == ("7", "person", "pixel 14, 35")


def test_the_map_has_the_ellipse_the_track_the_landmarks_and_the_view_in_metres(clock):
    view = begun()
    for number in range(1, 5):
        shown = result(number, [[number, 10]], sigma_m=2.0)
        marks = LandmarkObservations(np.array([1]), np.full((1, 2), 5.0), np.array([[7.0, 8.0]]))
        view.show(replace(shown, locations=replace(shown.locations, marks=marks)), None)
        clock[0] += 0.6
    found = view.facts()["map"]
    (target,) = found["targets"]
    # The first of places within a second stays, and the track ends at the newest place.
    assert target["way"] == [[1, 10], [3, 10], [4, 10]]
    radius = np.hypot(*(np.array(target["ring"]) - (4, 10)).T)
    assert np.allclose(radius, 2.0 * np.sqrt(5.9915), atol=0.02)
    assert found["landmarks"] == [["ugv2", 7.0, 8.0]] and found["camera"] == [0.0, 0.0]
    east, north = np.array(found["view"]).T
    assert np.ptp(east) == pytest.approx(319 / 300 * 30, abs=0.1) and np.ptp(north) == pytest.approx(23.9, abs=0.1)


def test_a_lost_target_stays_on_the_map_for_a_minute(clock):
    view = begun()
    view.show(result(1, [[1, 2]]), None)
    clock[0] += 30
    view.show(result(2, [None, [5, 5]]), None)
    lost = [target["id"] for target in view.facts()["map"]["targets"] if target.get("lost")]
    assert lost == ["1"]
    clock[0] += 31
    view.show(result(3, [None, [5, 6]]), None)
    assert [target["id"] for target in view.facts()["map"]["targets"]] == ["2"]


def test_a_frame_that_is_not_located_says_why_on_the_map():
    view, shown = begun(), result(1, [])
    view.show(replace(shown, locations=replace(shown.locations, fix=Fix(1, "", cause="no landmark is seen"))), None)
    found = view.facts()["map"]
    assert (found["cause"], found["view"], found["targets"]) == ("no landmark is seen", [], [])


def test_many_targets_are_counted_and_not_all_listed():
    view = begun()
    view.show(result(1, [[k, 0] for k in range(MOST_TARGETS + 7)]), None)
    facts = view.facts()
    assert len(facts["targets"]) == MOST_TARGETS == len(facts["map"]["targets"]) and facts["more"] == 7


def test_zones_on_the_ground_are_in_metres_and_those_in_pixels_are_in_the_picture_only():
    square = np.array([[0.0, 0], [4, 0], [4, 3]])
    zones = [
        Zone("field", (square,), unit="m"),
        Zone("door", (square,), unit="px"),
        Zone("road", (square[:2],), True, "m"),
    ]
    assert begun(zones=zones).zones() == [
        {"name": "field", "rings": [square.tolist()], "line": False},
        {"name": "road", "rings": [square[:2].tolist()], "line": True},
    ]


def test_before_the_first_result_there_is_a_state_and_no_target():
    assert begun().facts() == {"frame": 0, "utc": None, "targets": [], "more": 0, "map": None}


# -- pictures ----------------------------------------------------------------------------------------------------------


def watched(view):
    """A stream that has begun."""
    stream = view.pictures()
    assert next(stream) == b"--picture\r\n"
    return stream


def decoded(part):
    head, _, rest = part.partition(b"\r\n\r\n")
    length = int(head.rpartition(b" ")[2])
    assert head.startswith(b"Content-Type: image/jpeg\r\n") and rest[length:] == b"\r\n--picture\r\n"
    return cv2.imdecode(np.frombuffer(rest[:length], np.uint8), cv2.IMREAD_COLOR)


def test_clients_that_ask_at_the_same_time_are_no_more_than_the_limit():
    view = begun()
    asked = [view.pictures() for _ in range(MOST_WATCHERS + 3)]
    assert sum(bool(next(pictures, b"")) for pictures in asked) == MOST_WATCHERS
    asked[0].close()
    assert not view.is_full
    for pictures in asked:
        pictures.close()


def test_no_picture_is_kept_or_drawn_while_nobody_watches(monkeypatch):
    monkeypatch.setattr(operator_view, "RunPictures", None)
    view = begun()
    for number in range(1, 30):
        view.take(frame(number))
        view.show(result(number, [[0, 0]]), None)
    assert not view._images and view._drawable is None


def test_a_watcher_gets_the_picture_of_the_newest_result_with_its_own_targets(clock):
    view = begun()
    with closing(watched(view)) as stream:
        for number in range(1, 9):  # results come three pictures later
            view.take(frame(number, np.full((240, 320), 20 * number, np.uint8)))
            clock[0] += 0.2
            if number > 3:
                view.show(result(number - 3, [[10, 10]]), None)
        picture = decoded(next(stream))
    assert picture.shape == (240, 320, 3)
    assert abs(int(np.median(picture[:60])) - 100) < 6  # of frame 5
    assert np.ptp(picture[90:110, 90:110].astype(int)) > 60  # the box of the target


def test_pictures_are_limited_in_rate_and_size_and_kept_only_until_their_results_come(clock):
    view = begun()
    with closing(watched(view)) as stream:
        for number in range(1, 101):  # 4 s at 25 Hz, without results
            view.take(frame(number))
            clock[0] += 0.04
        assert len(view._images) == operator_view._MOST_WAITING
        numbers = list(view._images)
        assert np.mean(np.diff(numbers)) >= 3  # an eighth of a second
        view.show(result(numbers[-1], []), None)
        assert not view._images
        view.take(frame(200, np.zeros((1080, 1920, 3), np.uint8)))
        view.show(result(200, [[0, 0]]), None)
        assert decoded(next(stream)).shape == (540, 960, 3)


def test_only_frames_that_get_a_result_are_kept(clock):
    view = begun(interval=5)
    with closing(watched(view)):
        for number in range(1, 20):
            view.take(frame(number))
            clock[0] += 1.0
        assert list(view._images) == [1, 6, 11, 16]


def test_clients_share_a_picture_and_a_slow_one_skips_to_the_newest(monkeypatch, clock):
    drawn, honest = [], OperatorView._draw

    def draw(self, *given):
        drawn.append(1)
        return honest(self, *given)

    monkeypatch.setattr(OperatorView, "_draw", draw)
    view = begun()
    with closing(watched(view)) as quick, closing(watched(view)) as slow:
        for number in (1, 2, 3):
            view.take(frame(number))
            view.show(result(number, [[0, 0]]), None)
            clock[0] += 1
            last = next(quick)
        assert next(slow) == last and len(drawn) == 3


def test_a_stream_without_new_pictures_goes_on_and_ends_when_the_run_does(monkeypatch):
    monkeypatch.setattr(operator_view, "_IDLE_S", 0.01)
    view = begun()
    stream = watched(view)
    assert list(islice(stream, 3)) == [b"", b"", b""]
    view.close()
    assert list(stream) == [] and view._watchers == 0


def test_a_picture_that_cannot_be_drawn_is_reported_once_and_the_next_ones_come(monkeypatch, clock):
    def fail(self, *given):
        raise ValueError("no picture will do")

    said = list[str]()
    view = OperatorView(said.append)
    view.begin(1, About(), None, ())
    with closing(watched(view)) as stream:
        for draw in (fail, fail, OperatorView._draw):
            monkeypatch.setattr(OperatorView, "_draw", draw)
            view.take(frame(number := round(clock[0]) - 99))
            view.show(result(number, [], located=False), None)
            clock[0] += 1
            if draw is fail:
                monkeypatch.setattr(operator_view, "_IDLE_S", 0.01)
                assert next(stream) == b""
        decoded(next(stream))
    assert said == ["pictures cannot be drawn for the page, ValueError: no picture will do"]


def test_the_last_client_takes_the_pictures_with_it(clock):
    view = begun()
    stream = watched(view)
    view.take(frame(1))
    view.show(result(1, []), None)
    decoded(next(stream))
    stream.close()
    assert view._drawable is None and view._encoded == (None, b"")


def test_people_are_drawn(clock):
    view = begun(None)
    box = np.array([[200.0, 100, 40, 80]])
    people = TrackedFrame(
        1, None, Detections(box, np.ones(1), kind="person"), Tracks(1, np.array([3]), box, np.ones(1), np.zeros(1, int))
    )
    with closing(watched(view)) as stream:
        view.take(frame(1))
        view.show(result(1, [], located=False), people)
        picture = decoded(next(stream)).astype(int)
    assert picture[140, 200, 1] > picture[140, 200, 0] + 30  # green


# -- over HTTP ---------------------------------------------------------------------------------------------------------


class Run(Any):
    hung = ""


def test_the_server_streams_to_some_clients_and_forgets_those_that_left(monkeypatch):
    monkeypatch.setattr(operator_view, "_IDLE_S", 0.01)
    view = begun()
    pages = health_pages(live.Health(), Run(), [], lambda: "running", "x", "1", 60.0, view)

    def watch():
        client = socket.create_connection(server.address, timeout=60)
        client.sendall(b"GET /picture.mjpg HTTP/1.0\r\n\r\n")
        return client, client.recv(4096)

    def wait(watchers):
        for _ in range(6000):
            if view._watchers == watchers:
                return
            threading.Event().wait(0.01)
        raise AssertionError(view._watchers)

    with HealthServer(("127.0.0.1", 0), pages) as server:
        clients = []
        for count in range(1, MOST_WATCHERS + 1):
            clients.append(watch())
            wait(count)
        assert all(head.startswith(b"HTTP/1.0 200 ") and b"multipart/x-mixed-replace" in head for _, head in clients)
        client, refused = watch()
        client.close()
        assert refused.startswith(b"HTTP/1.0 503 ")
        for client, _ in clients:
            client.close()
        wait(0)
        client, _ = watch()
        wait(1)
    with client:  # the server closes its streams too
        wait(0)


def test_the_state_holds_the_health_the_targets_and_marked_alarms():
    health, view = live.Health(), begun()
    health.event("zone", "target 1 enters <b>yard", 3)
    for _ in range(25):
        health.event("load", "fewer keypoints")
    view.show(result(1, [[0, 0]]), None)
    pages = health_pages(health, Run(), [], lambda: "running", "x", "1", 60.0, view)
    status, kind, text = pages["/state.json"]()
    state = json.loads(str(text), parse_constant=lambda name: pytest.fail(name))
    assert (status, kind, state["trouble"], len(state["targets"])) == (200, "application/json", "", 1)
    # Twenty other events do not push an alarm off the page.
    assert [event[2] for event in state["events"] if event[3]] == ["target 1 enters <b>yard"]
    assert len(state["events"]) == 21 and state["session"] == view.session != OperatorView().session
    assert ABOVE.place_m[2] == 30
