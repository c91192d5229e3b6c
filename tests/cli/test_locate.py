"""`dddas locate ground`: what it writes, and one line for each mistake."""

import json

import numpy as np
import pytest

from tests.cli.conftest import bad, record, rows
from tests.upright import boxes, camera
from torchvision_dddas.io.ground_tables import read_positions

CAMERA = "focal_px = 1000\nwidth_px = 1280\nheight_px = 960\nheight_m = 1.2\n"
PEOPLE = np.array([[-1.0, 10.0], [2.0, 14.0]])


def walked(frame):
    """Where people who go north are."""
    return PEOPLE + np.array([0, 0.1 * frame])


def tracks(cam, place=(0.0, 0.0), frames=(1, 2, 3), identities=(4, 8)):
    lines = ["frame,identity,x_px,y_px,width_px,height_px,score"]
    for frame in frames:
        for identity, box in zip(identities, boxes(walked(frame), 1.75, cam, place), strict=True):
            lines.append(",".join([f"{frame},{identity}", *(f"{v:.6f}" for v in box), "0.9"]))
    return "\n".join(lines) + "\n"


def test_tracks_become_positions_with_covariances(dddas, file, tmp_path):
    out = tmp_path / "out"
    result = dddas(
        "locate", "ground", file("t.csv", tracks(camera())), "--camera", file("c.toml", CAMERA), "--out", out
    )
    assert result.exit_code == 0, result.output
    left = "no pitch_deg: level is assumed; no heading_deg: north is assumed; no place: 0, 0 is assumed"
    assert result.stdout.splitlines() == [
        "3 frames, 6 sightings (6 by height and feet, 0 by height, 0 by feet alone), 6 positions",
        f"note: {tmp_path / 'c.toml'} has {left}",
        f"{out}: positions.csv, sightings.csv, run.json",
    ]
    found = read_positions(out / "positions.csv")
    assert found.frame.tolist() == [1, 1, 2, 2, 3, 3] and found.target.tolist() == [4, 8] * 3
    assert np.allclose(found.east_north_m[2:4], walked(2), atol=1e-3)
    assert (np.linalg.eigvalsh(found.covariance_m2) > 0).all()
    assert (out / "positions.csv").read_text().splitlines()[0] == (
        "frame,target,east_m,north_m,var_east_m2,cov_east_north_m2,var_north_m2,score,cameras"
    )
    (first, *_) = rows(out / "sightings.csv")
    assert (first["camera"], first["target"], first["by"], first["cut"]) == ("c", "4", "both", "0")
    assert float(first["distance_m"]) == pytest.approx(np.hypot(1, 10.1), abs=1e-3)
    assert float(first["bearing_deg"]) == pytest.approx(360 - np.degrees(np.arctan(1 / 10.1)), abs=1e-3)
    kept = record(out)
    assert (kept["state"], kept["people"], kept["sightings"]["both"]) == ("complete", 6, 6)


def test_a_place_in_degrees_gives_a_map_which_a_run_without_one_removes(dddas, file, tmp_path):
    text = CAMERA + "longitude_deg = -110.95\nlatitude_deg = 32.23\n"
    out = tmp_path / "out"
    result = dddas("locate", "ground", file("t.csv", tracks(camera())), "--camera", file("c.toml", text), "--out", out)
    assert result.exit_code == 0, result.output
    assert "tracks.geojson" in result.stdout
    found = json.loads((out / "tracks.geojson").read_text())
    assert found["type"] == "FeatureCollection" and len(found["features"]) == 2
    (feature, _) = found["features"]
    assert feature["type"] == "Feature" and feature["geometry"]["type"] == "LineString"
    assert feature["properties"]["target"] == 4 and feature["properties"]["frames"] == [1, 2, 3]
    degrees = read_positions(out / "positions.csv").lonlat_deg
    assert degrees is not None
    assert np.allclose(feature["geometry"]["coordinates"], degrees[::2], atol=1e-8)
    assert abs(degrees[0, 0] + 110.95) < 1e-4 and 0 < degrees[0, 1] - 32.23 < 2e-4
    again = dddas("locate", "ground", tmp_path / "t.csv", "--camera", file("m.toml", CAMERA), "--out", out)
    assert not (out / "tracks.geojson").exists() and "geojson" not in again.stdout


def test_a_line_of_the_map_is_cut_at_180_degrees(dddas, file, tmp_path):
    text = CAMERA + "longitude_deg = 180\nlatitude_deg = -17\nheading_deg = 90\n"
    table = file("t.csv", tracks(camera(), frames=(1,)) + "2,4,640,400,40,120,0.9\n")
    poses = file("p.csv", "frame,longitude_deg,latitude_deg\n1,179.9995,-17\n2,-179.9995,-17\n")
    words = ("--camera", file("c.toml", text), "--poses", poses, "--out", tmp_path / "out")
    assert dddas("locate", "ground", table, *words).exit_code == 0
    (line, _) = (f["geometry"] for f in json.loads((tmp_path / "out/tracks.geojson").read_text())["features"])
    assert line["type"] == "MultiLineString"
    (west, east) = line["coordinates"]
    assert west[-1][0] == 180 and east[0][0] == -180 and west[-1][1] == east[0][1]
    assert 179 < west[0][0] < 180 and -180 < east[-1][0] < -179
    assert min(west[0][1], east[-1][1]) <= east[0][1] <= max(west[0][1], east[-1][1])


@pytest.mark.parametrize("name", ["circle", "x" * 300])
def test_a_name_that_cannot_be_is_said_in_one_line(dddas, file, tmp_path, name):
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    table, toml = file("t.csv", tracks(camera())), file("c.toml", CAMERA)
    assert "cannot be read" in bad(dddas("locate", "ground", tmp_path / name, "--camera", toml))
    assert "cannot write" in bad(dddas("locate", "ground", table, "--camera", toml, "--out", tmp_path / name))


def test_two_cameras_give_the_fused_places_and_what_each_alone_says(dddas, file, tmp_path):
    near = "position_sigma_m = 0.1\nheading_sigma_deg = 0.3\n"
    west = camera(heading_rad=np.pi / 2)
    words = [file("a.csv", tracks(camera())), file("b.csv", tracks(west, (-15.0, 12.0), identities=(1, 2)))]
    cameras = [
        file("south.toml", CAMERA + near),
        file("west.toml", CAMERA + near + "heading_deg = 90\neast_m = -15\nnorth_m = 12\n"),
    ]
    out = tmp_path / "out"
    result = dddas("locate", "ground", *words, "--camera", cameras[0], "--camera", cameras[1], "--out", out)
    assert result.exit_code == 0, result.output
    fused = rows(out / "positions.csv")
    assert [row["cameras"] for row in fused] == ["2"] * 6
    assert [row["target"] for row in fused] == ["1", "2"] * 3
    found = read_positions(out / "positions.csv")
    assert np.allclose(found.east_north_m[:2], walked(1), atol=1e-3)
    assert [row["camera"] for row in rows(out / "sightings.csv")][:4] == ["south", "south", "west", "west"]
    words = [word for _ in "ab" for word in ("--camera", file("c.toml", CAMERA + 'name = "left, low"\n'))]
    assert dddas("locate", "ground", tmp_path / "a.csv", tmp_path / "a.csv", *words, "--out", out).exit_code == 0
    assert {row["camera"] for row in rows(out / "sightings.csv")} == {"left, low-1", "left, low-2"}


def test_poses_move_the_camera(dddas, file, tmp_path):
    poses = file("p.csv", "frame,east_m,north_m\n1,100,0\n3,102,0\n")
    words = ("--camera", file("c.toml", CAMERA), "--poses", poses, "--out", tmp_path / "out")
    result = dddas("locate", "ground", file("t.csv", tracks(camera())), *words)
    assert result.exit_code == 0, result.output
    found = read_positions(tmp_path / "out/positions.csv")
    assert np.allclose(found.east_north_m[::2, 0], [99, 100, 101], atol=1e-3)


def test_sightings_without_a_distance_are_counted(dddas, file, tmp_path):
    table = file("t.csv", "frame,x_px,y_px,width_px,height_px,cut\n1,600,700,150,260,1\n1,600,400,40,160,0\n")
    result = dddas("locate", "ground", table, "--camera", file("c.toml", CAMERA), "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "note: 1 sightings have a bearing but no distance (see sightings.csv)" in result.stdout
    (first, _) = rows(tmp_path / "out/sightings.csv")
    assert (first["by"], first["east_m"]) == ("bearing", "")
    assert len(read_positions(tmp_path / "out/positions.csv")) == 1


def test_a_table_without_rows_gives_empty_tables(dddas, file, tmp_path):
    text = CAMERA + "longitude_deg = 10\nlatitude_deg = 50\n"
    words = ("--camera", file("c.toml", text), "--out", tmp_path / "out")
    result = dddas("locate", "ground", file("t.csv", "frame,x_px,y_px,width_px,height_px\n"), *words)
    assert result.exit_code == 0, result.output
    assert "note: the tables have no rows: nobody to locate" in result.stdout
    assert len(read_positions(tmp_path / "out/positions.csv")) == 0
    assert json.loads((tmp_path / "out/tracks.geojson").read_text())["features"] == []
    assert (record(tmp_path / "out")["state"], record(tmp_path / "out")["people"]) == ("complete", 0)
