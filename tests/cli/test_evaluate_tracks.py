"""`dddas evaluate` of tracks."""

import json

import pytest

TRUTH = "1,1,0,0,10,20,1,-1,-1\n1,2,100,0,10,20,0,-1,-1\n2,1,0,0,10,20,1,-1,-1\n"
FOUND = "1,7,0,0,10,20,1,-1,-1,-1\n1,8,100,0,10,20,1,-1,-1,-1\n2,8,0,0,10,20,1,-1,-1,-1\n"


@pytest.fixture
def places(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "gt.txt").write_text(TRUTH)
    (tmp_path / "out/tracks.txt").write_text(FOUND)
    return tmp_path / "gt.txt", tmp_path / "out"


def test_tracks_get_a_table_of_80_columns_and_metrics_beside_the_file(dddas, places):
    truth, out = places
    result = dddas("evaluate", truth, out / "tracks.txt")
    assert result.exit_code == 0
    for word in ("HOTA", "MOTA", "IDF1", "IDsw", "AR_3"):
        assert word in result.stdout
    assert max(map(len, result.stdout.splitlines()[:6])) <= 80
    assert json.loads((out / "metrics.json").read_text())["clips"]["tracks"]["tracks"]["n_switches"] == 1


def test_interval_and_ignored_rows_are_options(dddas, places):
    assert dddas("evaluate", *places, "--interval", 2, "--ignored", "removed").exit_code == 0
    found = json.loads((places[1] / "metrics.json").read_text())["clips"]["out"]["tracks"]
    assert (found["n_tp"], found["n_fp"], found["n_fn"]) == (1, 0, 0)


def test_a_mistake_in_the_tracks_is_one_line(dddas, places):
    (places[1] / "tracks.txt").write_text(FOUND + "2,8,5,5,10,20,1\n")
    result = dddas("evaluate", *places)
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith("dddas: ")
    assert "tracks.txt, lines 3 and 4: identity 8 twice in frame 2" in line
    assert dddas("evaluate", *places, "--interval", 0).exit_code == 2


def test_many_clips_get_a_pooled_and_a_mean_row(dddas, tmp_path):
    for name in "ab":
        (tmp_path / "truth" / name).mkdir(parents=True)
        (tmp_path / "truth" / name / "gt.txt").write_text(TRUTH)
        (tmp_path / "found").mkdir(exist_ok=True)
        (tmp_path / "found" / f"{name}.txt").write_text(FOUND)
    result = dddas("evaluate", tmp_path / "truth", tmp_path / "found")
    assert "pooled" in result.stdout
    assert "mean" in result.stdout
    assert (tmp_path / "found/metrics.json").is_file()
