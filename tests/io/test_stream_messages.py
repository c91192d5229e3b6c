"""Frames as lines of JSON and the page that documents them, rows of MOT text, and Cursor-on-Target events."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.io.ground import NAMES, tracks
from tests.io.streamed import ABOUT, located, tracked
from torchvision_dddas.io.maps.formats import cot
from torchvision_dddas.io.streams import About
from torchvision_dddas.io.streams.messages import PEOPLE_FROM, CotEvents, json_lines, mot_lines
from torchvision_dddas.types import Adjustment, AppearanceUse, Camera, CameraPose, FrameResult, TrackedFrame, Tracks

PAGE = (Path(__file__).parents[2] / "docs" / "stream.md").read_text(encoding="utf-8")


def strict(line):
    """As a reader takes it that knows no NaN."""

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(line, parse_constant=refuse)


def one(*given, about=ABOUT, **rest):
    (line,) = json_lines(about, *given, **rest)
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    return strict(line)


def with_positions(frame, **changes):
    at = replace(frame.locations.positions, **changes)
    return replace(frame, locations=replace(frame.locations, positions=at))


def example():
    """The frame of the page: a crowd that was located, and a person."""
    moved = Adjustment(41, "interval_frames", 1.0, 2.0, "background flow 0.4 px a frame")
    frame = located(42, rate=30.0)
    marks = replace(frame.locations.marks, image_px=np.array([[40.0, 30], [120, 50], [99, 99], [7, 7]]))[:2]
    states = ("used", "excluded", "used", "used")
    fix = replace(frame.locations.fix, state=states, changes=("bravo excluded: 9.1 px off",))
    ground = replace(frame.locations, marks=marks, fix=fix)
    frame = replace(frame, locations=ground, tracked=replace(frame.tracked, adjustments=(moved,)))
    use = AppearanceUse(True, "a track has several likely detections")
    frame = replace(frame, tracked=replace(frame.tracked, tracks=replace(frame.tracks, appearance=use)))
    return json_lines(ABOUT, frame, tracked(42, 0, kind="person", rate=30.0), 0.0612)[0].decode()


def test_the_line_of_the_page_is_what_is_sent():
    shown = re.search(r"```json\n(.*?)```", PAGE, re.DOTALL)
    assert shown is not None and shown[1] == example()


def test_the_page_names_every_field_and_no_other():
    rows = [row for row in PAGE.splitlines() if row.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`([a-z][a-z0-9_.\[\]]*)`", row.split("|")[1])}
    sent = set()
    frame = located()
    tracks = replace(frame.tracked.tracks, label=np.array(["car"] * len(frame.tracked.tracks), object))
    named_frame = replace(frame, tracked=replace(frame.tracked, tracks=tracks))
    lines = [*json_lines(ABOUT, frame, tracked(), most_bytes=512), *json_lines(ABOUT, named_frame, None), example()]
    for mark in ({"provisional": True}, {"corrects": (1,)}):
        lines += json_lines(ABOUT, replace(frame, tracked=replace(frame.tracked, tracks=replace(tracks, **mark))), None)
    for fields in map(strict, lines):
        sent |= set(fields) | {f"targets[].{name}" for row in fields["targets"] for name in row}
        sent |= {f"{part}.{name}" for part in ("ground", "appearance") for name in fields.get(part) or {}}
    assert {name for name in sent if not name.startswith(("ground.landmarks", "adjustments"))} <= named
    first = {row.split("`")[1] for row in rows}
    assert {
        name for name in first if re.fullmatch(r"[a-z]+_?[a-z]*|targets\[\]\..*|(ground|appearance)\.[a-z_]*", name)
    } <= sent


def test_a_target_has_its_identity_its_box_and_its_place():
    fields = one(located(3), None)
    assert (fields["frame"], fields["time_s"], fields["utc"]) == (3, 0.2, "2020-09-13T12:26:40.450Z")
    first, bridge, loose = fields["targets"]
    box = {"id": 1, "kind": "moving", "seen": True, "box_px": [10, 20, 30, 40], "score": 0.875, "link": 0.75}
    motion = {"heading_deg": 0.0, "speed_px_per_frame": 1.5, "velocity_m_s": [3, 4]}
    place = {"east_north_m": [0, 0], "covariance_m2": [1, 0, 1], "lonlat_deg": [-110.95, 32.23]}
    assert first == {**box, **motion, **place, "confirmed": "human", "human": 0.75}
    assert bridge == {**box, "id": 2, "seen": False, "box_px": [20, 20, 30, 40], "link": None}
    assert (loose["id"], loose["link"], loose["heading_deg"], loose["seen"]) == (None, None, None, True)
    assert [mark["name"] for mark in fields["ground"]["landmarks"]] == list(NAMES)
    assert "lonlat_deg" not in one(located(1, origin=None), None)["targets"][0]


def test_provisional_tracks_are_marked_and_settled_tracks_name_what_they_correct():
    frame = located()
    frames = [
        replace(frame, tracked=replace(frame.tracked, tracks=replace(frame.tracks, **mark)))
        for mark in ({}, {"provisional": True}, {"corrects": (2, 5)})
    ]
    marks = [
        {name: line[name] for name in ("provisional", "corrects") if name in line}
        for line in (one(frame, None) for frame in frames)
    ]
    assert marks == [{}, {"provisional": True}, {"corrects": [2, 5]}]
    parts = [strict(line) for line in json_lines(ABOUT, frames[1], None, most_bytes=512)]
    assert len(parts) > 1 and all(part["provisional"] for part in parts)
    assert mot_lines(frames[0], None) and not mot_lines(frames[1], None)


def test_what_was_not_searched_is_null_and_what_was_not_found_is_empty():
    fields = one(located(1, 0, on_ground=False), None, about=About())
    assert (fields["people"], fields["ground"], fields["utc"]) == (None, None, None)
    unread = FrameResult(TrackedFrame(5, None, tracked(1, 0).detections, Tracks(5), cause="the picture cannot be read"))
    fields = one(unread, None)
    assert (fields["time_s"], fields["utc"], fields["cause"]) == (None, None, "the picture cannot be read")
    assert one(None, tracked(1, 1, kind="person"))["targets"] is None
    assert one(None, replace(tracked(1, 0), detections=type(tracked().detections)()))["people"] == []


def test_targets_and_people_of_different_frames_are_lines_of_their_own():
    lines = [strict(line) for line in json_lines(ABOUT, located(7), tracked(5, kind="person"))]
    assert [(f["frame"], f["targets"] is None, f["people"] is None) for f in lines] == [
        (7, False, True),
        (5, True, False),
    ]
    assert {row["kind"] for row in lines[1]["people"]} == {"person"}


@given(st.lists(st.floats(), min_size=12, max_size=12), st.floats(), st.text(max_size=20), st.text(max_size=8))
def test_whatever_the_numbers_and_names_a_line_is_one_line_of_strict_json(values, start, cause, name):
    a, b, c, d, *rest = values
    frame = with_positions(
        located(1),
        east_north_m=np.array([rest[:2]]),
        covariance_m2=np.array(rest[2:6]).reshape(1, 2, 2),
        lonlat_deg=np.array([rest[6:8]]),
    )
    boxes = replace(frame.tracked.tracks, box_px=np.array([[a, b, c, d]] * 2), score=np.array([a, b]))
    own = replace(frame.tracked, cause=cause, tracks=boxes, adjustments=(Adjustment(1, "track.gate", c, d, cause),))
    frame = replace(frame, tracked=own, locations=replace(frame.locations, velocity_m_s=np.array([[a, d]])))
    fields = one(frame, None, b, about=replace(ABOUT, start_utc_s=start, landmarks=(name,) * 4))
    assert fields["cause"] == cause
    assert fields["ground"]["landmarks"][0]["name"] == name
    is_finite = all(map(math.isfinite, (a, b, c, d)))
    assert fields["targets"][0]["box_px"] == (pytest.approx([a, b, c, d], abs=0.006) if is_finite else None)


def test_a_frame_too_long_for_a_datagram_is_split_into_parts_that_fit():
    frames = located(1, 300), tracked(1, 40, kind="person")
    whole, lines = one(*frames), json_lines(ABOUT, *frames, most_bytes=1400)
    parts = [strict(line) for line in lines]
    assert max(map(len, lines)) <= 1400 and len(lines) > 10
    assert [(part["part"], part["parts"]) for part in parts] == [(k + 1, len(parts)) for k in range(len(parts))]
    for name in ("targets", "people"):
        assert [row for part in parts for row in part[name]] == whole[name]
    assert parts[0]["ground"] == whole["ground"] and all("ground" not in part for part in parts[1:])
    assert all(part["frame"] == 1 and part["utc"] == whole["utc"] for part in parts)
    short = json_lines(ABOUT, located(1), None)
    assert json_lines(ABOUT, located(1), None, most_bytes=len(short[0])) == short and "part" not in strict(short[0])


def test_people_have_mot_rows_with_identities_that_no_target_has():
    (message,) = mot_lines(located(4), tracked(4, 3, kind="person"))
    rows = [row.split(",") for row in message.decode().splitlines()]
    assert [int(row[1]) for row in rows] == [1, 2, PEOPLE_FROM + 1, PEOPLE_FROM + 2, PEOPLE_FROM + 3]
    assert all(row[0] == "4" and row[7:] == ["-1"] * 3 for row in rows)


def test_mot_rows_are_split_between_lines_and_boxes_without_end_left_out():
    (whole,) = mot_lines(located(1, 100), None)
    parts = mot_lines(located(1, 100), None, most_bytes=512)
    assert b"".join(parts) == whole and len(parts) > 5
    assert all(len(part) <= 512 and part.endswith(b"\n") for part in parts)
    odd = replace(tracked().tracks, box_px=np.array([[1e300, 0, 1, 1], [np.nan, 0, 1, 1]]))
    assert mot_lines(FrameResult(replace(tracked(), tracks=odd)), None) == []


def test_events_one_by_one_are_those_of_the_file():
    events = CotEvents(ABOUT)
    sent = [message.decode() for k in range(25) for message in events(located(k + 1, 3))]
    kept = tracks([located(k + 1, 3).locations.positions for k in range(25)])
    still = replace(kept, velocity_m_s=np.tile((3.0, 4.0), (len(kept), 1)))
    assert sent == cot(still).splitlines(keepends=True)[2:-1]


def test_a_target_keeps_its_uid_when_the_clock_is_set_and_is_sent_at_once_when_it_is_set_back():
    about = replace(ABOUT)
    events = CotEvents(about)
    first = ElementTree.fromstring(events(located(30))[0])
    about.start_utc_s += 3600
    assert events(located(31)) == []
    later = ElementTree.fromstring(events(located(2))[0])
    assert first.get("uid") == later.get("uid") == "dddas-1600000000-1"
    assert str(later.get("time")).startswith("2020-09-13T13:26:40")


def test_memory_of_targets_does_not_grow_with_time():
    events = CotEvents(ABOUT)
    for k in range(1, 300):
        events(with_positions(located(k), target=np.array([k])))
    assert len(events._sent_s) <= 10


CAMERA = Camera("falcon & <co>", (640, 480), (600.0, 600.0), (319.5, 239.5))


def detail(event, name) -> Any:
    return event.find(name)


def own_events(events, frames):
    sent = [ElementTree.fromstring(message) for frame in frames for message in events(frame)]
    return [event for event in sent if str(event.get("uid")).endswith("-camera")]


def with_fix(frame, **changes):
    fix = replace(frame.locations.fix, **changes)
    return replace(frame, locations=replace(frame.locations, fix=fix))


def test_the_camera_tells_its_place_and_view_once_a_second():
    about = replace(ABOUT, camera=CAMERA, plane_above_ellipsoid_m=700.0)
    spread = np.diag([0.0, 0, 0, 4.0, 1.0, 8.0, 0])
    first, second, third = own_events(CotEvents(about), [with_fix(located(k), covariance=spread) for k in range(1, 30)])
    assert [str(event.get("time"))[17:] for event in (first, second, third)] == ["40.250Z", "41.250Z", "42.250Z"]
    assert first.get("type") == "a-f-A-M-F-Q" and detail(first, "detail/track") is None
    point, sensor = detail(first, "point").attrib, detail(first, "detail/sensor").attrib
    assert (point["hae"], point["ce"], point["le"]) == ("750.00", "2.00", "3.00")
    assert float(point["lat"]) == pytest.approx(32.23 - 5 / 110_900, abs=1e-6)
    wide, high = (f"{2 * math.degrees(math.atan(half / 600)):.1f}" for half in (320, 240))
    facing = ("0.0", "-90.0", "0.0", wide, high, "50")
    assert tuple(sensor[n] for n in ("azimuth", "elevation", "roll", "fov", "vfov", "range")) == facing
    assert sensor["model"] == detail(first, "detail/contact").get("callsign") == CAMERA.name


def test_a_camera_that_looks_forward_tells_its_heading_and_its_course_when_it_moved_farther_than_its_errors():
    east, down = np.array([0.0, -1.0, 0.0]), np.array([-0.5, 0.0, -math.sqrt(0.75)])
    axes = np.column_stack([east, down, np.cross(east, down)])
    spread = np.diag([0.0, 0, 0, 1.0, 1.0, 1.0, 0])

    def flown(k, m_s):
        pose = CameraPose(np.array([m_s * (k - 1) / 10, 0.0, 50.0]), axes)
        return with_fix(located(k), pose=pose, covariance=spread)

    for m_s, is_known in ((1.9, False), (2.1, True)):
        event = own_events(CotEvents(replace(ABOUT, camera=CAMERA)), [flown(k, m_s) for k in (1, 11)])[1]
        sensor, track = detail(event, "detail/sensor").attrib, detail(event, "detail/track")
        assert (sensor["azimuth"], sensor["elevation"], sensor["range"]) == ("90.0", "-30.0", "100")
        assert detail(event, "point").get("hae") == detail(event, "point").get("le") == "9999999.0"
        assert (track is not None) == is_known
        if track is not None:
            assert (track.get("course"), track.get("speed")) == ("90.0", "2.10")


def test_a_camera_without_a_pose_tells_no_place():
    events = CotEvents(replace(ABOUT, camera=CAMERA))
    assert own_events(events, [with_fix(located(1), pose=None)]) == []
    assert own_events(CotEvents(ABOUT), [located(1)]) == []


def test_targets_carry_the_camera_s_name_and_the_errors_of_course_and_speed():
    frame = located(1, 3)
    spread = np.array([np.diag([0.25, 0.25]), np.full((2, 2), np.nan)])  # the targets go 3 m/s east and 4 m/s north
    frame = replace(frame, locations=replace(frame.locations, velocity_covariance=spread))
    _, known, unknown = (ElementTree.fromstring(m) for m in CotEvents(replace(ABOUT, camera=CAMERA))(frame))
    track = detail(known, "detail/track").attrib
    course = f"{math.degrees(0.5 / 5):.1f}"
    assert track == {"course": "36.9", "speed": "5.00", "eCourse": course, "eSpeed": "0.50"}
    assert "eCourse" not in detail(unknown, "detail/track").attrib
    assert detail(known, "detail/contact").get("callsign") == "falcon & <co> target 1"
    assert known.get("uid") == "dddas-falcon & <co>-1600000000-1"
    plain = replace(ABOUT, camera=replace(CAMERA, given=frozenset()))  # no file names this camera
    assert ElementTree.fromstring(CotEvents(plain)(frame)[1]).get("uid") == "dddas-1600000000-1"


@pytest.mark.parametrize("lonlat", [(np.nan, 32.0), (np.inf, 32.0), (-110.0, 91.0), (1e300, 0.0)])
def test_a_place_that_is_none_on_earth_is_no_event(lonlat):
    assert CotEvents(ABOUT)(with_positions(located(1), lonlat_deg=np.array([lonlat]))) == []


def test_without_degrees_clock_or_ground_there_are_no_events():
    assert CotEvents(ABOUT)(located(1, origin=None)) == CotEvents(ABOUT)(located(1, on_ground=False)) == []
    assert CotEvents(About(geographic=True))(located(1)) == CotEvents(ABOUT)(None) == []
