"""`dddas colours`: the TOML and the picture that it writes, and one line for each mistake."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.io.colour_files import read_colours

BOXES = {"red": (20, 30, 24, 16), "blue": (90, 60, 24, 16)}
BGR = {"red": (40, 30, 200), "blue": (190, 60, 40)}


@pytest.fixture
def picture(tmp_path):
    image = np.full((120, 160, 3), (90, 110, 100), np.uint8) + np.random.default_rng(0).integers(
        0, 6, (120, 160, 3), np.uint8
    )
    for name, (x, y, width, height) in BOXES.items():
        image[y : y + height, x : x + width] = BGR[name]
    path = tmp_path / "view.png"
    cv2.imwrite(str(path), image)
    return path


def test_colours_are_found_named_and_shown(dddas, picture, tmp_path):
    out = tmp_path / "made" / "team.toml"
    result = dddas("colours", picture, "--out", out)
    assert result.exit_code == 0, result.output
    found = read_colours(out)
    assert sorted(found.names) == ["blue", "red"]
    lines = result.stdout.splitlines()
    assert [line.split(":")[0] for line in lines[:2]] == list(found.names)
    assert lines[-1] == f"{out}; {out.with_suffix('.png')} shows the areas that the ranges mark"
    drawn = cv2.imread(str(out.with_suffix(".png")))
    assert drawn is not None and drawn.shape == (120, 160, 3)
    assert drawn[68, 100].tolist() == list(BGR["blue"])  # what is marked keeps its colour
    assert np.ptp(drawn[100, 20].astype(int)) == 0  # the rest is grey


def test_names_that_are_colours_go_to_theirs_and_others_by_hue(dddas, picture, tmp_path):
    out = tmp_path / "colours.toml"
    assert dddas("colours", picture, "--names", "blue,red", "--out", out, "--quiet").stdout == ""
    found = read_colours(out)
    hue = dict(zip(found.names, found.low[:, 0], strict=True))
    assert 100 < hue["blue"] < 125 and (hue["red"] > 165 or hue["red"] < 10)
    dddas("colours", picture, "--names", "north,south", "--out", out)
    assert read_colours(out).names == ("north", "south")


def test_boxes_bring_their_names(dddas, picture, tmp_path):
    out = tmp_path / "colours.toml"
    result = dddas("colours", picture, "--at", "rover 1=90,60,24,16", "--at", "x=20,30,24,16", "--out", out)
    assert result.exit_code == 0, result.output
    assert read_colours(out).names == ("rover 1", "x")
