"""One's own data: the plain convention, and what is wrong with a clip in one line."""

from pathlib import Path

import pytest

from tests.evaluation.datasets.layouts import clip, complaint, mask, pictures, read, text, video

BOX = {(2, 2, 8, 8): 1}


def test_a_clip_of_numbered_pictures_and_masks_from_0(tmp_path: Path) -> None:
    pictures(tmp_path / "cars" / "frames", [f"{n:05d}.png" for n in range(12)])
    mask(tmp_path / "cars" / "masks" / "00000.png", BOX)
    mask(tmp_path / "cars" / "masks" / "00010.png", BOX)
    found = clip("folder", tmp_path)
    assert (found.name, found.frames, len(found.pictures), found.rate_hz) == ("cars", 12, 12, None)
    assert found.truth is not None
    assert found.truth.kind == "masks"
    assert found.truth.frames == [1, 11]
    assert not found.still
    assert found.shows == ("movers",)


def test_masks_are_numbered_as_the_pictures_are_even_where_the_first_frame_has_none(tmp_path: Path) -> None:
    """Pictures from 0 and a first mask of number 5: it is the sixth frame, not the fifth."""
    pictures(tmp_path / "cars" / "frames", [f"frame_{n}.png" for n in range(12)])
    mask(tmp_path / "cars" / "masks" / "5.png", BOX)
    truth = clip("folder", tmp_path).truth
    assert truth is not None
    assert truth.frames == [6]


def test_pictures_that_begin_anywhere_keep_their_masks(tmp_path: Path) -> None:
    pictures(tmp_path / "cars" / "frames", ["100.png", "102.png", "104.png"])
    mask(tmp_path / "cars" / "masks" / "104.png", BOX)
    truth = clip("folder", tmp_path).truth
    assert truth is not None
    assert truth.frames == [3]


def test_pictures_without_numbers_have_masks_by_frame(tmp_path: Path) -> None:
    pictures(tmp_path / "cars" / "frames", ["a.png", "b.png", "c.png"])
    mask(tmp_path / "cars" / "masks" / "3.png", BOX)
    truth = clip("folder", tmp_path).truth
    assert truth is not None
    assert truth.frames == [3]


def test_a_video_is_a_clip(tmp_path: Path) -> None:
    video(tmp_path / "cars" / "any.mp4", 5)
    mask(tmp_path / "cars" / "masks" / "000000.png", BOX)
    mask(tmp_path / "cars" / "masks" / "000004.png", BOX)
    found = clip("folder", tmp_path)
    assert found.pictures == (tmp_path / "cars" / "any.mp4",)
    assert found.frames == 5
    assert found.truth is not None
    assert found.truth.frames == [1, 5]


def test_one_target_a_frame(tmp_path: Path) -> None:
    pictures(tmp_path / "walk" / "frames", ["1.png", "2.png", "3.png"])
    text(tmp_path / "walk" / "boxes_xywh.txt", "1,2,3,4\nNaN,NaN,NaN,NaN\n5,6,7,8\n")
    truth = clip("folder", tmp_path).truth
    assert truth is not None
    assert truth.kind == "one target"
    assert truth.length == 3
    assert truth.tracks is not None
    assert truth.tracks.frame.tolist() == [1, 3]


def test_tracks_without_pictures_can_be_followed(tmp_path: Path) -> None:
    text(tmp_path / "crowd" / "gt" / "gt.txt", "1,1,0,0,5,5,1\n2,1,1,0,5,5,1\n")
    text(tmp_path / "crowd" / "det" / "det.txt", "1,-1,0,0,5,5,1\n")
    text(tmp_path / "crowd" / "seqinfo.ini", "[Sequence]\nseqLength=3\nframeRate=7\n")
    found = clip("folder", tmp_path, people=["crowd"])
    assert (found.pictures, found.frames, found.rate_hz) == ((), 3, 7.0)
    assert found.given == tmp_path / "crowd" / "det" / "det.txt"
    assert found.shows == ("people",)


def test_true_places_and_what_the_vehicle_says_go_with_the_clip(tmp_path: Path) -> None:
    place = tmp_path / "flight"
    pictures(place / "img1", ["000001.jpg", "000002.jpg"])
    text(place / "gt.txt", "1,4,0,0,5,5,1\n2,4,1,0,5,5,1\n")
    text(place / "positions.csv", "frame,target,east_m,north_m\n2,4,7.5,-3\n1,4,7,-3\n")
    for name in ("telemetry.srt", "landmarks.csv", "colours.toml", "camera.toml", "dem.tif"):
        text(place / name, "x")
    found = clip("folder", tmp_path)
    assert found.truth is not None
    assert found.truth.positions is not None
    assert found.truth.positions.identity.tolist() == [4, 4]
    assert found.truth.positions.east_north_m.tolist() == [[7, -3], [7.5, -3]]
    files = (found.telemetry, found.landmarks, found.colours, found.camera, found.elevation)
    assert [f and f.name for f in files] == ["telemetry.srt", "landmarks.csv", "colours.toml", "camera.toml", "dem.tif"]


def test_a_stream_of_telemetry_is_no_second_video(tmp_path: Path) -> None:
    video(tmp_path / "flight" / "flight.mp4", 2)
    text(tmp_path / "flight" / "telemetry.ts", "x")
    text(tmp_path / "flight" / "gt.txt", "1,4,0,0,5,5,1\n")
    assert clip("folder", tmp_path).pictures[0].name == "flight.mp4"


def test_the_folder_may_itself_be_a_clip(tmp_path: Path) -> None:
    pictures(tmp_path / "cars" / "frames", ["0.png", "1.png"])
    mask(tmp_path / "cars" / "masks" / "1.png", BOX)
    assert clip("folder", tmp_path / "cars").name == "cars"


def test_a_still_clip_needs_no_truth(tmp_path: Path) -> None:
    pictures(tmp_path / "roof" / "frames", ["0.png", "1.png"])
    found = clip("folder", tmp_path, still=["ro*"])
    assert found.still
    assert found.truth is None


def test_a_clip_without_truth_is_told_and_the_others_go_on(tmp_path: Path) -> None:
    for name in ("cars", "roof"):
        pictures(tmp_path / name / "frames", ["0.png", "1.png"])
    mask(tmp_path / "cars" / "masks" / "1.png", BOX)
    found = read("folder", tmp_path)
    assert [c.name for c in found.clips] == ["cars"]
    assert found.missing == (f"roof: {tmp_path / 'roof'} has no truth; nothing in it can be scored",)


def test_truth_without_a_clip_is_told(tmp_path: Path) -> None:
    mask(tmp_path / "cars" / "masks" / "1.png", BOX)
    text(tmp_path / "walk" / "boxes_xywh.txt", "1,2,3,4\n")
    found = read("folder", tmp_path)
    assert found.clips == ()
    assert [line.split(" is the truth of ")[1] for line in found.missing] == [
        f"a clip without pictures; put them into {tmp_path / name}" for name in ("cars", "walk")
    ]


def test_an_empty_folder_is_no_clip(tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    assert "notes holds neither pictures nor truth; wanted frames/ or a video" in complaint("folder", tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("boxes_xywh.txt", "1,2,3,4\n", "has 1 lines, but the clip 2 frames; wanted a line a frame"),
        ("gt.txt", "9,1,2,3,4,5,1\n", "labels frame 9, but the clip has 2 frames; is it the same clip?"),
        ("gt.txt", "1,1,2,3,-4,5,1\n", "the box is -4×5 pixels; wanted more than 0"),
        ("gt.txt", "", "is empty: wanted one box a line"),
        ("gt.txt", "1,2\n", "has 2 columns; wanted 4 (x,y,w,h) or MOTChallenge's"),
    ],
)
def test_boxes_that_do_not_fit_the_clip_are_told(tmp_path: Path, name: str, content: str, line: str) -> None:
    pictures(tmp_path / "cars" / "frames", ["0.png", "1.png"])
    text(tmp_path / "cars" / name, content)
    assert line in complaint("folder", tmp_path)


def test_a_clip_shorter_than_is_said_of_it_is_told(tmp_path: Path) -> None:
    pictures(tmp_path / "cars" / "img1", ["1.png", "2.png"])
    text(tmp_path / "cars" / "gt" / "gt.txt", "1,1,2,3,4,5,1\n")
    text(tmp_path / "cars" / "seqinfo.ini", "[Sequence]\nseqLength=9\n")
    assert "is of 9 frames, but the clip has 2; is it whole?" in complaint("folder", tmp_path)


def test_a_mask_of_no_picture_is_told(tmp_path: Path) -> None:
    pictures(tmp_path / "cars" / "frames", ["0.png", "1.png"])
    mask(tmp_path / "cars" / "masks" / "7.png", BOX)
    assert "7.png labels no picture of" in (line := complaint("folder", tmp_path))
    assert "its pictures are 0 to 1; is it the same clip?" in line


@pytest.mark.parametrize("kind", ["pictures", "video"])
def test_masks_of_another_size_are_told(tmp_path: Path, kind: str) -> None:
    if kind == "video":
        video(tmp_path / "cars" / "cars.mp4", 2)
    else:
        pictures(tmp_path / "cars" / "frames", ["0.jpg", "1.jpg"])
    mask(tmp_path / "cars" / "masks" / "1.png", BOX, size=(20, 10))
    assert "1.png is 20×10 pixels, but" in (line := complaint("folder", tmp_path))
    assert line.endswith("32×24; wanted masks of the size of the pictures")


def test_two_videos_are_one_too_many(tmp_path: Path) -> None:
    video(tmp_path / "cars" / "a.mp4", 1)
    video(tmp_path / "cars" / "b.mp4", 1)
    assert "holds 2 videos, a.mp4 and b.mp4; wanted one" in complaint("folder", tmp_path)


def test_a_damaged_video_is_told(tmp_path: Path) -> None:
    text(tmp_path / "cars" / "a.mp4", "no video")
    text(tmp_path / "cars" / "gt.txt", "1,1,2,3,4,5,1\n")
    assert "cannot open a.mp4 as a video" in complaint("folder", tmp_path)
