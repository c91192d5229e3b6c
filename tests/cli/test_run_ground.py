"""`dddas run --ground`: fused.csv and confirmed.csv beside the other files, and one line for each mistake."""

import json
import shutil

import numpy as np
import pytest

from tests.cli.conftest import bad, names, record, rows, stub_engine
from torchvision_dddas.types import People

LOG = "time_s,altitude_m,speed_m_s,east_m,north_m,heading_deg,pitch_deg\n0,40,0,0,0,0,90\n60,40,0,0,0,0,90\n"
PLATFORM = """
detections = "people.csv"
rate_hz = 5
[camera]
width_px = 1280
height_px = 960
focal_px = 1000
height_m = 1.5
heading_deg = 0
pitch_deg = 0
east_m = 0
north_m = -12
"""


@pytest.fixture
def platform(file):
    boxes = "".join(f"{frame},600,484,60,150,0.9\n" for frame in range(1, 12))
    file("people.csv", "frame,x_px,y_px,width_px,height_px,score\n" + boxes)
    return file("ugv1.toml", PLATFORM)


def test_air_and_ground_give_one_table_of_targets(dddas, clip, engine, file, platform, tmp_path):
    out, log = tmp_path / "out", file("log.csv", LOG)
    done = dddas("run", clip, "--telemetry", log, "--ground", platform, "--out", out, "--save", "none")
    assert done.exit_code == 0, done.output
    assert {"fused.csv", "confirmed.csv"} <= set(names(out)) and "fused.csv" in done.stdout
    kept = record(out)
    assert kept["platforms"]["ugv1"]["frames"] > 0 and kept["ground"][0].endswith("ugv1.toml")
    fused = rows(out / "fused.csv")
    assert {row["seen_by"] for row in fused} & {"uav:1", "uav:1;ugv1", "ugv1;uav:1"}
    assert all(float(row["speed_sigma_m_s"]) > 0 for row in fused)
    again = dddas("run", clip, "--telemetry", log, "--out", out, "--save", "none")
    assert again.exit_code == 0 and "fused.csv" not in names(out)


def test_an_interrupted_run_keeps_what_its_platforms_did(dddas, clip, engine, file, platform, tmp_path):
    for k in range(5, 40):
        shutil.copy(clip / "00000.png", clip / f"{k:05d}.png")

    def stop(scene):
        if scene.frame.number == 35:
            raise KeyboardInterrupt

    engine(after=stop)
    out, log = tmp_path / "out", file("log.csv", LOG)
    done = dddas("run", clip, "--telemetry", log, "--ground", platform, "--out", out, "--save", "none")
    assert done.exit_code == 130, done.output
    assert record(out)["state"] == "interrupted" and record(out)["platforms"]["ugv1"]["frames"] > 0


@pytest.mark.slow
def test_live_runs_that_drop_nothing_have_the_tables_of_offline_runs(
    dddas, clip, engine, file, platform, tmp_path, monkeypatch
):
    for k in range(5, 30):
        shutil.copy(clip / "00000.png", clip / f"{k:05d}.png")
    for name in ("ugv1", "uav2"):
        shutil.copytree(clip, tmp_path / name)
    box = np.array([[29.0, 19, 6, 14]])
    person = People(box, np.array([0.9]), np.ones(1), np.zeros(1, bool), box)
    monkeypatch.setattr("torchvision_dddas.control.ground_team.detect_people", lambda *_: [person])
    monkeypatch.setattr("torchvision_dddas.control.ground_team.load_scorer", lambda *_: object())
    monkeypatch.setattr("torchvision_dddas.live.run_path.load_engine", stub_engine()["load_engine"])
    small = PLATFORM.replace("1280", "64").replace("960", "48").replace("focal_px = 1000", "focal_px = 60")
    log = file("log.csv", LOG)
    ugv = file("ugv.toml", small.replace('detections = "people.csv"', 'clip = "ugv1"\nname = "ugv1"'))
    uav = file("uav.toml", 'clip = "uav2"\nname = "uav2"\nrate_hz = 10\nstarts_s = 0.1\ntelemetry = "log.csv"\n')
    words = ("run", clip, "--telemetry", log, "--rate", 10, "--ground", ugv, "--aerial", uav)
    still = dddas(*words, "--out", tmp_path / "still", "--save", "none")
    live = dddas(*words, "--out", tmp_path / "live", "--live", "--set", "live.pace=0")
    assert (still.exit_code, live.exit_code) == (0, 0), still.output + live.output
    (session,) = (tmp_path / "live").iterdir()
    for name in ("fused.csv", "confirmed.csv"):
        assert (session / name).read_text() == (tmp_path / "still" / name).read_text(), name
    kept, fused = record(session), rows(session / "fused.csv")
    assert {"uav:1", "uav2:1", "ugv1"} <= {name for row in fused for name in row["seen_by"].split(";")}
    assert {name: one["state"] for name, one in kept["platforms"].items()} == {"ugv1": "ended", "uav2": "ended"}
    lines = [json.loads(line) for line in (session / "results.jsonl").read_text().splitlines()]
    assert any(line["fused"]["targets"] for line in lines if "fused" in line)


def test_mistakes_are_told_in_one_line(dddas, clip, file, platform, tmp_path):
    log, out = file("log.csv", LOG), tmp_path / "out"
    for words, says in (
        (["--ground", platform], "--telemetry or --landmarks"),
        (["--ground", tmp_path / "none.toml", "--telemetry", log], "none.toml cannot be read"),
        (["--ground", platform, "--ground", platform, "--telemetry", log], "its own name"),
        (["--ground", platform, "--live", "--telemetry", log], "has detections, which --live cannot use"),
    ):
        assert says in bad(dddas("run", clip, *words, "--out", out))
