"""What a run that locates targets from the air leaves in its folder."""

import json
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from tests.cli.conftest import names, record, rows
from tests.io.ground import NAMES, ORIGIN, START, grounded
from torchvision_dddas import geometry
from torchvision_dddas.geometry.projection import axes_of
from torchvision_dddas.io.ground_tables import read_positions
from torchvision_dddas.io.output import AerialRecorder, MapSite
from torchvision_dddas.io.output.tables import angles_deg, upper_edge_deg
from torchvision_dddas.types import Adjustment, CameraPose, Ortho

TABLES = {"positions.csv", "fixes.csv", "run.json"}
COT, GEOJSON, ELLIPSES, KML = "tracks.cot.xml", "tracks.geojson", "ellipses.geojson", "tracks.kml"
ALL = {*TABLES, GEOJSON, ELLIPSES, KML, COT, "map.png", "report.html"}
GOOD = [grounded(k) for k in range(1, 13)]


def run(folder, frames=GOOD, origin=ORIGIN, start=START, save=("cot", "map", "report"), **site):
    with AerialRecorder(folder, save) as output:
        output.begin({"input": "clip.mp4", "settings": {}}, MapSite(NAMES, origin, start, 10.0, **site))
        for frame in frames:
            output.write(frame)
    return record(folder)


def test_the_table_of_positions_is_read_back_and_says_more_than_places(tmp_path):
    run(tmp_path)
    found = read_positions(tmp_path / "positions.csv")
    assert len(found) == 24 and found.frame[-1] == 12 and found.target[:2].tolist() == [1, 2]
    assert np.allclose(found.east_north_m[:2], [[1, 2], [3, 4]], atol=1e-4)
    assert np.allclose(found.covariance_m2[0], np.eye(2), atol=1e-4) and (found.score == 0.75).all()
    assert found.lonlat_deg is not None
    assert np.abs(geometry.east_north(found.lonlat_deg, ORIGIN) - found.east_north_m).max() < 1e-3
    one = rows(tmp_path / "positions.csv")[2]
    assert (one["time_s"], one["by"], one["landmarks"]) == ("0.1000", "pose", "4")
    assert float(one["relative_sigma_m"]) == pytest.approx(np.sqrt(0.5), abs=1e-4)
    assert (one["velocity_east_m_s"], one["velocity_north_m_s"]) == ("3.0000", "4.0000")


def test_small_covariances_are_read_back_as_they_are_and_unknown_cells_as_unknown(tmp_path):
    small = np.array([[3.2e-5, 1.7e-5], [1.7e-5, 2.1e-5]])
    run(tmp_path, [grounded(1, covariance=small)])
    assert np.allclose(read_positions(tmp_path / "positions.csv").covariance_m2, small, rtol=1e-5)
    unknown = grounded(1, covariance=np.full((2, 2), np.nan), origin=None)
    unknown.velocity_m_s[:] = np.nan
    run(tmp_path, [unknown], origin=None)
    assert [name for name, value in rows(tmp_path / "positions.csv")[0].items() if value == ""] == [
        *("var_east_m2", "cov_east_north_m2", "var_north_m2"),
        *("relative_sigma_m", "velocity_east_m_s", "velocity_north_m_s"),
        *("class", "class_id", "above_sea_m", "above_ellipsoid_m", "circular_error90_m", "error_category"),
    ]
    assert np.isnan(read_positions(tmp_path / "positions.csv").covariance_m2).all()


def test_every_frame_has_a_line_of_how_it_was_located(tmp_path):
    gap = grounded(2, by="", states=(), cause='no landmark, and "nothing" else')
    states = ("reassigned", "reassigned", "used", "excluded")
    swapped = grounded(3, states=states, changes=("a, b swapped", "d is out"), chi2=3.5, freedom=5)
    run(tmp_path, [grounded(1), gap, swapped])
    found = rows(tmp_path / "fixes.csv")
    assert [int(row["frame"]) for row in found] == [1, 2, 3]
    pose = [found[0][name] for name in ("east_m", "up_m", "heading_deg", "pitch_deg", "roll_deg", "focal")]
    assert pose == ["0.1000", "50.0000", "0.0000", "90.0000", "0.0000", "1.000000"]
    assert (found[1]["by"], found[1]["cause"], found[1]["up_m"]) == ("", 'no landmark, and "nothing" else', "")
    assert (found[2]["landmarks_seen"], found[2]["landmarks_used"]) == ("4", "3")
    assert (found[2]["chi2"], found[2]["freedom"], found[2]["changes"]) == ("3.500", "5", "a, b swapped; d is out")


@pytest.mark.parametrize("angles", [(30, 20, 5), (359.99999, 80, -170), (200, -40, 90), (77, 90, 0), (5, -90, 0)])
def test_the_angles_are_those_that_the_axes_were_made_of(angles):
    found = angles_deg(CameraPose(np.zeros(3), axes_of(*np.radians(angles))))
    assert np.allclose((np.array(found) - angles + 180) % 360, 180, atol=1e-3)
    assert 0 <= found[0] < 360


@pytest.mark.parametrize(
    ("tilt", "edge"),
    [((30, 90, 0), 30), ((200, 89.99, 170), 10), ((0, 90, 30), 30), ((77, 40, 0), 77), ((0, 0, 0), np.nan)],
)
def test_the_bearing_of_the_upper_edge_is_steady_straight_down(tilt, edge):
    found = upper_edge_deg(CameraPose(np.zeros(3), axes_of(*np.radians(tilt))))
    assert found == pytest.approx(edge, abs=0.02, nan_ok=True)


def test_all_files_are_there_and_valid(tmp_path):
    noise = np.random.default_rng(1).integers(0, 256, (400, 600, 3), np.uint8)
    photo = Ortho(noise, np.array([[0.1, 0, -30.0], [0, -0.1, 20.0]]))
    kept = run(tmp_path, to_degrees=lambda metres: geometry.lonlat(metres, ORIGIN), background=photo)
    assert set(names(tmp_path)) == ALL and kept["state"] == "complete" and kept["notes"] == []
    layers = [json.loads((tmp_path / name).read_text()) for name in (GEOJSON, ELLIPSES)]
    assert [layer["name"] for layer in layers] == ["tracks", "ellipses"] and len(layers[1]["features"]) == 2 * 3
    found = [feature["properties"] for feature in layers[0]["features"]]
    assert len(found) == 2 + 4 and [p["landmark"] for p in found if "landmark" in p] == list(NAMES)
    assert "delta &amp; &lt;co&gt;" in (tmp_path / KML).read_text()
    assert all(len(ElementTree.parse(tmp_path / name).getroot()) > 0 for name in (KML, COT))
    picture = cv2.imread(str(tmp_path / "map.png"))
    assert picture is not None and picture.shape[1] == 1400
    text = (tmp_path / "report.html").read_text()
    assert "data:image/jpeg" in text and "data:image/png" not in text and 'src="map.png"' in text


def test_maps_that_cannot_be_made_or_are_not_wanted_are_left_out_and_those_of_an_earlier_run_go(tmp_path):
    run(tmp_path)
    unclocked = run(tmp_path, start=float("nan"))
    assert set(names(tmp_path)) == ALL - {COT} and "no clock" in unclocked["notes"][0]
    assert "no clock" in (tmp_path / "report.html").read_text()
    local = run(tmp_path, [grounded(k, origin=None) for k in (1, 2)], origin=None)
    assert "no longitude and latitude" in local["notes"][0]
    assert set(names(tmp_path)) == ALL - {GEOJSON, ELLIPSES, KML, COT}
    run(tmp_path, save=())
    assert set(names(tmp_path)) == {*TABLES, GEOJSON, ELLIPSES, KML}


def test_the_record_counts_by_what_frames_were_located_and_says_what_went_wrong(tmp_path):
    line = Adjustment(3, "landmarks.wanted", 4.0, 6.0, "detected <poorly>")
    weak: dict = {"by": "telemetry", "states": ("excluded",) * 4}
    nothing: dict = {"by": "", "states": (), "cause": "nothing in view"}
    swapped: dict = {"states": ("reassigned", "reassigned", "used", "used")}
    frames = [
        grounded(1),
        grounded(2, **weak, cause="2 of 4 landmarks"),
        grounded(3, **weak, cause="1 of 4 landmarks", adjustments=(line,)),
        grounded(4, **nothing),
        grounded(5, **nothing),
        grounded(6, **swapped, changes=("swapped: chi2 81 for 8",)),
        grounded(7, **swapped, changes=("swapped: chi2 92 for 8",)),
        grounded(9, changes=("swapped: chi2 92 for 8",)),
    ]
    kept = run(tmp_path, frames)
    assert kept["by"] == {"pose": 4, "homography": 0, "paper": 0, "telemetry": 2, "nothing": 2}
    assert kept["positions"] == 12 and kept["targets"] == 16 and kept["frames"] == {"written": 8, "unreliable": 2}
    assert kept["unreliable"] == [{"first": 4, "last": 5, "cause": "nothing in view"}]
    assert kept["weak"] == [{"first": 2, "last": 3, "by": "telemetry", "cause": "2 of 4 landmarks"}]
    assert kept["repairs"] == [{"first": 6, "last": 9, "cause": "swapped: chi2 81 for 8"}]
    counts = {"seen": 6, "used": 4, "left_out": 2, "reassigned": [[6, 7]], "excluded": [[2, 3]]}
    assert kept["landmarks"]["alpha"] == counts
    text = (tmp_path / "report.html").read_text()
    for words in ("4 to 5", "nothing in view", "2 of 4 landmarks", "swapped: chi2 81 for 8", "detected &lt;poorly&gt;"):
        assert words in text


@pytest.mark.parametrize("frames", [[], [grounded(1, by="", states=(), cause="nothing in view")]])
def test_a_run_that_located_nothing_is_valid(tmp_path, frames):
    run(tmp_path, frames)
    assert set(names(tmp_path)) == ALL and len(read_positions(tmp_path / "positions.csv")) == 0
    assert json.loads((tmp_path / GEOJSON).read_text())["features"] == []
