"""Histograms of what targets look like."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.tracking.appearance import SIGNATURE, strips

RED, GREEN, BLUE = (0, 0, 200), (0, 200, 0), (200, 0, 0)
GROUND = (110, 120, 115)


def picture(*people: tuple[tuple[int, int, int, int], tuple[int, int, int], tuple[int, int, int]]) -> np.ndarray:
    """A (200, 300, 3) picture with people of a box, a colour above and a colour below."""
    image = np.full((200, 300, 3), GROUND, np.uint8)
    for (x, y, width, height), above, below in people:
        image[y : y + height // 2, x : x + width] = above
        image[y + height // 2 : y + height, x : x + width] = below
    return image


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (200, 300, 3), np.uint8)


def likeness(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.sqrt(one) @ np.sqrt(other))


BOX = (100, 40, 40, 120)
BOXES = np.array([BOX, (10, 10, 20, 50), (200.4, 100.7, 30.2, 80.9), (150, 150, 3, 2)], float)


def test_all_histograms_of_a_box_sum_to_one_together_and_none_is_negative():
    found = strips(noise(), BOXES)
    assert found.shape == (4, SIGNATURE) and found.dtype == np.float32
    np.testing.assert_allclose(found.sum(axis=1), 1, rtol=1e-5)
    assert (found >= 0).all()


def test_each_strip_counts_the_same_and_each_channel_of_it():
    np.testing.assert_allclose(strips(noise(), BOXES[:3]).reshape(3, 3, -1).sum(axis=2), 1 / 3, rtol=1e-5)
    plain = strips(picture((BOX, RED, RED)), np.array([BOX], float))[0]
    np.testing.assert_allclose(plain[plain > 0], np.full(9, 1 / 9), rtol=1e-5)


def test_the_likeness_of_a_target_to_itself_is_one_and_to_another_colour_less():
    image = picture((BOX, RED, BLUE), ((200, 40, 40, 120), GREEN, BLUE), ((20, 40, 40, 120), RED, BLUE))
    same, other, again = strips(image, np.array([BOX, (200, 40, 40, 120), (20, 40, 40, 120)], float))
    assert likeness(same, same) == pytest.approx(1, abs=1e-5)
    assert likeness(same, again) == pytest.approx(1, abs=1e-5)
    assert likeness(same, other) < 0.8


def test_the_same_colours_the_other_way_round_are_another_target():
    image = picture((BOX, RED, BLUE), ((200, 40, 40, 120), BLUE, RED))
    one, other = strips(image, np.array([BOX, (200, 40, 40, 120)], float))
    assert likeness(one, other) < 0.6


def test_the_size_of_a_target_hardly_matters():
    image = picture((BOX, RED, BLUE), ((200, 100, 15, 45), RED, BLUE))
    one, small = strips(image, np.array([BOX, (200, 100, 15, 45)], float))
    assert likeness(one, small) > 0.95


def test_the_middle_of_a_box_counts_more_than_its_sides():
    middle, sides = picture(), picture()
    middle[40:160, 113:127] = RED
    sides[40:160, 100:107] = sides[40:160, 133:140] = RED
    body = strips(picture((BOX, RED, RED)), np.array([BOX], float))[0]
    in_the_middle, at_the_sides = (strips(image, np.array([BOX], float))[0] for image in (middle, sides))
    assert likeness(body, in_the_middle) > likeness(body, at_the_sides) + 0.1


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 100), st.permutations(range(4)))
def test_each_box_is_for_itself(seed, order):
    found = strips(noise(seed), BOXES)
    np.testing.assert_array_equal(strips(noise(seed), BOXES[list(order)]), found[list(order)])


def test_a_box_outside_has_zeros_and_one_half_outside_has_its_inside():
    image = noise()
    outside = [(-50, 10, 40, 80), (300, 10, 40, 80), (10, -90, 40, 80), (10, 200, 40, 80)]
    found = strips(image, np.array([*outside, (-20, 40, 40, 120), (0, 150, 40, 120), (-100, -100, 600, 600)], float))
    assert not found[:4].any()
    np.testing.assert_allclose(found[4:].sum(axis=1), 1, rtol=1e-5)


def test_a_target_cut_off_by_the_border_still_looks_like_itself():
    """What is left of it is compared in its place in the whole box, not stretched to one."""
    image = picture((BOX, RED, BLUE))
    whole, cut = strips(image, np.array([BOX], float))[0], strips(image[:, 115:], np.array([(-15, *BOX[1:])], float))[0]
    low = strips(image[:130], np.array([BOX], float))[0]
    assert likeness(whole, cut) > 0.98
    assert likeness(whole, low) > 0.98


def test_what_the_upper_border_cut_off_is_missing_not_the_legs():
    """Two strips of three are left: the legs are still compared with legs."""
    image = picture((BOX, RED, BLUE))
    whole = strips(image, np.array([BOX], float))[0]
    headless = strips(image[70:], np.array([(100, -30, 40, 120)], float))[0]
    assert likeness(whole, headless) > 0.99 * np.sqrt(2 / 3)
    assert not headless[: SIGNATURE // 3].any()


def test_the_middle_of_a_box_stays_the_middle_where_a_side_was_cut_off():
    image = picture((BOX, GREEN, GREEN))
    image[40:160, 110:130] = RED
    whole, half = (
        strips(image, np.array([BOX], float))[0],
        strips(image[:, 120:], np.array([(-20, *BOX[1:])], float))[0],
    )
    assert likeness(whole, half) > 0.96


def test_a_grey_picture_is_one_without_colour():
    grey = cv2.cvtColor(noise(), cv2.COLOR_BGR2GRAY)
    small = BOXES[1:2]
    np.testing.assert_array_equal(strips(grey, small), strips(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), small))
    assert strips(grey, BOXES).shape == (4, SIGNATURE)


def test_a_box_of_less_than_a_pixel_has_a_colour():
    found = strips(noise(), np.array([[10.0, 10.0, 1, 1], [10.2, 10.3, 0.6, 0.6], [10.2, 10.3, 0.1, 0.1]]))
    np.testing.assert_allclose(found.sum(axis=1), 1, rtol=1e-5)


def test_no_boxes():
    assert strips(noise(), np.zeros((0, 4))).shape == (0, SIGNATURE)
