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


@pytest.mark.parametrize(("least", "areas"), [(25, [25, 36]), (26, [36]), (37, [])])
def test_connected_regions_of_enough_area_are_blobs_with_their_boxes(least, areas, painted):
    blobs = found(painted(SIZE, (0, 0, 5, 5), (20, 20, 6, 6)), area=least)
    assert [blob.area_px for blob in blobs] == areas
    assert all(blob.box == (20, 20, 6, 6) and blob.centre_px.tolist() == [22.5, 22.5] for blob in blobs[-1:])


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


@pytest.mark.parametrize("other", [(3.3, 0.2), (-3, 0), (0, 3), (4.5, 0), (np.nan, np.nan)])
def test_neighbours_are_fragments_of_one_target_if_they_move_alike(other):
    groups = group_fragments(np.array([TORSO, LEGS], float), np.array([(3, 0), other], float))
    assert groups == ([[0, 1]] if other == (3.3, 0.2) else [[0], [1]])


def test_evidence_spreads_over_a_flat_region_and_stops_at_its_edge():
    evidence, guide = np.zeros((31, 41, 1), np.float32), np.zeros((31, 41, 3), np.uint8)
    evidence[15, 10], guide[:, 20:] = 1, 200
    after = smooth_along_edges(evidence, guide, 30, 80)[..., 0]
    assert after[15, 19] > 20 * after[15, 20]
    assert after[15, 19] > 0


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


@pytest.mark.parametrize("shift", [(0, 0), (5, 3)])
def test_the_shadow_goes_and_the_body_stays_through_the_registration_of_the_ground(shift):
    image, mask = scene((20, 200, 90))
    ground = np.roll(GROUND, shift[::-1], axis=(0, 1))
    there = np.array([[1.0, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]])
    left = remove_shadow(mask, BOX, image, [ground, ground], [there, there])
    assert left[:, :29].mean() > 0.97
    assert left[:, 33:].mean() < 0.03


def test_a_body_that_is_itself_evenly_dark_is_left_whole():
    image = GROUND.copy()
    image[20:60, 20:80] = (GROUND[20:60, 20:80] * 0.5).astype(np.uint8)
    assert remove_shadow(np.ones((40, 60), bool), BOX, image, [GROUND, GROUND], STILL).all()


@pytest.mark.parametrize("grounds", [[], [GROUND], [GROUND[..., 0], GROUND[..., 0]]])
def test_without_two_colour_pictures_of_the_ground_the_mask_is_left_alone(grounds):
    image, mask = scene((20, 200, 90))
    assert remove_shadow(mask, BOX, image, grounds, STILL[: len(grounds)]) is mask


def test_a_region_in_another_ones_box_but_outside_its_hull_is_kept(painted):
    core = painted(SIZE, (10, 10, 40, 4), (10, 10, 4, 40), (40, 40, 8, 8))
    assert sorted(b.box for b in found(core, hull=True)) == [(10, 10, 40, 40), (40, 40, 8, 8)]
