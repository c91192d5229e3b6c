"""`--detector` of `dddas detect`, `dddas track` and `dddas run --live`: boxes and classes of a network."""

import json

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad, record, rows
from tests.onnx_models import write_finder

FRAMES = 5


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A clip of a red rectangle that moves by 8 px a frame, and a network that finds it."""
    folder = tmp_path_factory.mktemp("made")
    ground = np.random.default_rng(0).integers(0, 150, (120, 160, 3)).astype(np.uint8)
    for frame in range(FRAMES):
        picture = ground.copy()
        picture[50:70, 20 + 8 * frame : 45 + 8 * frame] = (0, 0, 255)
        cv2.imwrite(str(folder / f"{frame}.png"), picture)
    metadata = {"names": "['car', 'person', 'bus']", "imgsz": "[640, 640]"}
    model = write_finder(folder / "finder.onnx", "YOLO without NMS", metadata=metadata, is_free=True)
    return folder, "--rate", 10, "--detector", model


@pytest.mark.parametrize("command", ["detect", "track"])
@pytest.mark.parametrize("more", [(), ("--movers",)])
def test_boxes_and_classes_are_those_of_the_network(dddas, made, tmp_path, command, more):
    result = dddas(command, *made, *more, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    found = rows(tmp_path / "out" / {"detect": "detections.csv", "track": "tracks.csv"}[command])
    found = [row for row in found if row["class"]]
    assert [(row["class"], row["class_id"], row["frame"]) for row in found] == [
        ("person", "1", str(frame)) for frame in range(1, FRAMES + 1)
    ]
    assert len({row.get("identity") for row in found}) == 1
    assert record(tmp_path / "out")["detector"]["layout"] == "YOLO without NMS"
    assert (tmp_path / "out" / "masks").exists() == (command == "detect" and bool(more))
    assert ("scale:" in result.stdout) == bool(more)


@pytest.mark.parametrize("command", ["detect", "track", "run", "run --live"])
def test_settings_of_the_motion_detector_without_effect_are_named(dddas, made, tmp_path, command):
    (tmp_path / "plain.toml").write_text("[morphology]\nhull = false\n[registration]\nkeypoints = 300\n")
    given = (*made, "--set", "difference.threshold=3", "--config", tmp_path / "plain.toml")
    for more in ((), ("--movers",)):
        out = tmp_path / f"out{len(more)}"
        result = dddas(*command.split(), *given, *more, "--out", out)
        assert result.exit_code == 0, result.output
        file = next(out.glob("**/run.json"))
        notes = [note for note in json.loads(file.read_text())["notes"] if "no effect" in note]
        assert [note.partition(" have")[0] for note in notes] == ["difference.threshold, morphology.hull"] * (not more)


def test_settings_of_the_motion_detector_have_no_effect_on_a_table(dddas, tmp_path):
    (tmp_path / "boxes.txt").write_text("".join(f"{k},-1,{40 + k},60,20,20,0.9\n" for k in range(1, 5)))
    options = ("--detections", tmp_path / "boxes.txt", "--set", "refine.on=false", "--out", tmp_path)
    assert dddas("track", *options).exit_code == 0
    assert "refine.on has no effect, because" in str(record(tmp_path)["notes"])


def test_live_results_have_the_classes_of_the_network(dddas, made, tmp_path):
    words = ("--live", "--set", "live.pace=0", "--quiet")
    assert dddas("run", *made, *words, "--out", tmp_path).exit_code == 0
    (lines,) = (file.read_text().splitlines() for file in tmp_path.glob("*/results.jsonl"))
    assert [[target["class"] for target in json.loads(line)["targets"]] for line in lines] == [["person"]] * FRAMES


@pytest.mark.parametrize("command", ["detect", "track"])
@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--score", 0.5), "--score is for --detector MODEL"),
        (("--movers",), "--movers is for --detector"),
        (("--detector", "MODEL", "--ignore", "mask.png"), "--ignore is for the search for what moves"),
        (("--detector", "none.onnx"), "none.onnx is no file"),
    ],
)
def test_options_that_do_not_fit_are_one_line(dddas, made, tmp_path, command, words, says):
    words = [made[-1] if word == "MODEL" else word for word in words]
    assert says in bad(dddas(command, made[0], *words, "--out", tmp_path / "out"))


def test_a_network_beside_a_table_is_refused(dddas, made, tmp_path):
    assert "leave --detections out" in bad(dddas("track", *made, "--detections", "a.csv", "--out", tmp_path / "out"))
