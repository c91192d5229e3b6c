"""The registry: every kind can be read, and what cannot be is told in a line."""

from pathlib import Path
from typing import Any

import pytest

from tests.evaluation.datasets.layouts import complaint, mask, pictures, read
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets import kinds


def make(folder: Path, *names: str) -> None:
    for name in names:
        pictures(folder / name / "frames", ["00000.png", "00001.png"])
        mask(folder / name / "masks" / "00001.png", {(2, 2, 8, 8): 1})


@pytest.mark.parametrize("kind", kinds.KINDS)
def test_each_kind_tells_of_a_folder_that_is_not_there_and_what_belongs_into_it(kind: str, tmp_path: Path) -> None:
    line = complaint(kind, tmp_path / "absent")
    assert line == f"{tmp_path / 'absent'} does not exist; wanted {kinds.KINDS[kind].layout}"


@pytest.mark.parametrize("kind", kinds.KINDS)
def test_each_kind_tells_that_an_empty_folder_holds_nothing_of_it(kind: str, tmp_path: Path) -> None:
    found = read(kind, tmp_path)
    assert found.clips == ()
    assert found.missing
    assert all("\n" not in line for line in found.missing)


@pytest.mark.parametrize("kind", kinds.KINDS)
def test_each_kind_refuses_an_option_that_it_does_not_know(kind: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"a data set of kind {kind} has no option 'colour'; it takes"):
        read(kind, tmp_path, colour="red")


def test_an_unknown_kind_lists_the_kinds(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'imagenet' is no kind of data set; wanted one of folder, bms, davis"):
        read("imagenet", tmp_path)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "clips").write_text("")
    assert "clips is no folder; wanted" in complaint("folder", tmp_path / "clips")


def test_patterns_pick_clips_and_the_others_are_not_complained_of(tmp_path: Path) -> None:
    make(tmp_path, "cars1", "cars2", "people1")
    pictures(tmp_path / "people2" / "frames", ["00000.png"])  # has no truth
    found = read("folder", tmp_path, clips=["cars*"])
    assert [clip.name for clip in found.clips] == ["cars1", "cars2"]
    assert found.missing == ()
    assert [clip.name for clip in read("folder", tmp_path, clips=["cars1", "people*"]).clips] == ["cars1", "people1"]


def test_a_pattern_that_fits_no_clip_is_told(tmp_path: Path) -> None:
    make(tmp_path, "cars1")
    (line,) = read("folder", tmp_path, clips=["boats*"]).missing
    assert "holds no clip by the name boats*" in line


def test_clips_come_in_natural_order(tmp_path: Path) -> None:
    make(tmp_path, "car10", "car2", "car1")
    assert [clip.name for clip in read("folder", tmp_path).clips] == ["car1", "car2", "car10"]


def test_a_folder_is_relative_to_the_base(tmp_path: Path) -> None:
    from torchvision_dddas.evaluation.datasets.record import Source

    make(tmp_path / "data", "cars1")
    found = kinds.read(Source("folder", Path("../data")), tmp_path / "studies")
    assert found.folder == tmp_path / "data"
    assert [clip.name for clip in found.clips] == ["cars1"]


@pytest.mark.parametrize(
    ("option", "line"),
    [
        (
            {"rate_hz": "fast"},
            "of kind folder must be a number above 0, at most 1000, got 'fast'",
        ),
        ({"rate_hz": 0}, "got 0"),
        ({"rate_hz": True}, "got True"),
        ({"still": "cars1"}, "still of a data set of kind folder must be a list of texts, got 'cars1'"),
        ({"still": [1]}, "got [1]"),
    ],
)
def test_an_option_of_another_type_is_refused(tmp_path: Path, option: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as caught:
        read("folder", tmp_path, **option)
    assert line in str(caught.value)


@pytest.mark.parametrize("kind", kinds.KINDS)
def test_each_kind_is_in_the_documentation(kind: str) -> None:
    told = (Path(__file__).parents[3] / "docs" / "datasets.md").read_text(encoding="utf-8")
    assert f"\n| [`{kind}`](#{kind}" in told
    assert f"\n## `{kind}`" in told
