"""Bad input of every command: one line on stderr, exit code 2, and nothing written."""

import shlex
import subprocess
import sys

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad
from tests.lab.simulation.small import as_file, small
from tests.overflight import COLOURS_TOML

CAMERA = "focal_px = 1000\nwidth_px = 1280\nheight_px = 960\n"
PLACED = CAMERA + "height_m = 1.2\nheading_deg = 0\neast_m = 0\nnorth_m = 0\n"
POSITIONS = "frame,target,east_m,north_m,var_east_m2,cov_east_north_m2,var_north_m2\n"
BOXES = "frame,target,x_px,y_px,width_px,height_px,score,kind\n"
WALKER = "".join(f"{n},-1,{4 + n},10,8,24,0.95,-1,-1,-1\n" for n in range(1, 6))
FILES = {
    "det.txt": WALKER,
    "text-width.txt": WALKER + "3,-1,5,5,x,9\n",
    "late.txt": WALKER + "6,-1,5,5,2,9\n",
    "crowd.txt": "1,-1,10,10,50,200,1\n1,-1,110,10,50,200,1\n",
    "svm.txt": "1\n" * 100,
    "boxes.csv": BOXES + "1,1,1,1,9,9,1,moving\n",
    "blobs.csv": POSITIONS + "1,7,0,10,.1,0,.1\n1,8,4,12,.1,0,.1\n",
    "people.csv": POSITIONS + "1,1,0.2,10.1,.01,0,.01\n",
    "degrees.csv": POSITIONS.strip() + ",longitude_deg,latitude_deg\n1,1,0,0,.1,0,.1,7,50\n",
    "twice.csv": POSITIONS + "1,3,0,0,1,0,1\n1,3,1,1,1,0,1\n1,4,1,1,1,0,1\n",
    "empty.csv": "",
    "far.csv": "distance_m,height_px\n3,100\n",
    "wrong.csv": "distance_m,height_px\nfar,100\n",
    "poses.csv": "frame,heading_deg\n1,0\n2,0\n",
    "timed.csv": "time_s,heading_deg\n0,0\n2,0\n",
    "known.toml": CAMERA,
    "placed.toml": PLACED,
    "degrees.toml": PLACED.replace("east_m", "longitude_deg").replace("north_m", "latitude_deg"),
    "sizes.toml": "width_px = 1280\nheight_px = 960\n",
    "turned.toml": "width_px = 1280\nheight_px = 960\nheading_deg = 900\n",
    "colours.toml": COLOURS_TOML,
    "empty.toml": "\n# nothing\n",
    "text.png": "no picture",
    "file": "",
}

DISTANCE = "--pixels 200 --distance 3"
SMALL = "--set people.window_width_px=16 --set people.window_height_px=32 --set people.enlarge=1.0"

CASES = [
    # What several commands share.
    *((f"{command} --set registration.keypints=5", "unknown parameter") for command in ("detect walk", "track walk")),
    *((f"{command} --config nosuch", "nosuch") for command in ("detect walk", "people walk", "track walk", "run walk")),
    *((f"{command} --save film", "--save must name some of") for command in ("detect walk", "people walk", "run walk")),
    *(
        (f"{command} --save ''", "all or none, got ''")
        for command in ("detect walk", "people walk", "track walk", "run walk", "run sim:joining", "simulate joining")
    ),
    ("simulate joining --save film", "--save must name some of frames, video, masks, ground, all or none, got 'film'"),
    *((f"{command} nosuch.mp4", "nosuch.mp4") for command in ("detect", "track", "people", "run")),
    *((f"{command} walk --ignore text.png", "not a whole picture") for command in ("detect", "track", "run")),
    ("detect walk --ignore nosuch.png", "nosuch.png"),
    ("run sim:joining --ignore text.png", "--ignore is of no use"),
    *((f"{command} --rate 0", "frame rate") for command in ("detect walk", "people walk", "run walk")),
    *((f"{command} --interval 0", "--interval must be 1 or more frames") for command in ("track walk", "run walk")),
    # One command each.
    ("detect walk --set registration.keypoints=5", "between 50 and 5000 points, got 5"),
    ("detect walk --telemetry nosuch.csv", "nosuch.csv"),
    ("detect photo.jpg", "photo.jpg is one image, not a clip; give its folder"),
    ("detect nosuch --out file/out", "cannot write into"),
    ("demo --out file/demo", "cannot write"),
    ("track", "track needs a clip, a table of detections"),
    ("track --detections nosuch.txt", "nosuch.txt"),
    ("track --detections det.txt --save overlay", "--save overlay needs a clip"),
    ("track walk --detections text-width.txt", "text-width.txt, line 6: width"),
    ("track walk --detections late.txt", "line 6: the table goes on to frame 6 but"),
    ("track out/overlay.mp4", "overlay.mp4 is a file that this run writes; choose another folder with --out"),
    ("people walk --around nosuch.csv", "nosuch.csv"),
    ("people walk", "64 x 48 px"),
    ("people walk walk --around det.txt", "--around is the table of one clip, and 2 were given"),
    (f"people walk --around late.txt {SMALL}", "line 6: the table goes on to frame 6 but"),
    ("people text.png", "text.png"),
    ("people walk --set people.enlarge=4 --set people.classifier=svm.txt", "3780"),
    ("confirm blobs.csv boxes.csv", "boxes.csv has boxes; give positions.csv for all"),
    ("confirm boxes.csv boxes.csv --camera placed.toml", "--camera and --poses are for positions"),
    ("confirm blobs.csv absent.csv", "absent.csv cannot be read"),
    ("confirm blobs.csv people.csv people.csv --camera placed.toml", "2 tables of people and 1 cameras"),
    ("confirm blobs.csv people.csv --poses poses.csv", "0 cameras and 1 files of poses"),
    ("confirm blobs.csv people.csv --interval 0", "--interval must be 1 to 10"),
    ("confirm blobs.csv people.csv --rate nan", "a frame rate above 0"),
    ("confirm twice.csv people.csv --identities", "target 3 is twice in frame 1"),
    ("confirm blobs.csv people.csv --camera degrees.toml", "no longitude_deg and latitude_deg"),
    ("confirm blobs.csv empty.csv", "empty.csv is empty; its first line must be frame,target"),
    ("confirm blobs.csv degrees.csv", "some tables have longitude_deg and latitude_deg, others only local metres"),
    ("locate ground det.txt --camera sizes.toml", "no focal length (focal_px). `dddas calibrate` finds it"),
    ("locate ground det.txt --camera known.toml --set ground.use=feet", "has no height_m"),
    ("locate ground det.txt --camera placed.toml --camera placed.toml", "1 tables and 2 cameras"),
    ("locate ground det.txt --camera placed.toml --poses poses.csv", "cover frames 1 to 2; 3 of 5 rows of the table"),
    (
        "locate ground det.txt --camera placed.toml --poses timed.csv",
        "are by time_s; give the number of frames a second",
    ),
    ("locate ground det.txt --camera placed.toml --rate 0", "a frame rate above 0"),
    ("calibrate", "calibration needs --distance with --pixels, or a table"),
    ("calibrate --pixels 200", "--pixels needs --distance"),
    ("calibrate --pixels -5 --distance 3", "-5"),
    (f"calibrate {DISTANCE} --body-height 0", "--body-height must be 0.1 to 10 m, got 0"),
    ("calibrate --pixels 1e-6 --distance 3", "focal_px would be"),
    (f"calibrate {DISTANCE} --size ²x5", "--size must be WIDTHxHEIGHT"),
    (f"calibrate {DISTANCE} --camera turned.toml", "heading_deg"),
    (f"calibrate {DISTANCE} --out /", "--out / is a folder"),
    ("calibrate far.csv --out far.csv", "is a file that this run writes; choose another --out"),
    ("calibrate crowd.txt --distance 3", "has 2 boxes in frame 1; --distance needs a single person in each picture"),
    ("calibrate crowd.txt --distance 3 --pixels 9", "--pixels and a table were both given"),
    ("calibrate crowd.txt", "has boxes without distances: give --distance for one person's, or --camera"),
    ("calibrate crowd.txt --camera known.toml", "20 whole boxes of people are needed to find the camera's pose, got 2"),
    ("calibrate crowd.txt --camera sizes.toml", "has no focal length"),
    ("calibrate far.csv --distance 3", "has its own distances"),
    ("calibrate wrong.csv", "line 2: distance_m"),
    ("calibrate gone.csv --distance 9", "cannot be read: No such file"),
    ("colours view.png --count 3", "2 of 3 colours stand out in"),
    ("colours view.png --count 0", "--count must be 1 to 12"),
    ("colours view.png --names a,,b", "got 'a,,b'"),
    ("colours view.png --names a,a", "the name a is given twice"),
    ("colours view.png --names a,b --count 3", "--count is 3, but --names has 2 names"),
    ("colours view.png --at a=1,2,3", "--at must be NAME=X,Y,WIDTH,HEIGHT in whole pixels"),
    ("colours view.png --at a=150,2,20,20", "the box 150,2,20,20 of a is not inside the picture, 160 x 120 px"),
    ("colours view.png --at a=20,30,9,9 --count 1", "--at was given with --names or --count"),
    ("colours view.png --out colours.png", "got the name of a picture"),
    ("colours view.png --out view.toml", "is a file that this run writes"),
    ("colours text.png", "text.png is not a whole picture"),
    ("colours nothing.png", "cannot be read"),
    ("colours grey.png", "is not a colour picture"),
    ("simulate nowhere", "no scenario is named 'nowhere'; choose from border100, border200"),
    ("simulate joining --set uav.altitud_m=3", "unknown parameter 'uav.altitud_m'; did you mean uav.altitude_m"),
    ("simulate joining --set team.ugvs=3", "scenario joining: team.ugvs must be 4 or more in a clip located by"),
    ("simulate joining --seed -1", "seed must be a whole number from 0 to 2147483647, got -1"),
    ("simulate joining --frames 0", "--frames must be 1 or more, got 0"),
    ("run sim:empty.toml", "empty.toml is empty; wanted tables"),
    ("run sim:joining --scene team.ugvs=3", "team.ugvs must be 4 or more in a clip located by landmarks"),
    ("run sim:joining --scene clip.located_by=\"'nothing'\"", "scenario joining has clip.located_by = nothing"),
    ("run sim:joining --interval 2", "--interval is of no use with sim:joining"),
    ("run sim:joining --save film", "--save must name some of overlay, cot, map, report, truth"),
    ("run walk walk --live", "2 clips were given; wanted one with --live"),
    ("run walk sim:four", "one sim:SCENARIO"),
    ("run walk --telemetry a.csv --telemetry b.csv", "one clip and 2 logs"),
    ("run walk walk --telemetry a.csv --telemetry b.csv --telemetry c.csv", "2 clips and 3 logs"),
    ("run walk --scene uav.altitude_m=60", "--scene and --seed change a simulated scenario"),
    ("run walk --colours colours.toml", "--colours is of no use without --landmarks"),
    ("run walk --emit json:-", "--emit is for a run that keeps up with a camera; give --live too"),
    ("run walk --serve 1", "--serve is for a run"),
    ("run walk --people", "--people is for a run"),
    ("run walk --live --save masks", "--save must name some of overlay, clips, all or none"),
    ("run walk --live --serve eighty", "--serve eighty is no address"),
    ("run walk --live --emit csv:-", "csv:-"),
    ("run walk --live --emit json:/nowhere/at/all", "/nowhere/at/all"),
    ("run two --live", "the clip has 2 frames that can be read; a window needs at least 3"),
    ("evaluate nosuch walk", "no truth at nosuch"),
    ("evaluate walk walk --jobs 2", "--jobs is for a study; give --dataset FILE too"),
    ("evaluate walk", "evaluate needs TRUTH and RESULT, or --dataset FILE"),
    ("evaluate det.txt det.txt --interval 0", "--interval must be 1 or more frames"),
    ("export --graph pepole", "no graph is named 'pepole'; choose from people, homography"),
    ("export --graph homography --out file", "must be a folder for the graphs"),
    ("export --graph step --config paper", "difference.kind = to_reference"),
    ("export --graph step --size 64x64", "keypoints at 64x64"),
    ("export --size 640", "--size must be WIDTHxHEIGHT"),
    ("export --size 20x20", "from 64 to 8192"),
    ("export --config absent", "absent"),
]


@pytest.fixture
def place(tmp_path, monkeypatch, clip):
    """Small inputs of all kinds in the working folder."""
    rng = np.random.default_rng(0)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    view = np.full((120, 160, 3), (90, 110, 100), np.uint8) + rng.integers(0, 6, (120, 160, 3), np.uint8)
    view[30:46, 20:44], view[60:76, 90:114] = (40, 30, 200), (190, 60, 40)
    cv2.imwrite(str(tmp_path / "view.png"), view)
    cv2.imwrite(str(tmp_path / "grey.png"), np.zeros((20, 20), np.uint8))
    cv2.imwrite(str(tmp_path / "photo.jpg"), view)
    (tmp_path / "two").mkdir()
    for k in range(2):
        cv2.imwrite(str(tmp_path / "two" / f"{k}.png"), view)
    low = {"uav": {"altitude_m": 2.0, "way_m": ((25.0, 25.0),)}, "world": {"trees_per_ha": 500.0}}
    as_file(tmp_path / "low.toml", small(**low))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("line", "message"), CASES)
def test_bad_input_is_one_line_and_writes_nothing(dddas, place, line, message):
    if line.startswith("export --graph"):
        pytest.importorskip("onnx", reason="the extra 'export' is not installed")
    words = shlex.split(line.replace(" walk", " walk/frames"))
    before = {path: path.stat().st_mtime_ns for path in place.rglob("*")}
    result = dddas(*words, *([] if "--out" in words or words[0] == "calibrate" else ["--out", "out"]))
    assert message in bad(result)
    assert {path: path.stat().st_mtime_ns for path in place.rglob("*")} == before


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("track --detections det.txt", "tracks.txt"),
        ("confirm blobs.csv people.csv", "confirmed.csv"),
        ("simulate low.toml --set uav.altitude_m=40", "telemetry.csv"),
        ("run sim:joining", "truth/gt.txt"),
        ("run walk/frames", "positions.csv"),
    ],
)
def test_files_of_another_program_are_not_replaced(dddas, place, line, name):
    theirs = place / "out" / name
    theirs.parent.mkdir(parents=True)
    theirs.write_text("not ours")
    assert "was not written by dddas" in bad(dddas(*shlex.split(line), "--out", "out"))
    assert theirs.read_text() == "not ours"


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("track --detections out/tracks.csv", "tracks.csv"),
        ("people walk/frames --around out/run.json", "run.json"),
        ("people out/overlay.png", "overlay.png"),
        ("detect out/overlay.mp4", "overlay.mp4"),
        ("confirm out/confirmed.csv people.csv", "confirmed.csv"),
        ("locate ground out/positions.csv --camera placed.toml", "positions.csv"),
        ("locate ground det.txt --camera placed.toml --poses out/sightings.csv", "sightings.csv"),
        ("locate aerial out/positions.csv --landmarks l.csv", "positions.csv"),
        ("run walk/frames --landmarks out/landmarks.csv", "landmarks.csv"),
    ],
)
def test_an_input_is_not_overwritten(dddas, place, line, name):
    (place / "out").mkdir()
    (place / "out" / name).write_text("an input")
    assert f"{name} is a file that this run writes; choose another folder with --out" in bad(
        dddas(*shlex.split(line), "--out", "walk/../out")
    )
    assert [(path.name, path.read_text()) for path in (place / "out").iterdir()] == [(name, "an input")]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["detect"], "Missing argument"),
        (["detect", "x", "--backend", "gpu"], "'onboard'; see"),
        (["detect", "x", "--nosuch"], "--nosuch"),
        (["nosuch"], "'nosuch'"),
    ],
)
def test_an_unknown_word_of_the_command_line_is_one_line(words, message):
    program = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()", *words]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("dddas: ") and message in line
