"""CVML annotations become clips that count from one; broken XML is one line."""

from pathlib import Path

import pytest

from tests.evaluation.datasets.layouts import complaint, read, text
from tests.evaluation.datasets.numbered import line_of, numbered

BOX = '<object id="{0}"><box h="10" w="4" xc="{1}" yc="20"/></object>'


def cvml(*frames: str, first: int = 0) -> str:
    inside = "".join(
        f'<frame number="{number}"><objectlist>{boxes}</objectlist></frame>'
        for number, boxes in enumerate(frames, first)
    )
    return f'<?xml version="1.0" encoding="utf-8"?><dataset name="PETS">{inside}</dataset>'


def test_a_clip_has_boxes_about_their_middles_from_frame_one(tmp_path: Path) -> None:
    text(tmp_path / "pets/S2L1.xml", cvml(BOX.format(1, 10) + BOX.format(2, 15), "", BOX.format(1, 11)))
    numbered(tmp_path / "pets/S2L1", 3, "frame_{:04d}.png", first=0)
    found = read("cvml", tmp_path / "pets", rate_hz=7)
    (clip,) = found.clips
    assert (clip.name, clip.rate_hz, clip.frames, clip.shows, found.missing) == ("S2L1", 7, 3, ("people",), ())
    assert clip.truth and clip.truth.tracks
    assert clip.truth.tracks.frame.tolist() == [1, 1, 3] and clip.truth.tracks.identity.tolist() == [1, 2, 1]
    assert clip.truth.tracks.box_px[0].tolist() == [8, 15, 4, 10]
    assert clip.truth.boxes[2].shape == (0, 4)


def test_a_calibration_is_passed_over_and_pictures_may_lie_beside(tmp_path: Path) -> None:
    text(tmp_path / "pets/a/S1.xml", cvml(BOX.format(1, 10)))
    text(tmp_path / "pets/a/View_001.xml", '<?xml version="1.0"?><Camera name="View_001"/>')
    numbered(tmp_path / "pets/a", 1, "frame_{:04d}.png", first=0)
    found = read("cvml", tmp_path / "pets")
    assert [(clip.name, len(clip.pictures)) for clip in found.clips] == [("S1", 1)] and found.missing == ()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (cvml(BOX.format(1, 10))[:-12], "is broken XML"),
        ("", "is broken XML"),
        (cvml(), "holds no box"),
        (cvml(BOX.format("x", 10)), "object of frame 0 has id='x'; wanted a number"),
        (cvml(BOX.format(1, "nan")), "box of frame 0 has xc='nan'; wanted a number"),
        (cvml('<object id="1"/>'), "object 1 of frame 0 has no box"),
        (cvml(BOX.format(1, 10) * 2), "identity 1 twice in frame 1"),
        (cvml(BOX.format(1, 10), first=-2), "a frame has the number -2"),
        (cvml("", "", BOX.format(1, 10)), "labels frame 3, but the clip has 1"),
        ('<!DOCTYPE a [<!ENTITY b "c"><!ENTITY d "&b;&b;">]><dataset>&e;</dataset>', "is broken XML"),
    ],
)
def test_a_spoiled_clip_is_one_line_and_the_others_go_on(tmp_path: Path, content: str, said: str) -> None:
    for name, xml in (("good", cvml(BOX.format(1, 10))), ("bad", content)):
        text(tmp_path / f"pets/{name}.xml", xml)
        numbered(tmp_path / "pets" / name, 1, first=0)
    found = read("cvml", tmp_path / "pets")
    assert [clip.name for clip in found.clips] == ["good"]
    assert line_of(found).startswith("bad: ") and said in line_of(found)


def test_a_folder_without_annotations_says_what_belongs_there(tmp_path: Path) -> None:
    text(tmp_path / "pets/View_001.xml", '<?xml version="1.0"?><Camera name="View_001"/>')
    assert "NAME.xml" in complaint("cvml", tmp_path / "pets")
