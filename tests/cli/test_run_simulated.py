"""`dddas run sim:SCENARIO`: a closed loop from the command line, its files and the truth beside them."""

import numpy as np
import pytest

from tests.cli.conftest import record, rows
from tests.simulation.small import as_file, small
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
    assert found.lonlat_deg is not None
    assert true.lonlat_deg is not None
    assert len(found) > 5
    kind = np.array([row["kind"] for row in rows(folder / "truth" / "positions.csv")])
    nearest = []
    for frame, place in zip(found.frame.tolist(), found.lonlat_deg, strict=True):
        crowd = true.lonlat_deg[(true.frame == frame) & (kind == "person")]
        nearest.append(np.linalg.norm(geometry.east_north(crowd, (place[0], place[1])), axis=1).min())
    assert np.median(nearest) < 2.0


def test_the_truth_is_judged_by_evaluate(made, dddas):
    folder, said = made
    assert f"dddas evaluate {folder / 'truth' / 'gt.txt'} {folder}" in said
    result = dddas("evaluate", folder / "truth" / "gt.txt", folder)
    assert result.exit_code == 0, result.output
    assert "HOTA" in result.stdout


def test_the_log_tells_what_the_run_itself_noticed(made):
    folder, _ = made
    noticed = [line for line in (folder / "log.txt").read_text().splitlines() if " noticed " in line]
    assert "the camera is frozen" in noticed[0]
    assert "3 pictures repeated" in noticed[1]
    assert "noticed" in (folder / "report.html").read_text()
    assert "frame 17 was dropped by the camera" in (folder / "log.txt").read_text()


def test_the_record_says_how_good_it_was(made):
    folder, said = made
    kept = record(folder)
    assert kept["state"] == "complete"
    assert kept["frames"]["written"] == 24
    assert kept["truth_score"]
    assert "crowds: " in said


@pytest.mark.slow
def test_an_interrupt_leaves_results_and_truth_up_to_the_same_frame(tmp_path, dddas, monkeypatch):
    from torchvision_dddas.simulation import SimulatedRunRecorder

    survey = SimulatedRunRecorder.write

    def short(self, item):
        survey(self, item)
        if item.tracked.number == 6:
            raise KeyboardInterrupt

    monkeypatch.setattr(SimulatedRunRecorder, "write", short)
    out = tmp_path / "out"
    path = scenario(tmp_path / "tiny.toml")
    result = dddas("run", f"sim:{path}", "--out", out, "--save", "truth", "--quiet", "--set", "steering.sampling=false")
    assert result.exit_code == 130
    assert record(out)["state"] == "interrupted"
    assert max(int(row["frame"]) for row in rows(out / "truth" / "positions.csv")) == 6
    assert len(rows(out / "fixes.csv")) == 6


@pytest.mark.slow
def test_truth_that_is_not_asked_for_goes_with_the_earlier_run(made, dddas, tmp_path):
    path = scenario(tmp_path / "tiny.toml", clip={"seconds": 0.5})
    for save, there in (("truth", True), ("none", False)):
        result = dddas("run", f"sim:{path}", "--out", tmp_path / "out", "--save", save, "--quiet")
        assert result.exit_code == 0, result.output
        assert result.output == ""
        assert (tmp_path / "out" / "truth" / "gt.txt").exists() == there
