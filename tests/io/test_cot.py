from datetime import datetime
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.io.ground import ORIGIN, positions, tracks
from torchvision_dddas.io.maps.cot import UNKNOWN, cot


def walk(count=25, **more):
    return [positions(k + 1, [[k, 0], [0, -k]], more.get("covariance", [[4, 0], [0, 1]])) for k in range(count)]


def events(found):
    return list(ElementTree.fromstring(cot(found)).iter("event"))


def test_a_target_gives_one_event_a_second_with_its_place_and_error():
    found = events(tracks(walk()))
    assert [e.get("uid") for e in found] == ["dddas-1600000000-1", "dddas-1600000000-2"] * 3
    one = found[0]
    assert (one.get("version"), one.get("type"), one.get("how")) == ("2.0", "a-u-G", "m-f")
    point = one.find("point")
    assert point is not None
    assert (float(point.get("lon", "")), float(point.get("lat", ""))) == pytest.approx(ORIGIN)
    assert (point.get("ce"), point.get("hae"), point.get("le")) == ("2.00", UNKNOWN, UNKNOWN)
    track = one.find("detail/track")
    assert track is not None and (track.get("course"), track.get("speed")) == ("0.0", "2.00")


def test_events_are_at_least_a_second_apart_and_believed_until_after_the_next():
    times: dict[str | None, list[float]] = {}
    for event in events(tracks(walk(38))):
        at, start, stale = (
            datetime.fromisoformat(event.get(name, "")).timestamp() for name in ("time", "start", "stale")
        )
        assert at == start and stale > at + 1
        times.setdefault(event.get("uid"), []).append(at)
    assert len(times) == 2
    assert all(np.diff(own).min() >= 0.999 and len(own) == 4 for own in times.values())


def test_an_unknown_error_is_said_to_be_unknown():
    point = events(tracks(walk(1, covariance=np.full((2, 2), np.nan))))[0].find("point")
    assert point is not None and point.get("ce") == UNKNOWN


@pytest.mark.parametrize("found", [tracks(walk(), start_utc_s=float("nan")), tracks(walk(), timed=False)])
def test_without_a_clock_there_are_no_events(found):
    with pytest.raises(ValueError, match="no clock"):
        cot(found)


def test_no_positions_are_a_valid_file():
    assert events(tracks([])) == []
