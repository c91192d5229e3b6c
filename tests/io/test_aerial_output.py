import csv
import json
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from tests.io.ground import NAMES, ORIGIN, START, grounded
from torchvision_dddas import geometry
from torchvision_dddas.geo.projection import axes_of
from torchvision_dddas.io.ground_tables import read_positions
from torchvision_dddas.io.output import AerialRecorder, Site
from torchvision_dddas.io.output.tables import angles_deg, upper_edge_deg
from torchvision_dddas.types import Adjustment, CameraPose

ALL = {
    "positions.csv",
    "fixes.csv",
    "tracks.geojson",
    "tracks.kml",
    "tracks.cot.xml",
    "map.png",
    "report.html",
    "run.json",
}
GOOD = [grounded(k) for k in range(1, 13)]


def run(folder, frames=GOOD, origin=ORIGIN, start=START, save=("cot", "map", "report"), fail=None, **more):
    with AerialRecorder(folder, save) as output:
        output.begin({"input": "clip.mp4", "settings": {}}, Site(NAMES, origin, start, 10.0, **more))
        for frame in frames:
            output.write(frame)
        if fail is not None:
            raise fail
    return json.loads((folder / "run.json").read_text())


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_the_table_of_positions_is_read_back(tmp_path):
    run(tmp_path)
    found = read_positions(tmp_path / "positions.csv")
    assert len(found) == 24 and found.frame[-1] == 12 and found.target[:2].tolist() == [1, 2]
    assert np.allclose(found.east_north_m[:2], [[1, 2], [3, 4]], atol=1e-4)
    assert np.allclose(found.covariance_m2[0], np.eye(2), atol=1e-4) and (found.score == 0.75).all()
    assert found.lonlat_deg is not None
    assert np.abs(geometry.east_north(found.lonlat_deg, ORIGIN) - found.east_north_m).max() < 1e-3


def test_the_table_of_positions_says_more_than_places(tmp_path):
    run(tmp_path)
    one = rows(tmp_path / "positions.csv")[2]
    assert (one["time_s"], one["by"], one["landmarks"]) == ("0.1000", "pose", "4")
    assert float(one["relative_sigma_m"]) == pytest.approx(np.sqrt(0.5), abs=1e-4)
    assert (one["velocity_east_m_s"], one["velocity_north_m_s"]) == ("3.0000", "4.0000")


def test_small_covariances_are_read_back_as_they_are(tmp_path):
    small = np.array([[3.2e-5, 1.7e-5], [1.7e-5, 2.1e-5]])
    run(tmp_path, [grounded(1, covariance=small)])
    assert np.allclose(read_positions(tmp_path / "positions.csv").covariance_m2, small, rtol=1e-5)


def test_what_is_unknown_is_an_empty_cell_and_is_read_back_as_unknown(tmp_path):
    unknown = grounded(1, covariance=np.full((2, 2), np.nan), origin=None)
    unknown.velocity_m_s[:] = np.nan
    run(tmp_path, [unknown], origin=None)
    one = rows(tmp_path / "positions.csv")[0]
    assert [name for name, value in one.items() if value == ""] == [
        *("var_east_m2", "cov_east_north_m2", "var_north_m2"),
        *("relative_sigma_m", "velocity_east_m_s", "velocity_north_m_s"),
    ]
    assert np.isnan(read_positions(tmp_path / "positions.csv").covariance_m2).all()


def test_every_frame_has_a_line_of_how_it_lies_on_the_ground(tmp_path):
    gap = grounded(13, by="", states=(), cause='no landmark, and "nothing" else')
    swapped = grounded(
        14,
        states=("reassigned", "reassigned", "used", "excluded"),
        changes=("a, b swapped", "d is out"),
        chi2=3.5,
        freedom=5,
    )
    run(tmp_path, [*GOOD, gap, swapped])
    found = rows(tmp_path / "fixes.csv")
    assert [int(row["frame"]) for row in found] == list(range(1, 15))
    assert [found[0][name] for name in ("east_m", "up_m", "heading_deg", "pitch_deg", "roll_deg", "focal")] == [
        *("0.1000", "50.0000", "0.0000", "90.0000", "0.0000", "1.000000"),
    ]
    assert (found[12]["by"], found[12]["cause"], found[12]["up_m"]) == ("", 'no landmark, and "nothing" else', "")
    assert (found[13]["landmarks_seen"], found[13]["landmarks_used"]) == ("4", "3")
    assert (found[13]["chi2"], found[13]["freedom"], found[13]["changes"]) == ("3.500", "5", "a, b swapped; d is out")


@pytest.mark.parametrize("angles", [(30, 20, 5), (359.99999, 80, -170), (200, -40, 90), (77, 90, 0), (5, -90, 0)])
def test_the_angles_are_those_that_the_axes_were_made_of(angles):
    found = angles_deg(CameraPose(np.zeros(3), axes_of(*np.radians(angles))))
    assert np.allclose((np.array(found) - angles + 180) % 360, 180, atol=1e-3)
    assert 0 <= found[0] < 360


@pytest.mark.parametrize("tilt", [(30, 90, 0), (30, 89.99, 0), (200, 89.99, 170), (0, 90, 30)])
def test_the_bearing_of_the_upper_edge_is_steady_straight_down(tilt):
    heading, pitch, roll = tilt
    edge = upper_edge_deg(CameraPose(np.zeros(3), axes_of(*np.radians((heading, pitch, roll)))))
    assert edge == pytest.approx((heading + roll) % 360, abs=0.02)
    assert upper_edge_deg(CameraPose(np.zeros(3), axes_of(*np.radians((heading, 40, 0))))) == pytest.approx(heading)
    assert np.isnan(upper_edge_deg(CameraPose(np.zeros(3), axes_of(0.0, 0.0, 0.0))))


def test_all_files_are_there_and_valid(tmp_path):
    record = run(tmp_path)
    assert names(tmp_path) == ALL and record["state"] == "complete" and record["notes"] == []
    assert len(json.loads((tmp_path / "tracks.geojson").read_text())["features"]) == 2 + 2 * 3
    for name in ("tracks.kml", "tracks.cot.xml"):
        assert len(ElementTree.parse(tmp_path / name).getroot()) > 0
    picture = cv2.imread(str(tmp_path / "map.png"))
    assert picture is not None and picture.shape[1] == 1400


def test_landmarks_are_on_the_maps_where_their_degrees_can_be_told(tmp_path):
    run(tmp_path, to_degrees=lambda metres: geometry.lonlat(metres, ORIGIN))
    features = json.loads((tmp_path / "tracks.geojson").read_text())["features"]
    marked = {
        f["properties"]["landmark"]: f["geometry"]["coordinates"] for f in features if "landmark" in f["properties"]
    }
    assert list(marked) == list(NAMES)
    assert np.allclose(geometry.east_north(np.array(marked["alpha"]), ORIGIN), (-20, -20), atol=1e-2)
    assert "delta &amp; &lt;co&gt;" in (tmp_path / "tracks.kml").read_text()


def test_without_degrees_or_a_clock_the_maps_that_need_them_are_left_out_and_it_is_said(tmp_path):
    local = run(tmp_path / "local", [grounded(k, origin=None) for k in (1, 2)], origin=None)
    assert names(tmp_path / "local") == ALL - {"tracks.geojson", "tracks.kml", "tracks.cot.xml"}
    assert "no longitude and latitude" in local["notes"][0]
    unclocked = run(tmp_path / "unclocked", start=float("nan"))
    assert names(tmp_path / "unclocked") == ALL - {"tracks.cot.xml"}
    assert "no clock" in unclocked["notes"][0] and "no clock" in (tmp_path / "unclocked/report.html").read_text()


def test_what_is_not_to_be_saved_is_not(tmp_path):
    run(tmp_path, save=())
    assert names(tmp_path) == ALL - {"tracks.cot.xml", "map.png", "report.html"}


def test_maps_of_an_earlier_run_go_where_this_one_makes_none(tmp_path):
    run(tmp_path)
    run(tmp_path, save=("map",), start=float("nan"))
    assert names(tmp_path) == ALL - {"tracks.cot.xml", "report.html"}


def test_the_record_counts_by_what_frames_were_located_and_says_what_went_wrong(tmp_path):
    line = Adjustment(3, "landmarks.wanted", 4.0, 6.0, "detected <poorly>")
    frames = [
        grounded(1),
        grounded(2, by="telemetry", states=("excluded",) * 4, cause="2 of 4 landmarks"),
        grounded(3, by="telemetry", states=("excluded",) * 4, cause="1 of 4 landmarks", adjustments=(line,)),
        grounded(4, by="", states=(), cause="nothing in view"),
        grounded(5, by="", states=(), cause="nothing in view"),
        grounded(6, states=("reassigned", "reassigned", "used", "used"), changes=("swapped: chi2 81 for 8",)),
        grounded(7, states=("reassigned", "reassigned", "used", "used"), changes=("swapped: chi2 92 for 8",)),
        grounded(9, changes=("swapped: chi2 92 for 8",)),
    ]
    record = run(tmp_path, frames)
    assert record["by"] == {"pose": 4, "homography": 0, "paper": 0, "telemetry": 2, "nothing": 2}
    assert record["positions"] == 12 and record["targets"] == 16 and record["frames"] == {"written": 8, "unreliable": 2}
    assert record["unreliable"] == [{"first": 4, "last": 5, "cause": "nothing in view"}]
    assert record["weak"] == [{"first": 2, "last": 3, "by": "telemetry", "cause": "2 of 4 landmarks"}]
    assert record["repairs"] == [{"first": 6, "last": 9, "cause": "swapped: chi2 81 for 8"}]
    assert record["landmarks"]["alpha"] == {
        "seen": 6,
        "used": 4,
        "left_out": 2,
        "reassigned": [[6, 7]],
        "excluded": [[2, 3]],
    }
    text = (tmp_path / "report.html").read_text()
    for words in ("4 to 5", "nothing in view", "2 of 4 landmarks", "swapped: chi2 81 for 8", "detected &lt;poorly&gt;"):
        assert words in text


@pytest.mark.parametrize("frames", [[], [grounded(1, by="", states=(), cause="nothing in view")]])
def test_a_run_that_located_nothing_is_valid(tmp_path, frames):
    run(tmp_path, frames)
    assert names(tmp_path) == ALL
    assert len(read_positions(tmp_path / "positions.csv")) == 0
    assert json.loads((tmp_path / "tracks.geojson").read_text())["features"] == []
