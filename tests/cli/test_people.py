"""`dddas people`: what it writes for clips and pictures, and one line for each mistake."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad
from torchvision_dddas.io.detection_tables import read_detections

ROOT = Path(__file__).resolve().parents[2]
SMALL = tuple(
    word
    for parameter in ("window_width_px=16", "window_height_px=32", "padding_px=0", "enlarge=1.0")
    for word in ("--set", f"people.{parameter}")
)


class Stub:
    """Every frame's first window of the first part shows a person, if anybody is there."""

    name = "stub"

    def __init__(self, parameters, found=True):
        self.parameters, self.found = parameters, found

    def scores(self, images, parts):
        k = self.parameters
        maps = [
            [
                np.full(
                    ((p.height - k.window_height_px) // 8 + 1, (p.width - k.window_width_px) // 8 + 1), -1, np.float32
                )
                for p in wanted
            ]
            for wanted in parts
        ]
        for of_picture in maps:
            if of_picture and self.found:
                of_picture[0][0, 0] = 3.0
        return maps


@pytest.fixture
def stub(monkeypatch):
    def install(found=True):
        loads = []

        def load(parameters, backend):
            loads.append(backend)
            return Stub(parameters, found)

        monkeypatch.setattr("torchvision_dddas.people.detector.load_scorer", load)
        return loads

    install()
    return install


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.jpg"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (150, 100, 3), dtype=np.uint8))
    return path


def size(path):
    image = cv2.imread(str(path))
    assert image is not None
    return image.shape


def record(folder):
    return json.loads((folder / "run.json").read_text())


def files(folder):
    return sorted(p.name for p in folder.iterdir())


def rows(folder):
    return (folder / "detections.csv").read_text().splitlines()[1:]


def test_a_clip_gives_tables_a_film_and_a_record(dddas, stub, clip, tmp_path):
    result = dddas("people", clip, *SMALL, "--out", tmp_path / "out", "--rate", 5)
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines() == [
        "5 frames, 5 people",
        f"{tmp_path / 'out'}: detections.csv, detections.txt, overlay.mp4, run.json",
    ]
    assert files(tmp_path / "out") == ["detections.csv", "detections.txt", "overlay.mp4", "run.json"]
    assert [line.split(",")[0] for line in rows(tmp_path / "out")] == ["1", "2", "3", "4", "5"]
    film = cv2.VideoCapture(str(tmp_path / "out/overlay.mp4"))
    assert (film.get(cv2.CAP_PROP_FRAME_COUNT), film.get(cv2.CAP_PROP_FPS)) == (5, 5)
    kept = record(tmp_path / "out")
    assert (kept["state"], kept["backend"], kept["targets"]) == ("complete", "stub", 5)
    assert kept["settings"]["people"]["window_width_px"] == 16
    assert kept["searched"]["frames_everywhere"] == 5
    assert set(kept["seconds"]["stages"]) == {"read", "plan", "score", "people"}


def test_a_picture_gives_a_picture(dddas, stub, photo, tmp_path):
    result = dddas("people", photo, "--set", "people.padding_px=0", "--out", tmp_path / "out")
    assert result.stdout.splitlines() == [
        "1 frame, 1 person",
        f"{tmp_path / 'out'}: detections.csv, detections.txt, overlay.png, run.json",
    ]
    assert files(tmp_path / "out") == ["detections.csv", "detections.txt", "overlay.png", "run.json"]
    assert size(tmp_path / "out/overlay.png") == (150, 100, 3)


def test_several_inputs_get_a_folder_each_and_share_one_engine(dddas, stub, photo, clip, tmp_path):
    loads = stub()
    result = dddas("people", photo, photo, clip, *SMALL, "--out", tmp_path / "out", "--save", "none", "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    assert files(tmp_path / "out") == ["photo", "photo-2", "walk"]
    assert loads == ["auto"]


def test_a_clip_without_people_is_a_valid_result(dddas, stub, clip, tmp_path):
    stub(found=False)
    assert dddas("people", clip, *SMALL, "--out", tmp_path / "out", "--quiet").exit_code == 0
    assert (tmp_path / "out/detections.txt").read_text() == ""
    assert len(rows(tmp_path / "out")) == 0
    result = dddas("track", "--detections", tmp_path / "out/detections.csv", "--out", tmp_path / "tracks")
    assert result.exit_code == 0 and "0 identities" in result.stdout


@pytest.mark.parametrize("name", ["detections.txt", "detections.csv"])
def test_track_and_evaluate_take_the_tables_as_they_are(dddas, stub, clip, tmp_path, name):
    dddas("people", clip, *SMALL, "--out", tmp_path / "out", "--quiet")
    found = tmp_path / "out" / name
    assert dddas("track", "--detections", found, "--out", tmp_path / "tracks", "--quiet").exit_code == 0
    truth = tmp_path / "gt.txt"
    boxes = read_detections(found).box_px
    truth.write_text("".join(f"{n},1,{x},{y},{w},{h},1,1,1\n" for n, (x, y, w, h) in enumerate(boxes, start=1)))
    for result in (tmp_path / "out", tmp_path / "tracks"):
        assert dddas("evaluate", truth, result, "--out", tmp_path / "scores").exit_code == 0
        (clip_scores,) = json.loads((tmp_path / "scores/metrics.json").read_text())["clips"].values()
        kind, measure = ("boxes", "f1") if result.name == "out" else ("tracks", "idf1")
        assert clip_scores[kind][measure] == pytest.approx(1)


def test_around_a_table_only_its_frames_are_searched_and_the_user_is_told(dddas, stub, clip, tmp_path):
    table = tmp_path / "det.csv"
    table.write_text("frame,x_px,y_px,width_px,height_px\n2,20,10,10,24\n4,20,10,10,24\n")
    words = ("--around", table, *SMALL, "--out", tmp_path / "out", "--save", "none")
    result = dddas("people", clip, *words)
    assert [line.split(",")[0] for line in rows(tmp_path / "out")] == ["2", "4"]
    assert f"note: 3 of 5 frames were not searched: {table} has no box there that a window fits" in result.stdout
    kept = record(tmp_path / "out")
    assert (kept["searched"]["frames_nowhere"], kept["searched"]["frames_in_regions"]) == (3, 2)
    assert kept["around"] == str(table)


def test_an_empty_table_to_search_around_finds_nobody(dddas, stub, clip, tmp_path):
    (tmp_path / "det.txt").write_text("")
    result = dddas("people", clip, *SMALL, "--around", tmp_path / "det.txt", "--out", tmp_path / "out")
    assert result.exit_code == 0
    assert "5 frames were not searched" in result.stdout and "holds no rows" in result.stdout
    assert rows(tmp_path / "out") == []


def test_in_regions_the_share_of_windows_is_told_and_recorded_with_its_cause(dddas, stub, clip, tmp_path):
    words = (*SMALL, "--set", "people.search=regions", "--set", "people.rescan_frames=3", "--save", "none")
    result = dddas("people", clip, *words, "--out", tmp_path / "out")
    assert "% of the windows searched" in result.stdout
    kept = record(tmp_path / "out")
    assert kept["searched"]["frames_everywhere"] == 1
    assert kept["adjustments"][0]["cause"] == "1 person expected"


def test_a_frame_that_cannot_be_decoded_is_told_and_recorded(dddas, stub, clip, tmp_path):
    (clip / "00002.png").write_bytes(b"no picture")
    result = dddas("people", clip, *SMALL, "--out", tmp_path / "out")
    assert "1 problem while reading, the first: frame 3" in result.stdout
    assert [line.split(",")[0] for line in rows(tmp_path / "out")] == ["1", "2", "4", "5"]
    assert record(tmp_path / "out")["unreliable"] == [{"first": 3, "last": 3, "cause": "the frame could not be read"}]
    assert cv2.VideoCapture(str(tmp_path / "out/overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 5


def test_a_picture_smaller_than_the_window_names_both_sizes_and_what_to_do(dddas, stub, clip, tmp_path):
    said = bad(dddas("people", clip, "--out", tmp_path / "out"))
    assert str(clip) in said and "64 x 48 px" in said and "64 x 128 px" in said and "people.enlarge" in said
    assert not (tmp_path / "out").exists()
    assert dddas("people", clip, "--set", "people.enlarge=3", "--out", tmp_path / "out", "--quiet").exit_code == 0


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_pictures_of_any_depth_and_colour_are_searched(dddas, stub, tmp_path, channels, depth):
    shape = (140, 90) if channels == 1 else (140, 90, channels)
    image = np.random.default_rng(0).integers(0, np.iinfo(depth).max, shape, dtype=depth)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    assert dddas("people", tmp_path / "a.png", "--out", tmp_path / "out", "--quiet").exit_code == 0
    assert size(tmp_path / "out/overlay.png") == (140, 90, 3)


@pytest.mark.parametrize("backend", ["torch", "onboard"])
def test_each_engine_runs_and_finds_nobody_in_noise(dddas, photo, tmp_path, backend):
    result = dddas("people", photo, "--backend", backend, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("1 frame, 0 people")
    assert record(tmp_path / "out")["backend"] == backend


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is read from /proc")
@pytest.mark.parametrize("search", ["everywhere", "regions"])
def test_the_whole_command_holds_less_than_150_mb_and_loads_neither_scipy_nor_torch(search, tmp_path):
    """A film besides takes 35 MB more: PyAV and its encoder."""
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
            lines = Path("/proc/self/status").read_text().splitlines()
            peak_mb = next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
            print(json.dumps([stop.code, peak_mb, [name for name in ("scipy", "torch") if name in sys.modules]]))
    """
    chosen = ["--set", f"people.search={search}", "--set", "people.scale_step=1.2", "--save", "none", "--quiet"]
    words = [sys.executable, "-c", textwrap.dedent(program), "people", str(tmp_path), *chosen]
    done = subprocess.run(
        [*words, "--out", str(tmp_path / "out")],
        capture_output=True, text=True, timeout=120, cwd=ROOT, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    code, peak_mb, loaded = json.loads(done.stdout)
    assert not code and loaded == []
    assert peak_mb < 150
