"""DAVIS 2016 and 2017: frames, annotations, and lists of clips in both their forms."""

from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import clip, complaint, mask, pictures, read, text
from torchvision_dddas.evaluation.metrics.truth import labels_of

BOX = {(2, 2, 8, 8): 255}


def davis(folder: Path, *names: str, labelled: int = 3) -> None:
    for name in names:
        numbers = [f"{n:05d}" for n in range(3)]
        pictures(folder / "JPEGImages" / "480p" / name, [f"{n}.jpg" for n in numbers])
        for n in numbers[:labelled]:
            mask(folder / "Annotations" / "480p" / name / f"{n}.png", BOX)


def test_a_clip_has_a_mask_a_frame(tmp_path: Path) -> None:
    davis(tmp_path, "bear")
    found = clip("davis", tmp_path)
    assert (found.name, found.frames, found.rate_hz) == ("bear", 3, 24.0)
    assert found.truth is not None
    assert found.truth.frames == [1, 2, 3]
    assert np.unique(labels_of(found.truth, 2)).tolist() == [0, 255]


def test_of_a_test_clip_only_the_first_frame_is_labelled(tmp_path: Path) -> None:
    davis(tmp_path, "bear", labelled=1)
    truth = clip("davis", tmp_path).truth
    assert truth is not None
    assert truth.frames == [1]


@pytest.mark.parametrize(
    ("path", "content"),
    [
        ("ImageSets/2017/val.txt", "car\nbear\n"),
        ("ImageSets/2016/val.txt", "car\nbear\n"),
        (
            "ImageSets/480p/val.txt",
            "".join(
                f"/JPEGImages/480p/{name}/0000{n}.jpg /Annotations/480p/{name}/0000{n}.png \n"
                for name in ("car", "bear")
                for n in range(3)
            ),
        ),
    ],
)
def test_a_subset_is_what_its_list_names(tmp_path: Path, path: str, content: str) -> None:
    davis(tmp_path, "bear", "car", "dog")
    text(tmp_path / path, content)
    found = read("davis", tmp_path, subset="val")
    assert [c.name for c in found.clips] == ["bear", "car"]
    assert found.missing == ()


def test_the_year_says_whose_list_it_is(tmp_path: Path) -> None:
    davis(tmp_path, "bear", "car")
    text(tmp_path / "ImageSets/2016/val.txt", "bear\n")
    text(tmp_path / "ImageSets/2017/val.txt", "bear\ncar\n")
    assert [c.name for c in read("davis", tmp_path, subset="val", year="2016").clips] == ["bear"]
    assert [c.name for c in read("davis", tmp_path, subset="val").clips] == ["bear", "car"]


def test_a_listed_clip_that_is_not_there_is_told_and_the_others_go_on(tmp_path: Path) -> None:
    davis(tmp_path, "bear")
    text(tmp_path / "ImageSets/2017/val.txt", "bear\nboat\n")
    found = read("davis", tmp_path, subset="val")
    assert [c.name for c in found.clips] == ["bear"]
    assert found.missing == (
        f"boat: {tmp_path / 'JPEGImages/480p/boat'} holds no pictures; wanted the frames of the clip",
    )


def test_an_unknown_subset_lists_those_there_are(tmp_path: Path) -> None:
    davis(tmp_path, "bear")
    text(tmp_path / "ImageSets/2017/train.txt", "bear\n")
    assert "has no list test.txt of 2017 or 2016 or 480p; it has train" in complaint("davis", tmp_path, subset="test")


def test_parts_that_are_not_there_are_told_with_their_place(tmp_path: Path) -> None:
    davis(tmp_path, "bear")
    (tmp_path / "Annotations").rename(tmp_path / "elsewhere")
    expected = f"{tmp_path / 'Annotations/480p'} does not exist; wanted the masks, a folder a clip"
    assert complaint("davis", tmp_path) == expected


def test_frames_without_masks_and_masks_without_frames_are_told(tmp_path: Path) -> None:
    davis(tmp_path, "bear")
    pictures(tmp_path / "JPEGImages" / "480p" / "car", ["00000.jpg"])
    mask(tmp_path / "Annotations" / "480p" / "dog" / "00000.png", BOX)
    found = read("davis", tmp_path)
    assert [c.name for c in found.clips] == ["bear"]
    assert "car: " in found.missing[0]
    assert "holds no masks; wanted the truth of the clip" in found.missing[0]
    assert "dog: " in found.missing[1]
    assert "holds no pictures; wanted the frames of the clip" in found.missing[1]


def test_more_masks_than_frames_are_told(tmp_path: Path) -> None:
    davis(tmp_path, "bear")
    mask(tmp_path / "Annotations" / "480p" / "bear" / "00003.png", BOX)
    assert "00003.png labels no picture of" in complaint("davis", tmp_path)


def test_masks_of_another_size_are_told(tmp_path: Path) -> None:
    davis(tmp_path, "bear")
    mask(tmp_path / "Annotations" / "480p" / "bear" / "00002.png", BOX, size=(64, 48))
    assert "00002.png is 64×48 pixels, but 00000.jpg 32×24" in complaint("davis", tmp_path)
