"""INRIA's pictures become a clip for each size; a picture that cannot be read is one line."""

from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import complaint, pictures, read, text
from tests.evaluation.datasets.numbered import line_of
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.inria import read_annotation

HEAD = (
    '# PASCAL Annotation Version 1.00\n\nImage filename : "Test/pos/{name}.png"\n'
    "Image size (X x Y x C) : {w} x {h} x 3\n"
    'Database : "The INRIA Rhône-Alpes Annotated Person Database"\n'
    'Objects with ground truth : {n} {{ "PASperson" }}\n\n# Top left pixel co-ordinates : ({o}, {o})\n\n'
)
BOX = (
    'Original label for object 1 "PASperson" : "UprightPerson"\n'
    'Center point on object 1 "PASperson" (X, Y) : (16, 5)\n'
    'Bounding box for object 1 "PASperson" (Xmin, Ymin) - (Xmax, Ymax) : (10, 2) - (19, 21)\n'
)


def annotation(size: tuple[int, int] = (32, 24), boxes: int = 1, announced: int | None = None, origin: int = 0) -> str:
    head = HEAD.format(name="a", w=size[0], h=size[1], n=boxes if announced is None else announced, o=origin)
    return head + BOX * boxes


def inria(home: Path) -> Path:
    for name, size in (("a", (32, 24)), ("b", (40, 24)), ("c", (32, 24))):
        pictures(home / "Test/pos", [f"{name}.png"], size)
        (home / "Test/annotations").mkdir(exist_ok=True)
        (home / f"Test/annotations/{name}.txt").write_text(annotation(size), encoding="latin-1")
    pictures(home / "Test/neg", ["n.png"])
    return home


def test_pictures_of_one_size_are_a_clip_and_those_without_people_another(tmp_path: Path) -> None:
    found = read("inria", inria(tmp_path / "INRIAPerson"))
    assert [(clip.name, clip.frames) for clip in found.clips] == [
        ("neg-32x24", 1), ("pos-32x24", 2), ("pos-40x24", 1),
    ]  # fmt: skip
    assert found.missing == () and {clip.shows for clip in found.clips} == {("people",)}
    nobody, people, _ = (clip.truth for clip in found.clips)
    assert nobody and people and nobody.boxes[1].shape == (0, 4)
    assert people.boxes[2].tolist() == [[10, 2, 10, 20]] and people.tracks is None


def test_pixels_may_count_from_one(tmp_path: Path) -> None:
    path = text(tmp_path / "a.txt", annotation(origin=1))
    assert read_annotation(path).box_px.tolist() == [[9, 1, 10, 20]]


def test_a_crop_shows_one_person_in_its_middle(tmp_path: Path) -> None:
    pictures(tmp_path / "crops", ["a.png", "b.png"], (96, 160))
    (clip,) = read("inria", tmp_path / "crops").clips
    assert clip.name == "crops-96x160" and clip.truth
    x, y, width, height = clip.truth.boxes[2][0]
    assert (height, y) == (96, 32) and x + width / 2 == 48 and width == pytest.approx(39.36)
    assert (
        "no body of 200 px fits; see body_height_px"
        in read("inria", tmp_path / "crops", body_height_px=200.0).missing[0]
    )


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (annotation((33, 24)), "it is 32×24 pixels, but"),
        (annotation(boxes=1, announced=2), "announces 2 objects and has the boxes of 1"),
        ("", "does not hold 'Image size'"),
        (annotation().replace("(19, 21)", "(5, 21)"), "has a box whose end is before its beginning"),
        (None, "no truth, which belongs in "),
    ],
)
def test_a_spoiled_picture_is_one_line_and_the_others_go_on(tmp_path: Path, content: str | None, said: str) -> None:
    home = inria(tmp_path / "INRIAPerson")
    path = home / "Test/annotations/c.txt"
    if content is None:
        path.unlink()
    else:
        path.write_text(content, encoding="latin-1")
    found = read("inria", home)
    assert [clip.frames for clip in found.clips] == [1, 1, 1]
    assert line_of(found).startswith("pos/c.png: ") and said in line_of(found)


def test_a_broken_picture_and_a_missing_part_are_told(tmp_path: Path) -> None:
    home = inria(tmp_path / "INRIAPerson")
    (home / "Test/neg/n.png").write_bytes(b"no picture")
    assert line_of(read("inria", home)).startswith("neg/n.png: ")
    (home / "Test/neg/n.png").unlink()
    assert line_of(read("inria", home)).startswith("no pictures in ")
    (tmp_path / "none").mkdir()
    assert "Test/pos" in complaint("inria", tmp_path / "none")


def test_boxes_are_numbers_and_an_empty_annotation_is_none(tmp_path: Path) -> None:
    path = text(tmp_path / "a.txt", annotation(boxes=0))
    assert read_annotation(path).box_px.shape == (0, 4) and np.isfinite(read_annotation(path).box_px).all()
    with pytest.raises(InputError, match="cannot be read"):
        read_annotation(tmp_path / "none.txt")
