"""`dddas evaluate` of tracks and of whole studies, and `dddas compare`: what a user sees, and one line a mistake."""

import json

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad, record
from tests.lab.evaluation.studies import world
from torchvision_dddas.lab.evaluation.studies.cache import SCORES

TRUTH = "1,1,0,0,10,20,1,-1,-1\n1,2,100,0,10,20,0,-1,-1\n2,1,0,0,10,20,1,-1,-1\n"
FOUND = "1,7,0,0,10,20,1,-1,-1,-1\n1,8,100,0,10,20,1,-1,-1,-1\n2,8,0,0,10,20,1,-1,-1,-1\n"


def measures(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_tracks_get_a_table_of_80_columns_and_metrics_beside_the_file(dddas, file, tmp_path):
    (tmp_path / "out").mkdir()
    places = truth, out = file("gt.txt", TRUTH), file("out/tracks.txt", FOUND).parent
    result = dddas("evaluate", truth, out / "tracks.txt")
    assert result.exit_code == 0
    assert all(word in result.stdout for word in ("HOTA", "MOTA", "IDF1", "IDsw", "AR_3"))
    assert max(map(len, result.stdout.splitlines()[:6])) <= 80
    assert measures(out)["clips"]["tracks"]["tracks"]["n_switches"] == 1
    assert dddas("evaluate", *places, "--interval", 2, "--ignored", "removed").exit_code == 0
    found = measures(out)["clips"]["out"]["tracks"]
    assert (found["n_tp"], found["n_fp"], found["n_fn"]) == (1, 0, 0)
    (out / "tracks.txt").write_text(FOUND + "2,8,5,5,10,20,1\n")
    assert "tracks.txt, lines 3 and 4: identity 8 twice in frame 2" in bad(dddas("evaluate", *places))


def test_many_clips_get_a_pooled_and_a_mean_row(dddas, tmp_path):
    (tmp_path / "found").mkdir()
    for name in "ab":
        (tmp_path / "truth" / name).mkdir(parents=True)
        (tmp_path / "truth" / name / "gt.txt").write_text(TRUTH)
        (tmp_path / "found" / f"{name}.txt").write_text(FOUND)
    result = dddas("evaluate", tmp_path / "truth", tmp_path / "found")
    assert "pooled" in result.stdout and "mean" in result.stdout
    assert (tmp_path / "found/metrics.json").is_file()


@pytest.fixture
def study(dddas, tmp_path, monkeypatch):
    """Runs `dddas evaluate --dataset` on a study of two tables, whose results go to out/."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    for seed, name in enumerate(("car[red]s", "other"), 3):
        world.followed(tmp_path / "clips", name, seed, pictures=False)
    file = world.study(tmp_path / "clips")

    def run(*words):
        jobs = () if {"--jobs", "--scheduler"} & set(words) else ("--jobs", 1)  # others take seconds to start
        return dddas("evaluate", "--dataset", file, *jobs, "--out", tmp_path / "out", *words)

    return run


def test_a_study_writes_its_measures_its_report_and_what_was_run(study, dddas, tmp_path) -> None:
    long_name = "a_clip_whose_name_alone_is_longer_than_half_a_line_of_a_terminal"
    world.filmed(tmp_path / "clips", long_name, masks=False)
    done = study()
    assert done.exit_code == 0, done.output
    assert set(measures(tmp_path / "out")["tasks"]["association"]["clips"]) == {"car[red]s", "other"}
    run = record(tmp_path / "out")
    assert run["state"] == "complete" and run["study"]["name"] == "study" and len(run["left_out"]) == 1
    assert (tmp_path / "out" / "report.html").read_text().lower().startswith("<!doctype html>")
    lines = done.stdout.splitlines()
    assert "association: Tracks" in done.stdout and "pooled" in done.stdout and "│ car[red]s " in done.stdout
    assert any(x.startswith(f"left out: {long_name}") and x.endswith("so that it cannot be scored") for x in lines)
    assert "2 of 2" in done.stderr and "(tracking, association)" in done.stderr
    assert (tmp_path / "home" / "torchvision_dddas" / "studies").is_dir()
    again = study("--set", "track.memory_frames=1", "--prune-cache", 0, "--out", tmp_path / "other")
    assert "results unused for 0 days were removed" in again.stdout
    shown = dddas("compare", tmp_path / "out", tmp_path / "other", "--out", tmp_path / "compare.html")
    assert "tracking, 2 clips together" in shown.stdout and "identical in both" in shown.stdout
    page = (tmp_path / "compare.html").read_text()
    for name in "A: study (", "B: study (", "track.memory_frames: ", " in A, 1 in B":
        assert name in shown.stdout and name in page
    assert f"B: study ({tmp_path / 'other'})" in shown.stdout and "</html>" in page
    found = json.loads(dddas("compare", tmp_path / "out", tmp_path / "other", "--json").stdout)
    assert found["tasks"]["association"]["pooled"]["tracks"]["mota"]["says"]
    assert list(found["settings"]) == ["track.memory_frames"] and found["settings"]["track.memory_frames"][1] == 1
    (tmp_path / "other" / SCORES).write_bytes(b"x" * 100)
    assert "is damaged or of another version" in bad(dddas("compare", tmp_path / "out", tmp_path / "other"))
    assert "is not a study: it lacks scores.bin" in bad(dddas("compare", tmp_path / "out", tmp_path / "clips"))


def test_what_a_study_keeps_is_scored_as_the_study_was(study, dddas, tmp_path) -> None:
    done = study("--keep", "tracks,masks", "--clips", "other")
    assert done.exit_code == 0 and "note: --keep masks: no task of this study has masks" in done.output
    kept = tmp_path / "out" / "kept" / "tracking"
    assert dddas("evaluate", tmp_path / "clips", kept).exit_code == 0
    of_study = measures(tmp_path / "out")["tasks"]["tracking"]["clips"]["other"]["tracks"]
    assert measures(kept)["clips"]["other"]["tracks"] == of_study
    assert "--keep takes tracks, detections, masks, got 'boxes'" in bad(study("--keep", "boxes"))


def test_results_of_several_methods_are_a_study_each_and_compared(dddas, file, tmp_path) -> None:
    truth, out = file("gt.txt", TRUTH), tmp_path / "out"
    for side in "ab":
        (tmp_path / side).mkdir()
    places = file("a/tracks.txt", FOUND), file("b/tracks.txt", FOUND.replace("2,8,", "2,7,"))
    done = dddas("evaluate", truth, *places, "--names", "ours,sort", "--out", out)
    assert done.exit_code == 0, done.output
    assert "A: ours" in done.stdout and "p, corrected" in done.stdout and (out / "report.html").is_file()
    shown = dddas("compare", out / "ours", out / "sort", "--out", tmp_path / "page.html")
    assert shown.exit_code == 0 and (tmp_path / "page-tables" / "tracking.tex").is_file()
    assert "two results are named 'tracks'" in bad(dddas("evaluate", truth, *places, "--out", out))
    assert "--names is of no use" in bad(dddas("evaluate", "--dataset", truth, "--names", "a"))


@pytest.fixture
def own_study(dddas, tmp_path):
    """Runs `dddas evaluate --dataset` on a file of the test's own."""
    words = ("--jobs", 1, "--out", tmp_path / "out", "--cache", tmp_path / "cache")
    return lambda file: dddas("evaluate", "--dataset", file, *words)


def test_what_clips_that_are_scored_lack_is_a_note_and_not_left_out(own_study, file, tmp_path) -> None:
    world.followed(tmp_path / "clips", "bare", 3, pictures=False)
    film = world.filmed(tmp_path / "own", "film", 4)
    (film / "frames" / "000004.png").write_bytes(b"no picture")
    tables = (("motchallenge", "clips"), ("folder", "own"))
    text = "".join(f'[[dataset]]\nkind = "{kind}"\nfolder = "{folder}"\n' for kind, folder in tables)
    done = own_study(file("study.toml", text))
    assert done.exit_code == 0 and "left out:" not in done.output
    notes = [line for line in done.stdout.splitlines() if line.startswith("note: ")]
    assert notes[0].startswith("note: bare: no pictures; they belong in ")
    assert any(line.startswith("note: film, motion: ") and "000004.png" in line for line in notes[1:])
    run = record(tmp_path / "out")
    assert run["left_out"] == [] and [f"note: {line}" for line in run["notes"]] == notes
    assert "no pictures; they belong in" in (tmp_path / "out" / "report.html").read_text()


def test_a_study_that_could_score_nothing_fails_and_says_why(own_study, tmp_path) -> None:
    film = world.filmed(tmp_path / "clips", "film", 4)
    (film / "masks" / "000004.png").write_bytes(b"no picture")
    done = own_study(world.study(tmp_path / "clips"))
    assert done.exit_code == 2
    assert done.stderr.splitlines()[-1].startswith("dddas: nothing could be scored; film, motion: ")
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.slow
def test_the_command_line_changes_the_study(study, tmp_path) -> None:
    words = ("--clips", "oth*", "--set", "track.memory_frames=7", "--interval", 2, "--quiet")
    done = study(*words, "--cache", tmp_path / "cache")
    assert done.exit_code == 0 and done.output == ""
    run = record(tmp_path / "out")
    assert run["study"]["interval"] == 2 and run["settings"]["track"]["memory_frames"] == 7
    assert set(measures(tmp_path / "out")["tasks"]["tracking"]["clips"]) == {"other"}
    bad(study("--clips", "nobody"))  # leaves the earlier study as it was
    assert record(tmp_path / "out") == run


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--jobs", "0"), "--jobs must be 1 or more"),
        (("--jobs", "2", "--scheduler", "tcp://127.0.0.1:1"), "give only one"),
        (("--scheduler", "nonsense"), "no Dask scheduler answers at nonsense"),
        (("--clips", "nobody"), "nobody fits none; there are car[red]s, other"),
        (("--clips", ""), "--clips '' names no clip"),
        (("--interval", "0"), "--interval must be 1 to 1000 frames, got 0"),
        (("--first-frame", "0"), "--first-frame is of no use with --dataset"),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(study, words, message) -> None:
    if "--scheduler" in words:
        pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    assert message in bad(study("--quiet", *words))


@pytest.mark.parametrize("out", ["b.csv", "b.json", "b.xml", "b.parquet", "davis"])
def test_results_in_each_format_that_convert_writes_score_as_text_does(dddas, file, tmp_path, out):
    if out == "b.parquet":
        pytest.importorskip("pyarrow", reason="the extra 'parquet' is not installed")
    truth, text = file("gt.txt", TRUTH), file("b.txt", FOUND)
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "1.png"), np.zeros((40, 200), np.uint8))
    more = ("--to", "davis", "--clip", tmp_path / "frames") if out == "davis" else ()
    out = tmp_path / "as" / out
    out.parent.mkdir()
    assert dddas("convert", text, out, *more).exit_code == 0
    places = [text, out, *([out / "masks"] if more else [])]
    folders = [tmp_path / f"by_{k}" for k in range(len(places))]
    for place, folder in zip(places, folders, strict=True):
        done = dddas("evaluate", truth, place, "--out", folder)
        assert done.exit_code == 0, done.output
    one, *others = (next(iter(measures(folder)["clips"].values())) for folder in folders)
    assert all(other == one for other in others) and one["tracks"]["n_tp"] == 2


def test_the_csv_of_a_run_is_scored_without_its_detections_that_have_no_identity(dddas, file, tmp_path):
    rows = "1,7,0,0,10,20,detection\n1,8,100,0,10,20,detection\n2,8,0,0,10,20,bridge\n2,,9,9,10,20,untracked\n"
    table = file("tracks.csv", f"frame,identity,x_px,y_px,width_px,height_px,kind\n{rows}")
    assert dddas("evaluate", file("gt.txt", TRUTH), table).exit_code == 0
    assert measures(tmp_path)["clips"]["tracks"]["tracks"]["n_fp"] == 1


def test_a_film_names_its_true_boxes_and_small_boxes_name_the_option_for_them(dddas, file, tmp_path):
    (tmp_path / "film" / "truth").mkdir(parents=True)
    (tmp_path / "found").mkdir()
    truth = file("film/truth/gt.txt", "".join(f"{n},1,{n},0,6,6,1,-1,-1\n" for n in range(1, 9)))
    found = file("found/tracks.txt", "".join(f"{n},1,{n + 2},1,6,6,1,-1,-1,-1\n" for n in range(1, 9)))
    assert f"{truth} holds the true boxes" in bad(dddas("evaluate", truth.parent.parent, found))
    said = dddas("evaluate", truth, found).stdout
    assert "IoU 0.2 finds 8 more of 8 boxes than IoU 0.5; --iou 0.2 counts" in said.replace("\n", " ")
    assert measures(found.parent)["clips"]["tracks"]["tracks"]["recall"] == 0
    done = dddas("evaluate", truth, found, "--iou", 0.2)
    assert "note: boxes count as found from IoU 0.2 on" in done.stdout
    scored = measures(found.parent)["clips"]["tracks"]["tracks"]
    assert scored["recall"] == scored["idf1"] == 1
    assert "must be above 0 and at most 1, got 2" in bad(dddas("evaluate", truth, found, "--iou", 2))
