"""`dddas run --aerial`: two UAVs over the same targets have one table of them, and one line for each mistake."""

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad, record, rows
from tests.overflight import Overflight
from torchvision_dddas.io.camera_files import read_camera
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.pipeline import Pipeline


@pytest.fixture
def uav(tmp_path):
    """A function that writes a UAV's folder of pictures, log, boxes and platform file, and returns these paths."""

    def write(name, other=None, **how):
        flight = Overflight(**{"frames": 60, "size": (320, 180), "focal_px": 228.0, "pace": 0.5, **how})
        folder = tmp_path / name
        (folder / "clip").mkdir(parents=True)
        noise = np.random.default_rng(len(name)).integers(0, 255, (180, 320), dtype=np.uint8)
        for frame in flight.numbers():
            cv2.imwrite(str(folder / "clip" / f"{frame:06d}.png"), noise)
        (folder / "log.csv").write_text(flight.telemetry_csv())
        (folder / "boxes.txt").write_text(flight.tracks_txt())
        (folder / "camera.toml").write_text(flight.camera_toml())
        keys = {"clip": "clip", "telemetry": "log.csv", "camera": "camera.toml", "detections": "boxes.txt"} | (
            other or {}
        )
        (folder / f"{name}.toml").write_text("".join(f"{key} = {value!r}\n" for key, value in keys.items() if value))
        return folder

    return write


@pytest.fixture
def run(dddas, tmp_path, uav):
    main = uav("main")
    files = "--telemetry", main / "log.csv", "--camera", main / "camera.toml", "--detections", main / "boxes.txt"

    def call(*words, log=True):
        out = "--out", tmp_path / "out", "--save", "none"
        return dddas("run", main / "clip", *(files if log else files[4:]), *words, *out)

    return call


def test_two_uavs_at_other_heights_and_headings_share_identities(run, uav, tmp_path):
    other = uav("uav2", height_m=62.0, heading_rad=2.6, pitch_deg=75.0)
    done = run("--aerial", other / "uav2.toml")
    assert done.exit_code == 0, done.output
    fused, kept = rows(tmp_path / "out" / "fused.csv"), record(tmp_path / "out")
    last = [row for row in fused if row["frame"] == "35"]
    assert len(last) == 4 and all("uav:" in row["seen_by"] and "uav2:" in row["seen_by"] for row in last)
    pairs = {(row["target"], row["seen_by"]) for row in fused if row["frame"] > "2" and row["seen_by"].count(";")}
    assert len({target for target, _ in pairs}) == 4
    assert kept["platforms"]["uav2"]["shared"] > 100 and kept["aerial"][0].endswith("uav2.toml")


def test_a_pipeline_takes_further_uavs_too(uav):
    main, other = uav("main"), uav("uav2", height_m=62.0, heading_rad=2.6)
    log, camera = read_telemetry(main / "log.csv"), read_camera(main / "camera.toml")
    boxes = read_detections(main / "boxes.txt", order=None, size=camera.size_px)
    pipeline = Pipeline(telemetry=log, camera=camera, detector=boxes, aerial=[other / "uav2.toml"])
    last = list(pipeline(main / "clip"))[-1].fused
    assert last is not None and [set(seen) for seen in last.seen_by] == [{"uav", "uav2"}] * 4


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"telemetry": None}, "dddas views"),
        ({"telemetry": "bare.csv"}, "dddas views"),
        ({"telemetry": "none.csv"}, "none.csv"),
        ({"clip": "../main/clip"}, "is the clip of the run"),
        ({"name": "uav"}, "two platforms have the name uav"),
        ({"poses": "a.csv"}, "has the unknown key"),
        ({"set": ["aerial.clock=1"]}, "unknown parameter"),
    ],
)
def test_mistakes_are_told_in_one_line(run, uav, other, says):
    folder = uav("uav2", other)
    (folder / "bare.csv").write_text("time_s,altitude_m\n0,50\n9,50\n")
    assert says in bad(run("--aerial", folder / "uav2.toml"))


@pytest.mark.slow
def test_a_uav_that_is_elsewhere_in_time_or_space_is_noted(run, uav, tmp_path):
    far = uav("far", {"set": ["aerial.heading_offset_deg=0"]})
    log = (far / "log.csv").read_text().replace("32.2", "32.3")
    (far / "log.csv").write_text(log)
    late = uav("late", {"starts_s": 60})
    assert run("--aerial", far / "far.toml", "--aerial", late / "late.toml").exit_code == 0
    notes = " ".join(record(tmp_path / "out")["notes"])
    assert "far locates" in notes and "was recognized as a target of another" in notes and "late was not used" in notes


def test_a_live_run_a_run_without_places_and_the_same_file_twice_are_refused(dddas, run, uav):
    path = uav("uav2") / "uav2.toml"
    assert "its own name" in bad(run("--aerial", path, "--aerial", path))
    assert "--telemetry or --landmarks" in bad(run("--aerial", path, log=False))
    assert "uav2 has detections" in bad(dddas("run", path.parent / "clip", "--aerial", path, "--live"))
