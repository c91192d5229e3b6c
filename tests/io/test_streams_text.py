"""Rows of MOT text and Cursor-on-Target events."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.io.ground import tracks
from tests.io.streamed import ABOUT, followed, surveyed
from torchvision_dddas.io.maps.cot import cot
from torchvision_dddas.io.streams.tool_messages import PEOPLE_FROM, CotEvents, mot_rows


def test_people_have_rows_of_their_own_with_identities_that_no_target_has():
    (message,) = mot_rows(surveyed(4), followed(4, 3, kind="person"))
    rows = [row.split(",") for row in message.decode().splitlines()]
    assert [int(row[1]) for row in rows] == [1, 2, PEOPLE_FROM + 1, PEOPLE_FROM + 2, PEOPLE_FROM + 3]
    assert all(row[0] == "4" and row[7:] == ["-1"] * 3 for row in rows)


def test_rows_that_need_several_datagrams_are_cut_between_lines():
    whole = mot_rows(surveyed(1, 100), None)[0]
    parts = mot_rows(surveyed(1, 100), None, most_bytes=512)
    assert b"".join(parts) == whole and len(parts) > 5
    assert all(len(part) <= 512 and part.endswith(b"\n") for part in parts)


def test_a_box_without_end_is_no_row_and_a_frame_without_boxes_no_message():
    found = surveyed(1)
    boxes = np.array([[1e300, 0, 1, 1], [np.nan, 0, 1, 1]])
    odd = replace(found.tracked, tracks=replace(found.tracked.tracks, box_px=boxes))
    assert mot_rows(replace(found, tracked=odd), None) == []


def walk(events, count=25, targets=3):
    return [message.decode() for k in range(count) for message in events(surveyed(k + 1, targets))]


def test_events_that_come_one_by_one_are_those_of_the_file():
    frames = [surveyed(k + 1, 3).locations for k in range(25)]
    kept = tracks([f.positions for f in frames if f is not None])
    still = replace(kept, velocity_m_s=np.tile((3.0, 4.0), (len(kept), 1)))
    assert walk(CotEvents(ABOUT)) == cot(still).splitlines(keepends=True)[2:-1]


def test_a_target_keeps_its_name_when_the_clock_is_set_and_is_told_at_once_when_it_is_set_back():
    about = replace(ABOUT)
    events = CotEvents(about)
    first = ElementTree.fromstring(events(surveyed(30))[0])
    about.start_utc_s += 3600
    assert events(surveyed(31)) == []
    later = ElementTree.fromstring(events(surveyed(2))[0])
    assert first.get("uid") == later.get("uid") == "dddas-1600000000-1"
    assert (later.get("time") or "").startswith("2020-09-13T13:26:40")


def test_what_is_remembered_of_targets_does_not_grow_with_time():
    events = CotEvents(ABOUT)
    for k in range(1, 300):
        found = surveyed(k)
        assert found.locations is not None
        at = replace(found.locations.positions, target=np.array([k]))
        events(replace(found, locations=replace(found.locations, positions=at)))
    assert len(events._sent_s) <= 10


@pytest.mark.parametrize("lonlat", [(np.nan, 32.0), (np.inf, 32.0), (-110.0, 91.0), (1e300, 0.0)])
def test_a_place_that_is_none_on_earth_is_no_event(lonlat):
    found = surveyed(1)
    assert found.locations is not None
    at = replace(found.locations.positions, lonlat_deg=np.array([lonlat]))
    assert CotEvents(ABOUT)(replace(found, locations=replace(found.locations, positions=at))) == []


def test_a_name_with_odd_characters_leaves_the_event_whole():
    about = replace(ABOUT, source='a"<b>&\x07\ud800é')
    event = ElementTree.fromstring(CotEvents(about)(surveyed(1))[0])
    assert event.get("uid") == 'a"<b>&é-1600000000-1'


def test_without_degrees_clock_or_ground_there_are_no_events():
    assert CotEvents(ABOUT)(surveyed(1, origin=None)) == []
    assert CotEvents(ABOUT)(surveyed(1, on_ground=False)) == []
    assert CotEvents(replace(ABOUT, start_utc_s=float("nan")))(surveyed(1)) == []
    assert CotEvents(ABOUT)(None) == []
