"""`dddas run --zones`: events beside the other files, live too, and one line for each mistake."""

import json

import cv2
import pytest

from tests.cli.conftest import bad, names, record, rows
from tests.cli.test_run_live import FAST, FRAMES, session
from tests.synthetic_clip import render

RING = [[0.0, 0.0], [40, 0], [40, 30], [0, 30]]


def geojson(file, ring=None, **members):
    area = {"type": "Polygon", "coordinates": [ring or RING]}
    feature = {"type": "Feature", "properties": {"name": "door"}, "geometry": area}
    return file("zones.geojson", json.dumps({"type": "FeatureCollection", "features": [feature], **members}))


def test_zones_in_pixels_need_nothing_but_a_clip(dddas, clip, engine, file, tmp_path):
    out = tmp_path / "out"
    done = dddas("run", clip, "--zones", geojson(file, unit="px"), "--out", out, "--save", "report")
    assert done.exit_code == 0, done.output
    kept = record(out)
    assert kept["zones"]["door"]["present"] == kept["zones"]["door"]["targets"] == 1
    assert kept["zones_file"].endswith("zones.geojson")
    assert [row["event"] for row in rows(out / "events.csv")] == ["present"] and "events.jsonl" in names(out)
    assert rows(out / "summary.csv")[0]["zones"] == "door" and "events.csv" in done.stdout
    again = dddas("run", clip, "--out", out, "--save", "none")
    assert again.exit_code == 0 and "events.csv" not in names(out) and "summary.csv" in names(out)


@pytest.mark.parametrize(
    ("ring", "unit", "says"),
    [
        (None, "deg", "locates nothing"),
        ([RING[0], RING[2], RING[1], RING[3]], "px", "crosses itself"),
        (RING[:2], "px", "3 or more"),
    ],
)
def test_zones_that_cannot_be_used_are_one_line(dddas, clip, engine, file, tmp_path, ring, unit, says):
    out = tmp_path / "out"
    assert says in bad(dddas("run", clip, "--zones", geojson(file, ring, unit=unit), "--out", out, "--quiet"))
    assert not out.exists()
    assert says in bad(dddas("run", clip, *FAST, "--zones", tmp_path / "zones.geojson", "--out", out, "--quiet"))
    assert not out.exists()


def test_a_file_of_zones_that_is_not_there_is_one_line(dddas, clip, tmp_path):
    assert "cannot be read" in bad(dddas("run", clip, "--zones", tmp_path / "none.kml", "--out", tmp_path / "out"))
    assert "cannot be read" in bad(dddas("run", "sim:joining", "--zones", tmp_path / "none.kml"))


def test_live_events_are_in_the_lines_of_json_and_counted(dddas, file, tmp_path):
    (tmp_path / "clip").mkdir()
    for number, image in enumerate(render(0, FRAMES, (240, 180)).images, 1):
        cv2.imwrite(str(tmp_path / "clip" / f"{number:03d}.png"), image)
    zones = geojson(file, [[-1000.0, -1000], [1000, -1000], [1000, 1000], [-1000, 1000]], unit="px")
    done = dddas("run", tmp_path / "clip", *FAST, "--zones", zones, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    folder, kept, results = session(tmp_path / "out")
    events = [event for line in results for event in line.get("events", [])]
    assert events and {event["event"] for event in events} == {"present"}
    assert kept["zones"]["door"]["present"] == kept["zones"]["door"]["targets"] == len(events)
    assert "zone: target 1 is seen in door" in (folder / "events.log").read_text()
