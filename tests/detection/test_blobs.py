"""Cleaning, labelling, gates, hulls and fragments; shadows and smoothing along flat regions."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import MorphologyParameters
from torchvision_dddas.detection.blobs import find_blobs, find_weak_blobs, group_fragments
from torchvision_dddas.detection.observation import remove_shadow, smooth_along_edges

SIZE = (101, 67)


def found(core, evidence=None, threshold=10, area=1, peak=0, hull=False):
    return find_blobs(core, core if evidence is None else evidence, threshold, area, peak, hull)


def test_each_connected_region_is_a_blob_with_its_box_and_area(painted):
    blobs = sorted(found(painted(SIZE, (3, 4, 10, 6), (50, 30, 7, 20))), key=lambda b: b.box)
    assert [b.box for b in blobs] == [(3, 4, 10, 6), (50, 30, 7, 20)]
    assert [b.area_px for b in blobs] == [60, 140]
    np.testing.assert_array_equal(blobs[0].centre_px, [7.5, 6.5])


def test_a_blank_picture_has_no_blobs_and_a_full_one_has_one(painted):
    assert found(painted(SIZE)) == []
    (blob,) = found(painted(SIZE, (0, 0, *SIZE)), hull=True)
    assert blob.box == (0, 0, *SIZE) and blob.mask.all()


@pytest.mark.parametrize(("least", "count"), [(24, 2), (25, 2), (26, 1), (37, 0)])
def test_a_region_below_the_area_gate_is_none(least, count, painted):
    assert len(found(painted(SIZE, (0, 0, 5, 5), (20, 20, 6, 6)), area=least)) == count


def test_a_region_whose_evidence_never_peaks_is_none(painted):
    core = painted(SIZE, (0, 0, 5, 5), (20, 20, 6, 6))
    evidence = np.full(core.shape, 50, np.uint8)
    evidence[22, 22] = 120
    (blob,) = found(core, evidence, peak=120)
    assert blob.box == (20, 20, 6, 6) and blob.peak == 120
    assert found(core, evidence, peak=121) == []


def test_only_evidence_above_the_threshold_is_certain(painted):
    core = painted(SIZE, (20, 20, 6, 6))
    evidence = np.full(core.shape, 50, np.uint8)
    evidence[22, 23:25] = 51
    (blob,) = found(core, evidence, threshold=50)
    assert np.argwhere(blob.core).tolist() == [[2, 3], [2, 4]]


def test_weak_blobs_are_those_of_the_wide_evidence_that_touch_none_found(painted):
    wide = painted(SIZE, (3, 4, 12, 12), (50, 30, 20, 20))
    strong = found(painted(SIZE, (5, 6, 10, 10)))
    (weak,) = find_weak_blobs(wide, strong, 10, MorphologyParameters(erode_px=1, close_px=1), 1, 0)
    assert weak.weak and weak.box == (50, 30, 20, 20)
    assert not strong[0].weak


@pytest.mark.parametrize("hull", [False, True])
def test_blobs_of_maps_at_half_the_size_are_those_of_the_maps_made_whole(hull):
    half = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (40, 60)).astype(np.uint8), (0, 0), 2)
    core = cv2.threshold(half, 132, 255, cv2.THRESH_BINARY)[1]
    whole, evidence = (picture.repeat(2, axis=0).repeat(2, axis=1) for picture in (core, half))
    wanted, blobs = found(whole, evidence, 135, 60, 137, hull), find_blobs(core, half, 135, 60, 137, hull, scale=2)
    assert len(blobs) == len(wanted) >= 3
    for blob, other in zip(blobs, wanted, strict=True):
        assert blob.box == other.box and blob.peak == other.peak
        np.testing.assert_array_equal(blob.mask, other.mask)
        np.testing.assert_array_equal(blob.core, other.core)


TORSO, LEGS = (50, 20, 20, 40), (52, 64, 16, 30)


def grouped(boxes, velocities):
    return sorted(
        sorted(g) for g in group_fragments(np.array(boxes, float).reshape(-1, 4), np.array(velocities, float))
    )


def test_fragments_near_each_other_that_move_alike_are_one():
    assert grouped([TORSO, LEGS], [(3, 0), (3.3, 0.2)]) == [[0, 1]]


@pytest.mark.parametrize("other", [(-3, 0), (0, 3), (4.5, 0), (np.nan, np.nan)])
def test_neighbours_that_move_differently_or_unknown_stay_apart(other):
    assert grouped([TORSO, LEGS], [(3, 0), other]) == [[0], [1]]


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


def test_a_region_in_another_ones_box_but_outside_its_hull_is_kept(painted):
    core = painted(SIZE, (10, 10, 40, 4), (10, 10, 4, 40), (40, 40, 8, 8))
    assert sorted(b.box for b in found(core, hull=True)) == [(10, 10, 40, 40), (40, 40, 8, 8)]
