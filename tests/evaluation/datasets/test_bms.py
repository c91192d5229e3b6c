"""Berkeley motion segmentation as published: definition files, labels in grey and in colour, frames among labels."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import clip, colours, complaint, mask, pictures, read, text
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.labelled_masks import read_definition
from torchvision_dddas.evaluation.metrics.truth import labels_of

CAR, MAN = (2, 2, 8, 8), (20, 10, 6, 10)
RED, GREEN, WHITE = 0xFF0000, 0x00FF00, 0xFFFFFF


def definition(regions: list[int], frames: int, labelled: Mapping[str, str]) -> str:
    """A definition file. labelled: picture -> file of its labels."""
    scales = "".join(f"Scale of region {k}:\n{value}\n" for k, value in enumerate(regions))
    matrix = "".join(" ".join("0" if i == j else "1" for j in regions) + "\n" for i in regions)
    said = "".join(
        f"Frame number:\n{k}\nFile name:\n{file}\nInput file name:\n{picture}\n"
        for k, (picture, file) in enumerate(labelled.items())
    )
    return (
        f"Ground truth definition file; do not change!\n\nTotal number of regions:\n{len(regions)}\n{scales}\n"
        f"Confusion penality matrix:\n{matrix}\nTotal number of frames in this shot:\n{frames}\n"
        f"Total number of labeled frames for this shot:\n{len(labelled)}\n{said}"
    )


def fbms(folder: Path) -> Path:
    """A clip of FBMS-59, of 25 frames, two of them labelled in colour on white."""
    place = folder / "Trainingset" / "cars1"
    pictures(place, [f"cars1_{n:02d}.jpg" for n in range(1, 26)])
    labelled = {"cars1_01.ppm": "cars1_0001_gt.ppm", "cars1_20.ppm": "cars1_0020_gt.ppm"}
    text(place / "GroundTruth" / "cars1Def.dat", definition([WHITE, RED, 0], 25, labelled))
    for file in labelled.values():
        colours(place / "GroundTruth" / file, {CAR: RED, MAN: 0, (0, 0, 1, 1): 0x123456}, WHITE)
        mask(place / "GroundTruth" / file.replace("_gt.ppm", "_PROB_gt.pgm"), {CAR: 9})
    return place


def test_a_clip_of_fbms(tmp_path: Path) -> None:
    place = fbms(tmp_path)
    found = clip("bms", tmp_path, rate_hz=25)
    assert (found.name, found.frames, found.rate_hz, len(found.pictures)) == ("cars1", 25, 25, 25)
    assert found.truth is not None
    assert found.truth.masks == {
        1: place / "GroundTruth" / "cars1_0001_gt.ppm",
        20: place / "GroundTruth" / "cars1_0020_gt.ppm",
    }


def test_the_first_region_is_background_each_other_a_mover_and_unlisted_values_do_not_count(tmp_path: Path) -> None:
    fbms(tmp_path)
    truth = clip("bms", tmp_path).truth
    assert truth is not None
    labels = labels_of(truth, 20)
    assert labels[0, 0] == -1
    assert (labels[2:10, 2:10] == RED).all()
    assert len(np.unique(labels[10:20, 20:26])) == 1
    assert labels[10, 20] > 0
    assert (labels[10:20, 20:26] == labels[10, 20]).all()
    assert np.count_nonzero(labels > 0) == 64 + 60
    assert labels[23, 31] == 0


def test_a_clip_of_bms_26_has_its_labels_among_its_frames(tmp_path: Path) -> None:
    place = tmp_path / "moseg_dataset" / "people1"
    pictures(place, [f"people1_{n:02d}.ppm" for n in range(1, 4)])
    mask(place / "people1_01.pgm", {CAR: 128, MAN: 255})
    text(place / "people1Def.dat", definition([0, 128, 255], 3, {"people1_01.ppm": "people1_01.pgm"}))
    found = clip("bms", tmp_path)
    assert [p.name for p in found.pictures] == ["people1_01.ppm", "people1_02.ppm", "people1_03.ppm"]
    assert found.truth is not None
    labels = labels_of(found.truth, 1)
    assert np.unique(labels).tolist() == [0, 128, 255]


def test_labels_may_have_the_other_suffix_than_is_said(tmp_path: Path) -> None:
    place = fbms(tmp_path) / "GroundTruth"
    (place / "cars1_0020_gt.ppm").unlink()
    mask(place / "cars1_0020_gt.pgm", {CAR: 9})
    truth = clip("bms", tmp_path).truth
    assert truth is not None
    assert truth.masks[20].name == "cars1_0020_gt.pgm"


def test_both_published_sets_and_plain_clips_lie_side_by_side(tmp_path: Path) -> None:
    fbms(tmp_path)
    (tmp_path / "Testset").mkdir()
    (tmp_path / "Trainingset" / "cars1").rename(tmp_path / "Testset" / "cars1")
    pictures(tmp_path / "bms_cars4" / "frames", ["00000.png", "00001.png"])
    mask(tmp_path / "bms_cars4" / "masks" / "00001.png", {CAR: 7})
    found = read("bms", tmp_path)
    assert [c.name for c in found.clips] == ["bms_cars4", "cars1"]
    assert found.missing == ()
    assert "research purposes only" in found.terms


def test_of_two_clips_of_one_name_the_second_is_told(tmp_path: Path) -> None:
    fbms(tmp_path)
    pictures(tmp_path / "cars1" / "frames", ["0.png", "1.png"])
    mask(tmp_path / "cars1" / "masks" / "1.png", {CAR: 7})
    found = read("bms", tmp_path)
    assert len(found.clips) == 1
    assert found.missing[0].endswith("of the same name is not")


def test_a_clip_without_its_definition_is_told(tmp_path: Path) -> None:
    next((fbms(tmp_path) / "GroundTruth").glob("*.dat")).unlink()
    assert "has no truth; wanted cars1Def.dat and masks in" in complaint("bms", tmp_path)


def test_a_definition_without_pictures_is_told(tmp_path: Path) -> None:
    for path in fbms(tmp_path).glob("*.jpg"):
        path.unlink()
    assert "is the truth of a clip without pictures; put them into" in complaint("bms", tmp_path)


def test_a_clip_that_is_not_whole_is_told(tmp_path: Path) -> None:
    place = fbms(tmp_path)
    (place / "cars1_07.jpg").unlink()
    assert "is of 25 frames, but" in (line := complaint("bms", tmp_path))
    assert "holds 24 pictures; is it whole?" in line


def test_labels_that_are_not_there_are_told(tmp_path: Path) -> None:
    (fbms(tmp_path) / "GroundTruth" / "cars1_0020_gt.ppm").unlink()
    assert "cars1_0020_gt.ppm does not exist; the definition beside it names it" in complaint("bms", tmp_path)


def test_labels_of_another_size_are_told(tmp_path: Path) -> None:
    place = fbms(tmp_path)
    mask(place / "GroundTruth" / "cars1_0020_gt.pgm", {CAR: 9}, size=(40, 30))
    (place / "GroundTruth" / "cars1_0020_gt.ppm").unlink()
    assert "is 40×30 pixels, but cars1_01.jpg 32×24" in complaint("bms", tmp_path)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "is no definition of a clip; wanted two regions or more"),
        (definition([0], 3, {"a.ppm": "a.pgm"}), "is no definition of a clip"),
        (definition([0, 9], 3, {}), "names 0 labelled frames, 0 files and 0 pictures; wanted as many of each"),
        (definition([0, 9], 3, {"a.ppm": "a.pgm"}).replace("\n9\n", "\nnine\n"), "wanted a whole number, got 'nine'"),
        (definition([0, 9], 3, {"a.ppm": "a.pgm"}).replace("File name:\na.pgm\n", "", 1), "1 labelled frames, 0 files"),
    ],
)
def test_a_damaged_definition_is_told(tmp_path: Path, content: str, line: str) -> None:
    with pytest.raises(InputError) as caught:
        read_definition(text(tmp_path / "carsDef.dat", content))
    assert line in str(caught.value)
