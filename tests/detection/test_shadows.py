"""Cast shadows are cut off, dark targets are not."""

import numpy as np
import pytest

from torchvision_dddas.detection.outlines import remove_shadow

GROUND = np.random.default_rng(3).integers(140, 180, (80, 120, 3)).astype(np.uint8)
STILL = [np.eye(3), np.eye(3)]
BOX = (20, 20, 60, 40)


def scene(body: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A body in the left half of the box, its shadow in the right half; and the mask of both."""
    image = GROUND.copy()
    image[20:60, 20:50] = body
    image[20:60, 50:80] = (GROUND[20:60, 50:80] * 0.5).astype(np.uint8)
    return image, np.ones((40, 60), bool)


def test_the_shadow_goes_and_the_body_stays():
    image, mask = scene((20, 200, 90))
    left = remove_shadow(mask, BOX, image, [GROUND, GROUND], STILL)
    assert left[:, :29].mean() > 0.97
    assert left[:, 33:].mean() < 0.03


def test_a_body_that_is_itself_evenly_dark_is_left_whole():
    image = GROUND.copy()
    image[20:60, 20:80] = (GROUND[20:60, 20:80] * 0.5).astype(np.uint8)
    mask = np.ones((40, 60), bool)
    assert remove_shadow(mask, BOX, image, [GROUND, GROUND], STILL).all()


def test_ground_that_looks_different_in_the_two_other_frames_tells_nothing():
    image, mask = scene((20, 200, 90))
    other = np.roll(GROUND, 40, axis=1) // 2
    assert remove_shadow(mask, BOX, image, [GROUND, other], STILL).mean() > 0.95


def test_the_ground_is_looked_up_through_the_registration():
    image, mask = scene((20, 200, 90))
    ground = np.roll(GROUND, (3, 5), axis=(0, 1))
    there = np.array([[1.0, 0, 5], [0, 1, 3], [0, 0, 1]])
    left = remove_shadow(mask, BOX, image, [ground, ground], [there, there])
    assert left[:, 33:].mean() < 0.03


@pytest.mark.parametrize("grounds", [[], [GROUND], [GROUND[..., 0], GROUND[..., 0]]])
def test_without_two_colour_pictures_of_the_ground_the_mask_is_left_alone(grounds):
    image, mask = scene((20, 200, 90))
    assert remove_shadow(mask, BOX, image, grounds, STILL[: len(grounds)]) is mask
