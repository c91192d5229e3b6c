"""UAV123: clips that are parts of sequences, boxes that may be NaN, and its three variants."""

from pathlib import Path

import pytest

from tests.evaluation.datasets.layouts import clip, complaint, pictures, read, text
from torchvision_dddas.errors import InputError

BOXES = ["1,2,30,4", "NaN,NaN,NaN,NaN", "3,2,30,4", "4,2,30,4"]


def part(name: str, path: str, first: int, last: int) -> str:
    return (
        f"struct('name','{name}','path','{path}','startFrame',{first},'endFrame',{last},"
        "'nz',6,'ext','jpg','init_rect',[0,0,0,0])"
    )


def config(*parts: str, table: str = "seqUAV123") -> str:
    return f"function seqs=configSeqs\n\n{table} = {{" + ",...\n    ".join(parts) + "};\n"


def uav123(folder: Path, variant: str = "UAV123", *, sequence: str = "car6", frames: int = 8) -> Path:
    pictures(folder / "data_seq" / variant / sequence, [f"{n:06d}.jpg" for n in range(1, frames + 1)])
    return folder / "anno" / variant


def test_a_clip_is_a_part_of_its_sequence(tmp_path: Path) -> None:
    anno = uav123(tmp_path)
    text(anno / "car6_2.txt", "\n".join(BOXES))
    text(
        tmp_path / "configSeqs.m",
        config(part("car6_1", r"D:\data_seq\UAV123\car6" + "\\", 1, 4), part("car6_2", r"D:\data\car6" + "\\", 4, 7)),
    )
    found = clip("uav123", tmp_path)
    assert (found.name, found.frames, found.rate_hz) == ("car6_2", 4, 30.0)
    assert [p.name for p in found.pictures] == ["000004.jpg", "000005.jpg", "000006.jpg", "000007.jpg"]
    assert found.truth is not None
    assert found.truth.kind == "one target"
    assert found.truth.tracks is not None
    assert found.truth.tracks.frame.tolist() == [1, 3, 4]
    assert found.truth.tracks.box_px[1].tolist() == [3, 2, 30, 4]


def test_a_whole_sequence_needs_no_configuration(tmp_path: Path) -> None:
    text(uav123(tmp_path, sequence="bike1", frames=4) / "bike1.txt", "\n".join(BOXES))
    assert clip("uav123", tmp_path).frames == 4


def test_a_part_without_the_configuration_is_told(tmp_path: Path) -> None:
    text(uav123(tmp_path) / "car6_2.txt", "\n".join(BOXES))
    line = complaint("uav123", tmp_path)
    assert "or configSeqs.m, which says of what sequence car6_2 is a part" in line


@pytest.mark.parametrize(("variant", "rate_hz"), [("UAV123", 30.0), ("UAV20L", 30.0), ("UAV123_10fps", 10.0)])
def test_each_variant_has_its_rate(tmp_path: Path, variant: str, rate_hz: float) -> None:
    for name in ("UAV123", "UAV20L", "UAV123_10fps"):
        text(uav123(tmp_path, name, sequence="bike1", frames=4) / "bike1.txt", "\n".join(BOXES))
    found = clip("uav123", tmp_path, variant=variant)
    assert found.rate_hz == rate_hz
    assert found.pictures[0].parent == tmp_path / "data_seq" / variant / "bike1"


def test_the_variant_that_is_there_is_read_with_its_own_table(tmp_path: Path) -> None:
    anno = uav123(tmp_path, "UAV123_10fps")
    text(anno / "car6_2.txt", "\n".join(BOXES))
    tables = config(part("car6_2", "x/car6", 100, 200)) + config(
        part("car6_2", "x/car6", 2, 5), table="seqUAV123_10fps"
    )
    text(tmp_path / "configSeqs.m", tables)
    found = clip("uav123", tmp_path)
    assert (found.rate_hz, found.pictures[0].name) == (10.0, "000002.jpg")


def test_boxes_may_lie_in_anno_itself(tmp_path: Path) -> None:
    pictures(tmp_path / "UAV123_10fps" / "data_seq" / "bike1", [f"{n:06d}.jpg" for n in range(1, 5)])
    text(tmp_path / "UAV123_10fps" / "anno" / "bike1.txt", "\n".join(BOXES))
    assert clip("uav123", tmp_path / "UAV123_10fps").rate_hz == 10.0


def test_a_building_is_no_mover(tmp_path: Path) -> None:
    text(uav123(tmp_path, sequence="building4", frames=4) / "building4.txt", "\n".join(BOXES))
    line = complaint("uav123", tmp_path)
    assert line.endswith("its target is a building, which does not move; name it in `still` if nothing else does")
    found = clip("uav123", tmp_path, still=["building4"])
    assert found.still
    assert found.truth is None


def test_other_frame_counts_are_told(tmp_path: Path) -> None:
    anno = uav123(tmp_path, sequence="bike1", frames=5)
    text(anno / "bike1.txt", "\n".join(BOXES))
    assert "bike1.txt has 4 lines, but the clip 5 frames; wanted a line a frame" in complaint("uav123", tmp_path)


def test_a_sequence_that_is_not_whole_is_told(tmp_path: Path) -> None:
    text(uav123(tmp_path) / "car6_2.txt", "\n".join(BOXES))
    text(tmp_path / "configSeqs.m", config(part("car6_2", "car6", 6, 9)))
    assert "holds 3 of the frames 6 to 9 of car6_2; wanted all of them" in complaint("uav123", tmp_path)


@pytest.mark.parametrize(("content", "line"), [("", "is empty"), ("a,b,c,d\n", "is no table of boxes")])
def test_damaged_boxes_are_told(tmp_path: Path, content: str, line: str) -> None:
    text(uav123(tmp_path, sequence="bike1", frames=1) / "bike1.txt", content)
    assert line in complaint("uav123", tmp_path)


def test_an_unknown_variant_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'UAV124' is no variant of UAV123; wanted UAV123, UAV20L, UAV123_10fps"):
        read("uav123", tmp_path, variant="UAV124")


def test_parts_that_are_not_there_are_told_with_their_place(tmp_path: Path) -> None:
    uav123(tmp_path)
    line = complaint("uav123", tmp_path)
    assert line == f"{tmp_path / 'anno'} does not exist; wanted the boxes, CLIP.txt"


def test_the_long_variant_may_share_its_sequences_with_the_short_one(tmp_path: Path) -> None:
    uav123(tmp_path, "UAV123", sequence="bike1", frames=4)
    text(tmp_path / "anno" / "UAV20L" / "bike1.txt", "\n".join(BOXES))
    found = clip("uav123", tmp_path, variant="UAV20L")
    assert found.pictures[0] == tmp_path / "data_seq" / "UAV123" / "bike1" / "000001.jpg"
