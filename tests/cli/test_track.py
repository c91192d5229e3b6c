"""`dddas track`: what it writes, and one line for each mistake."""

import json

import cv2
import numpy as np
import pytest

UNREAD = "the frame could not be read"


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
