"""Ranges of colour from TOML: what they mean, and one line for each mistake."""

import re

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.colours import find_overlaps
from torchvision_dddas.io.colour_files import format_colours, read_colours
from torchvision_dddas.types import Colours


@pytest.fixture
def toml(tmp_path):
    def write(text):
        path = tmp_path / "colours.toml"
        path.write_text(text)
        return path

    return write


def test_ranges_are_read_in_the_order_of_the_file(toml):
    found = read_colours(
        toml("[red]\nlow = [172, 90, 60]\nhigh = [8, 255, 255]\n[blue]\nlow=[100,1,2]\nhigh=[120,3,4]")
    )
    assert found.names == ("red", "blue")
    assert found.low.tolist() == [[172, 90, 60], [100, 1, 2]]
    assert found.high.tolist() == [[8, 255, 255], [120, 3, 4]]


def test_what_is_written_is_read_again(toml):
    names = ("red", "rover 2", 'the "big" one')
    low = np.array([[172, 90, 60], [20, 0, 0], [60, 1, 1]])
    written = Colours(names, low, np.array([[8, 255, 255], [40, 255, 255], [90, 200, 200]]))
    found = read_colours(toml(format_colours(written)))
    assert found.names == names
    assert (found.low == written.low).all() and (found.high == written.high).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no colour"),
        ("[red", "is not valid TOML"),
        ("red = 3", "red lacks low or high"),
        ("[red]\nlow = [1, 2, 3]", "red lacks low or high"),
        ("[red]\nlow = [1, 2, 3]\nhigh = [2, 3, 4]\nhue = 1", "red has hue, which no colour has"),
        ("[red]\nlow = [1, 2]\nhigh = [2, 3, 4]", "red.low is [1, 2]; wanted [hue, saturation, value]"),
        ("[red]\nlow = [1, 2, 3]\nhigh = [190, 3, 4]", "red.high is [190, 3, 4]; wanted"),
        ("[red]\nlow = [1.5, 2, 3]\nhigh = [9, 3, 4]", "red.low is [1.5, 2, 3]; wanted"),
        ("[red]\nlow = [1, 9, 3]\nhigh = [2, 3, 4]", "red's lowest saturation 9 is above its highest 3"),
        ("[red]\nlow = [1, 2, 9]\nhigh = [2, 3, 4]", "red's lowest value 9 is above its highest 4"),
        (
            "[red]\nlow = [170, 0, 0]\nhigh = [5, 255, 255]\n[orange]\nlow = [5, 0, 0]\nhigh = [15, 255, 255]",
            "red and orange overlap",
        ),
    ],
)
def test_each_mistake_is_one_clear_line(toml, text, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_colours(toml(text))
    assert str(caught.value).startswith("colours ") and "\n" not in str(caught.value)


def test_ranges_overlap_only_where_hue_saturation_and_value_all_do():
    low = np.array([[170, 100, 0], [0, 0, 0], [176, 100, 200], [11, 0, 0]])
    high = np.array([[5, 255, 199], [10, 99, 255], [179, 255, 255], [20, 99, 255]])
    assert find_overlaps(low, high) == []
    high[1] = (10, 100, 255)
    assert find_overlaps(low, high) == [(0, 1)]


def test_a_hue_of_180_is_that_of_0():
    assert find_overlaps(np.array([[175, 0, 0], [0, 0, 0]]), np.array([[180, 9, 9], [3, 9, 9]])) == [(0, 1)]
