"""What is particular to each kind of data set: where its files may lie, what counts, and in which coordinates."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.lab.evaluation.datasets import layouts
from tests.lab.evaluation.datasets.layouts import CAR, MAN, clip, complaint, definition, mask, numbered, read, text
from tests.lab.evaluation.studies.scored_clips import found_of
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.inria import read_annotation
from torchvision_dddas.lab.evaluation.datasets.labelled_masks import read_definition
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.metrics import pixels
from torchvision_dddas.lab.evaluation.metrics.matching import counted
from torchvision_dddas.lab.evaluation.metrics.truth import labels_of
from torchvision_dddas.lab.evaluation.studies.scoring import score


def truth_of(found: Clip) -> Any:
    return found.truth


def tracks_of(found: Clip) -> Any:
    return truth_of(found).tracks


def ignored_of(found: Clip) -> list[int]:
    return sorted(truth_of(found).ignored.identity.tolist())


def counting(found: Clip, frames: list[int], *boxes: tuple[float, ...]) -> list[bool]:
    return list(counted(truth_of(found), np.array(frames), np.array(boxes, float)).tolist())


# -- folder ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "label", "frame"),
    [
        (["00000.png", "00001.png", "00002.png"], "00000.png", 1),
        (["frame_0.png", "frame_1.png", "frame_2.png", "frame_3.png"], "3.png", 4),  # and the first frame has none
        (["100.png", "102.png", "104.png"], "104.png", 3),
        (["a.png", "b.png", "c.png"], "3.png", 3),
        (["1.png", "1b1.png", "c2.png"], "3.png", 3),  # numbers that repeat are none
    ],
)
def test_masks_are_numbered_as_the_pictures_are(tmp_path: Path, names: list[str], label: str, frame: int) -> None:
    layouts.pictures(tmp_path / "cars" / "frames", names)
    mask(tmp_path / "cars" / "masks" / label, {CAR: 1})
    assert truth_of(clip("folder", tmp_path)).frames == [frame]
    assert clip("folder", tmp_path / "cars").name == "cars"  # the folder may itself be a clip


def test_a_video_is_a_clip_and_a_stream_of_telemetry_no_second_one(tmp_path: Path) -> None:
    layouts.video(tmp_path / "cars" / "any.mp4", 5)
    text(tmp_path / "cars" / "telemetry.ts", "x")
    for name in ("000000.png", "000004.png"):
        mask(tmp_path / "cars" / "masks" / name, {CAR: 1})
    found = clip("folder", tmp_path)
    assert found.pictures == (tmp_path / "cars" / "any.mp4",)
    assert (found.frames, truth_of(found).frames) == (5, [1, 5])
    mask(tmp_path / "cars" / "masks" / "000004.png", {CAR: 1}, size=(20, 10))
    assert "000004.png is 20×10 pixels, but any.mp4 32×24" in complaint("folder", tmp_path)


def test_tracks_without_pictures_and_one_target_a_frame_can_be_scored(tmp_path: Path) -> None:
    text(tmp_path / "crowd" / "gt" / "gt.txt", "1,1,0,0,5,5,1\n2,1,1,0,5,5,1\n")
    text(tmp_path / "crowd" / "det" / "det.txt", "1,-1,0,0,5,5,1\n")
    text(tmp_path / "crowd" / "seqinfo.ini", "[Sequence]\nseqLength=3\nframeRate=7\n")
    found = clip("folder", tmp_path, people=["crowd"])
    assert (found.pictures, found.frames, found.rate_hz, found.shows) == ((), 3, 7.0, ("people",))
    assert found.given == tmp_path / "crowd" / "det" / "det.txt"
    numbered(tmp_path / "crowd" / "img1", 2)
    assert "is of 3 frames, but the clip has 2; is it whole?" in complaint("folder", tmp_path)
    numbered(tmp_path / "walk" / "frames", 3)
    text(tmp_path / "walk" / "boxes_xywh.txt", "1,2,3,4\nNaN,NaN,NaN,NaN\n5,6,7,8\n")
    truth = truth_of(read("folder", tmp_path, ["walk"]).clips[0])
    assert (truth.kind, truth.length, truth.tracks.frame.tolist()) == ("one target", 3, [1, 3])


def test_true_places_and_the_files_of_the_vehicle_go_with_the_clip(tmp_path: Path) -> None:
    place = tmp_path / "flight"
    numbered(place / "img1", 2, "{:06d}.jpg")
    text(place / "gt.txt", "1,4,0,0,5,5,1\n2,4,1,0,5,5,1\n")
    text(place / "positions.csv", "frame,target,east_m,north_m\n2,4,7.5,-3\n1,4,7,-3\n")
    for name in layouts.INSTRUMENTS:
        text(place / name, "x")
    found = clip("folder", tmp_path)
    positions = truth_of(found).positions
    assert positions.identity.tolist() == [4, 4] and positions.east_north_m.tolist() == [[7, -3], [7.5, -3]]
    files = (found.telemetry, found.landmarks, found.colours, found.camera, found.elevation)
    assert [f and f.name for f in files] == list(layouts.INSTRUMENTS)


def test_a_still_clip_needs_no_truth_but_pictures_and_an_empty_folder_is_no_clip(tmp_path: Path) -> None:
    numbered(tmp_path / "roof" / "frames", 2)
    found = clip("folder", tmp_path, still=["ro*"])
    assert found.still and found.truth is None
    (tmp_path / "notes").mkdir()
    (line,) = read("folder", tmp_path, still=["ro*"]).missing
    assert "notes holds neither pictures nor truth; wanted frames/ or a video" in line
    text(tmp_path / "damaged" / "a.mp4", "no video")
    text(tmp_path / "damaged" / "gt.txt", "1,1,2,3,4,5,1\n")
    assert "cannot open a.mp4 as a video" in read("folder", tmp_path, ["damaged"]).missing[0]


@pytest.mark.parametrize(("name", "content"), [("masks/1.png", None), ("boxes_xywh.txt", "1,2,3,4\n")])
def test_masks_and_boxes_without_identities_need_pictures(tmp_path: Path, name: str, content: str | None) -> None:
    path = tmp_path / "cars" / name
    if content is None:
        mask(path, {CAR: 1})
    else:
        text(path, content)
    assert f"a clip without pictures; put the pictures into {tmp_path / 'cars'}" in complaint("folder", tmp_path)


# -- simulated ---------------------------------------------------------------------------------------------------------


def test_a_simulated_run_has_masks_identities_and_positions_of_visible_targets(tmp_path: Path) -> None:
    layouts.simulated(tmp_path, "four")
    found = clip("simulated", tmp_path)
    truth, positions = truth_of(found), truth_of(found).positions
    assert np.unique(labels_of(truth, 1)).tolist() == [0, 1, 2]
    assert tracks_of(found).identity.tolist() == [1, 1] and ignored_of(found) == [4]
    assert (positions.frame.tolist(), positions.identity.tolist()) == ([1, 2], [1, 1])
    assert positions.east_north_m.tolist() == [[10, 20], [10.5, 20]]
    assert len(positions.lonlat_deg) == 2
    assert truth.fleet.east_north_m.tolist() == [[11, 20]]
    assert found.telemetry and found.elevation
    assert clip("simulated", tmp_path / "four").name == "four"


def test_a_track_on_a_ground_vehicle_is_neither_right_nor_false(tmp_path: Path) -> None:
    layouts.simulated(tmp_path, "four")
    vehicle, part, nothing = (20, 10, 10, 8), (21, 10, 4, 8), (14, 2, 4, 4)
    rows = [(1, 1, *CAR, 1), (1, 2, *vehicle, 1), (2, 1, *CAR, 1), (2, 2, *part, 1), (2, 3, *nothing, 1)]
    counts: Any = score(clip("simulated", tmp_path), "tracking", found_of(np.array(rows, float), 2)).counts
    assert counts["tracks"].clear[:3] == (2, 0, 1)


def test_without_masks_the_boxes_of_a_simulated_run_are_scored(tmp_path: Path) -> None:
    layouts.simulated(tmp_path, "four")
    (tmp_path / "four/truth/masks").rename(tmp_path / "four/elsewhere")
    (tmp_path / "four/run.json").unlink()
    found = clip("simulated", tmp_path)
    assert (truth_of(found).kind, found.rate_hz) == ("boxes", None) and truth_of(found).positions
    text(tmp_path / "four/truth/gt.txt", "")
    assert "no target is visible in the pictures" in complaint("simulated", tmp_path)
    (tmp_path / "four/truth").rename(tmp_path / "four/lost")
    assert "has no truth/; wanted the output of `dddas simulate --out`" in complaint("simulated", tmp_path)


# -- masks -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "line"),
    [
        ("ImageSets/2017/val.txt", "{0}\n"),
        ("ImageSets/480p/val.txt", "/JPEGImages/480p/{0}/00000.jpg /Annotations/480p/{0}/00000.png \n" * 3),
    ],
)
def test_a_subset_of_davis_is_what_its_list_names(tmp_path: Path, path: str, line: str) -> None:
    for name in ("bear", "car", "dog"):
        layouts.davis(tmp_path, name)
    text(tmp_path / path, line.format("car") + line.format("bear"))
    found = read("davis", tmp_path, subset="val")
    assert ([c.name for c in found.clips], found.missing) == (["bear", "car"], ())
    text(tmp_path / "ImageSets/2017/val.txt", "boat\nbear\n")
    text(tmp_path / "ImageSets/2016/val.txt", "dog\n")
    found = read("davis", tmp_path, subset="val")
    place = tmp_path / "JPEGImages/480p/boat"
    assert [c.name for c in found.clips] == ["bear"]
    assert found.missing == (f"boat: {place} holds no pictures; wanted the frames of the clip",)
    assert [c.name for c in read("davis", tmp_path, subset="val", year="2016").clips] == ["dog"]
    assert "it has val" in complaint("davis", tmp_path, subset="test")
    (tmp_path / "Annotations").rename(tmp_path / "elsewhere")
    expected = f"{tmp_path / 'Annotations/480p'} does not exist; wanted the masks, one folder for each clip"
    assert complaint("davis", tmp_path) == expected


def test_shadow_of_cdnet_is_background_and_unknown_and_outside_do_not_count(tmp_path: Path) -> None:
    layouts.cdnet(tmp_path / "dataset", "PTZ-zoom")
    layouts.cdnet(tmp_path / "dataset", "baseline-road")
    found = read("cdnet", tmp_path)
    assert [c.name for c in found.clips] == ["baseline-road", "PTZ-zoom"]
    truth = truth_of(found.clips[1])
    labels = labels_of(truth, 4)
    assert [labels[y, x] for y, x in ((0, 0), (10, 10), (11, 20), (20, 30), (12, 12))] == [-1, -1, 0, 0, 255]
    assert pixels.count(np.ones(labels.shape, np.uint8), labels) == (16, 32 * 24 - 4 * 24 - 36, 0, 0)
    assert not truth.labels.separate


def test_the_first_region_of_bms_is_background_and_unlisted_values_do_not_count(tmp_path: Path) -> None:
    layouts.bms(tmp_path, "cars1")
    truth = truth_of(clip("bms", tmp_path, rate_hz=25))
    labels = labels_of(truth, 4)
    assert (labels[0, 0], labels[23, 31]) == (-1, 0)
    assert (labels[2:10, 2:10] == layouts.RED).all()
    assert labels[10, 20] > 0 and (labels[10:20, 20:26] == labels[10, 20]).all()
    assert np.count_nonzero(labels > 0) == 64 + 60
    truth.masks[4].unlink()  # labels may have another suffix than the definition says
    mask(truth.masks[4].with_suffix(".pgm"), {CAR: 9})
    assert truth_of(clip("bms", tmp_path)).masks[4].name == "cars1_0004_gt.pgm"


def test_a_clip_of_bms_26_has_its_labels_among_its_frames(tmp_path: Path) -> None:
    place = tmp_path / "moseg_dataset" / "people1"
    numbered(place, 3, "people1_{:02d}.ppm")
    mask(place / "people1_01.pgm", {CAR: 128, MAN: 255})
    text(place / "people1Def.dat", definition([0, 128, 255], 3, {"people1_01.ppm": "people1_01.ppm.ppm"}))
    assert "people1_01.ppm.ppm does not exist" in complaint("bms", tmp_path)
    (place / "people1_01.ppm").rename(place / "people1_01a.ppm")
    text(place / "people1Def.dat", definition([0, 128, 255], 3, {"people1_01a.ppm": "people1_01.pgm"}))
    found = clip("bms", tmp_path)
    assert [p.name for p in found.pictures] == ["people1_01a.ppm", "people1_02.ppm", "people1_03.ppm"]
    assert np.unique(labels_of(truth_of(found), 1)).tolist() == [0, 128, 255]


def test_sets_and_plain_clips_of_bms_are_read_and_the_second_of_a_name_is_left_out(tmp_path: Path) -> None:
    layouts.bms(tmp_path, "cars1")
    layouts.MAKE["folder"](tmp_path, "cars4")
    layouts.MAKE["folder"](tmp_path, "cars1")
    found = read("bms", tmp_path)
    assert [c.name for c in found.clips] == ["cars1", "cars4"]
    assert found.missing[0].endswith("of the same name is not read")


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (definition([0], 3, {"a.ppm": "a.pgm"}), "is not a definition of a clip; wanted two regions or more"),
        (definition([0, 9], 3, {}), "names 0 labelled frames, 0 files and 0 pictures; wanted as many of each"),
        (definition([0, 9], 3, {"a.ppm": "a.pgm"}).replace("\n9\n", "\nnine\n"), "wanted a whole number, got 'nine'"),
        (definition([0, 9], 3, {"a.ppm": "x/.."}), "'x/..' is not the name of a file"),
    ],
)
def test_a_damaged_definition_is_one_line(tmp_path: Path, content: str, line: str) -> None:
    with pytest.raises(InputError) as caught:
        read_definition(text(tmp_path / "carsDef.dat", content))
    assert line in str(caught.value)


# -- one target --------------------------------------------------------------------------------------------------------


def part(name: str, path: str, first: int, last: int) -> str:
    return f"struct('name','{name}','path','{path}','startFrame',{first},'endFrame',{last},'nz',6,'ext','jpg')"


def test_a_clip_of_uav123_is_a_part_of_its_sequence(tmp_path: Path) -> None:
    layouts.uav123(tmp_path, "car6")
    numbered(tmp_path / "data_seq/UAV123/car6", 8, "{:06d}.jpg")
    (tmp_path / "anno/UAV123/car6.txt").rename(tmp_path / "anno/UAV123/car6_2.txt")
    parts = part("car6_1", "D:\\data_seq\\UAV123\\car6\\", 1, 4), part("car6_2", "D:\\data\\car6\\", 4, 7)
    text(tmp_path / "configSeqs.m", "function seqs=configSeqs\n\nseqUAV123 = {" + ",...\n    ".join(parts) + "};\n")
    found = clip("uav123", tmp_path)
    assert (found.name, found.frames) == ("car6_2", 4)
    assert [p.name for p in found.pictures] == ["000004.jpg", "000005.jpg", "000006.jpg", "000007.jpg"]
    assert tracks_of(found).frame.tolist() == [1, 3, 4] and tracks_of(found).box_px[1].tolist() == [3, 2, 30, 4]
    (tmp_path / "data_seq/UAV123/car6/000005.jpg").unlink()
    assert "holds 3 of the frames 4 to 7 of car6_2; wanted all of them" in complaint("uav123", tmp_path)


def test_each_variant_of_uav123_has_its_folders_rate_and_table(tmp_path: Path) -> None:
    for name in ("UAV123", "UAV20L", "UAV123_10fps"):
        layouts.uav123(tmp_path / "all", "bike1", name)
    for name, rate_hz in (("UAV123", 30.0), ("UAV20L", 30.0), ("UAV123_10fps", 10.0)):
        found = clip("uav123", tmp_path / "all", variant=name)
        assert (found.rate_hz, found.pictures[0].parent) == (rate_hz, tmp_path / "all/data_seq" / name / "bike1")
    layouts.uav123(tmp_path / "one", "car6", "UAV123_10fps")
    tables = part("car6", "x/car6", 100, 200), part("car6", "x/car6", 1, 4)
    text(tmp_path / "one/configSeqs.m", "seqUAV123 = {{{}}};\nseqUAV123_10fps = {{{}}};".format(*tables))
    assert clip("uav123", tmp_path / "one").rate_hz == 10.0
    layouts.uav123(tmp_path / "UAV123_10fps", "bike1", ".")  # the boxes may lie in anno itself
    assert clip("uav123", tmp_path / "UAV123_10fps").rate_hz == 10.0
    home = tmp_path / "shared"
    layouts.uav123(home, "bike1")
    (home / "anno/UAV123").rename(home / "anno/UAV20L")
    assert clip("uav123", home, variant="UAV20L").pictures[0] == home / "data_seq/UAV123/bike1/000001.jpg"
    (home / "anno").rename(home / "elsewhere")
    assert complaint("uav123", home) == f"{home / 'anno'} does not exist; wanted the boxes, CLIP.txt"


def test_a_building_does_not_move(tmp_path: Path) -> None:
    layouts.uav123(tmp_path, "building4")
    line = complaint("uav123", tmp_path)
    assert line.endswith("its target is a building; name the clip in `still` if nothing moves")
    assert clip("uav123", tmp_path, still=["building4"]).still


@pytest.mark.parametrize("home", ["egtest01", ".", "Groundtruth"])
def test_all_vehicles_of_vivid_with_identities(tmp_path: Path, home: str) -> None:
    numbered(tmp_path / "egtest01/egtest01", 21, "frame{:05d}.jpg", first=0)  # pictures may lie one folder deeper
    rows = "name,frame,id,x,y,w,h\ncar,0,7,1,2,8,5\ntruck,0,9,15,2,8,5\ncar,10,7,3,2,8,5\n"
    text(tmp_path / home / "egtest01_truth.csv", rows)
    found = clip("vivid", tmp_path)
    assert (found.frames, truth_of(found).kind, truth_of(found).length) == (21, "boxes", 21)
    assert tracks_of(found).frame.tolist() == [1, 1, 11] and tracks_of(found).identity.tolist() == [7, 9, 7]


@pytest.mark.parametrize("home", ["egtest01mask", "egtest01/masks"])
def test_one_target_of_vivid_is_the_box_about_its_mask(tmp_path: Path, home: str) -> None:
    layouts.vivid(tmp_path, "egtest01")
    assert tracks_of(clip("vivid", tmp_path)).box_px.tolist() == [[1, 2, 8, 5], [3, 2, 8, 5]]
    text(tmp_path / "egtest01_gt.txt", "1,2,8,5\n" * 21)
    assert truth_of(clip("vivid", tmp_path)).frames == list(range(1, 22))
    (tmp_path / "egtest01_gt.txt").unlink()
    mask(tmp_path / home / "frame00000.png", {(4, 3, 10, 6): 255})
    mask(tmp_path / home / "frame00010.png", {})
    truth = truth_of(clip("vivid", tmp_path))
    assert truth.boxes[1].tolist() == [[4, 3, 10, 6]] and np.isnan(truth.boxes[11]).all()
    assert truth.tracks.frame.tolist() == [1]
    mask(tmp_path / home / "frame00010.png", {}, size=(64, 48))
    assert "frame00010.png is 64×48 pixels, but frame00000.jpg 32×24" in complaint("vivid", tmp_path)
    mask(tmp_path / home / "frame00030.png", {})
    assert "frame00030.png labels no picture of" in complaint("vivid", tmp_path)


# -- boxes with identities ---------------------------------------------------------------------------------------------


def test_regions_of_visdrone_and_boxes_in_them_do_not_count(tmp_path: Path) -> None:
    rows = "1,1,2,3,4,5,1,1,0,0\n2,2,12,3,4,5,1,4,0,1\n1,0,20,0,10,10,0,0,0,0\n2,9,0,0,8,8,1,11,0,0\n"
    inside, marked = "1,5,22,2,4,5,1,1,0,0\n", "2,7,12,23,4,5,0,1,0,0\n"
    layouts.visdrone(tmp_path / "sets/VisDrone2019-MOT-val", "uav1", rows + inside + marked)
    found = clip("visdrone", tmp_path / "sets")
    assert tracks_of(found).identity.tolist() == [1, 2]
    assert truth_of(found).regions.frame.tolist() == [1, 2]
    assert counting(found, [1, 2, 2], (21, 1, 4, 4), (21, 1, 4, 4), (1, 1, 3, 3)) == [False, True, False]
    found = clip("visdrone", tmp_path / "sets", classes=["pedestrian"])
    assert tracks_of(found).identity.tolist() == [1] and ignored_of(found) == [2, 5, 7]
    assert counting(found, [1, 2], (2, 3, 4, 5), (12, 3, 4, 5)) == [True, False]


def test_regions_categories_and_attributes_of_uavdt(tmp_path: Path) -> None:
    for name, night in (("M0101", 0), ("M0201", 1)):
        layouts.uavdt(tmp_path, name)
        text(tmp_path / f"M_attr/train/{name}_attr.txt", f"{1 - night},{night},0,1,0,0,1,1,0,0\n")
    text(tmp_path / "UAV-benchmark-MOTD_v1.0/GT/M0201_gt_ignore.txt", "1,1,20,0,10,10,1,-1,-1\n")
    found = clip("uavdt", tmp_path, classes=["bus"], attributes=["night", "low-alt"])
    assert found.name == "M0201"
    assert tracks_of(found).identity.tolist() == [2] and ignored_of(found) == [1, 1]
    assert counting(found, [1, 1], (21, 1, 4, 4), (12, 13, 4, 5)) == [False, True]
    text(tmp_path / "M_attr/train/M0101_attr.txt", "1,0\n")
    (line,) = read("uavdt", tmp_path, attributes=["night"]).missing
    assert "M0101: " in line and "does not hold 10 times 0 or 1" in line
    (tmp_path / "M_attr/train/M0101_attr.txt").unlink()
    assert "M0101: no attributes; they belong in" in read("uavdt", tmp_path, attributes=["night"]).missing[0]


def test_stanford_drone_counts_frames_from_one_and_leaves_out_lost_rows(tmp_path: Path) -> None:
    layouts.MAKE["sdd"](tmp_path, "quad-video0")
    found = clip("sdd", tmp_path)
    assert tracks_of(found).frame.tolist() == [1, 2, 1] and tracks_of(found).identity.tolist() == [0, 0, 3]
    assert tracks_of(found).box_px[0].tolist() == [10, 20, 8, 10]
    assert truth_of(found).boxes[3].shape == (0, 4)  # nobody is there, and that is known
    text(tmp_path / "flat/SDD-quad-video0/annotations.txt", layouts.WALKERS)
    found = clip("sdd", tmp_path / "flat", classes=["Biker"])
    assert found.name == "SDD-quad-video0" and tracks_of(found).identity.tolist() == [3]


def test_boxes_of_cvml_lie_about_their_middles(tmp_path: Path) -> None:
    text(tmp_path / "a/S1.xml", layouts.cvml_text(layouts.CVML_BOX.format(1, 10)))
    text(tmp_path / "a/View_001.xml", '<?xml version="1.0"?><Camera name="View_001"/>')
    numbered(tmp_path / "a", 1, "frame_{:04d}.png", first=0)  # beside the annotation that is alone there
    found = clip("cvml", tmp_path, rate_hz=7)
    assert (found.name, len(found.pictures), found.rate_hz) == ("S1", 1, 7)
    assert tracks_of(found).box_px.tolist() == [[8, 15, 4, 10]]
    (tmp_path / "a/S1.xml").unlink()
    assert "NAME.xml" in complaint("cvml", tmp_path)


def test_of_kitti_other_classes_and_what_is_cut_off_or_unknown_neither_count_nor_harm(tmp_path: Path) -> None:
    care = "0 -1 DontCare -1 -1 -10 20 0 30 9 -1 -1 -1 -1000 -1000 -1000 -10\n"
    rows = [
        layouts.kitti_label(0, 0),
        layouts.kitti_label(0, 1, "Van", x=16),
        layouts.kitti_label(0, 2, truncated=1, x=30),
    ]
    hidden = [layouts.kitti_label(0, 3, occluded=3, x=34), layouts.kitti_label(0, 4, occluded=2, x=38)]
    layouts.kitti(tmp_path, "0000", "".join([*rows, *hidden, care]))
    found = clip("kitti", tmp_path, classes=["Car"])
    assert tracks_of(found).identity.tolist() == [0, 4] and ignored_of(found) == [1, 2, 3]
    assert tracks_of(found).box_px[0].tolist() == [10, 5, 4, 5]
    assert counting(found, [1, 1, 2], (21, 1, 4, 4), (10, 5, 4, 5), (21, 1, 4, 4)) == [False, True, True]


def test_of_inria_pictures_of_one_size_are_a_clip(tmp_path: Path) -> None:
    for name in ("a", "b", "az"):
        layouts.inria(tmp_path, name)
    found = read("inria", tmp_path)
    assert [(c.name, c.frames) for c in found.clips] == [("neg-32x24", 1), ("pos-32x24", 2), ("pos-33x24", 1)]
    nobody, people, _ = map(truth_of, found.clips)
    assert nobody.boxes[1].shape == (0, 4) and people.boxes[2].tolist() == [[10, 2, 10, 20]] and people.tracks is None
    (tmp_path / "Test/neg/n.png").unlink()
    assert read("inria", tmp_path).missing[0].endswith(" holds no pictures; wanted pictures there")
    path = text(tmp_path / "a.txt", layouts.inria_text(origin=1))  # pixels may count from 1
    assert read_annotation(path).box_px.tolist() == [[9, 1, 10, 20]]
    assert read_annotation(text(path, layouts.inria_text(boxes=0))).box_px.shape == (0, 4)


def test_a_crop_shows_one_person_in_its_middle(tmp_path: Path) -> None:
    layouts.pictures(tmp_path / "crops", ["a.png", "b.png"], (96, 160))
    found = clip("inria", tmp_path / "crops")
    x, y, width, height = truth_of(found).boxes[2][0]
    assert found.name == "crops-96x160"
    assert (height, y, x + width / 2) == (96, 32, 48) and width == pytest.approx(39.36)
    (line, _) = read("inria", tmp_path / "crops", body_height_px=200.0).missing
    assert "too low for a body of 200 px; see body_height_px" in line


# -- MOTChallenge ------------------------------------------------------------------------------------------------------

OF_2017 = (
    "1,1,10,20,30,40,1,1,1\n1,2,100,20,30,40,0,2,1\n1,4,10,200,30,40,1,1,0.1\n"
    "2,1,11,20,30,40,1,1,0.8\n3,5,40,20,30,40,0,6,1\n"
)


def test_rows_of_2015_marked_0_do_not_count_and_places_are_known(tmp_path: Path) -> None:
    layouts.motchallenge(tmp_path, "A")
    text(tmp_path / "A/det/det.txt", "1,-1,10,20,30,40,0.9,-1,-1,-1\n")
    found = clip("motchallenge", tmp_path)
    truth = truth_of(found)
    assert found.given == tmp_path / "A/det/det.txt"
    assert tracks_of(found).identity.tolist() == [1, 1, 2]
    assert ignored_of(found) == [2] and truth.ignoring == "dropped"
    assert truth.positions.identity.tolist() == [1, 1]
    assert truth.positions.east_north_m.tolist() == [[4.5, -7.5], [4.6, -7.5]]
    for nowhere in ("-1,-1,-1", "0,0,0"):
        layouts.motchallenge(tmp_path, "A", f"1,1,10,20,30,40,1,{nowhere}\n2,1,10,20,30,40,1,{nowhere}\n")
        assert truth_of(clip("motchallenge", tmp_path)).positions is None


def test_later_years_have_classes_distractors_and_options_for_the_rules(tmp_path: Path) -> None:
    layouts.motchallenge(tmp_path / "2017", "MOT17-02-DPM", f"{OF_2017}1,6,300,20,30,40,0,7,1\n")
    found = clip("motchallenge", tmp_path / "2017")
    assert tracks_of(found).identity.tolist() == [1, 4, 1] and ignored_of(found) == [2, 6]
    assert truth_of(found).others.identity.tolist() == [5]  # no motor: a distractor in 2020 alone
    assert counting(found, [1, 1, 3], (10, 20, 30, 40), (101, 20, 30, 40), (40, 20, 30, 40)) == [True, False, True]
    layouts.motchallenge(tmp_path / "2020", "MOT20-01", OF_2017)
    assert ignored_of(clip("motchallenge", tmp_path / "2020")) == [2, 5]
    layouts.motchallenge(tmp_path / "A", "A", OF_2017)
    found = clip("motchallenge", tmp_path / "A", benchmark="MOT15")
    assert truth_of(found).ignoring == "dropped" and tracks_of(found).identity.tolist() == [1, 4, 1]
    found = clip("motchallenge", tmp_path / "A", least_visibility=0.5)
    assert tracks_of(found).identity.tolist() == [1, 1] and ignored_of(found) == [2, 4]


def test_sequences_may_lie_deeper_share_a_name_be_the_folder_or_be_videos(tmp_path: Path) -> None:
    layouts.motchallenge(tmp_path / "train", "S", OF_2017)
    assert [c.name for c in read("motchallenge", tmp_path / "train/S").clips] == ["S"]
    layouts.motchallenge(tmp_path / "b", "S")
    assert {c.name for c in read("motchallenge", tmp_path).clips} == {"S", "train-S"}
    text(tmp_path / "videos/A/gt/gt.txt", layouts.OF_2015)
    layouts.video(tmp_path / "videos/A/a.mp4", 3)
    found = clip("motchallenge", tmp_path / "videos")
    assert (len(found.pictures), found.frames) == (1, 3)
