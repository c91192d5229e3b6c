"""Cleaning, labelling, gates, hulls and fragments."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import MorphologyParameters
from torchvision_dddas.detection.blobs import find_blobs, find_weak_blobs, group_fragments

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


def test_a_hull_fills_the_notch_of_an_l_and_only_that(painted):
    core = painted(SIZE, (10, 10, 20, 5), (10, 10, 5, 20))
    (blob,) = found(core, hull=True)
    assert blob.mask[6, 6] and not blob.mask[18, 18]
    assert blob.mask[core[blob.window] > 0].all()


def test_a_region_inside_another_ones_hull_is_swallowed(painted):
    core = painted(SIZE, (10, 10, 40, 4), (10, 10, 4, 40), (46, 10, 4, 40), (25, 25, 6, 6))
    assert [b.box for b in found(core, hull=True)] == [(10, 10, 40, 40)]
    assert len(found(core, hull=False)) == 2


def test_a_region_in_another_ones_box_but_outside_its_hull_is_kept(painted):
    core = painted(SIZE, (10, 10, 40, 4), (10, 10, 4, 40), (40, 40, 8, 8))
    assert sorted(b.box for b in found(core, hull=True)) == [(10, 10, 40, 40), (40, 40, 8, 8)]


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


@pytest.mark.parametrize("box", [(52, 75, 16, 30), (75, 20, 20, 40), (66, 64, 30, 30)])
def test_movers_side_by_side_or_too_far_stay_apart(box):
    assert grouped([TORSO, box], [(3, 0), (3, 0)]) == [[0], [1]]


def test_a_chain_of_fragments_is_one_group_whatever_their_order():
    boxes = [(10, 10, 20, 20), (11, 33, 20, 20), (12, 56, 20, 20), (200, 10, 20, 20)]
    velocities = [(3, 0), (3, 0), (3, 0), (3, 0)]
    assert grouped(boxes, velocities) == [[0, 1, 2], [3]]
    assert grouped([boxes[i] for i in (2, 0, 3, 1)], velocities) == [[0, 1, 3], [2]]
