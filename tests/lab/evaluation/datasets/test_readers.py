"""What every reader does: it reads a good clip of its kind and says in a line what is wrong with a bad one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.lab.evaluation.datasets.layouts import (
    BAD,
    CAR,
    CVML_BOX,
    GOOD,
    MAKE,
    WALKERS,
    complaint,
    cvml_text,
    definition,
    inria_text,
    kitti_label,
    mask,
    read,
    text,
    video,
)
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets import kinds
from torchvision_dddas.lab.evaluation.datasets.record import DatasetSource


def good(kind: str) -> str:
    return GOOD.get(kind, "good")


def bad(kind: str) -> str:
    return BAD.get(kind, "bad")


def names_of(kind: str, name: str) -> list[str]:
    return ["neg-32x24", "pos-32x24"] if kind == "inria" else [name]


# Frames, rate, kind of truth, labelled frames, what is labelled, boxes with identities.
EXPECTED: dict[str, tuple[int, float | None, str, list[int], str, int | None]] = {
    "folder": (3, None, "masks", [2], "movers", None),
    "davis": (3, 24.0, "masks", [1, 2, 3], "movers", None),
    "cdnet": (6, None, "masks", [3, 4, 5], "movers", None),
    "bms": (5, None, "masks", [1, 4], "movers", None),
    "uav123": (4, 30.0, "one target", [1, 2, 3, 4], "movers", 3),
    "vivid": (21, 30.0, "one target", [1, 11, 21], "movers", 2),
    "motchallenge": (3, 25.0, "boxes", [1, 2, 3], "people", 3),
    "visdrone": (2, None, "boxes", [1, 2], "movers", 2),
    "uavdt": (2, 30.0, "boxes", [1, 2], "movers", 3),
    "cvml": (3, None, "boxes", [1, 2, 3], "people", 3),
    "sdd": (3, None, "boxes", [1, 2, 3], "movers", 3),
    "kitti": (2, 10.0, "boxes", [1, 2], "movers", 2),
    "inria": (1, None, "boxes", [1], "people", None),
    "simulated": (2, 12.5, "masks", [1, 2], "movers", 2),
}
"""Frames, rate, kind of truth, labelled frames, what is labelled, boxes with identities."""


@pytest.mark.parametrize("kind", kinds.KINDS)
def test_a_clip_has_its_pictures_rate_and_truth(kind: str, tmp_path: Path) -> None:
    MAKE[kind](tmp_path, good(kind))
    found = read(kind, tmp_path)
    assert (found.missing, found.notes) == ((), ())
    assert [clip.name for clip in found.clips] == names_of(kind, good(kind))
    clip = found.clips[-1]
    frames, rate_hz, what, labelled, shows, boxes = EXPECTED[kind]
    assert (clip.frames, clip.rate_hz, clip.shows, clip.still) == (frames, rate_hz, (shows,), False)
    assert len(clip.pictures) == (1 if kind == "sdd" else frames)
    assert all(path.is_file() for path in clip.pictures)
    assert clip.truth is not None and (clip.truth.kind, clip.truth.frames) == (what, labelled)
    assert clip.truth.length in (0, frames)
    assert (clip.truth.tracks and len(clip.truth.tracks.frame)) == boxes


def other_size(path: Path) -> None:
    mask(path, {CAR: 9}, size=(40, 30))


HEAD = "name,frame,id,x,y,w,h\ncar,0,7,1,2,8,5\n"
VIVID, VISDRONE, UAVDT = "bad_truth.csv", "annotations/bad.txt", "UAV-benchmark-MOTD_v1.0/GT/bad_gt_whole.txt"
SDD, KITTI, INRIA = "annotations/quad/bad/annotations.txt", "training/label_02/bad.txt", "Test/annotations/b.txt"
BMS = "Trainingset/bad/GroundTruth/"
SIZES = "wanted masks of the same size"
SPOILED: list[tuple[str, str, str | Callable[[Path], None] | None, str]] = [
    ("folder", "bad/masks/1.png", None, "has no truth, so that it cannot be scored"),
    ("folder", "bad/masks/7.png", lambda p: mask(p, {CAR: 1}), "its pictures are 0 to 2; is it the same clip?"),
    ("folder", "bad/masks/1.png", other_size, "1.png is 40×30 pixels, but 0.png 32×24; " + SIZES),
    ("folder", "bad/gt.txt", "", "is empty: wanted one box a line"),
    ("folder", "bad/gt.txt", "1,2\n", "has 2 columns; wanted 4 (x,y,w,h) or MOTChallenge's"),
    ("folder", "bad/gt.txt", "9,1,2,3,4,5,1\n", "labels frame 9, but the clip has 3 frames; is it the same clip?"),
    (
        "folder",
        "bad/boxes_xywh.txt",
        "1,2,3,4\n",
        "has 1 lines, but the clip has 3 frames; wanted one line for each frame",
    ),
    ("folder", "bad/boxes_xywh.txt", "1,2,3,2e9\n", "a box is 1,2,3,2e9; wanted numbers from -1e+09 to 1e+09"),
    ("davis", "Annotations/480p/bad/*", None, "holds no masks; wanted the truth of the clip"),
    ("davis", "JPEGImages/480p/bad/*", None, "holds no pictures; wanted the frames of the clip"),
    ("davis", "Annotations/480p/bad/00003.png", lambda p: mask(p, {CAR: 1}), "00003.png labels no picture of"),
    ("cdnet", "PTZ/bad/input/*", None, "holds no pictures; wanted the frames of the clip"),
    ("cdnet", "PTZ/bad/temporalROI.txt", None, "has no temporalROI.txt; wanted input, groundtruth, temporalROI.txt"),
    *(
        ("cdnet", "PTZ/bad/temporalROI.txt", region, f"says '{region}'; wanted the first and the last frame that count")
        for region in ("3", "five six", "5 3", "-1 4")
    ),
    ("cdnet", "PTZ/bad/temporalROI.txt", "90 99", "labels no frame from 90 to 99; wanted masks"),
    ("bms", BMS + "badDef.dat", None, "has no truth; wanted badDef.dat and masks in"),
    ("bms", "Trainingset/bad/*.jpg", None, "is the truth of a clip without pictures; put the pictures into"),
    ("bms", BMS + "bad_0004_gt.ppm", None, "bad_0004_gt.ppm does not exist, but the definition beside it names it"),
    ("bms", BMS + "bad_0004_gt.ppm", other_size, "is 40×30 pixels, but bad_01.jpg 32×24"),
    ("bms", BMS + "badDef.dat", definition([0, 9], 5, {"x.ppm": "x.pgm"}), "picture x.ppm of frame 0 is not in"),
    ("uav123", "anno/UAV123/bad.txt", "", "is empty"),
    ("uav123", "anno/UAV123/bad.txt", "a,b,c,d\n", "is not a table of boxes"),
    (
        "uav123",
        "anno/UAV123/bad.txt",
        "1,2,3,4\n",
        "has 1 lines, but the clip has 4 frames; wanted one line for each frame",
    ),
    ("uav123", "data_seq/UAV123/bad/*", None, "or configSeqs.m, which states the sequence that bad is part of"),
    ("vivid", "bad/*", None, "holds no pictures; wanted frame00000.jpg and so on"),
    ("vivid", "bad_gt.txt", None, "has no truth of this clip; wanted bad_truth.csv, bad*.txt or a folder bad_mask"),
    ("vivid", VIVID, HEAD + "car,99,7,1,2,8,5\n", "line 3: there is no picture 99; the clip has 0 to 20"),
    ("vivid", VIVID, HEAD + "car,1,7\n", "line 3: 3 columns; wanted name,frame,identity,x,y,width,height"),
    ("vivid", VIVID, HEAD + "car,1,7,a,2,8,5\n", "line 3: wanted a number from -1e+09 to 1e+09, got 'a'"),
    ("vivid", VIVID, HEAD + "car,0,7,1,2,8,5\n", "lines 2 and 3: identity 7 twice in frame 1"),
    ("vivid", VIVID, HEAD + "car,1,7.5,1,2,8,5\n", "7.5 is not an identity; wanted whole numbers"),
    ("vivid", VIVID, "name,frame,id,x,y,w,h\n", "holds no boxes"),
    ("vivid", "bad_gt.txt", "", "is empty; wanted frame,x,y,width,height"),
    ("vivid", "bad_gt.txt", "1,2\n", "has 2 columns; wanted frame,x,y,width,height"),
    ("vivid", "bad_gt.txt", "0,1,2,8,5\n0,1,2,8,5\n", "line 2: frame 0 occurs twice"),
    ("vivid", "bad_gt.txt", "1,2,8,5\n", "has 1 lines, but the clip has 21 frames; wanted one for each"),
    ("vivid", "bad_gt.txt", "0,1,2,8,5\n1,2,8,5\n", "line 2: 4 columns; the first line has 5"),
    ("vivid", "bad_gt.txt", "NaN,1,2,8,5\n", "line 1: there is no picture nan"),
    ("motchallenge", "bad/gt/gt.txt", None, "no truth; it belongs in "),
    ("motchallenge", "bad/gt/gt.txt", "1,1,10,20,30\n", "wanted"),
    ("motchallenge", "bad/gt/gt.txt", "\n", "is empty"),
    ("motchallenge", "bad/gt/gt.txt", "1,1,1,2,3,4,1,1,1\n" * 2, "identity 1 twice in frame 1"),
    ("motchallenge", "bad/gt/gt.txt", "1,1,1,2,0,4,1,1,1\n", "0×4 pixels; wanted more than 0"),
    ("motchallenge", "bad/gt/gt.txt", "1,1,1,2,3,4,1,car,1\n", "line 1: class is 'car'; wanted a number"),
    ("motchallenge", "bad/gt/gt.txt", "0,1,1,2,3,4,1,1,1\n", "line 1: frame is '0'; wanted a whole number, 1 to"),
    ("motchallenge", "bad/gt/gt.txt", "1,1,1,2,3,4,0,3,1\n", "holds no pedestrian that counts"),
    ("motchallenge", "bad/gt/gt.txt", "1,-1,1,2,3,4,1\n", "has no identities; wanted MOTChallenge's"),
    ("motchallenge", "bad/seqinfo.ini", "[Sequence]\nseqLength=4\n", "has 3 frames, but seqinfo.ini says 4"),
    ("motchallenge", "bad/seqinfo.ini", "nothing\n", "does not hold seqLength"),
    ("motchallenge", "bad/seqinfo.ini", f"[Sequence]\nseqLength=3\nimDir={'9' * 300}\n", "is not a folder's name"),
    ("motchallenge", "bad/img1/000002.png", None, "has 000003.png in place of frame 2"),
    ("visdrone", VISDRONE, "1,1,2,3,4,5,1\n", "line 1: 7 columns; wanted frame,identity,left"),
    ("visdrone", VISDRONE, "1,1,2,3,4,5,1,12,0,0\n", "line 1: the category is '12'; wanted 0 to 11"),
    ("visdrone", VISDRONE, "3,1,2,3,4,5,1,1,0,0\n", "labels frame 3, but the clip has 2"),
    ("visdrone", VISDRONE, "1,0,20,0,10,10,0,0,0,0", "holds no box that counts: categories 0 (regions) and 11"),
    ("visdrone", VISDRONE, "1,1,20,0,10,10,1,11,0,0", "holds no box that counts: categories 0 (regions) and 11"),
    ("uavdt", UAVDT, "1,1,2,3,4,5,1,1\n", "8 columns"),
    ("uavdt", UAVDT, "1,1,2,3,4,5,1,1,4\n", "the category is '4'; wanted 1 to 3"),
    ("cvml", "bad.xml", cvml_text(CVML_BOX.format(1, 10))[:-12], "is broken XML"),
    ("cvml", "bad.xml", '<!DOCTYPE a [<!ENTITY b "c"><!ENTITY d "&b;">]><dataset>&e;</dataset>', "is broken XML"),
    ("cvml", "bad.xml", cvml_text(), "holds no box"),
    ("cvml", "bad.xml", cvml_text(CVML_BOX.format("x", 10)), "object of frame 0 has id='x'; wanted a number"),
    ("cvml", "bad.xml", cvml_text(CVML_BOX.format(1, "nan")), "box of frame 0 has xc='nan'; wanted a number"),
    ("cvml", "bad.xml", cvml_text('<object id="1"/>'), "object 1 of frame 0 has no box"),
    ("cvml", "bad.xml", cvml_text(CVML_BOX.format(1, 10), first=-2), "a frame has the number -2"),
    ("cvml", "bad.xml", cvml_text(*[""] * 5, CVML_BOX.format(1, 10)), "labels frame 6, but the clip has 3"),
    ("sdd", SDD, '0 10 20 18 30 0 0 0 "Biker"\n', "9 columns"),
    ("sdd", SDD, '0 10 20 18 30 0 0 0 0 "Dog"\n', "the label is 'Dog'; wanted Pedestrian"),
    ("sdd", SDD, '0 10 20 10 30 0 0 0 0 "Biker"\n', "0×10 pixels"),
    ("sdd", SDD, '0 10 20 18 30 0 1 0 0 "Biker"\n', "holds no box that counts"),
    ("sdd", SDD, WALKERS + '0 10 20 18 30 9 0 0 0 "Biker"\n', "labels frame 10, but the clip has 3"),
    ("kitti", KITTI, "0 0 Car 0 0\n", "5 columns"),
    ("kitti", KITTI, kitti_label(0, 0, "Dog"), "the type is 'Dog'; wanted Car"),
    ("kitti", KITTI, kitti_label(5, 0), "labels frame 6, but the clip has 2"),
    ("inria", INRIA, inria_text((34, 24)), "it is 33×24 pixels, but"),
    ("inria", INRIA, inria_text(announced=2), "announces 2 objects, but has 1 boxes"),
    ("inria", INRIA, inria_text((0, 24)), "says the picture is 0×24 pixels"),
    ("inria", INRIA, "", "does not hold 'Image size'"),
    ("inria", INRIA, inria_text().replace("(19, 21)", "(5, 21)"), "has a box whose end is before its start"),
    ("inria", "Test/pos/b.png", "no picture", "is not a readable picture"),
    ("simulated", "bad/truth/*.csv", None, "does not exist; the run was not finished, simulate it again"),
    ("simulated", "bad/frames/*", None, "holds neither frames/ nor clip.mp4; simulate it with --save frames,masks"),
    ("simulated", "bad/frames/000002.jpg", None, "labels frame 2, but the clip has 1 frames; is it the same clip?"),
    (
        "simulated",
        "bad/truth/positions.csv",
        "frame,target,east_m,north_m\n1,1,10,20\n",
        "lacks kind, visible_px; want",
    ),
    ("simulated", "bad/run.json", '{"state": "interrupted", "clip": {"rate_hz": 1}}', "the run is interrupted"),
    ("simulated", "bad/run.json", "[]", "run.json does not hold the frames per second"),
    ("simulated", "bad/run.json", '{"clip": 3, "state": "complete"}', "run.json does not hold the frames per second"),
]


@pytest.mark.parametrize(("kind", "path", "content", "line"), SPOILED)
def test_a_spoiled_clip_is_one_line_and_the_others_are_read(
    kind: str, path: str, content: str | Callable[[Path], None] | None, line: str, tmp_path: Path
) -> None:
    """content: of the file; None: it is deleted."""
    MAKE[kind](tmp_path, good(kind))
    MAKE[kind](tmp_path, bad(kind))
    if content is None:
        assert list(tmp_path.glob(path))
        for file in tmp_path.glob(path):
            file.unlink()
    elif isinstance(content, str):
        text(tmp_path / path, content)
        if kind == "folder":  # masks come before boxes
            (tmp_path / "bad/masks/1.png").unlink()
    else:
        content(tmp_path / path)
    found = read(kind, tmp_path)
    assert [clip.name for clip in found.clips] == names_of(kind, good(kind))
    (only,) = found.missing
    assert only.isprintable() and line in only
    assert only.startswith("pos/b.png: " if kind == "inria" else f"{bad(kind)}: ")
    if kind != "inria":  # its pictures are no clips by themselves
        alone = read(kind, tmp_path, [good(kind)])
        assert [clip.name for clip in alone.clips] == [good(kind)] and alone.missing == ()


@pytest.mark.parametrize(
    ("kind", "pictures"),
    [("motchallenge", "img1"), ("visdrone", "sequences"), ("uavdt", "UAV-bench"), ("cvml", "good"), ("sdd", "annot")],
)
def test_boxes_without_pictures_are_a_clip_and_a_note(kind: str, pictures: str, tmp_path: Path) -> None:
    MAKE[kind](tmp_path, good(kind))
    for path in [path for path in tmp_path.rglob("*") if path.suffix in (".png", ".mov")]:
        path.unlink()
    found = read(kind, tmp_path)
    (clip,), (note,) = found.clips, found.notes
    assert (clip.pictures, found.missing) == ((), ())
    assert clip.frames == EXPECTED[kind][0] - (kind == "sdd")  # a lost row labels the last frame there
    assert note.startswith(f"{good(kind)}: no pictures; they belong in ") and pictures in note


@pytest.mark.parametrize("kind", ["folder", "motchallenge"])
def test_two_videos_are_refused(kind: str, tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        video(tmp_path / "x" / name, 1)
    text(tmp_path / "x/gt/gt.txt", "1,1,2,3,4,5,1\n")
    assert "holds 2 videos" in complaint(kind, tmp_path)


# -- folders and options -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", kinds.KINDS)
def test_each_kind_is_documented_and_refuses_unknown_options_and_folders_without_data(
    kind: str, tmp_path: Path
) -> None:
    layout = kinds.KINDS[kind].layout
    assert complaint(kind, tmp_path / "absent") == f"{tmp_path / 'absent'} does not exist; wanted {layout}"
    text(tmp_path / "file", "")
    assert complaint(kind, tmp_path / "file") == f"{tmp_path / 'file'} is no folder; wanted {layout}"
    (tmp_path / "empty").mkdir()
    found = read(kind, tmp_path / "empty")
    assert found.clips == () and found.missing
    assert all("wanted " in line for line in found.missing)
    with pytest.raises(InputError, match=f"a data set of kind {kind} has no option 'colour'; it takes"):
        read(kind, tmp_path, colour="red")
    docs = (Path(__file__).parents[4] / "docs" / "datasets.md").read_text(encoding="utf-8")
    assert f"\n| [`{kind}`](#{kind}" in docs and f"\n## `{kind}`" in docs


@pytest.mark.parametrize(
    ("kind", "option", "line"),
    [
        ("folder", {"rate_hz": "fast"}, "rate_hz of a data set of kind folder must be a number above 0, at most 1000"),
        ("folder", {"rate_hz": 0}, "got 0"),
        ("folder", {"still": "cars1"}, "still of a data set of kind folder must be a list of texts, got 'cars1'"),
        ("inria", {"body_height_px": "96"}, "must be a number, got '96'"),
        ("davis", {"year": 2016}, "must be a text, got 2016"),
        ("visdrone", {"classes": ["dog"]}, "'dog' is not a class of VisDrone; wanted some of pedestrian, people"),
        (
            "uavdt",
            {"attributes": ["dawn"]},
            "'dawn' is not a class of UAVDT's sequences; wanted some of daylight, night",
        ),
        (
            "motchallenge",
            {"benchmark": "MOT18"},
            "'MOT18' is not a benchmark; wanted one of MOT15, MOT16, MOT17, MOT20",
        ),
        ("uav123", {"variant": "UAV124"}, "'UAV124' is not a variant of UAV123; wanted UAV123, UAV20L, UAV123_10fps"),
        ("imagenet", {}, "'imagenet' is not a kind of data set; wanted one of folder, bms, davis"),
    ],
)
def test_a_wrong_option_is_refused(kind: str, option: dict[str, Any], line: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read(kind, tmp_path, **option)
    assert line in str(caught.value)


def test_patterns_pick_clips_in_natural_order_from_a_folder_relative_to_the_base(tmp_path: Path) -> None:
    for name in ("car10", "car2", "car1", "people1"):
        MAKE["folder"](tmp_path / "data", name)
    found = kinds.read(DatasetSource("folder", Path("../data"), ("car*",)), tmp_path / "studies")
    assert found.folder == tmp_path / "data"
    assert [clip.name for clip in found.clips] == ["car1", "car2", "car10"]
    (line,) = read("folder", tmp_path / "data", ["boats*"]).missing
    assert "holds no clip by the name boats*" in line
