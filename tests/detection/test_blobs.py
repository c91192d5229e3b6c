"""Blobs, hulls, fragments, shadows and smoothing along edges."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.detection.blobs import find_blobs
from torchvision_dddas.detection.fragments import Ground, group_fragments, join_fragments
from torchvision_dddas.detection.observation import Target
from torchvision_dddas.detection.outlines import remove_shadow, smooth_along_edges

SIZE = (101, 67)


def found(core, evidence=None, threshold=10, area=1, peak=0, hull=False):
    return find_blobs(core, core if evidence is None else evidence, threshold, area, peak, hull)


@pytest.mark.parametrize(("least", "areas"), [(25, [25, 36]), (26, [36]), (37, [])])
def test_connected_regions_of_enough_area_are_blobs(least, areas, painted):
    blobs = found(painted(SIZE, (0, 0, 5, 5), (20, 20, 6, 6)), area=least)
    assert [blob.area_px for blob in blobs] == areas
    assert all(blob.box == (20, 20, 6, 6) and blob.centre_px.tolist() == [22.5, 22.5] for blob in blobs[-1:])


def test_a_region_without_a_peak_is_left_out_and_only_evidence_above_the_threshold_is_certain(painted):
    core = painted(SIZE, (0, 0, 5, 5), (20, 20, 6, 6))
    evidence = np.full(core.shape, 50, np.uint8)
    evidence[22, 22:24] = 120
    (blob,) = found(core, evidence, threshold=50, peak=120)
    assert blob.box == (20, 20, 6, 6) and blob.peak == 120
    assert np.argwhere(blob.core).tolist() == [[2, 2], [2, 3]]
    assert found(core, evidence, peak=121) == []


@pytest.mark.parametrize("hull", [False, True])
def test_blobs_of_half_size_maps_equal_those_of_doubled_maps(hull):
    half = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (40, 60)).astype(np.uint8), (0, 0), 2)
    core = cv2.threshold(half, 132, 255, cv2.THRESH_BINARY)[1]
    whole, evidence = (picture.repeat(2, axis=0).repeat(2, axis=1) for picture in (core, half))
    wanted, blobs = found(whole, evidence, 135, 60, 137, hull), find_blobs(core, half, 135, 60, 137, hull, scale=2)
    assert len(blobs) == len(wanted) >= 3
    for blob, other in zip(blobs, wanted, strict=True):
        assert blob.box == other.box and blob.peak == other.peak
        np.testing.assert_array_equal(blob.mask, other.mask)
        np.testing.assert_array_equal(blob.core, other.core)


@pytest.mark.parametrize("other", [(3.3, 0.2), (-3, 0), (0, 3), (4.5, 0), (np.nan, np.nan)])
def test_neighbours_with_like_motion_are_fragments_of_one_target(other):
    groups = group_fragments(np.array([(50, 20, 20, 40), (52, 64, 16, 30)], float), np.array([(3, 0), other], float))
    assert groups == ([[0, 1]] if other == (3.3, 0.2) else [[0], [1]])


def test_smoothing_spreads_over_a_flat_region_and_stops_at_its_edge():
    evidence, guide = np.zeros((31, 41, 1), np.float32), np.zeros((31, 41, 3), np.uint8)
    evidence[15, 10], guide[:, 20:] = 1, 200
    after = smooth_along_edges([evidence], [guide], 30, 80)[0][..., 0]
    assert after[15, 19] > 20 * after[15, 20]
    assert after[15, 19] > 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1)])
def test_smoothing_works_on_one_row_or_column(shape):
    (after,) = smooth_along_edges([np.ones((*shape, 1), np.float32)], [np.zeros(shape, np.uint8)], 10, 80)
    np.testing.assert_allclose(after, 1, atol=1e-6)


def test_pictures_smoothed_together_equal_those_smoothed_alone():
    rng = np.random.default_rng(0)
    shapes = [(20, 31), (7, 40), (33, 5)]
    values = [rng.random((*shape, 2)).astype(np.float32) for shape in shapes]
    guides = [rng.integers(0, 256, (*shape, 3)).astype(np.uint8) for shape in shapes]
    for value, guide, together in zip(values, guides, smooth_along_edges(values, guides, 30, 80), strict=True):
        np.testing.assert_array_equal(together, smooth_along_edges([value], [guide], 30, 80)[0])


GROUND = np.random.default_rng(3).integers(140, 180, (80, 120, 3)).astype(np.uint8)
BOX = (20, 20, 60, 40)


def pictured(body: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A body in the left half of the box, its shadow in the right half; and the mask of both."""
    image = GROUND.copy()
    image[20:60, 20:80] = (GROUND[20:60, 20:80] * 0.5).astype(np.uint8)
    if any(body):
        image[20:60, 20:50] = body
    return image, np.ones((40, 60), bool)


@pytest.mark.parametrize("shift", [(0, 0), (5, 3)])
def test_a_shadow_is_removed_with_registered_pictures_of_the_ground(shift):
    image, mask = pictured((20, 200, 90))
    ground = np.roll(GROUND, shift[::-1], axis=(0, 1))
    there = np.array([[1.0, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]])
    left = remove_shadow(mask, BOX, image, [ground, ground], [there, there])
    assert left[:, :29].mean() > 0.97
    assert left[:, 33:].mean() < 0.03


@pytest.mark.parametrize(
    ("body", "grounds"),
    [((20, 200, 90), []), ((20, 200, 90), [GROUND]), ((20, 200, 90), [GROUND[..., 0]] * 2), ((0, 0, 0), [GROUND] * 2)],
    ids=["no ground", "one picture", "grey", "evenly dark body"],
)
def test_a_mask_is_kept_without_two_colour_pictures_or_where_all_is_shadow(body, grounds):
    image, mask = pictured(body)
    assert remove_shadow(mask, BOX, image, grounds, [np.eye(3)] * len(grounds)).all()


def test_a_region_in_the_box_of_another_but_outside_its_hull_is_kept(painted):
    core = painted(SIZE, (10, 10, 40, 4), (10, 10, 4, 40), (40, 40, 8, 8))
    assert sorted(b.box for b in found(core, hull=True)) == [(10, 10, 40, 40), (40, 40, 8, 8)]


def ends_of_a_body(way: tuple[int, int], body: int | None, passed: int = 10) -> list[Target]:
    """Two targets 40 px apart along their way, with an even body between them, or the ground (None), after joining."""
    ground = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (240, 240)).astype(np.uint8), (0, 0), 1.5)
    pictures = []
    for frame in (-passed, 0, passed):
        picture = ground.copy()
        middle = np.array([120, 120]) + frame * np.array(way)
        ends = [np.round(middle + side * 25 * np.array(way) / np.hypot(*way)).astype(int) for side in (-1, 1)]
        if body is not None:
            cv2.line(picture, ends[0].tolist(), ends[1].tolist(), body, 16)
        for end in ends:
            cv2.circle(picture, end.tolist(), 8, 250, -1)
        pictures.append(picture)
        if frame == 0:
            boxes = [(end[0] - 8, end[1] - 8, 17, 17) for end in ends]
    full = np.ones((17, 17), bool)
    targets = [Target(box, full, np.array(way, float), 0.9, full) for box in boxes]
    grounds = [Ground(pictures[k], (k - 1) * passed, np.eye(3)) for k in (0, 2)]
    return join_fragments(targets, pictures[1], grounds)


@pytest.mark.parametrize("way", [(3, 0), (0, -3), (2, 2)])
def test_two_ends_of_an_even_body_are_one_target_and_two_walkers_are_not(way):
    assert len(ends_of_a_body(way, body=30)) == 1
    assert len(ends_of_a_body(way, body=None)) == 2


def test_ends_are_not_joined_before_the_body_has_left_its_place():
    assert len(ends_of_a_body((3, 0), body=30, passed=1)) == 2


def test_a_shadow_that_the_blue_sky_lights_is_removed():
    image, mask = pictured((20, 200, 90))
    image[20:60, 50:80] = (GROUND[20:60, 50:80] * (0.46, 0.39, 0.35)).astype(np.uint8)
    left = remove_shadow(mask, BOX, image, [GROUND, GROUND], [np.eye(3), np.eye(3)])
    assert left[:, :29].mean() > 0.97
    assert left[:, 33:].mean() < 0.03
