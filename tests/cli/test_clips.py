"""`dddas detect`, `people`, `track` and `run` on clips: what they write, valid clips that are odd, and faulty ones."""

import csv
import json
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad, names, record, rows
from tests.io.clips import textured, write_by_av
from tests.synthetic_clip import render
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import read_detections

ROOT = Path(__file__).resolve().parents[2]
WINDOW = tuple(
    word
    for parameter in ("window_width_px=16", "window_height_px=32", "padding_px=0", "enlarge=1.0")
    for word in ("--set", f"people.{parameter}")
)
COMMANDS = {"detect": (), "people": WINDOW, "track": (), "run": ()}
TABLES = {"detect": "detections", "people": "detections", "track": "tracks", "run": "tracks"}
every_command = pytest.mark.parametrize("command", COMMANDS)


def walker(frames, x=4.0):
    return "".join(f"{n},-1,{x + n:.3f},10,8,24,0.95,-1,-1,-1\n" for n in frames)


@pytest.fixture
def table(file):
    return lambda text=None: file("det.txt", walker(range(1, 6)) if text is None else text)


def tracks(folder):
    text = (folder / "tracks.txt").read_text()
    return np.array([[float(v) for v in line.split(",")] for line in text.splitlines()]).reshape(-1, 10)


def film(folder):
    """Frames and rate of the overlay."""
    overlay = cv2.VideoCapture(str(folder / "overlay.mp4"))
    return overlay.get(cv2.CAP_PROP_FRAME_COUNT), overlay.get(cv2.CAP_PROP_FPS)


# What all four do.


@every_command
def test_quiet_says_nothing_and_save_none_writes_tables_alone(dddas, engine, scorer, clip, tmp_path, command):
    out = tmp_path / "out"
    words = ("--out", out, "--save", "none", "--quiet", "--set", "registration.keypoints=77", "--config", "fast")
    result = dddas(command, clip, *COMMANDS[command], *words)
    assert (result.exit_code, result.output) == (0, "")
    assert {f"{TABLES[command]}.csv", f"{TABLES[command]}.txt", "run.json"} <= set(names(out))
    assert not {"masks", "overlay.mp4", "report.html"} & set(names(out))
    assert [row.split(",")[0] for row in (out / f"{TABLES[command]}.txt").read_text().splitlines()] == list("12345")
    assert record(out)["settings"]["registration"]["keypoints"] == 77


@every_command
def test_a_frame_that_cannot_be_decoded_is_reported_and_recorded(dddas, engine, scorer, clip, tmp_path, command):
    (clip / "00002.png").write_bytes(b"no picture")
    result = dddas(command, clip, *COMMANDS[command], "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "1 problem while reading, the first: frame 3" in result.stdout
    assert len(record(tmp_path / "out")["problems"]) == 1
    assert film(tmp_path / "out")[0] == (5 if command == "people" else 4)  # the stand-in for detection skips it


@pytest.mark.parametrize("command", ["detect", "people"])
def test_several_clips_get_a_folder_each_and_share_one_engine(dddas, engine, scorer, clip, tmp_path, command):
    loaded = scorer()
    words = (*COMMANDS[command], "--out", tmp_path / "out", "--save", "none", "--quiet")
    assert dddas(command, clip, clip, *words).exit_code == 0
    assert names(tmp_path / "out") == ["walk", "walk-2"]
    assert loaded == (["auto"] if command == "people" else [])


@pytest.mark.parametrize("command", ["detect", "people"])
def test_a_clip_in_which_nothing_is_found_has_empty_tables(dddas, engine, scorer, clip, tmp_path, command):
    engine(found=False)
    scorer(found=False)
    found = tmp_path / "found"
    assert dddas(command, clip, *COMMANDS[command], "--out", found, "--quiet").exit_code == 0
    assert (found / "detections.txt").read_text() == ""
    for given in ([clip], ["--detections", found / "detections.csv"]):
        assert dddas("track", *given, "--out", tmp_path / "out", "--quiet", "--save", "none").exit_code == 0
        assert (tmp_path / "out/tracks.txt").read_text() == ""
        assert (tmp_path / "out/tracks.csv").read_text().count("\n") == 1


# Detect.


def test_detect_saves_everything_by_default_and_sums_up(dddas, engine, clip, tmp_path):
    result = dddas("detect", clip, "--rate", 10, "--out", tmp_path / "out", "--backend", "onboard")
    assert result.stdout.splitlines() == [
        "5 frames, 5 detections, 1 frames with unreliable registration",
        "scale: the size of people is unknown: it needs the height above ground and the focal length",
        f"{tmp_path / 'out'}: detections.csv, detections.txt, masks/, overlay.mp4, run.json",
    ]
    assert names(tmp_path / "out/masks") == [f"{k:06d}.png" for k in range(1, 6)]
    kept = record(tmp_path / "out")
    assert (kept["state"], kept["backend"], kept["clip"]["size"]) == ("complete", "stub onboard", [64, 48])
    assert kept["unreliable"] == [{"first": 2, "last": 2, "cause": "blank"}]


def test_an_error_that_the_engine_raises_is_one_line(dddas, engine, clip, tmp_path):
    def stop(scene):
        raise InputError("the clip has 1 frame;\nthe window needs 3: 2 are missing")

    engine(after=stop)
    assert "the window needs 3: 2 are missing" in bad(dddas("detect", clip, "--out", tmp_path / "out", "--quiet"))
    assert not (tmp_path / "out/detections.txt").exists()


# People.


def test_people_in_a_clip_give_tables_a_film_and_a_record(dddas, scorer, clip, tmp_path):
    result = dddas("people", clip, *WINDOW, "--out", tmp_path / "out", "--rate", 5)
    assert result.stdout.splitlines() == [
        "5 frames, 5 people",
        f"{tmp_path / 'out'}: detections.csv, detections.txt, overlay.mp4, run.json",
    ]
    assert film(tmp_path / "out") == (5, 5)
    kept = record(tmp_path / "out")
    assert (kept["state"], kept["backend"], kept["targets"]) == ("complete", "stub", 5)
    assert kept["searched"]["frames_everywhere"] == 5
    assert set(kept["seconds"]["stages"]) == {"read", "plan", "score", "people"}


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_picture_of_any_depth_and_colour_gives_a_picture(dddas, scorer, tmp_path, channels, depth):
    shape = (140, 90) if channels == 1 else (140, 90, channels)
    image = np.random.default_rng(0).integers(0, np.iinfo(depth).max, shape, dtype=depth)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    result = dddas("people", tmp_path / "a.png", "--out", tmp_path / "out")
    assert result.stdout.startswith("1 frame, 1 person")
    overlay = cv2.imread(str(tmp_path / "out/overlay.png"))
    assert overlay is not None and overlay.shape == (140, 90, 3)


@pytest.mark.parametrize("name", ["detections.txt", "detections.csv"])
def test_track_and_evaluate_take_the_tables_of_people(dddas, scorer, clip, tmp_path, name):
    dddas("people", clip, *WINDOW, "--out", tmp_path / "out", "--quiet")
    found, truth = tmp_path / "out" / name, tmp_path / "gt.txt"
    assert dddas("track", "--detections", found, "--out", tmp_path / "tracks", "--quiet").exit_code == 0
    boxes = read_detections(found).box_px
    truth.write_text("".join(f"{n},1,{x},{y},{w},{h},1,1,1\n" for n, (x, y, w, h) in enumerate(boxes, start=1)))
    for folder, kind, measure in (("out", "boxes", "f1"), ("tracks", "tracks", "idf1")):
        assert dddas("evaluate", truth, tmp_path / folder, "--out", tmp_path / "scores").exit_code == 0
        (scores,) = json.loads((tmp_path / "scores/metrics.json").read_text())["clips"].values()
        assert scores[kind][measure] == pytest.approx(1)


def test_around_a_table_only_its_frames_are_searched(dddas, scorer, clip, file, tmp_path):
    table = file("det.csv", "frame,x_px,y_px,width_px,height_px\n2,20,10,10,24\n4,20,10,10,24\n")
    words = (*WINDOW, "--out", tmp_path / "out", "--save", "none")
    result = dddas("people", clip, "--around", table, *words)
    assert [row["frame"] for row in rows(tmp_path / "out/detections.csv")] == ["2", "4"]
    assert f"note: 3 of 5 frames were not searched: {table} has no box of a suitable size there" in result.stdout
    kept = record(tmp_path / "out")
    assert (kept["searched"]["frames_nowhere"], kept["searched"]["frames_in_regions"]) == (3, 2)
    result = dddas("people", clip, "--around", file("none.txt", ""), *words)
    assert "5 frames were not searched" in result.stdout and "holds no rows" in result.stdout


def test_in_regions_the_share_of_windows_is_reported_and_recorded_with_its_cause(dddas, scorer, clip, tmp_path):
    words = (*WINDOW, "--set", "people.search=regions", "--set", "people.rescan_frames=3", "--save", "none")
    result = dddas("people", clip, *words, "--out", tmp_path / "out")
    assert "% of the windows searched" in result.stdout
    kept = record(tmp_path / "out")
    assert kept["searched"]["frames_everywhere"] == 1
    assert kept["adjustments"][0]["cause"] == "1 person expected"


@pytest.mark.parametrize("backend", ["torch", "onboard"])
def test_each_engine_runs_and_finds_nobody_in_noise(dddas, tmp_path, backend):
    noise = np.random.default_rng(0).integers(0, 255, (150, 100, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "photo.jpg"), noise)
    result = dddas("people", tmp_path / "photo.jpg", "--backend", backend, "--out", tmp_path / "out")
    assert result.stdout.startswith("1 frame, 0 people")
    assert record(tmp_path / "out")["backend"] == backend


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is read from /proc")
def test_people_needs_little_memory_and_loads_neither_scipy_nor_torch(tmp_path):
    """It allocates 70 MB. Pages of libraries are not counted: the kernel maps more or fewer of the same library."""
    for name in ("1.png", "2.png"):
        image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / name), image)
    program = """
        import json, sys
        from pathlib import Path
        import cv2
        import torchvision_dddas.cli

        cv2.setNumThreads(2)
        try:
            torchvision_dddas.cli.main()
        except SystemExit as stop:
            status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
            peak_mb, files_mb = (int(status[name].split()[0]) / 1024 for name in ("VmHWM", "RssFile"))
            loaded = [name for name in ("scipy", "torch") if name in sys.modules]
            print(json.dumps([stop.code, peak_mb - files_mb, loaded]))
    """
    words = f"people {tmp_path} --set people.search=regions --set people.scale_step=1.2 --save none --quiet"
    command = [sys.executable, "-c", textwrap.dedent(program), *words.split(), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    code, allocated_mb, loaded = json.loads(done.stdout)
    assert not code and loaded == []
    assert allocated_mb < 110


# Track.


def test_a_table_alone_gives_tables_and_a_record_without_a_film(dddas, table, tmp_path):
    result = dddas("track", "--detections", table(), "--out", tmp_path / "out")
    assert result.stdout.splitlines() == [
        "5 frames, 5 detections, 1 identities, 0 detections without identity",
        f"{tmp_path / 'out'}: tracks.csv, tracks.txt, run.json",
    ]
    assert names(tmp_path / "out") == ["run.json", "tracks.csv", "tracks.txt"]
    made = tracks(tmp_path / "out")
    assert made[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert len(set(made[:, 1])) == 1
    assert np.array_equal(made[:, 2:6], [[4 + n, 10, 8, 24] for n in range(1, 6)])
    kept = record(tmp_path / "out")
    assert (kept["state"], kept["frames"]["written"], kept["identities"], kept["untracked"]) == ("complete", 5, 1, 0)
    assert kept["rows"] == {"given": 5, "used": 5}
    assert (kept["clip"], kept["backend"], kept["outputs"]) == (None, None, ["tables"])


def test_a_clip_with_a_table_gives_a_film_of_the_sampled_frames(dddas, clip, table, tmp_path):
    words = ("--detections", table(), "--interval", 2, "--out", tmp_path / "out", "--rate", 8)
    result = dddas("track", clip, *words)
    assert "note: 2 of 5 rows lie on frames that --interval 2 leaves out" in result.stdout
    assert film(tmp_path / "out") == (3, 4)
    assert tracks(tmp_path / "out")[:, 0].tolist() == [1, 3, 5]
    kept = record(tmp_path / "out")
    assert kept["rows"] == {"given": 5, "used": 3}
    assert (kept["interval_frames"], kept["backend"], kept["clip"]["size"]) == (2, "onboard", [64, 48])


@pytest.mark.parametrize("config", [(), ("--config", "paper")])
def test_whether_appearance_was_looked_at_is_recorded_with_its_cause(dddas, clip, table, tmp_path, config):
    given = table(walker(range(1, 6)) + walker(range(1, 6), x=12))
    result = dddas("track", clip, "--detections", given, *config, "--out", tmp_path / "out", "--save", "none")
    assert "tracks.csv, tracks.txt, appearance.csv, run.json" in result.stdout
    kept, decisions = record(tmp_path / "out"), rows(tmp_path / "out/appearance.csv")
    assert [row["frame"] for row in decisions] == list("2345") and all(row["cause"] for row in decisions)
    looked = sum(row["looked"] == "1" for row in decisions)
    assert (kept["appearance"]["decisions"], kept["appearance"]["looked_at"]) == (4, looked)
    assert looked and sum(kept["appearance"]["causes"].values()) == 4
    (moved,) = (kept["adjustments"][k] for k in range(1))
    assert (moved["knob"], moved["frame"]) == ("paper.weight" if config else "appearance.looked", 2)
    assert moved["cause"] == decisions[0]["cause"]
    assert (decisions[0]["weight"] == "") == (not config)


def test_the_sources_association_gives_the_same_tracks_by_either_back_end(dddas, clip, table, tmp_path):
    given = table(walker(range(1, 6)) + walker(range(1, 6), x=12))
    for backend in ("onboard", "torch"):
        words = ("--detections", given, "--config", "paper", "--backend", backend, "--out", tmp_path / backend)
        assert dddas("track", clip, *words, "--save", "none", "--quiet").exit_code == 0
        assert record(tmp_path / backend)["backend"] == backend
    text = (tmp_path / "torch/tracks.txt").read_text()
    assert text == (tmp_path / "onboard/tracks.txt").read_text()
    assert text.count("\n") == 10


MOVING = "frame,target,x_px,y_px,width_px,height_px,score,kind\n"
MOVING += "".join(f"{n},1,{4 + n},10,8,24,0.41,moving\n" for n in range(1, 6))
NOTED = {
    "moving targets": (MOVING, "note: all rows are moving targets of dddas detect", 0.41),
    "SVM margins": (walker(range(1, 6)).replace("0.95", "43.332"), "scores from 43.332 to 43.332 are not prob", 43.332),
    "unlikely rows": (
        walker(range(1, 6)) + walker(range(1, 6), x=40).replace("0.95", "0.05"),
        "10 detections, 1 identities, 5 detections without identity",
        0.95,
    ),
}


@pytest.mark.parametrize("with_clip", [False, True])
@pytest.mark.parametrize(("text", "said", "score"), NOTED.values(), ids=NOTED)
def test_scores_of_a_table_decide_what_is_tracked_and_are_kept(
    dddas, clip, table, tmp_path, text, said, score, with_clip
):
    words = (clip,) if with_clip else ()
    result = dddas("track", *words, "--detections", table(text), "--out", tmp_path / "out", "--save", "none")
    assert said in result.stdout and "1 identities" in result.stdout
    assert tracks(tmp_path / "out")[:, 6].tolist() == [score] * 5
    assert (tmp_path / "out/tracks.csv").read_text().count("untracked") == text.count("0.05")


def test_classes_of_a_table_are_kept(dddas, file, tmp_path):
    lines = [f"{n},{4 + n},10,8,24,{'person' if n < 4 else 'cyclist'}\n" for n in (1, 2, 4, 5, 6)]
    path = file("det.csv", "frame,x_px,y_px,width_px,height_px,class\n" + "".join(lines))
    dddas("track", "--detections", path, "--out", tmp_path / "out")
    found = [(row["identity"], row["kind"], row["class"]) for row in rows(tmp_path / "out/tracks.csv")]
    person, cyclist = ("1", "detection", "person"), ("1", "detection", "cyclist")
    assert found == [person, person, ("1", "bridge", "person"), cyclist, cyclist, cyclist]


def test_the_record_of_a_table_that_begins_late_names_its_first_and_last_frame(dddas, table, tmp_path):
    text = walker(range(501, 560), x=0) + walker(range(502, 560), x=40)
    dddas("track", "--detections", table(text), "--interval", 2, "--out", tmp_path / "out", "--quiet")
    kept = record(tmp_path / "out")
    assert (kept["first_frame"], kept["last_frame"], kept["frames"]["written"]) == (501, 559, 30)
    assert kept["identities"] == len(set(tracks(tmp_path / "out")[:, 1])) == 2


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


# Odd and faulty clips, with the true engine.


def grey16(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint16) * 16


def small(width, height):
    return lambda image: cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def images():
    return render(0, 9, (240, 180)).images


@pytest.fixture
def folder(tmp_path):
    def write(images):
        (tmp_path / "frames").mkdir()
        for number, image in enumerate(images, 1):
            cv2.imwrite(str(tmp_path / f"frames/{number:05d}.png"), image)
        return tmp_path / "frames"

    return write


ODD = {
    "16-bit grey": (grey16, (180, 240)),
    "portrait": (lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE), (240, 180)),
    "odd sides": (small(101, 67), (67, 101)),
    "8x8": (small(8, 8), (8, 8)),
    "a strip": (small(90, 3), (3, 90)),
    "one pixel": (small(1, 1), (1, 1)),
}


def masks(folder):
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((folder / "masks").iterdir())]


@pytest.mark.parametrize(
    "words", [("detect",), ("detect", "--config", "source"), ("track",), ("track", "--detections")]
)
@pytest.mark.parametrize(("change", "shape"), ODD.values(), ids=ODD)
def test_clips_of_any_depth_and_size_can_be_used(dddas, folder, images, table, tmp_path, change, shape, words):
    out, given = tmp_path / "out", "--detections" in words
    clip = folder([change(image) for image in images])
    result = dddas(*words, *([table()] if given else []), clip, "--out", out, "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    assert record(out)["frames"]["written"] == film(out)[0] == 9
    if words[0] == "detect":
        assert [mask.shape for mask in masks(out)] == [shape] * 9
    if words == ("detect",) and change is grey16:
        assert any(mask.any() for mask in masks(out))
    if given:
        assert (out / "tracks.csv").read_text().count("\n") >= 6


@pytest.mark.parametrize("numbers", [(8, 9), (3, 4, 9)])
def test_undecodable_frames_get_empty_masks_and_are_recorded(dddas, folder, images, tmp_path, numbers):
    clip, out = folder(images), tmp_path / "out"
    for number in numbers:
        (clip / f"{number:05d}.png").write_bytes(b"no picture")
    assert dddas("detect", clip, "--out", out, "--config", "fast", "--quiet").exit_code == 0
    assert [mask.any() for mask in masks(out)].count(False) >= len(numbers) and len(masks(out)) == 9
    assert not any(masks(out)[number - 1].any() for number in numbers)
    kept = record(out)
    assert len(kept["problems"]) == len(numbers)
    assert set(numbers) <= {n for row in kept["unreliable"] for n in range(row["first"], row["last"] + 1)}


def test_a_frame_of_another_size_late_in_a_clip_leaves_nothing_that_looks_whole(dddas, folder, images, tmp_path):
    clip = folder([*images, *images[::-1], small(200, 150)(images[0])])
    line = bad(dddas("detect", clip, "--out", tmp_path / "out", "--quiet", "--config", "fast"))
    assert "200x150" in line and "240x180" in line
    assert record(tmp_path / "out")["state"] == "failed"
    assert not set(names(tmp_path / "out")) - {"run.json", "masks"}


# Clips as they come.


def textured_frames(count, size=(96, 72)):
    ground = np.random.default_rng(0).integers(0, 255, (size[1] + 40, size[0] + 100, 3)).astype(np.uint8)
    return [ground[k : k + size[1], 2 * k : 2 * k + size[0]].copy() for k in range(count)]


def film_of(path, shots, rate_hz=10.0):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, shots[0].shape[1::-1])
    for shot in shots:
        writer.write(shot)
    writer.release()
    return path


def test_repeated_pictures_are_noted(dddas, tmp_path):
    film = film_of(tmp_path / "twice.mp4", [shot for shot in textured_frames(8) for _ in (1, 2)], 20.0)
    result = dddas("detect", film, "--config", "fast", "--out", tmp_path / "out", "--save", "none")
    assert result.exit_code == 0, result.output
    assert "8 of 16 frames repeat the previous picture, and have its result" in result.stdout


def test_a_varying_frame_rate_is_noted(dddas, engine, tmp_path):
    stamps = (np.arange(30) * 50 + 3000 * (np.arange(30) >= 15)).tolist()
    film = write_by_av(tmp_path / "gap.mkv", "mjpeg", stamps)
    result = dddas("track", film, "--out", tmp_path / "out", "--save", "none")
    assert "the frame rate varies: pictures are 50 to 3050 ms apart, usually 50 ms (exceptions: 1)" in result.stdout


@pytest.mark.parametrize("command", ["detect", "track", "people", "run"])
def test_a_clip_with_a_colon_in_its_name_and_that_of_its_folder_is_read(
    dddas, engine, scorer, tmp_path, monkeypatch, command
):
    monkeypatch.chdir(tmp_path)
    film_of(tmp_path / "clip.mp4", textured_frames(5)).rename(tmp_path / "cam1:2024-05-01.mp4")
    result = dddas(command, "cam1:2024-05-01.mp4", *COMMANDS[command], "--out", "out:1", "--save", "overlay")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out:1" / "overlay.mp4").stat().st_size > 100


@pytest.mark.parametrize("command", ["detect", "track", "people", "run"])
def test_a_clip_that_changes_its_size_is_one_line(dddas, engine, scorer, tmp_path, command):
    parts = [cv2.imencode(".jpg", shot)[1].tobytes() for n in (96, 64) for shot in textured_frames(6, (n, 72))]
    (tmp_path / "clip.mjpeg").write_bytes(b"".join(parts))
    result = dddas(command, tmp_path / "clip.mjpeg", *COMMANDS[command], "--out", tmp_path / "out", "--save", "none")
    assert result.exit_code == 2 and "is 64x72 but the first is 96x72" in bad(result)


def test_a_damaged_clip_is_counted_and_not_ok(dddas, engine, tmp_path):
    film = write_by_av(
        tmp_path / "clip.mp4", "libx264", list(range(0, 4000, 100)), (320, 240), textured, g="10", bf="0"
    )
    data = bytearray(film.read_bytes())
    for place in np.random.default_rng(0).integers(len(data) // 4, len(data) * 3 // 4, 12).tolist():
        data[place] ^= 255
    for content, ok in ((film.read_bytes(), True), (bytes(data), False)):
        film.write_bytes(content)
        result = dddas("run", film, "--out", tmp_path / "out", "--save", "none")
        found = record(tmp_path / "out")
        assert result.exit_code == 0 and found["ok"] is ok and (found.get("concealed", 0) == 0) is ok
    assert "the decoder concealed errors in" in result.stdout


def test_clips_of_one_flight_are_one_run_and_clips_to_detect_in_are_several(dddas, engine, tmp_path):
    shots = textured_frames(20)
    films = [film_of(tmp_path / f"part{k}.mp4", shots[10 * k : 10 * k + 10]) for k in (0, 1)]
    logs = []
    for k in (0, 1):
        rows = [f"{n / 10},{50},{11.5 + (10 * k + n) / 1e5:.5f},48.1,0,90,60" for n in range(10)]
        logs.append(tmp_path / f"part{k}.csv")
        header = "time_s,altitude_m,longitude_deg,latitude_deg,heading_deg,pitch_deg,hfov_deg"
        logs[k].write_text("\n".join([header, *rows, ""]))
    told = [word for log in logs for word in ("--telemetry", log)]
    result = dddas("run", *films, *told, "--out", tmp_path / "run", "--save", "none")
    assert result.exit_code == 0 and result.stdout.startswith("20 frames, 20 detections"), result.output
    with (tmp_path / "run" / "fixes.csv").open() as file:
        fixes = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in fixes] == list(range(1, 21))
    assert [float(row["time_s"]) for row in fixes] == pytest.approx(np.arange(20) / 10)
    assert record(tmp_path / "run")["input"] == [str(film) for film in films]
    result = dddas("detect", *films, "--out", tmp_path / "found", "--save", "none")
    assert result.exit_code == 0 and sorted(path.name for path in (tmp_path / "found").iterdir()) == ["part0", "part1"]


@pytest.mark.parametrize("command", ["detect", "track", "run"])
def test_a_note_says_how_much_a_mask_leaves_out(dddas, clip, tmp_path, command):
    mask = np.zeros((48, 64), np.uint8)
    mask[:12] = 255
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    result = dddas(command, clip, "--ignore", tmp_path / "mask.png", "--out", tmp_path / "out", "--save", "none")
    assert result.exit_code == 0, result.output
    assert "mask.png leaves out 25 % of every picture" in " ".join(record(tmp_path / "out")["notes"])
