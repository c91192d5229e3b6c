"""Ranges of colour from painted ground hold the plates and little else; finders of colours agree with OpenCV."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.colours import (
    ColourSample,
    build_ranges,
    calibrate_colours,
    hue_difference,
    mask_colours,
    mask_range,
    to_hsv,
)

PLATES = {"red": (178, 210, 200), "yellow": (28, 220, 220), "blue": (112, 200, 190), "magenta": (150, 190, 200)}
LEAST = 12


def painted(plates, seed=0):
    """A meadow with shrubs, shadows and noise, and plates of 24 x 16 px: the picture and each plate's box."""
    rng = np.random.default_rng(seed)
    hsv = rng.normal((45, 110, 120), (6, 30, 40), (60, 80, 3))
    hsv[rng.random((60, 80)) < 0.05] = (105, 120, 60)  # shadows are blue
    ground = cv2.resize(np.clip(hsv, 0, (179, 255, 255)).astype(np.uint8), (640, 480), interpolation=cv2.INTER_NEAREST)
    image = cv2.GaussianBlur(cv2.cvtColor(ground, cv2.COLOR_HSV2BGR), (0, 0), 2).astype(float)
    boxes = {}
    for k, (name, colour) in enumerate(plates.items()):
        x, y = 60 + 130 * k, int(rng.integers(60, 400))
        image[y : y + 16, x : x + 24] = cv2.cvtColor(np.array([[colour]], np.uint8), cv2.COLOR_HSV2BGR)[0, 0]
        boxes[name] = (x, y, 24, 16)
    image += rng.normal(0, 5, image.shape)
    return cv2.GaussianBlur(np.clip(image, 0, 255).astype(np.uint8), (0, 0), 0.6), boxes


@pytest.mark.parametrize("seed", range(3))
def test_the_plates_are_found_and_each_range_marks_its_own_and_no_other(seed):
    image, boxes = painted(PLATES, seed)
    found = calibrate_colours([image], LEAST)
    assert sorted(found.ranges.names) == sorted(PLATES) and found.others == (0, 0, 0, 0)
    for name, low, high in zip(found.ranges.names, found.ranges.low, found.ranges.high, strict=True):
        mask = mask_range(to_hsv(image), low, high) > 0
        for other, (x, y, width, height) in boxes.items():
            marked = mask[y + 2 : y + height - 2, x + 2 : x + width - 2].mean()
            assert marked > 0.95 if other == name else marked < 0.02


def test_names_go_to_the_nearest_hues_or_in_their_order():
    image, _ = painted(PLATES)
    wanted = ["yellow", "blue", "magenta", "red"]
    assert list(calibrate_colours([image], LEAST, names=sorted(PLATES)).ranges.names) == wanted
    assert calibrate_colours([image], LEAST, names="abcd").ranges.names == tuple("abcd")
    two = calibrate_colours([painted({"blue": (108, 200, 190), "deep": (121, 200, 190)})[0]], LEAST)
    assert two.ranges.names == ("blue-1", "blue-2")


@pytest.mark.parametrize(
    ("count", "boxes", "words"),
    [
        (20, None, "of 20 colours stand out in the picture"),
        (None, [("a", "blue"), ("b", "blue")], "the hues of a and b are too similar"),
        (None, [("a", (630, 0, 20, 20))], "is not inside the picture, 640 x 480 px"),
        (None, [("a", (0, 0, 20, 20))], "has a strong colour"),
    ],
)
def test_too_few_and_too_similar_colours_and_boxes_without_one_are_refused(count, boxes, words):
    image, plates = painted(PLATES)
    image[:20, :20] = 128
    if boxes:
        boxes = [(name, plates.get(box, box)) for name, box in boxes]
    with pytest.raises(InputError, match=words):
        calibrate_colours([image], LEAST, count, boxes=boxes)


def test_neighbouring_hues_share_the_gap_between_them():
    def sample(hue):
        return [ColourSample(hue, np.full((50, 3), (hue, 200, 200), np.uint8), 1.0, 0, (0, 0, 5, 5))]

    low, high, _ = build_ranges([sample(20), sample(30), sample(175)], [np.zeros((9, 9, 3), np.uint8)], LEAST)
    assert high[0, 0] < low[1, 0] <= high[0, 0] + 2
    assert (low[0, 0], high[1, 0]) == (12, 38)  # where there is room, all of the margin
    assert (low[2, 0], high[2, 0]) == (167, 3)


def test_a_box_half_on_the_plate_has_the_plates_colour():
    image, boxes = painted({"blue": PLATES["blue"]})
    box = np.add(boxes["blue"], (-8, -4, 0, 0)).tolist()
    ((half,),) = calibrate_colours([image], LEAST, boxes=[("blue", tuple(box))]).groups
    assert abs(hue_difference(half.hue, 112)) <= 4


LOW = np.array([[170, 80, 60], [10, 80, 60], [55, 40, 40], [0, 0, 0]], float)
HIGH = np.array([[8, 255, 255], [30, 255, 255], [65, 255, 200], [180, 255, 90]], float)


def picture(height: int = 120, width: int = 160) -> np.ndarray:
    random = np.random.default_rng(0)
    patches = random.integers(0, 256, (height // 10, width // 10, 3)).astype(np.float32)
    return cv2.resize(patches, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def by_in_range(image: np.ndarray) -> np.ndarray:
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    masks = [cv2.inRange(hsv, low, high) for low, high in zip(LOW, HIGH, strict=True)]
    ends = cv2.inRange(hsv, LOW[0], np.array([180.0, 255, 255])), cv2.inRange(hsv, LOW[0] * (0, 1, 1), HIGH[0])
    return np.stack([np.maximum(*ends), *masks[1:]])


def test_masks_are_those_of_opencv_also_for_a_hue_that_goes_over_zero_and_empty_for_no_ranges_or_pixels():
    image = picture()
    found, wanted = mask_colours(image, LOW, HIGH), by_in_range(image)
    assert found.dtype == np.uint8 and found.shape == (4, 120, 160) and set(np.unique(found)) == {0, 255}
    assert ((wanted > 0).mean((1, 2)) > 0.002).all()
    assert (found == wanted).all()
    assert mask_colours(image, LOW[:0], HIGH[:0]).shape == (0, 120, 160)
    assert mask_colours(np.zeros((0, 5, 3), np.uint8), LOW, HIGH).shape == (4, 0, 5)


def test_large_pictures_are_masked_in_parts_that_leave_no_trace():
    for image in (picture(700, 900), picture(20, 140_000)):
        np.testing.assert_array_equal(mask_colours(image, LOW, HIGH), by_in_range(image))


def test_pictures_of_one_team_are_taken_together():
    groups = calibrate_colours([painted(PLATES, seed)[0] for seed in (0, 1)], LEAST, 4).groups
    assert [{one.picture for one in group} for group in groups] == [{0, 1}] * 4
