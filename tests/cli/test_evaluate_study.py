"""`dddas evaluate --dataset`: what a user sees of a study, and of a mistake."""

import json

import pytest

from tests.evaluation.studies import world


@pytest.fixture
def study(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    world.followed(tmp_path / "clips", "table", 3, pictures=False)
    world.followed(tmp_path / "clips", "other", 4, pictures=False)
    return world.study(tmp_path / "clips")


def test_a_study_writes_its_measures_its_report_and_what_was_run(dddas, study, tmp_path) -> None:
    done = dddas("evaluate", "--dataset", study, "--jobs", 1, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    measures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert set(measures["tasks"]["association"]["clips"]) == {"table", "other"}
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["state"] == "complete" and run["study"]["name"] == "study" and run["left_out"] == []
    assert (tmp_path / "out" / "report.html").read_text().lower().startswith("<!doctype html>")
    assert "association: Tracks" in done.stdout and "pooled" in done.stdout
    assert "2 of 2" in done.stderr and "(tracking, association)" in done.stderr
    assert (tmp_path / "home" / "torchvision_dddas" / "studies").is_dir()


def test_clips_that_are_left_out_are_named_at_the_end(dddas, study, tmp_path) -> None:
    world.filmed(tmp_path / "clips", "bare", masks=False)
    done = dddas("evaluate", "--dataset", study, "--jobs", 1, "--out", tmp_path / "out")
    assert done.exit_code == 0
    assert any(x.startswith("left out: bare") and "no truth" in x for x in done.stdout.splitlines())


def test_a_line_is_not_broken_however_long(dddas, study, tmp_path) -> None:
    world.filmed(tmp_path / "clips", "a_clip_whose_name_alone_is_longer_than_half_a_line_of_a_terminal", masks=False)
    done = dddas("evaluate", "--dataset", study, "--jobs", 1, "--out", tmp_path / "out")
    assert any(x.startswith("left out: a_clip") and x.endswith("can be scored") for x in done.stdout.splitlines())


def test_names_are_shown_as_they_are(dddas, tmp_path) -> None:
    world.followed(tmp_path / "clips", "car[red]s", 3, pictures=False)
    words = ("--jobs", 1, "--out", tmp_path / "out", "--cache", tmp_path / "cache")
    assert "car[red]s │" in dddas("evaluate", "--dataset", world.study(tmp_path / "clips"), *words).stdout


def test_what_lacks_of_clips_that_are_scored_is_a_note_and_not_left_out(dddas, tmp_path) -> None:
    world.followed(tmp_path / "clips", "bare", 3, pictures=False)
    film = world.filmed(tmp_path / "own", "film", 4)
    (film / "frames" / "000004.png").write_bytes(b"no picture")
    tables = (("motchallenge", "clips"), ("folder", "own"))
    text = "".join(f'[[dataset]]\nkind = "{kind}"\nfolder = "{folder}"\n' for kind, folder in tables)
    (tmp_path / "study.toml").write_text(text)
    words = ("--jobs", 1, "--out", tmp_path / "out", "--cache", tmp_path / "cache")
    done = dddas("evaluate", "--dataset", tmp_path / "study.toml", *words)
    assert done.exit_code == 0 and "left out:" not in done.output
    told = [line for line in done.stdout.splitlines() if line.startswith("note: ")]
    assert told[0].startswith("note: bare: no pictures, which belong in ")
    assert any(line.startswith("note: film, motion: ") and "000004.png" in line for line in told[1:])
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["left_out"] == [] and [f"note: {line}" for line in run["notes"]] == told
    assert "no pictures, which belong in" in (tmp_path / "out" / "report.html").read_text()


def test_a_study_that_could_score_nothing_fails_and_says_why(dddas, tmp_path) -> None:
    film = world.filmed(tmp_path / "clips", "film", 4)
    (film / "masks" / "000004.png").write_bytes(b"no picture")
    study = world.study(tmp_path / "clips")
    words = ("--jobs", 1, "--out", tmp_path / "out", "--cache", tmp_path / "cache")
    done = dddas("evaluate", "--dataset", study, *words)
    assert done.exit_code == 2 and done.stderr.splitlines()[-1].startswith(
        "dddas: nothing could be scored; film, motion: "
    )
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.slow
def test_the_command_line_changes_the_study(dddas, study, tmp_path) -> None:
    words = ("--clips", "ta*", "--set", "track.memory_frames=7", "--interval", 2, "--jobs", 1, "--quiet")
    done = dddas("evaluate", "--dataset", study, *words, "--out", tmp_path / "out", "--cache", tmp_path / "cache")
    assert done.exit_code == 0 and done.output == ""
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["study"]["interval"] == 2 and run["settings"]["track"]["memory_frames"] == 7
    measures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert set(measures["tasks"]["tracking"]["clips"]) == {"table"}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--jobs", "0"), "--jobs must be 1 or more"),
        (("--jobs", "2", "--scheduler", "tcp://127.0.0.1:1"), "give only one"),
        (("--scheduler", "tcp://127.0.0.1:1"), "no Dask scheduler answers at tcp://127.0.0.1:1"),
        (("--scheduler", "nonsense"), "no Dask scheduler answers at nonsense"),
        (("--clips", "nobody"), "nobody fits none; there are other, table"),
        (("--clips", ""), "--clips '' names no clip"),
        (("--interval", "1001"), "--interval must be 1 to 1000 frames"),
        (("--set", "no.parameter=1"), "unknown parameter"),
        (("--first-frame", "0"), "--first-frame is of no use with --dataset"),
        (("--interval", "0"), "--interval must be 1 to 1000 frames, got 0"),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(dddas, study, tmp_path, words, told) -> None:
    if "--scheduler" in words:
        pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    done = dddas("evaluate", "--dataset", study, "--quiet", "--out", tmp_path / "out", *words)
    assert done.exit_code == 2
    assert told in done.stderr and len(done.stderr.splitlines()) == 1


def test_bad_input_leaves_an_earlier_study_of_the_folder_as_it_was(dddas, study, tmp_path) -> None:
    words = ("evaluate", "--dataset", study, "--jobs", 1, "--quiet", "--out", tmp_path / "out")
    assert dddas(*words).exit_code == 0
    before = (tmp_path / "out" / "run.json").read_bytes()
    assert dddas(*words, "--clips", "nobody").exit_code == 2
    assert (tmp_path / "out" / "run.json").read_bytes() == before


def test_options_of_a_study_need_one(dddas, tmp_path) -> None:
    done = dddas("evaluate", tmp_path, tmp_path, "--jobs", 2)
    assert done.exit_code == 2 and "--jobs is for a study; give --dataset FILE too" in done.stderr
    done = dddas("evaluate", tmp_path)
    assert done.exit_code == 2 and "evaluate needs TRUTH and RESULT, or --dataset FILE" in done.stderr


def test_an_unknown_kind_lists_the_kinds(dddas, tmp_path) -> None:
    (tmp_path / "study.toml").write_text('[[dataset]]\nkind = "imagenet"\nfolder = "."\n')
    done = dddas("evaluate", "--dataset", tmp_path / "study.toml", "--out", tmp_path / "out")
    assert done.exit_code == 2 and "davis" in done.stderr and len(done.stderr.splitlines()) == 1
