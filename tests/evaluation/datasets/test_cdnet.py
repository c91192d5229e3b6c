"""CDnet: what counts in its masks, and the frames that count."""

from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import clip, complaint, mask, pictures, read, text
from torchvision_dddas.evaluation.metrics import pixels
from torchvision_dddas.evaluation.metrics.truth import labels_of

REGIONS = {(0, 0, 4, 24): 85, (10, 10, 6, 6): 170, (11, 11, 4, 4): 255, (20, 10, 3, 3): 50}


def cdnet(folder: Path, category: str = "PTZ", name: str = "zoom", frames: int = 6, region: str = "3 5") -> Path:
    place = folder / category / name
    pictures(place / "input", [f"in{n:06d}.jpg" for n in range(1, frames + 1)])
    for n in range(1, frames + 1):
        mask(place / "groundtruth" / f"gt{n:06d}.png", REGIONS)
    text(place / "temporalROI.txt", region)
    pictures(place, ["ROI.bmp"])
    return place


def test_frames_outside_the_temporal_region_are_not_labelled(tmp_path: Path) -> None:
    cdnet(tmp_path)
    found = clip("cdnet", tmp_path)
    assert (found.name, found.frames) == ("PTZ-zoom", 6)
    assert found.truth is not None
    assert found.truth.frames == [3, 4, 5]
    assert found.truth.masks[3].name == "gt000003.png"


def test_shadow_is_background_and_unknown_and_outside_do_not_count(tmp_path: Path) -> None:
    cdnet(tmp_path)
    truth = clip("cdnet", tmp_path).truth
    assert truth is not None
    labels = labels_of(truth, 4)
    assert [labels[y, x] for y, x in ((0, 0), (10, 10), (11, 20), (20, 30), (12, 12))] == [-1, -1, 0, 0, 255]
    everything = np.ones(labels.shape, np.uint8)
    counts = pixels.count(everything, labels)
    assert counts == (16, 32 * 24 - 4 * 24 - 36, 0, 0)
    assert not truth.labels.separate


def test_the_archive_has_its_categories_in_a_folder(tmp_path: Path) -> None:
    cdnet(tmp_path / "dataset", "baseline", "road")
    cdnet(tmp_path / "dataset", "PTZ", "zoom")
    found = read("cdnet", tmp_path)
    assert [c.name for c in found.clips] == ["baseline-road", "PTZ-zoom"]
    assert [c.name for c in read("cdnet", tmp_path, clips=["PTZ-*"]).clips] == ["PTZ-zoom"]


@pytest.mark.parametrize("part", ["input", "groundtruth", "temporalROI.txt"])
def test_a_part_that_is_not_there_is_told(tmp_path: Path, part: str) -> None:
    place = cdnet(tmp_path)
    (place / part).rename(tmp_path / "elsewhere")
    assert complaint("cdnet", tmp_path) == (
        f"PTZ-zoom: {place} has no {part}; wanted input, groundtruth, temporalROI.txt"
    )


@pytest.mark.parametrize("region", ["", "3", "five six", "5 3", "1 2 3", "-1 4"])
def test_a_temporal_region_that_is_none_is_told(tmp_path: Path, region: str) -> None:
    cdnet(tmp_path, region=region)
    assert f"says '{region}'; wanted the first and the last frame that count" in complaint("cdnet", tmp_path)


def test_a_temporal_region_without_masks_is_told(tmp_path: Path) -> None:
    cdnet(tmp_path, region="90 99")
    assert "labels none of the frames 90 to 99; wanted masks" in complaint("cdnet", tmp_path)


def test_masks_of_other_frames_or_sizes_are_told_and_the_others_go_on(tmp_path: Path) -> None:
    short = cdnet(tmp_path, name="short")
    (short / "input" / "in000004.jpg").unlink()
    mask(cdnet(tmp_path, name="small") / "groundtruth" / "gt000005.png", REGIONS, size=(30, 24))
    cdnet(tmp_path)
    found = read("cdnet", tmp_path)
    assert [c.name for c in found.clips] == ["PTZ-zoom"]
    assert "gt000004.png labels no picture of" in found.missing[0]
    assert "gt000005.png is 30×24 pixels, but in000001.jpg 32×24" in found.missing[1]
