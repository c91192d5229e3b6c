"""`dddas simulate`: files in the very formats that the other commands read."""

import tomllib

import numpy as np
import pytest

from tests.cli.conftest import record, rows
from tests.simulation.small import as_file, small
from torchvision_dddas import geometry, open_video
from torchvision_dddas.evaluation.metrics import truth as judges
from torchvision_dddas.io.camera_files import read_camera, read_poses
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.io.ground_tables import read_landmarks, read_positions
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.simulation import load_scenario, scenario_names

FAULTS = ({"what": "dropped", "time_s": 0.5, "seconds": 0.15}, {"what": "gps_dropout", "time_s": 1.0, "seconds": 0.55})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scenario of two seconds, simulated with everything that there is."""
    from typer.testing import CliRunner

    from torchvision_dddas.cli import app

    folder = tmp_path_factory.mktemp("made")
    path = as_file(folder / "tiny.toml", small(fault=FAULTS, settings={"steering": {"picture_s": 0.5}}))
    result = CliRunner().invoke(app, ["simulate", str(path), "--out", str(folder / "out"), "--save", "all"])
    assert result.exit_code == 0, result.output
    return folder / "out", result.stdout


def test_the_pictures_are_a_clip_that_keeps_its_numbers(made):
    folder, _ = made
    source = open_video(folder / "frames")
    frames = list(source)
    assert [f.number for f in frames] == [n for n in range(1, 21) if n not in (6, 7)]
    assert source.size == (160, 120)
    assert len(list(open_video(folder / "clip.mp4"))) == 20
    assert len(source.problems) == 2
    run = {f.number: f.image for f in open_video(f"sim:{folder / 'scenario.toml'}")}
    apart = np.abs(frames[0].image.astype(int) - run[1])
    assert apart.mean() < 3  # what JPEG takes away


def test_the_scenario_is_written_as_it_was_run(made):
    folder, _ = made
    assert load_scenario(folder / "scenario.toml") == load_scenario(folder.parent / "tiny.toml")


def test_reports_are_read_and_true(made):
    folder, _ = made
    landmarks = read_landmarks(folder / "landmarks.csv")
    assert landmarks.names == ("ugv1", "ugv2", "ugv3", "ugv4")
    assert landmarks.geographic
    assert landmarks.planned.any()
    said = {
        (landmarks.names[k], f)
        for k, f, p in zip(landmarks.landmark, landmarks.frame, landmarks.planned, strict=True)
        if not p
    }
    assert ("ugv1", 9.0) in said
    assert ("ugv1", 13.0) not in said  # its receiver is silent
    assert ("ugv2", 13.0) in said
    true = [r for r in rows(folder / "truth" / "positions.csv") if r["kind"] == "ugv"][:4]
    first = np.flatnonzero((landmarks.frame == 1) & ~landmarks.planned)
    places = np.array([[float(r["longitude_deg"]), float(r["latitude_deg"])] for r in true])
    origin = float(places[0, 0]), float(places[0, 1])
    apart = geometry.east_north(landmarks.place[first], origin) - geometry.east_north(places, origin)
    assert np.abs(apart).max() < 0.02


def test_the_elevation_is_that_of_the_world(made):
    pytest.importorskip("rasterio")
    from torchvision_dddas.io.elevation import read_elevation
    from torchvision_dddas.simulation import open_simulator
    from torchvision_dddas.simulation.world import height_at

    folder, _ = made
    scenario = load_scenario(folder / "scenario.toml")
    places = np.random.default_rng(0).uniform(-25, 25, (50, 2))
    read = read_elevation(folder / "dem.tif", places, scenario.world.origin_deg, 10.0)
    np.testing.assert_allclose(height_at(read, places), open_simulator(scenario).world.up_m(places), atol=0.02)
    assert read.base_m == pytest.approx(scenario.world.above_sea_m, abs=0.05)


def test_what_ground_vehicles_saw_has_the_poses_that_they_report(made):
    folder, _ = made
    camera = read_camera(folder / "ground" / "ugv2" / "camera.toml")
    table = read_poses(folder / "ground" / "ugv2" / "poses.csv")
    pictures = list(open_video(folder / "ground" / "ugv2"))
    assert [p.number for p in pictures] == table.at.tolist() == [1, 2, 3, 4]
    assert [row["aerial_frame"] for row in rows(folder / "ground/ugv2/poses.csv")] == ["1", "6", "11", "16"]
    camera, poses = geometry.poses_at(camera, table, np.array([1, 4]))
    assert camera.geographic
    true = read_positions(folder / "truth" / "positions.csv")
    vehicles = [r for r in rows(folder / "truth" / "positions.csv") if r["kind"] == "ugv"]
    number = int(vehicles[1]["target"])
    assert true.lonlat_deg is not None
    lon, lat = true.lonlat_deg[(true.target == number) & (true.frame == 16)][0].tolist()
    assert np.hypot(*geometry.east_north(poses.place[1:], (lon, lat))[0]) < 0.1
    # Its receiver is silent at frames 11 and 16: nobody would know where the picture was taken.
    assert len(list((folder / "ground" / "ugv1").glob("*.jpg"))) == 2


def test_the_truth_is_read_by_its_judges(made):
    folder, _ = made
    boxes = judges.load_truth(folder / "truth" / "gt.txt")
    assert boxes.tracks is not None
    assert set(boxes.tracks.identity.tolist()) == {1}
    masks = judges.load_truth(folder / "truth")
    assert masks.kind == "masks"
    assert masks.frames == list(range(1, 21))
    assert judges.read_mask(masks.masks[10]).max() >= 1


def test_the_record_tells_what_happened(made):
    folder, said = made
    kept = record(folder)
    assert kept["state"] == "complete"
    assert (kept["frames"]["written"], kept["dropped"]) == (20, 2)
    assert [e["frame"] for e in kept["events"]]
    assert kept["scenario"]["clip"]["seconds"] == 2
    assert "20 frames of 160×120" in said
    assert f"dddas run {folder / 'frames'} --landmarks {folder / 'landmarks.csv'}" in said


@pytest.mark.slow
def test_the_same_seed_gives_the_same_files_and_another_does_not(made, dddas, tmp_path):
    folder, _ = made
    scenario = folder / "scenario.toml"
    for name, more in (("same", ()), ("other", ("--seed", 9))):
        result = dddas("simulate", scenario, "--out", tmp_path / name, "--frames", 3, "--quiet", *more)
        assert result.exit_code == 0, result.output
        assert result.output == ""
    jpg, csv_text = "frames/000003.jpg", "truth/positions.csv"
    assert (tmp_path / "same" / jpg).read_bytes() == (folder / jpg).read_bytes()
    assert (folder / csv_text).read_text().startswith((tmp_path / "same" / csv_text).read_text())
    assert (tmp_path / "other" / jpg).read_bytes() != (folder / jpg).read_bytes()
    assert tomllib.loads((tmp_path / "other" / "scenario.toml").read_text())["seed"] == 9


@pytest.mark.slow
def test_a_shorter_run_leaves_nothing_of_a_longer_one(made, dddas, tmp_path):
    folder, _ = made
    out = tmp_path / "out"
    for count in (6, 2):
        assert dddas("simulate", folder / "scenario.toml", "--out", out, "--frames", count, "--quiet").exit_code == 0
    assert len(list((out / "frames").iterdir())) == len(list((out / "truth" / "masks").iterdir())) == 2
    assert len(list((out / "ground" / "ugv1").glob("*.jpg"))) == 1


def test_what_is_not_to_be_saved_is_not(made, dddas, tmp_path):
    folder, _ = made
    out = tmp_path / "out"
    result = dddas("simulate", folder / "scenario.toml", "--out", out, "--frames", 2, "--save", "none")
    assert result.exit_code == 0, result.output
    assert not [name for name in ("frames", "clip.mp4", "ground", "truth/masks") if (out / name).exists()]
    assert (out / "truth" / "gt.txt").is_file()
    assert "Next" not in result.stdout


def test_without_a_name_it_lists_the_scenarios(dddas):
    result = dddas("simulate")
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stdout.splitlines()] == scenario_names()


def test_run_locates_what_was_simulated(made, dddas, tmp_path):
    """The files go together: `run` takes them all, and every picture is georeferenced."""
    folder, _ = made
    files = {name: folder / f"{name}.csv" for name in ("landmarks", "telemetry")}
    files |= {name: folder / f"{name}.toml" for name in ("colours", "camera")}
    flown = read_telemetry(files["telemetry"])
    assert len(flown) == 20 and flown.geographic and np.isfinite(flown.altitude_m).all()
    assert np.degrees(flown.hfov_rad) == pytest.approx(60)
    camera = read_camera(files["camera"])
    assert camera.size_px == (160, 120) and camera.focal_px[0] == pytest.approx(80 / np.tan(np.radians(30)))
    assert read_colours(files["colours"]).names == ("ugv1", "ugv2", "ugv3", "ugv4")
    words = [word for name, path in files.items() for word in (f"--{name}", path)]
    result = dddas("run", folder / "frames", *words, "--out", tmp_path / "run", "--save", "none", "--quiet")
    assert result.exit_code == 0, result.output
    assert record(tmp_path / "run")["frames"]["written"] == 20
    assert record(tmp_path / "run")["by"]["pose"] >= 18
