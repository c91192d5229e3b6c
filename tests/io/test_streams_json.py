"""Frames as lines of JSON, and the page that documents them."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from torchvision_dddas.io.streams.json_lines import json_lines

from tests.io.streamed import ABOUT, NAMES, followed, surveyed
from torchvision_dddas.io.streams import About
from torchvision_dddas.types import Adjustment, FrameResult, TrackedFrame, Tracks

PAGE = Path(__file__).parents[2] / "docs" / "stream.md"

anything = st.floats(allow_nan=True, allow_infinity=True)


def strict(line):
    """As a reader takes it that knows no NaN."""

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(line, parse_constant=refuse)


def one(*given, **rest):
    (line,) = json_lines(*given, **rest)
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    return strict(line)


def example():
    """The frame of the page: a crowd that was located, and a person."""
    moved = Adjustment(41, "interval_frames", 1.0, 2.0, "background flow 0.4 px a frame")
    found = surveyed(42, targets=2, rate=30.0)
    assert found.locations is not None
    near = replace(found.locations.marks, image_px=np.array([[40.0, 30], [120, 50], [99, 99], [7, 7]]))
    states = ("used", "excluded", "used", "used")
    fix = replace(found.locations.fix, state=states, changes=("bravo excluded: 9.1 px off",))
    marks = replace(near, **{name: getattr(near, name)[:2] for name in ("landmark", "image_px", "east_north_m")})
    ground = replace(found.locations, marks=marks, fix=fix)
    found = replace(found, locations=ground, tracked=replace(found.tracked, adjustments=(moved,)))
    return json_lines(found, followed(42, 0, kind="person", rate=30.0), ABOUT, 0.0612)[0].decode()


def test_the_line_of_the_page_is_what_is_sent():
    shown = re.search(r"```json\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert shown is not None and shown[1] == example()


def test_the_page_names_every_field_and_no_other():
    rows = [row.split("|")[1] for row in PAGE.read_text(encoding="utf-8").splitlines() if row.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`([a-z][a-z0-9_.\[\]]*)`", row)}
    sent = set()
    lines = [*json_lines(surveyed(1, 2), followed(1), ABOUT, most_bytes=512)]
    lines += [example().encode()]
    for fields in map(strict, lines):
        sent |= set(fields)
        sent |= {f"targets[].{name}" for row in fields["targets"] for name in row}
        ground = fields.get("ground") or {}
        sent |= {f"ground.{name}" for name in ground}
    assert {name for name in sent if not name.startswith(("ground.landmarks", "adjustments"))} <= named
    first = {row.split("`")[1] for row in PAGE.read_text(encoding="utf-8").splitlines() if row.startswith("| `")}
    assert {name for name in first if re.fullmatch(r"[a-z]+_?[a-z]*|targets\[\]\..*|ground\.[a-z_]*", name)} <= sent


def test_a_target_has_its_identity_its_box_and_its_place():
    fields = one(surveyed(3), None, ABOUT)
    assert (fields["frame"], fields["time_s"], fields["utc"]) == (3, 0.2, "2020-09-13T12:26:40.450Z")
    located, bridge, loose = fields["targets"]
    assert located == {
        "id": 1,
        "kind": "moving",
        "seen": True,
        "box_px": [10, 20, 30, 40],
        "score": 0.875,
        "heading_deg": 0.0,
        "speed_px_per_frame": 1.5,
        "east_north_m": [0, 0],
        "covariance_m2": [1, 0, 1],
        "velocity_m_s": [3, 4],
        "lonlat_deg": [-110.95, 32.23],
        "confirmed": "human",
        "human": 0.75,
    }
    assert bridge == {"id": 2, "kind": "moving", "seen": False, "box_px": [20, 20, 30, 40], "score": 0.875}
    assert (loose["id"], loose["heading_deg"], loose["seen"]) == (None, None, True)
    assert [mark["name"] for mark in fields["ground"]["landmarks"]] == list(NAMES)


def test_what_was_not_looked_for_is_null_and_what_was_not_found_is_empty():
    fields = one(surveyed(1, 0, on_ground=False), None, About())
    assert (fields["people"], fields["ground"], fields["utc"]) == (None, None, None)
    nothing = FrameResult(
        TrackedFrame(5, None, followed(1, 0).detections, Tracks(5), cause="the picture cannot be read")
    )
    fields = one(nothing, None, ABOUT)
    assert (fields["time_s"], fields["utc"], fields["cause"]) == (None, None, "the picture cannot be read")
    assert one(None, followed(1, 1, kind="person"), ABOUT)["targets"] is None
    nobody = replace(followed(1, 0), detections=type(followed().detections)())
    assert one(None, nobody, ABOUT)["people"] == []


def test_targets_and_people_of_different_frames_are_lines_of_their_own():
    told = [strict(line) for line in json_lines(surveyed(7), followed(5, kind="person"), ABOUT)]
    assert [(t["frame"], t["targets"] is None, t["people"] is None) for t in told] == [
        (7, False, True),
        (5, True, False),
    ]
    assert {row["kind"] for row in told[1]["people"]} == {"person"}


def test_without_degrees_there_are_metres_only():
    fields = one(surveyed(1, origin=None), None, ABOUT)
    assert "lonlat_deg" not in fields["targets"][0] and fields["targets"][0]["east_north_m"] == [0, 0]


@settings(deadline=None)
@given(
    st.lists(anything, min_size=12, max_size=12),
    st.floats(allow_nan=True, allow_infinity=True),
    st.text(max_size=20),
    st.text(alphabet=st.characters(codec=None), max_size=8),
)
def test_whatever_the_numbers_and_names_a_line_is_one_line_of_strict_json(values, start, cause, name):
    a, b, c, d, *rest = values
    found = surveyed(1)
    assert found.locations is not None
    tracks = found.tracked.tracks
    own = replace(
        found.tracked,
        cause=cause,
        tracks=replace(tracks, box_px=np.array([[a, b, c, d]] * 2), score=np.array([a, b])),
        adjustments=(Adjustment(1, "track.gate", c, d, cause),),
    )
    at = found.locations.positions
    places = replace(
        at,
        east_north_m=np.array([rest[:2]]),
        covariance_m2=np.array(rest[2:6]).reshape(1, 2, 2),
        lonlat_deg=np.array([rest[6:8]]),
    )
    ground = replace(found.locations, positions=places, velocity_m_s=np.array([[a, d]]))
    fields = one(
        replace(found, tracked=own, locations=ground), None, replace(ABOUT, start_utc_s=start, landmarks=(name,) * 4), b
    )
    assert fields["cause"] == cause
    assert fields["ground"]["landmarks"][0]["name"] == name
    assert fields["targets"][0]["box_px"] == pytest.approx([a, b, c, d], abs=0.006) or not all(
        map(math.isfinite, (a, b, c, d))
    )


def test_a_frame_too_long_for_a_datagram_is_told_in_parts_that_fit():
    whole = one(surveyed(1, 300), followed(1, 40, kind="person"), ABOUT)
    lines = json_lines(surveyed(1, 300), followed(1, 40, kind="person"), ABOUT, most_bytes=1400)
    parts = [strict(line) for line in lines]
    assert max(map(len, lines)) <= 1400 and len(lines) > 10
    assert [(part["part"], part["parts"]) for part in parts] == [(k + 1, len(parts)) for k in range(len(parts))]
    for name in ("targets", "people"):
        assert [row for part in parts for row in part[name]] == whole[name]
    assert parts[0]["ground"] == whole["ground"] and all("ground" not in part for part in parts[1:])
    assert all(part["frame"] == 1 and part["utc"] == whole["utc"] for part in parts)


def test_a_frame_that_fits_is_told_in_one_line():
    line = json_lines(surveyed(1), None, ABOUT)[0]
    assert json_lines(surveyed(1), None, ABOUT, most_bytes=len(line)) == [line]
    assert "part" not in strict(line)
