"""`dddas locate ground`: what it writes and says."""

import json

import numpy as np
import pytest

from tests.cli.conftest import bad, record, rows
from tests.upright import boxes, camera
from torchvision_dddas.io.ground_tables import read_positions

CAMERA = "focal_px = 1000\nwidth_px = 1280\nheight_px = 960\nheight_m = 1.2\n"
PLACE = "longitude_deg = -110.95\nlatitude_deg = 32.23\n"
PEOPLE = np.array([[-1.0, 10.0], [2.0, 14.0]])


def walked(frame):
    """Where people who go north are."""
    return PEOPLE + np.array([0, 0.1 * frame])


def tracks(cam, place=(0.0, 0.0), identities=(4, 8)):
    lines = ["frame,identity,x_px,y_px,width_px,height_px,score"]
    for frame in (1, 2, 3):
        for identity, box in zip(identities, boxes(walked(frame), 1.75, cam, place), strict=True):
            lines.append(",".join([f"{frame},{identity}", *(f"{v:.6f}" for v in box), "0.9"]))
    return "\n".join(lines) + "\n"


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def locate(dddas, file, out):
    """Locate the people of tables with a camera each; what was said."""

    def run(table, *more, cameras=(CAMERA,)):
        tables = [file(f"t{k}.csv", text) for k, text in enumerate([table] if isinstance(table, str) else table)]
        words = [word for k, text in enumerate(cameras) for word in ("--camera", file(f"c{k}.toml", text))]
        result = dddas("locate", "ground", *tables, *words, *more, "--out", out)
        assert result.exit_code == 0, result.output
        return result.stdout

    return run


def test_tracks_become_positions_with_covariances(locate, out, tmp_path):
    said = locate(tracks(camera()))
    left = "no pitch_deg: a level camera is assumed; no heading_deg: north is assumed; no place: 0, 0 is assumed"
    assert said.splitlines() == [
        "3 frames, 6 sightings (6 by height and feet, 0 by height, 0 by feet alone), 6 positions",
        f"note: {tmp_path / 'c0.toml'} has {left}",
        f"{out}: positions.csv, sightings.csv, run.json",
    ]
    found = read_positions(out / "positions.csv")
    assert found.frame.tolist() == [1, 1, 2, 2, 3, 3] and found.target.tolist() == [4, 8] * 3
    assert np.allclose(found.east_north_m[2:4], walked(2), atol=1e-3)
    assert (np.linalg.eigvalsh(found.covariance_m2) > 0).all()
    assert (out / "positions.csv").read_text().splitlines()[0] == (
        "frame,target,east_m,north_m,var_east_m2,cov_east_north_m2,var_north_m2,score,cameras,class,class_id,"
        "above_sea_m,above_ellipsoid_m,circular_error90_m,error_category"
    )
    (first, *_) = rows(out / "sightings.csv")
    assert (first["camera"], first["target"], first["by"], first["cut"]) == ("c0", "4", "both", "0")
    assert float(first["distance_m"]) == pytest.approx(np.hypot(1, 10.1), abs=1e-3)
    assert float(first["bearing_deg"]) == pytest.approx(360 - np.degrees(np.arctan(1 / 10.1)), abs=1e-3)
    kept = record(out)
    assert (kept["state"], kept["people"], kept["sightings"]["both"]) == ("complete", 6, 6)


def test_a_place_in_degrees_gives_a_map_which_a_run_without_one_removes(locate, out):
    assert "tracks.geojson" in locate(tracks(camera()), cameras=[CAMERA + PLACE])
    (feature, _) = json.loads((out / "tracks.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "LineString"
    assert feature["properties"]["target"] == 4 and feature["properties"]["frames"] == [1, 2, 3]
    degrees = read_positions(out / "positions.csv").lonlat_deg
    assert degrees is not None
    assert np.allclose(feature["geometry"]["coordinates"], degrees[::2], atol=1e-8)
    assert abs(degrees[0, 0] + 110.95) < 1e-4 and 0 < degrees[0, 1] - 32.23 < 2e-4
    assert "geojson" not in locate(tracks(camera()))
    assert not (out / "tracks.geojson").exists()


@pytest.mark.parametrize("name", ["circle", "x" * 300])
def test_a_name_that_no_file_can_have_is_one_line(dddas, file, tmp_path, name):
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    table, toml = file("t.csv", tracks(camera())), file("c.toml", CAMERA)
    assert "cannot be read" in bad(dddas("locate", "ground", tmp_path / name, "--camera", toml))
    assert "cannot write" in bad(dddas("locate", "ground", table, "--camera", toml, "--out", tmp_path / name))


def test_two_cameras_give_the_fused_places_and_what_each_alone_says(locate, out):
    near = CAMERA + "position_sigma_m = 0.1\nheading_sigma_deg = 0.3\n"
    west = tracks(camera(heading_rad=np.pi / 2), (-15.0, 12.0), identities=(1, 2))
    locate([tracks(camera()), west], cameras=[near, near + "heading_deg = 90\neast_m = -15\nnorth_m = 12\n"])
    fused = rows(out / "positions.csv")
    assert [(row["cameras"], row["target"]) for row in fused] == [("2", "1"), ("2", "2")] * 3
    assert np.allclose(read_positions(out / "positions.csv").east_north_m[:2], walked(1), atol=1e-3)
    assert [row["camera"] for row in rows(out / "sightings.csv")][:4] == ["c0", "c0", "c1", "c1"]
    locate([tracks(camera())] * 2, cameras=[CAMERA + 'name = "left, low"\n'] * 2)
    assert {row["camera"] for row in rows(out / "sightings.csv")} == {"left, low-1", "left, low-2"}


def test_poses_move_the_camera(locate, file, out):
    locate(tracks(camera()), "--poses", file("p.csv", "frame,east_m,north_m\n1,100,0\n3,102,0\n"))
    found = read_positions(out / "positions.csv")
    assert np.allclose(found.east_north_m[::2, 0], [99, 100, 101], atol=1e-3)


def test_sightings_without_a_distance_are_counted(locate, out):
    said = locate("frame,x_px,y_px,width_px,height_px,cut\n1,600,700,150,260,1\n1,600,400,40,160,0\n")
    assert "note: 1 sightings have a bearing but no distance (see sightings.csv)" in said
    (first, _) = rows(out / "sightings.csv")
    assert (first["by"], first["east_m"]) == ("bearing", "")
    assert len(read_positions(out / "positions.csv")) == 1


def test_sightings_none_of_which_has_a_distance_end_with_an_exit_code_of_their_own(dddas, file, out):
    table = file("t.csv", "frame,x_px,y_px,width_px,height_px,cut\n1,600,700,150,260,1\n")
    result = dddas("locate", "ground", table, "--camera", file("c.toml", CAMERA), "--out", out)
    cause = "0 located, because no sighting has a distance (see sightings.csv)"
    assert (result.exit_code, result.stderr) == (3, f"dddas: {cause}; all other results are in {out}\n")
    assert "0 positions" in result.stdout and record(out)["state"] == "complete"
    assert cause in record(out)["notes"]


def test_a_table_without_rows_gives_empty_tables(locate, out):
    said = locate("frame,x_px,y_px,width_px,height_px\n", cameras=[CAMERA + PLACE])
    assert "note: the tables have no rows: nothing to locate" in said
    assert len(read_positions(out / "positions.csv")) == 0
    assert json.loads((out / "tracks.geojson").read_text())["features"] == []
    assert (record(out)["state"], record(out)["people"]) == ("complete", 0)
