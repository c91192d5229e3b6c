"""What `dddas simulate` writes is a clip with masks, identities and places; the folder is made by the very writers."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import clip, complaint, mask, pictures, read, text
from tests.evaluation.studies.scored_clips import found_of
from torchvision_dddas.evaluation.metrics.truth import labels_of
from torchvision_dddas.evaluation.studies.scoring import score
from torchvision_dddas.simulation.truth import COLUMNS

PLACES = (
    ",".join(COLUMNS) + "\n"
    "1,1,person,3,10,20,7.1,50.1,0,0,64\n"
    "1,2,ugv,0,11,20,7.1,50.1,0,0,80\n"
    "1,3,person,3,90,20,7.2,50.1,0,0,0\n"
    "2,1,person,3,10.5,20,7.1,50.1,0,0,64\n"
)


def run(folder: Path, name: str = "four", *, masks: bool = True, state: str = "complete") -> Path:
    place = folder / name
    pictures(place / "frames", ["000001.jpg", "000002.jpg"])
    if masks:
        for n in (1, 2):
            mask(place / "truth" / "masks" / f"00000{n}.png", {(2, 2, 8, 8): 1, (20, 10, 10, 8): 2})
    text(place / "truth" / "gt.txt", "1,1,2,2,8,8,1,-1,-1,-1\n1,4,12,2,3,3,0,-1,-1,-1\n2,1,2,2,8,8,1,-1,-1,-1\n")
    text(place / "truth" / "people.txt", "1,1,2,2,3,3,1,-1,-1,-1\n")
    text(place / "truth" / "positions.csv", PLACES)
    text(place / "run.json", json.dumps({"state": state, "clip": {"rate_hz": 12.5}}))
    for file in ("telemetry.csv", "landmarks.csv", "colours.toml", "camera.toml", "dem.tif"):
        text(place / file, "x")
    return place


def test_masks_tell_pixels_and_gt_tells_identities(tmp_path: Path) -> None:
    run(tmp_path)
    found = clip("simulated", tmp_path)
    assert (found.name, found.frames, found.rate_hz) == ("four", 2, 12.5)
    truth = found.truth
    assert truth is not None
    assert truth.frames == [1, 2]
    assert np.unique(labels_of(truth, 1)).tolist() == [0, 1, 2]
    assert truth.tracks is not None
    assert truth.tracks.identity.tolist() == [1, 1]
    assert truth.ignored is not None
    assert truth.ignored.identity.tolist() == [4]


def test_a_track_on_a_ground_vehicle_is_neither_right_nor_false(tmp_path: Path) -> None:
    run(tmp_path)
    target, vehicle, part, nothing = (2, 2, 8, 8), (20, 10, 10, 8), (21, 10, 4, 8), (14, 2, 4, 4)
    rows = [(1, 1, *target, 1), (1, 2, *vehicle, 1), (2, 1, *target, 1), (2, 2, *part, 1), (2, 3, *nothing, 1)]
    tracks: Any = score(clip("simulated", tmp_path), "tracking", found_of(np.array(rows, float), 2)).counts["tracks"]
    assert (tracks.clear.tp, tracks.clear.fp, tracks.clear.fn) == (2, 1, 0)


def test_places_are_those_of_targets_that_show_and_are_no_landmarks(tmp_path: Path) -> None:
    run(tmp_path)
    truth = clip("simulated", tmp_path).truth
    assert truth is not None
    assert truth.positions is not None
    assert truth.positions.frame.tolist() == [1, 2]
    assert truth.positions.identity.tolist() == [1, 1]
    assert truth.positions.east_north_m.tolist() == [[10, 20], [10.5, 20]]
    assert truth.positions.lonlat_deg is not None
    assert len(truth.positions.lonlat_deg) == 2


def test_what_the_instruments_say_goes_with_the_clip(tmp_path: Path) -> None:
    run(tmp_path)
    found = clip("simulated", tmp_path)
    files = (found.telemetry, found.landmarks, found.colours, found.camera, found.elevation)
    assert [f and f.name for f in files] == ["telemetry.csv", "landmarks.csv", "colours.toml", "camera.toml", "dem.tif"]


def test_without_masks_boxes_are_what_is_scored(tmp_path: Path) -> None:
    run(tmp_path, masks=False)
    truth = clip("simulated", tmp_path).truth
    assert truth is not None
    assert truth.kind == "boxes"
    assert truth.positions is not None


def test_one_run_or_several(tmp_path: Path) -> None:
    assert clip("simulated", run(tmp_path, "a")).name == "a"
    run(tmp_path, "b")
    assert [c.name for c in read("simulated", tmp_path).clips] == ["a", "b"]


@pytest.mark.parametrize("part", ["truth/gt.txt", "truth/positions.csv"])
def test_a_run_that_was_not_finished_is_told(tmp_path: Path, part: str) -> None:
    (run(tmp_path) / part).unlink()
    assert "does not exist; the run was not finished, simulate it again" in complaint("simulated", tmp_path)


def test_an_interrupted_run_is_told_and_the_others_go_on(tmp_path: Path) -> None:
    run(tmp_path, "a", state="interrupted")
    run(tmp_path, "b")
    found = read("simulated", tmp_path)
    assert [c.name for c in found.clips] == ["b"]
    assert "the run is interrupted; simulate it again" in found.missing[0]


def test_a_run_without_pictures_is_told(tmp_path: Path) -> None:
    (run(tmp_path) / "frames").rename(tmp_path / "four" / "elsewhere")
    assert "holds neither frames/ nor clip.mp4; simulate it with --save frames,masks" in complaint(
        "simulated", tmp_path
    )


def test_a_folder_without_truth_is_no_run(tmp_path: Path) -> None:
    pictures(tmp_path / "four" / "frames", ["000001.jpg"])
    assert "has no truth/; wanted what `dddas simulate --out` writes" in complaint("simulated", tmp_path)


def test_positions_of_another_kind_are_told(tmp_path: Path) -> None:
    text(run(tmp_path) / "truth" / "positions.csv", "frame,target,east_m,north_m\n1,1,10,20\n")
    assert "lacks kind, visible_px; wanted what `dddas simulate` writes" in complaint("simulated", tmp_path)


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"clip": 3, "state": "complete"}'])
def test_a_damaged_record_of_the_run_is_told(tmp_path: Path, content: str) -> None:
    text(run(tmp_path) / "run.json", content)
    assert "run.json does not hold the frames a second" in complaint("simulated", tmp_path)


def test_more_masks_than_pictures_are_told(tmp_path: Path) -> None:
    (run(tmp_path) / "frames" / "000002.jpg").unlink()
    assert "labels frame 2, but the clip has 1 frames; is it the same clip?" in complaint("simulated", tmp_path)


def test_masks_of_another_size_are_told(tmp_path: Path) -> None:
    mask(run(tmp_path) / "truth" / "masks" / "000002.png", {(2, 2, 8, 8): 1}, size=(64, 48))
    assert "000002.png is 64×48 pixels, but 000001.jpg 32×24" in complaint("simulated", tmp_path)
