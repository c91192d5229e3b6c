"""`dddas track`: what it writes, and one line for each mistake."""

import json
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.mistakes import bad

UNREAD = "the frame could not be read"
ROOT = Path(__file__).resolve().parents[2]


def walker(frames, x=4.0):
    return "".join(f"{n},-1,{x + n:.3f},10,8,24,0.95,-1,-1,-1\n" for n in frames)


@pytest.fixture
def table(tmp_path):
    def write(text=None):
        path = tmp_path / "det.txt"
        path.write_text(walker(range(1, 6)) if text is None else text)
        return path

    return write


def tracks(folder):
    text = (folder / "tracks.txt").read_text()
    return np.array([[float(v) for v in line.split(",")] for line in text.splitlines()]).reshape(-1, 10)


def record(folder):
    return json.loads((folder / "run.json").read_text())


def files(folder):
    return sorted(p.name for p in folder.iterdir())


def test_a_table_alone_gives_tables_and_a_record_without_a_film(dddas, table, tmp_path):
    result = dddas("track", "--detections", table(), "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines() == [
        "5 frames, 5 detections, 1 identities, 0 detections without one",
        f"{tmp_path / 'out'}: tracks.csv, tracks.txt, run.json",
    ]
    assert files(tmp_path / "out") == ["run.json", "tracks.csv", "tracks.txt"]
    made = tracks(tmp_path / "out")
    assert made[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert len(set(made[:, 1])) == 1
    assert np.array_equal(made[:, 2:6], [[4 + n, 10, 8, 24] for n in range(1, 6)])
    kept = record(tmp_path / "out")
    assert (kept["state"], kept["frames"]["written"], kept["identities"], kept["untracked"]) == ("complete", 5, 1, 0)
    assert kept["rows"] == {"given": 5, "used": 5}
    assert (kept["clip"], kept["backend"], kept["outputs"]) == (None, None, ["tables"])
    assert "track" in kept["settings"] and "track" in kept["seconds"]["stages"]


def test_a_clip_with_a_table_gives_a_film_of_the_frames_looked_at(dddas, clip, table, tmp_path):
    words = ("--detections", table(), "--interval", 2, "--out", tmp_path / "out", "--rate", 8)
    result = dddas("track", clip, *words)
    assert result.exit_code == 0, result.output
    assert "note: 2 of 5 rows lie on frames that --interval 2 leaves out" in result.stdout
    film = cv2.VideoCapture(str(tmp_path / "out/overlay.mp4"))
    assert (film.get(cv2.CAP_PROP_FRAME_COUNT), film.get(cv2.CAP_PROP_FPS)) == (3, 4)
    assert tracks(tmp_path / "out")[:, 0].tolist() == [1, 3, 5]
    kept = record(tmp_path / "out")
    assert kept["rows"] == {"given": 5, "used": 3}
    assert kept["notes"] == ["2 of 5 rows lie on frames that --interval 2 leaves out"]
    assert (kept["interval_frames"], kept["backend"], kept["clip"]["size"]) == (2, "onboard", [64, 48])


def test_a_clip_alone_is_tracked_by_its_own_detections(dddas, engine, clip, tmp_path):
    result = dddas("track", clip, "--out", tmp_path / "out", "--save", "none", "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    made = tracks(tmp_path / "out")
    assert made[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert len(set(made[:, 1])) == 1
    assert record(tmp_path / "out")["backend"] == "stub auto"
    assert record(tmp_path / "out")["unreliable"] == [{"first": 2, "last": 2, "cause": "blank"}]


def test_what_detect_wrote_can_be_tracked_as_text_and_as_csv(dddas, engine, clip, tmp_path):
    dddas("detect", clip, "--out", tmp_path / "found", "--quiet")
    for name in ("detections.txt", "detections.csv"):
        words = ("--detections", tmp_path / "found" / name, "--out", tmp_path / name, "--quiet")
        assert dddas("track", *words).exit_code == 0
        assert len(tracks(tmp_path / name)) == 5
    assert (tmp_path / "detections.txt/tracks.txt").read_text() == (tmp_path / "detections.csv/tracks.txt").read_text()


def test_the_csv_of_detect_gives_identities_however_faint_its_targets_are(dddas, clip, table, tmp_path):
    names = "frame,target,x_px,y_px,width_px,height_px,score,kind\n"
    text = names + "".join(f"{n},1,{4 + n},10,8,24,0.41,moving\n" for n in range(1, 6))
    for words in ((), (clip,)):
        result = dddas("track", *words, "--detections", table(text), "--out", tmp_path / "out", "--save", "none")
        assert "5 detections, 1 identities, 0 detections without one" in result.stdout
        assert "note: all rows are moving targets of dddas detect" in result.stdout
        assert tracks(tmp_path / "out")[:, 6].tolist() == [0.41] * 5


def test_a_clip_in_which_nothing_moves_has_empty_tables(dddas, engine, clip, tmp_path):
    engine(found=False)
    dddas("detect", clip, "--out", tmp_path / "found", "--quiet")
    for words in ([clip], ["--detections", tmp_path / "found/detections.txt"]):
        assert dddas("track", *words, "--out", tmp_path / "out", "--quiet", "--save", "none").exit_code == 0
        assert (tmp_path / "out/tracks.txt").read_text() == ""
        assert (tmp_path / "out/tracks.csv").read_text().count("\n") == 1


def test_rows_in_any_order_give_the_same_tracks(dddas, table, tmp_path):
    text = walker(range(1, 20)) + walker(range(1, 20), x=40)
    lines = text.splitlines(keepends=True)
    made = []
    for k, rows in enumerate([lines, lines[::-1]]):
        dddas("track", "--detections", table("".join(rows)), "--out", tmp_path / f"{k}", "--quiet")
        made.append(tracks(tmp_path / f"{k}"))
    same = [{(f, *box): i for f, i, *box in run[:, :6].tolist()} for run in made]
    assert same[0].keys() == same[1].keys()
    assert len({(same[0][key], same[1][key]) for key in same[0]}) == 2


def test_scores_that_are_no_probabilities_are_told_and_kept(dddas, table, tmp_path):
    text = walker(range(1, 6)).replace("0.95", "43.332")
    result = dddas("track", "--detections", table(text), "--out", tmp_path / "out")
    assert "note: scores from 43.332 to 43.332 are no probabilities" in result.stdout
    assert set(tracks(tmp_path / "out")[:, 6]) == {43.332}


def test_rows_that_get_no_identity_are_counted_and_stay_in_the_csv(dddas, table, tmp_path):
    text = walker(range(1, 6)) + walker(range(1, 6), x=40).replace("0.95", "0.05")
    result = dddas("track", "--detections", table(text), "--out", tmp_path / "out")
    assert "10 detections, 1 identities, 5 detections without one" in result.stdout
    assert (tmp_path / "out/tracks.csv").read_text().count("untracked") == 5
    assert len(tracks(tmp_path / "out")) == 5


def test_settings_choose_the_mode_and_are_recorded(dddas, clip, table, tmp_path):
    words = ("--set", "track.mode=paper", "--save", "none", "--quiet")
    assert dddas("track", clip, "--detections", table(), "--out", tmp_path / "out", *words).exit_code == 0
    assert record(tmp_path / "out")["settings"]["track"]["mode"] == "paper"


MISTAKES = [
    (("--set", "track.mod=paper"), "unknown parameter"),
    (("--set", "track.mode=best"), "track.mode"),
    (("--config", "nosuch"), "nosuch"),
    (("--save", "masks"), "--save must name some of overlay, all or none, got 'masks'"),
    (("--save", "overlay"), "--save overlay needs a clip"),
    (("--interval", "0"), "--interval is 0; wanted 1 or more"),
    (("--interval", "-2"), "--interval is -2"),
]


@pytest.mark.parametrize(("words", "says"), MISTAKES)
def test_a_mistake_in_an_option_is_one_line_and_leaves_no_folder(dddas, table, tmp_path, words, says):
    assert says in bad(dddas("track", "--detections", table(), "--out", tmp_path / "out", *words))
    assert not (tmp_path / "out").exists()


def test_neither_clip_nor_table_is_one_line(dddas):
    assert "track needs a clip, a table of detections" in bad(dddas("track"))


BAD_ROWS = [
    ("3,-1,5,5,x,9\n", "line 6: width is 'x'"),
    ("3,-1,5,5,-2,9\n", "line 6: width is '-2'; wanted pixels, 0.001 at least"),
    ("3,-1,5,nan,2,9\n", "line 6: y is 'nan'"),
    ("0,-1,5,5,2,9\n", "line 6: frame is '0'"),
    ("3,-1,5\n", "line 6: 3 columns"),
    ("6,-1,5,5,2,9\n", "line 6: the table goes on to frame 6 but"),
]


@pytest.mark.parametrize(("row", "says"), BAD_ROWS)
def test_a_bad_row_is_one_line_that_names_it_and_leaves_no_folder(dddas, clip, table, tmp_path, row, says):
    path = table(walker(range(1, 6)) + row)
    said = bad(dddas("track", clip, "--detections", path, "--out", tmp_path / "out"))
    assert says in said and str(path) in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["nosuch.mp4"], ["--detections", "nosuch.txt"]])
def test_a_missing_input_is_one_line_and_leaves_no_folder(dddas, tmp_path, words):
    assert words[-1] in bad(dddas("track", *words, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_tracks_that_someone_else_made_are_not_replaced(dddas, table, tmp_path):
    (tmp_path / "tracks.txt").write_text("truth")
    assert "tracks.txt was not written by dddas" in bad(dddas("track", "--detections", table(), "--out", tmp_path))
    assert (tmp_path / "tracks.txt").read_text() == "truth"


@pytest.mark.parametrize("name", ["tracks.txt", "tracks.csv", "run.json", "overlay.mp4"])
def test_a_table_that_the_run_would_write_over_is_refused(dddas, table, tmp_path, name):
    out = tmp_path / "out"
    assert dddas("track", "--detections", table(), "--out", out, "--quiet").exit_code == 0
    (out / name).write_text(walker(range(1, 6)))
    before = {path: path.read_bytes() for path in out.iterdir()}
    said = bad(dddas("track", "--detections", tmp_path / "out/../out" / name, "--out", out))
    assert f"{name} is a file that this run writes; choose another folder with --out" in said
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_clip_that_the_run_would_write_over_is_refused(dddas, tmp_path):
    film = tmp_path / "out/overlay.mp4"
    said = bad(dddas("track", film, "--out", tmp_path / "out"))
    assert "overlay.mp4 is a file that this run writes; choose another folder with --out" in said


def test_the_record_of_a_run_that_begins_late_names_its_first_and_last_frame(dddas, table, tmp_path):
    text = walker(range(501, 560), x=0) + walker(range(502, 560), x=40)
    dddas("track", "--detections", table(text), "--interval", 2, "--out", tmp_path / "out", "--quiet")
    kept = record(tmp_path / "out")
    assert (kept["first_frame"], kept["last_frame"], kept["frames"]["written"]) == (501, 559, 30)
    assert kept["identities"] == len(set(tracks(tmp_path / "out")[:, 1])) == 2


def test_a_frame_that_cannot_be_decoded_keeps_its_rows_and_is_told(dddas, clip, table, tmp_path):
    (clip / "00002.png").write_bytes(b"no picture")
    result = dddas("track", clip, "--detections", table(), "--out", tmp_path / "out")
    assert "1 problem while reading, the first: frame 3" in result.stdout
    assert tracks(tmp_path / "out")[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert record(tmp_path / "out")["unreliable"][1] == {"first": 3, "last": 3, "cause": UNREAD}
    assert cv2.VideoCapture(str(tmp_path / "out/overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 5


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize(("size", "grey"), [((1, 1), False), ((90, 3), True), ((101, 67), True), ((8, 8), False)])
def test_clips_of_any_size_and_colour_can_be_tracked(dddas, table, tmp_path, size, grey, given):
    folder, rng = tmp_path / "frames", np.random.default_rng(0)
    folder.mkdir()
    for k in range(6):
        shape = size[::-1] if grey else (*size[::-1], 3)
        image = rng.integers(0, 4095, shape, dtype=np.uint16) if grey else rng.integers(0, 255, shape, dtype=np.uint8)
        cv2.imwrite(str(folder / f"{k}.png"), image)
    words = ("--detections", table()) if given else ()
    result = dddas("track", folder, *words, "--out", tmp_path / "out", "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    assert record(tmp_path / "out")["frames"]["written"] == 6
    assert (tmp_path / "out/tracks.csv").read_text().count("\n") >= 1 + 5 * given
    assert cv2.VideoCapture(str(tmp_path / "out/overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 6


def test_a_clip_cut_short_ends_with_a_note_and_keeps_the_rows_after_it(dddas, table, tmp_path):
    """A Matroska file does not count its frames: what it announces is no reason to refuse a table."""
    path = tmp_path / "clip.mkv"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for k in range(8):
        writer.write(np.full((48, 64, 3), 60 + k, np.uint8))
    writer.release()
    result = dddas("track", path, "--detections", table(walker(range(1, 13))), "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "note: the clip ended after frame 8, the table goes on to 12" in result.stdout
    assert tracks(tmp_path / "out")[:, 0].tolist() == list(range(1, 13))


def test_ctrl_c_exits_with_130_and_leaves_valid_outputs(clip, table, tmp_path):
    """In a process of its own, with a true signal after the third frame was written."""
    program = """
        import sys, time
        from torchvision_dddas.io.tables import TableFiles
        honest, seen = TableFiles.write, []

        def write(self, followed):
            honest(self, followed)
            seen.append(followed.number)

        TableFiles.write = write
        from contextlib import contextmanager
        import torchvision_dddas.cli

        @contextmanager
        def stopping(*_):
            def tick():
                if len(seen) == 3:
                    print("now", flush=True)
                    time.sleep(60)
            yield tick

        sys.modules["torchvision_dddas.cli.track"].progress = stopping
        from torchvision_dddas.cli import main
        main()
    """
    words = [sys.executable, "-c", textwrap.dedent(program), "track", str(clip), "--detections", str(table())]
    process = subprocess.Popen(
        [*words, "--out", str(tmp_path / "out"), "--quiet"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "now\n", process.communicate(timeout=30)[1]
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130
    assert error == "dddas: stopped; what was done until then is kept\n"
    assert (record(tmp_path / "out")["interrupted"], record(tmp_path / "out")["frames"]["written"]) == (True, 3)
    assert tracks(tmp_path / "out")[:, 0].tolist() == [1, 2, 3]
    assert cv2.VideoCapture(str(tmp_path / "out/overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert not list((tmp_path / "out").rglob("*.part*"))
