"""`dddas run sim:SCENARIO`: a closed loop from the command line, its files and the truth beside them."""

import numpy as np
import pytest

from tests.cli.conftest import record, rows
from tests.lab.simulation.small import as_file, small
from torchvision_dddas import geometry
from torchvision_dddas.io.ground_tables import read_positions

FAULTS = ({"what": "frozen", "time_s": 1.0, "seconds": 0.25}, {"what": "dropped", "time_s": 1.5, "seconds": 0.15})


def scenario(path, **tables):
    return as_file(path, small(**{"clip": {"seconds": 2.4}, **tables}))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a run with faults, and what was said at its end."""
    from typer.testing import CliRunner

    from torchvision_dddas.cli import app

    folder = tmp_path_factory.mktemp("flown")
    path = scenario(folder / "tiny.toml", fault=FAULTS)
    words = ["run", f"sim:{path}", "--out", str(folder / "out"), "--save", "report,truth"]
    result = CliRunner().invoke(app, [*words, "--set", "steering.sampling=false"])
    assert result.exit_code == 0, result.output
    return folder / "out", result.stdout


def test_results_and_truth_are_places_on_the_same_earth(made):
    folder, _ = made
    found, true = read_positions(folder / "positions.csv"), read_positions(folder / "truth" / "positions.csv")
    assert found.lonlat_deg is not None and true.lonlat_deg is not None and len(found) >= 3
    people = np.array([row["kind"] == "person" for row in rows(folder / "truth" / "positions.csv")])
    nearest = []
    for frame, place in zip(found.frame.tolist(), found.lonlat_deg, strict=True):
        crowd = true.lonlat_deg[(true.frame == frame) & people]
        nearest.append(np.linalg.norm(geometry.east_north(crowd, (place[0], place[1])), axis=1).min())
    assert np.median(nearest) < 2.0


def test_the_command_that_is_proposed_evaluates_the_run(made, dddas):
    folder, said = made
    words = ("evaluate", folder / "truth" / "gt.txt", folder)
    assert f"boxes in the picture (not places, as above) are scored by dddas {' '.join(map(str, words))}\n" in said
    result = dddas(*words)
    assert result.exit_code == 0, result.output
    assert "HOTA" in result.stdout


def test_log_and_record_tell_what_the_run_noticed_and_how_good_it_was(made):
    folder, said = made
    log = (folder / "log.txt").read_text()
    noticed = [line for line in log.splitlines() if " noticed " in line]
    assert "the camera is frozen" in noticed[0] and "3 pictures repeated" in noticed[1]
    assert "frame 17 was dropped by the camera" in log
    assert "noticed" in (folder / "report.html").read_text()
    kept = record(folder)
    assert kept["state"] == "complete" and kept["frames"]["written"] == 24 and kept["truth_score"]
    decisions = rows(folder / "appearance.csv")
    assert kept["appearance"]["decisions"] == len(decisions) > 0
    moved = [row for row in kept["adjustments"] if row["knob"] == "appearance.looked"]
    assert moved and all(row["cause"] in log for row in moved)
    assert "crowds: " in said


@pytest.mark.slow
def test_an_interrupt_leaves_results_and_truth_up_to_the_same_frame(tmp_path, dddas, monkeypatch):
    from torchvision_dddas.lab.simulation import SimulatedRunRecorder

    survey = SimulatedRunRecorder.write

    def short(self, item):
        survey(self, item)
        if item.tracked.number == 6:
            raise KeyboardInterrupt

    monkeypatch.setattr(SimulatedRunRecorder, "write", short)
    path, out = scenario(tmp_path / "tiny.toml"), tmp_path / "out"
    words = ("--save", "truth", "--quiet", "--set", "steering.sampling=false")
    assert dddas("run", f"sim:{path}", "--out", out, *words).exit_code == 130
    assert record(out)["state"] == "interrupted"
    assert max(int(row["frame"]) for row in rows(out / "truth" / "positions.csv")) == 6
    assert len(rows(out / "fixes.csv")) == 6


@pytest.mark.slow
def test_a_run_without_truth_removes_that_of_the_earlier_run(dddas, tmp_path):
    path = scenario(tmp_path / "tiny.toml", clip={"seconds": 0.5})
    for save, there in (("truth", True), ("none", False)):
        words = ("--save", save, "--set", "steering.sampling=false", "--quiet")
        result = dddas("run", f"sim:{path}", "--out", tmp_path / "out", *words)
        assert (result.exit_code, result.output) == (0, "")
        assert (tmp_path / "out" / "truth" / "gt.txt").exists() == there


@pytest.mark.slow
def test_what_ground_vehicles_see_steers_them_once_the_air_has_lost_a_crowd(tmp_path, dddas):
    away = ["uav.way_m=[[-110.0, 0.0]]", "uav.speed_m_s=4.0", "clip.seconds=11.0"]
    words = [word for change in away for word in ("--scene", change)]
    run = (
        "run",
        "sim:leaving",
        "--seed",
        5,
        *words,
        "--set",
        "steering.follow=false",
        "--save",
        "truth",
        "--out",
        tmp_path,
    )
    result = dddas(*run, "--quiet")
    assert result.exit_code == 0, result.output
    log = (tmp_path / "log.txt").read_text()
    assert "team.by_ground 0 -> 1: target 1 is not located from the air" in log
    true = {row["frame"]: row for row in rows(tmp_path / "truth" / "positions.csv") if row["kind"] == "person"}
    steers = [row for row in rows(tmp_path / "crowds.csv") if row["steers"] == "1"]
    assert steers
    for row in steers:
        crowd, seen = (
            np.array([float(of["longitude_deg"]), float(of["latitude_deg"])]) for of in (true[row["frame"]], row)
        )
        assert np.linalg.norm(geometry.east_north(crowd[None], (seen[0], seen[1]))) < 4.0
