"""Clips that are odd but valid, and clips with faults, through the command line and the true engine."""

import json

import cv2
import numpy as np
import pytest

from tests.synthetic_clip import render

CONFIGS = ("default", "fast", "source")


def grey16(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint16) * 16


def small(width, height):
    return lambda image: cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def images():
    return render(0, 9, (240, 180)).images


@pytest.fixture
def folder(tmp_path):
    def write(images):
        (tmp_path / "frames").mkdir()
        for number, image in enumerate(images, 1):
            cv2.imwrite(str(tmp_path / f"frames/{number:05d}.png"), image)
        return tmp_path / "frames"

    return write


@pytest.fixture
def found(dddas, tmp_path):
    """Detect, expect success, and give the record and the masks."""

    def detect(clip, config="fast"):
        words = () if config == "default" else ("--config", config)
        result = dddas("detect", clip, "--out", tmp_path / "out", "--quiet", *words)
        assert (result.exit_code, result.output) == (0, "")
        masks = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in sorted((tmp_path / "out/masks").iterdir())]
        return json.loads((tmp_path / "out/run.json").read_text()), masks

    return detect


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize(
    ("change", "shape"),
    [
        (grey16, (180, 240)),
        (lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE), (240, 180)),
        (small(101, 67), (67, 101)),
        (small(8, 8), (8, 8)),
        (small(90, 3), (3, 90)),
        (small(1, 1), (1, 1)),
    ],
    ids=["16-bit grey", "portrait", "odd sides", "8x8", "a strip", "one pixel"],
)
def test_any_depth_and_size_gives_a_mask_for_every_frame(folder, found, images, change, shape, config):
    record, masks = found(folder([change(image) for image in images]), config)
    assert record["frames"]["written"] == 9
    assert [mask.shape for mask in masks] == [shape] * 9


def test_sixteen_bits_show_what_eight_bits_show(folder, found, images):
    _, masks = found(folder([grey16(image) for image in images]))
    assert any(mask.any() for mask in masks)


@pytest.mark.parametrize("bad", [(4,), (8, 9), (3, 4, 9)])
def test_undecodable_frames_get_empty_masks_and_are_recorded(folder, found, images, bad):
    clip = folder(images)
    for number in bad:
        (clip / f"{number:05d}.png").write_bytes(b"no picture")
    record, masks = found(clip)
    assert len(masks) == 9
    assert not any(masks[number - 1].any() for number in bad)
    assert len(record["problems"]) == len(bad)
    lost = [n for row in record["unreliable"] for n in range(row["first"], row["last"] + 1)]
    assert set(bad) <= set(lost)


def test_a_frame_of_another_size_late_in_a_clip_leaves_nothing_that_looks_whole(dddas, folder, images, tmp_path):
    clip = folder([*images, *images[::-1], small(200, 150)(images[0])])
    result = dddas("detect", clip, "--out", tmp_path / "out", "--quiet", "--config", "fast")
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert "200x150" in line and "240x180" in line
    assert json.loads((tmp_path / "out/run.json").read_text())["state"] == "failed"
    assert not [p for p in (tmp_path / "out").iterdir() if p.name not in ("run.json", "masks")]
