"""`dddas simulate`: files in the very formats that the other commands read."""

import tomllib

import numpy as np
import pytest

from tests.cli.conftest import record, rows
from tests.lab.simulation.small import as_file, small
from torchvision_dddas import geometry, open_video
from torchvision_dddas.io.camera_files import read_camera, read_poses
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.lab.evaluation.metrics import truth as judges
from torchvision_dddas.lab.simulation import load_scenario, scenario_names

FAULTS = ({"what": "dropped", "time_s": 0.5, "seconds": 0.15}, {"what": "gps_dropout", "time_s": 1.0, "seconds": 0.55})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scenario of two seconds, simulated with everything that there is: its folder, and what was said."""
    from typer.testing import CliRunner

    from torchvision_dddas.cli import app

    folder = tmp_path_factory.mktemp("made")
    path = as_file(folder / "tiny.toml", small(fault=FAULTS, settings={"steering": {"picture_s": 0.5}}))
    result = CliRunner().invoke(app, ["simulate", str(path), "--out", str(folder / "out"), "--save", "all"])
    assert result.exit_code == 0, result.output
    return folder / "out", result.stdout


@pytest.fixture
def folder(made):
    return made[0]


@pytest.fixture
def again(dddas, folder):
    """Simulate the same scenario again."""

    def run(out, *words):
        result = dddas("simulate", folder / "scenario.toml", "--out", out, *words)
        assert result.exit_code == 0, result.output
        return result.stdout

    return run


def true_places(folder, kind):
    """Longitude and latitude of all of a kind, in the order of the truth."""
    found = [row for row in rows(folder / "truth" / "positions.csv") if row["kind"] == kind]
    return np.array([[float(row["longitude_deg"]), float(row["latitude_deg"])] for row in found])


def test_the_pictures_are_a_clip_that_keeps_its_numbers(folder):
    source = open_video(folder / "frames")
    frames = list(source)
    assert [f.number for f in frames] == [n for n in range(1, 21) if n not in (6, 7)]
    assert source.size == (160, 120) and len(source.problems) == 2
    assert len(list(open_video(folder / "clip.mp4"))) == 20
    run = {f.number: f.image for f in open_video(f"sim:{folder / 'scenario.toml'}")}
    assert np.abs(frames[0].image.astype(int) - run[1]).mean() < 3  # what JPEG takes away


def test_reports_are_read_and_true(folder):
    landmarks = read_landmarks(folder / "landmarks.csv")
    assert landmarks.names == ("ugv1", "ugv2", "ugv3", "ugv4")
    assert landmarks.geographic and landmarks.planned.any()
    real = ~landmarks.planned
    said = {(landmarks.names[k], f) for k, f in zip(landmarks.landmark[real], landmarks.frame[real], strict=True)}
    assert {("ugv1", 9.0), ("ugv2", 13.0)} <= said
    assert ("ugv1", 13.0) not in said  # its receiver is silent
    places = true_places(folder, "ugv")[:4]
    origin = float(places[0, 0]), float(places[0, 1])
    first = landmarks.place[(landmarks.frame == 1) & real]
    assert np.abs(geometry.east_north(first, origin) - geometry.east_north(places, origin)).max() < 0.02


def test_the_elevation_is_that_of_the_world(folder):
    pytest.importorskip("rasterio")
    from torchvision_dddas.io.elevation import read_elevation
    from torchvision_dddas.lab.simulation import open_simulator
    from torchvision_dddas.lab.simulation.world import height_at

    scenario = load_scenario(folder / "scenario.toml")
    places = np.random.default_rng(0).uniform(-25, 25, (50, 2))
    read = read_elevation(folder / "dem.tif", places, scenario.world.origin_deg, margin_m=10.0)
    np.testing.assert_allclose(height_at(read, places), open_simulator(scenario).world.up_m(places), atol=0.02)
    assert read.base_m == pytest.approx(scenario.world.above_sea_m, abs=0.05)


def test_what_ground_vehicles_saw_has_the_poses_that_they_report(folder):
    seen = folder / "ground" / "ugv2"
    table = read_poses(seen / "poses.csv")
    assert [p.number for p in open_video(seen)] == table.at.tolist() == [1, 2, 3, 4]
    assert [row["aerial_frame"] for row in rows(seen / "poses.csv")] == ["1", "6", "11", "16"]
    camera, poses = geometry.poses_at(read_camera(seen / "camera.toml"), table, np.array([1, 4]))
    assert camera.geographic
    lon, lat = true_places(folder, "ugv").reshape(20, 4, 2)[15, 1].tolist()
    assert np.hypot(*geometry.east_north(poses.place[1:], (lon, lat))[0]) < 0.1
    # The receiver of the first is silent at frames 11 and 16: nobody would know where the picture was taken.
    assert len(list((folder / "ground" / "ugv1").glob("*.jpg"))) == 2


def test_the_truth_is_read_by_its_judges(folder):
    boxes = judges.load_truth(folder / "truth" / "gt.txt")
    assert boxes.tracks is not None
    assert set(boxes.tracks.identity.tolist()) == {1}
    masks = judges.load_truth(folder / "truth")
    assert masks.kind == "masks" and masks.frames == list(range(1, 21))
    assert judges.read_mask(masks.masks[10]).max() >= 1


def test_the_record_tells_what_happened(made):
    folder, said = made
    kept = record(folder)
    assert (kept["state"], kept["frames"]["written"], kept["dropped"]) == ("complete", 20, 2)
    assert [e["frame"] for e in kept["events"]]
    assert kept["scenario"]["clip"]["seconds"] == 2
    assert load_scenario(folder / "scenario.toml") == load_scenario(folder.parent / "tiny.toml")
    assert "20 frames of 160×120" in said
    assert f"dddas run {folder / 'frames'} --landmarks {folder / 'landmarks.csv'}" in said


@pytest.mark.slow
def test_the_same_seed_gives_the_same_files_and_another_does_not(folder, again, tmp_path):
    same, other = tmp_path / "same", tmp_path / "other"
    assert again(same, "--frames", 3, "--quiet") == again(other, "--frames", 3, "--quiet", "--seed", 9) == ""
    jpg, table = "frames/000003.jpg", "truth/positions.csv"
    assert (same / jpg).read_bytes() == (folder / jpg).read_bytes() != (other / jpg).read_bytes()
    assert (folder / table).read_text().startswith((same / table).read_text())
    assert tomllib.loads((other / "scenario.toml").read_text())["seed"] == 9


@pytest.mark.slow
def test_a_shorter_run_leaves_nothing_of_a_longer_one(again, tmp_path):
    for count in (6, 2):
        again(tmp_path, "--frames", count, "--quiet")
    assert len(list((tmp_path / "frames").iterdir())) == len(list((tmp_path / "truth" / "masks").iterdir())) == 2
    assert len(list((tmp_path / "ground" / "ugv1").glob("*.jpg"))) == 1


def test_save_none_leaves_the_tables_alone(again, tmp_path):
    assert "Next" not in again(tmp_path, "--frames", 2, "--save", "none")
    assert not [name for name in ("frames", "clip.mp4", "ground", "truth/masks") if (tmp_path / name).exists()]
    assert (tmp_path / "truth" / "gt.txt").is_file()


def test_a_video_of_odd_width_is_refused_before_anything_is_written(dddas, tmp_path):
    out = tmp_path / "odd"
    result = dddas("simulate", "demo", "--set", "camera.width_px=333", "--save", "video", "--out", out)
    assert result.exit_code == 2 and not out.exists()
    assert "needs an even width and height, got 333x" in result.output and "camera.width_px=334" in result.output


def test_without_a_name_it_lists_the_scenarios(dddas):
    assert [line.split()[0] for line in dddas("simulate").stdout.splitlines()] == scenario_names()


def test_run_takes_all_files_and_locates_every_picture(folder, dddas, tmp_path):
    files = {name: folder / f"{name}.csv" for name in ("landmarks", "telemetry")}
    files |= {name: folder / f"{name}.toml" for name in ("colours", "camera")}
    flown = read_telemetry(files["telemetry"])
    assert len(flown) == 20 and flown.geographic and np.isfinite(flown.altitude_m).all()
    assert np.degrees(flown.hfov_rad) == pytest.approx(60)
    camera = read_camera(files["camera"])
    assert camera.size_px == (160, 120) and camera.focal_px[0] == pytest.approx(80 / np.tan(np.radians(30)))
    assert read_colours(files["colours"]).names == ("ugv1", "ugv2", "ugv3", "ugv4")
    words = [word for name, path in files.items() for word in (f"--{name}", path)]
    result = dddas("run", folder / "frames", *words, "--out", tmp_path, "--save", "none", "--quiet")
    assert result.exit_code == 0, result.output
    kept = record(tmp_path)
    assert kept["frames"]["written"] == 20 and kept["by"]["pose"] >= 18
