"""Motion of blobs from dense flow, and blobs that are split by it."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.detection.blob_motion import (
    DenseFlow,
    find_second_motion,
    measure_motions,
    split_by_flow,
)

SHAPE = (120, 160)


BOX = (50, 40, 40, 30)
FULL_CORE = np.ones((30, 40), bool)


def textured(shift: tuple[int, int]) -> np.ndarray:
    """A textured box, shifted, over a textured ground."""
    ground, body = (cv2.GaussianBlur(p, (0, 0), 2.0) for p in np.random.default_rng(0).normal(size=(2, *SHAPE)))
    x, y, width, height = BOX
    ground[y + shift[1] : y + shift[1] + height, x + shift[0] : x + shift[0] + width] = body[:height, :width]
    return cv2.normalize(ground, ground.copy(), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.mark.parametrize("velocity", [(2, 0), (-1, 2), (3, -3)])
def test_the_velocity_of_a_textured_box_is_measured(velocity, box_blob):
    u, v = velocity
    measured = DenseFlow()(textured((0, 0)), [textured((-2 * u, -2 * v)), textured((2 * u, 2 * v))])
    (motion,) = measure_motions([box_blob(BOX)], measured, (-2, 2))
    np.testing.assert_allclose(motion.velocity_px, velocity, atol=0.3)
    assert motion.steady > 0.7


def test_flow_is_searched_around_boxes_only():
    noise = np.random.default_rng(0).integers(0, 256, (480, 640)).astype(np.uint8)
    grey = cv2.equalizeHist(cv2.GaussianBlur(noise, (0, 0), 3))
    later = [np.roll(grey, (2, 4), axis=(0, 1))]
    (everywhere,), (around,) = DenseFlow()(grey, later), DenseFlow()(grey, later, [BOX])
    x, y, width, height = (v // 2 for v in BOX)
    inside = np.s_[y : y + height, x : x + width]
    for field in (everywhere, around):
        np.testing.assert_allclose(np.median(field[inside], axis=(0, 1)), (4, 2), atol=0.3)
    assert around.shape == everywhere.shape
    assert everywhere[-60:, -80:].any() and not around[-60:, -80:].any()


def flows(inside: float, ground: float) -> list[np.ndarray]:
    """Half-resolution flow fields to an earlier and a later frame, one motion inside BOX and another outside."""
    x, y, width, height = (v // 2 for v in BOX)
    field = np.full((SHAPE[0] // 2, SHAPE[1] // 2, 2), (ground, 0), np.float32)
    field[y : y + height, x : x + width] = inside, 0
    return [-field, field]


def test_a_blob_in_a_corner_does_not_change_the_flow_of_later_pictures():
    noise = np.random.default_rng(0).integers(0, 256, (480, 640)).astype(np.uint8)
    grey = cv2.equalizeHist(cv2.GaussianBlur(noise, (0, 0), 3))
    later, used = np.roll(grey, 3, axis=1), DenseFlow()
    (corner,) = used(grey, [later], [(0, 0, 10, 10)])
    tiny = np.ascontiguousarray(grey[:60, :80])
    used(tiny, [np.roll(tiny, 1, axis=1)])
    np.testing.assert_array_equal(used(grey, [later])[0], DenseFlow()(grey, [later])[0])
    assert (corner[:40, :40] != 0).any() and not corner[100:].any()


def test_a_blob_that_moves_with_its_surroundings_is_not_steady(box_blob):
    assert measure_motions([box_blob(BOX)], flows(6, 0), (-2, 2))[0].steady == 1
    assert measure_motions([box_blob(BOX)], flows(6, 6), (-2, 2))[0].steady == 0


@pytest.mark.parametrize("box", [(0, 0, 9, 7), (151, 113, 9, 7), (0, 0, 160, 120), (77, 50, 1, 1)])
def test_blobs_at_the_border_or_of_one_pixel_have_finite_or_unknown_motion(box, box_blob):
    (motion,) = measure_motions([box_blob(box)], flows(1, 0), (-1, 1))
    assert 0 <= motion.steady <= 1
    assert np.isfinite(motion.velocity_px).all() or np.isnan(motion.velocity_px).all()


def two_halves(left: tuple[float, float], right: tuple[float, float], at: int = 20, noise: float = 0.1) -> np.ndarray:
    """A (30, 40, 2) field with one motion left of a column and another right of it."""
    field = np.random.default_rng(0).normal(0, noise, (30, 40, 2))
    field[:, :at] += left
    field[:, at:] += right
    return field.astype(np.float32)


@pytest.mark.parametrize(
    ("left", "right", "at"), [((3, 0), (-3, 0), 10), ((0, 3), (3, 0), 20), ((6, 1), (3, 6), 28), ((3, 0), (-3, 0), 28)]
)
def test_two_motions_are_separated_where_they_meet(left, right, at):
    second = find_second_motion(two_halves(left, right, at), FULL_CORE)
    assert second is not None and second[0, 0] != second[0, -1]
    wanted = np.tile(np.arange(40) >= at, (30, 1))
    assert ((second != second[0, 0]) != wanted).mean() < 0.05


@pytest.mark.parametrize(
    "field",
    [
        two_halves((3, 0), (3, 0)),
        two_halves((3, 0), (3.5, 0)),  # less than 1 px a frame
        two_halves((9, 0), (7, 0)),  # less than 30 %
        two_halves((8, 0), (4, 1)),  # slower the same way
        two_halves((3, 0), (0, 0)),  # ground between its wheels
        two_halves((3, 0), (-3, 0), at=4),  # a part of a tenth
        two_halves((3, 0), (3, 0), noise=2.0),
        np.where(np.random.default_rng(1).random((30, 40, 1)) < 0.4, (-3, 0), (3, 0)).astype(np.float32),  # scattered
    ],
)
def test_one_motion_is_not_split(field):
    assert find_second_motion(field, FULL_CORE) is None


@pytest.mark.parametrize(("corner", "size"), [((0, 0), (80, 60)), ((13, 7), (81, 59))])
def test_a_blob_is_split_along_the_seam_and_keeps_every_pixel(corner, size, box_blob):
    field = np.zeros((70, 110, 2), np.float32)
    seam = corner[0] // 2 + 20
    field[:, :seam], field[:, seam:] = (3, 0), (-3, 0)
    blob = box_blob((*corner, *size))
    there_and_back, offsets = [2 * field, -2 * field], (2, -2)
    (motion,) = measure_motions([blob], there_and_back, offsets)
    parts = split_by_flow(blob, motion, there_and_back, offsets)
    left, right = sorted(parts, key=lambda part: part.box[0])
    assert left.box[:2] == corner
    assert left.box[0] + left.box[2] == pytest.approx(corner[0] + 40, abs=3)
    assert left.area_px + right.area_px == blob.area_px
    assert right.box[0] + right.box[2] == corner[0] + size[0]
