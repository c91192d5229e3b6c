"""Smoothing along flat regions, and cutting off cast shadows."""

import numpy as np
import pytest

from torchvision_dddas.detection.outlines import remove_shadow, smooth_along_edges


def step_guide(height=31, width=41, at=20):
    guide = np.zeros((height, width, 3), np.uint8)
    guide[:, at:] = 200
    return guide


def test_evidence_spreads_over_a_flat_region_and_stops_at_its_edge():
    evidence = np.zeros((31, 41, 1), np.float32)
    evidence[15, 10] = 1
    after = smooth_along_edges(evidence, step_guide(), 30, 80)[..., 0]
    assert after[15, 19] > 20 * after[15, 20]
    assert after[15, 19] > 0


def test_without_edges_it_reaches_as_far_to_either_side():
    evidence = np.zeros((81, 81, 1), np.float32)
    evidence[40, 40] = 1
    after = smooth_along_edges(evidence, np.zeros((81, 81), np.uint8), 10, 80)[..., 0]
    # The borders, which one sweep meets before the other, tilt it a little.
    np.testing.assert_allclose(after[40, 25:56], after[40, 55:24:-1], rtol=0.02)
    np.testing.assert_allclose(after[25:56, 40], after[55:24:-1, 40], rtol=0.02)
    assert after.argmax() == 40 * 81 + 40


def test_channels_do_not_mix_and_the_input_is_left_alone():
    evidence = np.random.default_rng(0).random((13, 17, 2)).astype(np.float32)
    before = evidence.copy()
    guide = np.random.default_rng(1).integers(0, 256, (13, 17, 3)).astype(np.uint8)
    both = smooth_along_edges(evidence, guide, 10, 80)
    np.testing.assert_array_equal(evidence, before)
    for k in range(2):
        np.testing.assert_allclose(
            both[..., k], smooth_along_edges(evidence[..., k : k + 1], guide, 10, 80)[..., 0], atol=1e-6
        )


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1)])
def test_pictures_of_one_row_or_column_work(shape):
    after = smooth_along_edges(np.ones((*shape, 1), np.float32), np.zeros(shape, np.uint8), 10, 80)
    np.testing.assert_allclose(after, 1, atol=1e-6)


def test_a_grey_picture_stops_the_spread_like_the_same_picture_in_colour():
    grey = np.random.default_rng(1).integers(0, 256, (13, 17)).astype(np.uint8)
    evidence = np.random.default_rng(0).random((13, 17, 2)).astype(np.float32)
    in_colour = smooth_along_edges(evidence, np.dstack([grey] * 3), 10, 80)
    np.testing.assert_allclose(smooth_along_edges(evidence, grey, 10, 80), in_colour, atol=1e-6)


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
