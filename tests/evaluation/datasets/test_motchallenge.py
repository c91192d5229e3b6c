"""MOTChallenge's sequences become clips with what counts for TrackEval; what is wrong with one is told in a line."""

from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import read, text, video
from tests.evaluation.datasets.numbered import line_of, numbered
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.matching import counted

INI = "[Sequence]\nname={0}\nimDir=img1\nframeRate=25\nseqLength={1}\nimWidth=32\nimHeight=24\nimExt=.png\n"
OF_2015 = (
    "1,1,10,20,30,40,1,4.5,-7.5,0\n2,1,11,20,30,40,1,4.6,-7.5,0\n2,2,60,20,30,40,0,1,1,0\n3,2,61,20,30,40,1,-1,-1,-1\n"
)
PERSON, RIDER, CAR, STATUE = (
    "1,1,10,20,30,40,1,1,1",
    "1,2,100,20,30,40,0,2,1",
    "1,3,102,20,30,40,0,3,1",
    "1,4,10,200,30,40,1,1,0.1",
)
OF_2017 = "\n".join([PERSON, RIDER, STATUE, "2,1,11,20,30,40,1,1,0.8", "3,5,40,20,30,40,0,6,1"]) + "\n"


def sequence(place: Path, gt: str = OF_2015, length: int = 3) -> Path:
    text(place / "seqinfo.ini", INI.format(place.name, length))
    text(place / "gt/gt.txt", gt)
    numbered(place / "img1", 3)
    return place


def test_a_sequence_of_2015_has_pictures_identities_rows_that_do_not_count_and_places(tmp_path: Path) -> None:
    text(sequence(tmp_path / "mot/A") / "det/det.txt", "1,-1,10,20,30,40,0.9,-1,-1,-1\n")
    found = read("motchallenge", tmp_path / "mot")
    (clip,) = found.clips
    assert (clip.name, clip.rate_hz, clip.frames, clip.shows) == ("A", 25.0, 3, ("people",))
    assert [path.name for path in clip.pictures] == ["000001.png", "000002.png", "000003.png"]
    assert clip.given == tmp_path / "mot/A/det/det.txt" and found.missing == () and "CC" in found.terms
    truth = clip.truth
    assert truth and truth.tracks and truth.ignored and truth.positions
    assert (truth.tracks.frame.tolist(), truth.tracks.identity.tolist()) == ([1, 2, 3], [1, 1, 2])
    assert truth.ignored.identity.tolist() == [2] and truth.ignoring == "dropped" and truth.length == 3
    assert truth.positions.identity.tolist() == [1, 1]
    assert truth.positions.east_north_m.tolist() == [[4.5, -7.5], [4.6, -7.5]]


@pytest.mark.parametrize("columns", ["-1,-1,-1", "0,0,0"])
def test_where_nobody_measured_there_are_no_places(tmp_path: Path, columns: str) -> None:
    gt = f"1,1,10,20,30,40,1,{columns}\n2,1,10,20,30,40,1,{columns}\n"
    sequence(tmp_path / "mot/A", gt)
    (clip,) = read("motchallenge", tmp_path / "mot").clips
    assert clip.truth and clip.truth.positions is None


def test_later_ones_have_classes_and_found_boxes_on_distractors_do_not_count(tmp_path: Path) -> None:
    sequence(tmp_path / "mot/MOT17-02-DPM", f"{OF_2017}1,6,300,20,30,40,0,7,1\n")
    (clip,) = read("motchallenge", tmp_path / "mot").clips
    truth = clip.truth
    assert truth and truth.tracks and truth.ignored and truth.others
    assert truth.tracks.identity.tolist() == [1, 4, 1] and truth.ignoring == "removed"
    assert sorted(truth.ignored.identity.tolist()) == [2, 6]
    assert truth.others.identity.tolist() == [5]  # no motor: a distractor in 2020 alone
    frames, boxes = np.array([1, 1, 3]), np.array([[10, 20, 30, 40], [101, 20, 30, 40], [40, 20, 30, 40]], float)
    assert counted(truth, frames, boxes).tolist() == [True, False, True]


def test_what_has_no_motor_distracts_in_2020(tmp_path: Path) -> None:
    sequence(tmp_path / "mot/MOT20-01", OF_2017)
    (clip,) = read("motchallenge", tmp_path / "mot").clips
    assert clip.truth and clip.truth.ignored and sorted(clip.truth.ignored.identity.tolist()) == [2, 5]


def test_a_car_that_fits_better_keeps_the_found_box_counting(tmp_path: Path) -> None:
    sequence(tmp_path / "mot/A", f"{OF_2017}{CAR}\n")
    (clip,) = read("motchallenge", tmp_path / "mot").clips
    assert clip.truth and counted(clip.truth, np.array([1]), np.array([[102.0, 20, 30, 40]])).tolist() == [True]


def test_the_rules_can_be_said_and_hidden_people_left_out(tmp_path: Path) -> None:
    sequence(tmp_path / "mot/A", OF_2017)
    (clip,) = read("motchallenge", tmp_path / "mot", benchmark="MOT15").clips
    assert clip.truth and clip.truth.ignoring == "dropped" and clip.truth.tracks
    assert clip.truth.tracks.identity.tolist() == [1, 4, 1]
    (clip,) = read("motchallenge", tmp_path / "mot", least_visibility=0.5).clips
    assert clip.truth and clip.truth.tracks and clip.truth.ignored
    assert clip.truth.tracks.identity.tolist() == [1, 1] and sorted(clip.truth.ignored.identity.tolist()) == [2, 4]
    with pytest.raises(InputError, match="'MOT18' is no benchmark; wanted one of MOT15, MOT16, MOT17, MOT20"):
        read("motchallenge", tmp_path / "mot", benchmark="MOT18")


def test_sequences_lie_in_train_and_test_and_those_without_truth_are_told(tmp_path: Path) -> None:
    sequence(tmp_path / "MOT17/train/MOT17-02-SDP", OF_2017)
    text(tmp_path / "MOT17/test/MOT17-01-SDP/seqinfo.ini", INI.format("x", 3))
    found = read("motchallenge", tmp_path / "MOT17")
    assert [clip.name for clip in found.clips] == ["MOT17-02-SDP"]
    assert line_of(found).startswith("MOT17-01-SDP: no truth, which belongs in ")


def test_a_folder_may_be_the_sequence_and_two_of_one_name_are_told_apart(tmp_path: Path) -> None:
    place = sequence(tmp_path / "a/S")
    assert [clip.name for clip in read("motchallenge", place).clips] == ["S"]
    sequence(tmp_path / "b/S")
    assert {clip.name for clip in read("motchallenge", tmp_path).clips} == {"S", "b-S"}


def test_a_video_stands_for_pictures_and_without_either_the_boxes_are_left(tmp_path: Path) -> None:
    for name in ("A", "B"):
        text(tmp_path / "mot" / name / "gt/gt.txt", OF_2015)
    video(tmp_path / "mot/A/a.mp4", 3)
    found = read("motchallenge", tmp_path / "mot")
    assert [len(clip.pictures) for clip in found.clips] == [1, 0]
    assert [clip.frames for clip in found.clips] == [3, 3]
    assert line_of(found).startswith("B: no pictures, which belong in ") and found.missing == ()


def test_only_what_is_asked_for_is_read(tmp_path: Path) -> None:
    sequence(tmp_path / "mot/A")
    sequence(tmp_path / "mot/B", "not a table\n")
    assert read("motchallenge", tmp_path / "mot", ["A*"]).missing == ()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        ("gt.txt=1,1,10,20,30\n", "wanted"),
        ("gt.txt=\n", "is empty"),
        ("gt.txt=9,1,10,20,30,40,1,-1,-1,-1\n", "labels frame 9, but the clip has 3"),
        ("gt.txt=1,1,10,20,30,40,1,1,1\n1,1,10,20,30,40,1,1,1\n", "identity 1 twice in frame 1"),
        ("gt.txt=1,1,10,20,0,40,1,1,1\n", "0×40 pixels; wanted more than 0"),
        ("gt.txt=1,1,10,20,30,40,1,car,1\n", "line 1: class is 'car'; wanted a number"),
        ("gt.txt=1.5,1,10,20,30,40,1,1,1\n", "line 1: frame is '1.5'; wanted a whole number"),
        ("gt.txt=0,1,10,20,30,40,1,1,1\n", "line 1: frame is '0'; wanted a whole number, 1 to"),
        ("gt.txt=1,1,10,20,30,40,0,3,1\n", "holds no pedestrian that counts"),
        ("seqinfo.ini=[Sequence]\nseqLength=4\n", "has 3 frames, but seqinfo.ini says 4"),
        ("seqinfo.ini=nothing\n", "does not hold seqLength"),
        (f"seqinfo.ini=[Sequence]\nseqLength=3\nimDir={'9' * 300}\n", "is no folder's name"),
        ("000002.png=", "has 000003.png where frame 2 belongs"),
    ],
)
def test_a_spoiled_sequence_is_one_clear_line_and_the_others_go_on(tmp_path: Path, spoil: str, said: str) -> None:
    sequence(tmp_path / "mot/good")
    bad = sequence(tmp_path / "mot/bad")
    name, content = spoil.split("=", 1)
    (path,) = bad.rglob(name)
    if content:
        path.write_text(content, encoding="utf-8")
    else:
        path.unlink()
    found = read("motchallenge", tmp_path / "mot")
    assert [clip.name for clip in found.clips] == ["good"]
    assert line_of(found).startswith("bad: ") and said in line_of(found)


def test_a_folder_without_sequences_says_what_belongs_there(tmp_path: Path) -> None:
    (tmp_path / "mot/x").mkdir(parents=True)
    assert "SEQUENCE/gt/gt.txt" in line_of(read("motchallenge", tmp_path / "mot"))
