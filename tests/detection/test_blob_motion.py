"""Motion of blobs from dense flow, and blobs that are split by it."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.detection.blob_motion import (
    DenseFlow,
    blob_motion,
    find_second_motion,
    split_by_flow,
)
from torchvision_dddas.detection.blobs import Blob

SHAPE = (120, 160)
BOX = (50, 40, 40, 30)


def texture(seed: int, shape=SHAPE) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), noise, 0, 255, cv2.NORM_MINMAX)


def scene(shift: tuple[int, int]) -> np.ndarray:
    """A textured box over a textured ground, the box shifted."""
    picture = texture(0)
    x, y, width, height = BOX
    picture[y + shift[1] : y + shift[1] + height, x + shift[0] : x + shift[0] + width] = texture(1)[:height, :width]
    return picture


def blob(box=BOX) -> Blob:
    full = np.ones((box[3], box[2]), bool)
    return Blob(box, full, full, 200.0)


def flows(before: tuple[float, float], after: tuple[float, float], ground=(0.0, 0.0)) -> list[np.ndarray]:
    """Half-resolution flow fields, one motion inside BOX and another outside."""
    x, y, width, height = (v // 2 for v in BOX)
    fields = []
    for inside in (before, after):
        field = np.full((SHAPE[0] // 2, SHAPE[1] // 2, 2), ground, np.float32)
        field[y : y + height, x : x + width] = inside
        fields.append(field)
    return fields


@pytest.mark.parametrize("velocity", [(2, 0), (-1, 2), (3, -3)])
def test_a_textured_box_is_found_to_move_as_it_was_moved(velocity):
    u, v = velocity
    measured = DenseFlow()(scene((0, 0)), [scene((-2 * u, -2 * v)), scene((2 * u, 2 * v))])
    motion = blob_motion(blob(), measured, (-2, 2))
    np.testing.assert_allclose(motion.velocity_px, velocity, atol=0.3)
    assert motion.steady > 0.7


def test_what_moves_like_its_surroundings_is_not_steady():
    assert blob_motion(blob(), flows((-6, 0), (6, 0), ground=(0, 0)), (-2, 2)).steady == 1
    fields = [np.full((60, 80, 2), (sign * 6, 0), np.float32) for sign in (-1, 1)]
    assert blob_motion(blob(), fields, (-2, 2)).steady == 0


@pytest.mark.parametrize("box", [(0, 0, 9, 7), (151, 113, 9, 7), (0, 0, 160, 120), (77, 50, 1, 1)])
def test_blobs_at_the_border_or_of_one_pixel_give_finite_or_unknown_motion(box):
    motion = blob_motion(blob(box), flows((1, 0), (1, 0)), (1, 1))
    assert 0 <= motion.steady <= 1
    assert np.isfinite(motion.velocity_px).all() or np.isnan(motion.velocity_px).all()


FULL_CORE = np.ones((30, 40), bool)


def two_halves(left: tuple[float, float], right: tuple[float, float], at: int = 20, noise: float = 0.1) -> np.ndarray:
    """A (30, 40, 2) field with one motion left of a column and another right of it."""
    field = np.random.default_rng(0).normal(0, noise, (30, 40, 2))
    field[:, :at] += left
    field[:, at:] += right
    return field.astype(np.float32)


@pytest.mark.parametrize("at", [10, 20, 28])
@pytest.mark.parametrize(("left", "right"), [((3, 0), (-3, 0)), ((0, 3), (3, 0)), ((6, 1), (3, 6))])
def test_two_motions_are_found_where_they_meet(left, right, at):
    second = find_second_motion(two_halves(left, right, at), FULL_CORE)
    assert second is not None
    assert second[0, 0] != second[0, -1]
    wanted = np.zeros(FULL_CORE.shape, bool)
    wanted[:, at:] = True
    if second[0, 0]:
        second = ~second
    assert (second != wanted).mean() < 0.05


SCATTERED = two_halves((3, 0), (3, 0))
SCATTERED[np.random.default_rng(1).random((30, 40)) < 0.4] = (-3, 0)


@pytest.mark.parametrize(
    "field",
    [
        SCATTERED,
        two_halves((3, 0), (3, 0)),
        two_halves((3, 0), (3.5, 0)),  # less than 1 px a frame
        two_halves((9, 0), (7, 0)),  # less than 30 %
        two_halves((8, 0), (4, 1)),  # slower the same way
        two_halves((3, 0), (0, 0)),  # ground between its wheels
        two_halves((3, 0), (-3, 0), at=4),  # a part of a tenth
        two_halves((3, 0), (3, 0), noise=2.0),
        np.zeros((30, 40, 2), np.float32),
    ],
)
def test_one_motion_stays_one(field):
    assert find_second_motion(field, FULL_CORE) is None


@pytest.mark.parametrize("corner", [(0, 0), (13, 7)])
@pytest.mark.parametrize("size", [(80, 60), (81, 59)])
def test_a_blob_is_cut_along_the_seam_and_loses_no_pixel(corner, size):
    picture = np.zeros((70, 110, 2), np.float32)
    seam = corner[0] // 2 + 20
    picture[:, :seam] = (3, 0)
    picture[:, seam:] = (-3, 0)
    full = np.ones((size[1], size[0]), bool)
    blob = Blob((*corner, *size), full, full, 100.0)
    left, right = sorted(split_by_flow(blob, [2 * picture, -2 * picture], (2, -2)), key=lambda part: part.box[0])
    assert left.box[:2] == corner
    assert left.box[0] + left.box[2] == pytest.approx(corner[0] + 40, abs=3)
    assert left.area_px + right.area_px == blob.area_px
    assert right.box[0] + right.box[2] == corner[0] + size[0]
