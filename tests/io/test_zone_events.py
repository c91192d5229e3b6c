"""The files of events and summaries: the same content in each, and figures that agree with the truth."""

import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.cli.conftest import record, rows
from tests.zoned import ORIGIN, walk
from torchvision_dddas.geo import Zones
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.io.output import MapSite, PipelineRecorder
from torchvision_dddas.io.overlay import RunPictures
from torchvision_dddas.io.streams.messages import About, json_lines
from torchvision_dddas.types import Camera

SQUARE = np.array([[0.0, 0.0], [4, 0], [4, 4], [0, 4]])
CAMERA = Camera("uav", (320, 240), (300.0, 300.0), (159.5, 119.5))
START_S = 1.7e9


def recorded(folder, zones, results, site=MapSite((), ORIGIN, START_S, camera=CAMERA), save=("report", "map")):  # noqa: B008
    with PipelineRecorder(folder, save) as output:
        output.begin({"input": "clip"}, 5.0, (320, 240), site, zones.zones if zones else ())
        for result in zones.mark(results) if zones else results:
            output.write(result)
    return record(folder)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    zones = Zones(
        polygons={"field": lonlat(SQUARE, ORIGIN), "far": lonlat(SQUARE + 500, ORIGIN)},
        lines={"gate": lonlat(np.array([[2.0, -5], [2, 8]]), ORIGIN)},
        dwell_s=3,
    )
    ways = (lambda t: (-3 + t, 2.0)), (lambda t: (6 - 1.5 * t, 1.0)), (lambda t: (1.0, 7.0))
    recorded(folder, zones, walk(*ways, labels={1: "person"}, noise_m=0.05))
    return folder


def test_events_are_the_same_in_all_files(folder):
    table = rows(folder / "events.csv")
    lines = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    features = json.loads((folder / "events.geojson").read_text())["features"]
    assert [f["geometry"]["type"] for f in features[:3]] == ["Polygon", "Polygon", "MultiLineString"]
    points = [{**f["properties"], "at": f["geometry"]["coordinates"]} for f in features[3:]]
    assert len(table) == len(lines) == len(points) == 7
    for row, line, point in zip(table, lines, points, strict=True):
        assert row["event"] == line["event"] == point["event"] and row["utc"] == line["utc"]
        assert float(row["longitude_deg"]) == line["longitude_deg"] == point["at"][0]
        assert row["class"] == (line["class"] or "")
    enter = next(line for line in lines if line["event"] == "enter" and line["target"] == 1)
    assert enter["time_s"] == pytest.approx(3, abs=0.15) and enter["utc"].startswith("2023-11-14T22:13:2")
    assert enter["class"] == "person" and enter["speed_px_s"] is None and enter["inside_s"] is None


def test_events_are_marks_of_cursor_on_target(folder):
    text = (folder / "events.cot.xml").read_text()
    marks = ElementTree.fromstring(text.encode()).findall("event")
    assert len(marks) == 7 and len({mark.get("uid") for mark in marks}) == 7
    assert {mark.get("type") for mark in marks} == {"b-m-p-s-m"}
    names = [contact.get("callsign", "") for mark in marks for contact in mark.iter("contact")]
    assert any(name.startswith("target 1 enters field at") for name in names)


def test_the_record_the_log_and_the_report_count_zones(folder):
    kept = record(folder)
    field = kept["zones"]["field"]
    assert (field["targets"], field["classes"]) == (2, {"person": 1, "unknown": 1})
    assert (field["enter"], field["leave"], field["present"], field["dwell"]) == (2, 2, 0, 1)
    assert (kept["zones"]["gate"]["to_right"], kept["zones"]["gate"]["to_left"]) == (1, 1)
    (note,) = [note for note in kept["notes"] if "in no located picture" in note]
    assert note.startswith("far is") and "710 m" in note
    page = (folder / "report.html").read_text()
    assert "Events by place" in page and "target 1 enters field" in page
    assert "zone      target 1 enters field" in (folder / "log.txt").read_text()


def test_the_summary_has_way_and_speed_of_each_target(folder):
    one, other, still = rows(folder / "summary.csv")
    assert float(one["path_m"]) == pytest.approx(11.8, abs=1.3)
    assert float(one["mean_speed_m_s"]) == pytest.approx(1.0, abs=0.05)
    assert float(other["mean_speed_m_s"]) == pytest.approx(1.5, abs=0.05)
    assert float(one["top_speed_m_s"]) == pytest.approx(1, abs=4 * float(one["top_speed_sigma_m_s"]))
    assert (one["class"], one["zones"], still["zones"]) == ("person", "field;gate", "")
    assert float(still["path_m"]) < 0.5 and (one["frames"], one["first_frame"], one["last_frame"]) == ("60", "1", "60")
    assert float(one["last_east_m"]) == pytest.approx(8.8, abs=0.3) and one["first_utc"] == "2023-11-14T22:13:20.000Z"


def test_a_run_that_locates_nothing_has_a_summary_and_events_in_pixels(tmp_path):
    zones = Zones(polygons={"door": SQUARE * (10, -10) + (0, 200)}, unit="px")
    kept = recorded(tmp_path, zones, walk(lambda t: (-3 + t, 2.0), located=False), site=None)
    assert kept["zones"]["door"]["enter"] == 1 and not (tmp_path / "events.geojson").exists()
    (row,) = rows(tmp_path / "summary.csv")
    assert (row["path_m"], row["first_east_m"], row["zones"]) == ("", "", "door") and float(row["first_u_px"]) == -30
    recorded(tmp_path, None, walk(lambda t: (-3 + t, 2.0), located=False), site=None)
    assert not (tmp_path / "events.csv").exists() and rows(tmp_path / "summary.csv")[0]["zones"] == ""


def test_pictures_show_zones_in_pixels_and_no_others():
    (result,) = walk(lambda t: (20.0, -3.0), seconds=0.2, located=False)
    in_px, in_m = (Zones(polygons=[SQUARE * 20 + 50], unit=unit).zones for unit in ("px", "m"))
    plain = RunPictures((320, 240))(result)
    np.testing.assert_array_equal(RunPictures((320, 240), zones=in_m)(result), plain)
    changed = (RunPictures((320, 240), zones=in_px)(result) != plain).any(axis=2)
    assert changed[130, 80] and changed[80, 50] and not changed[90, 90]


def test_lines_of_json_hold_the_events_of_their_frame():
    zones, found = Zones(polygons=[SQUARE], unit="m"), []
    for result in walk(lambda t: (-3 + t, 2.0)):
        marked = replace(result, events=tuple(zones.update(result)))
        (line,) = json_lines(About(START_S, True), marked, None)
        found += json.loads(line).get("events", [])
    assert [event["event"] for event in found] == ["enter", "leave"] and found[0]["zone"] == "zone 1"
