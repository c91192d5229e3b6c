"""The small world: the same every time, true where it says so, and moving as its cameras say."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.simulation.camera import flight
from torchvision_dddas.simulation.scene import boxes_of, cast, film, render

SIZE = (320, 240)


@pytest.fixture(scope="module")
def clip():
    return render(seed=3, frames=4, size=SIZE)


def test_same_seed_gives_the_same_film_and_another_seed_another(clip):
    again, other = render(seed=3, frames=4, size=SIZE), render(seed=4, frames=4, size=SIZE)
    assert all(np.array_equal(a, b) for a, b in zip(clip.images, again.images, strict=True))
    assert not np.array_equal(clip.images[0], other.images[0])


@pytest.mark.parametrize("size", [(320, 240), (321, 239), (240, 320)])
def test_pictures_and_masks_have_the_size_asked_for(size):
    picture = next(iter(film(seed=0, frames=1, size=size)))
    assert picture.image.shape == (size[1], size[0], 3)
    assert picture.image.dtype == np.uint8
    assert picture.mask.shape == (size[1], size[0])


def test_boxes_are_the_bounds_of_the_mask_values(clip):
    for mask, boxes in zip(clip.masks, clip.boxes_px, strict=True):
        assert len(boxes) >= 4
        for x, y, w, h in boxes.astype(int):
            assert (mask[y : y + h, x : x + w] > 0).any(axis=0).all()


def test_registering_by_the_true_cameras_leaves_only_movers_and_their_shades(clip):
    views = flight(3, 4, SIZE)
    first_from_last = views[0].image_from_ground @ np.linalg.inv(views[3].image_from_ground)
    warped = cv2.warpPerspective(clip.images[3], first_from_last, SIZE)
    valid = cv2.warpPerspective(np.ones(SIZE[::-1], np.uint8), first_from_last, SIZE)
    last = cv2.warpPerspective(clip.masks[3], first_from_last, SIZE, flags=cv2.INTER_NEAREST)
    movers = (clip.masks[0] > 0) | (last > 0)
    near = cv2.dilate(movers.astype(np.uint8), np.ones((25, 25), np.uint8))
    off = cv2.absdiff(clip.images[0], warped).max(axis=2)
    unaligned = cv2.absdiff(clip.images[0], clip.images[3]).max(axis=2)
    assert np.median(off[(valid > 0) & (near == 0)]) < 0.6 * np.median(unaligned[(valid > 0) & (near == 0)])
    assert np.mean(off[movers & (valid > 0)]) > 3 * np.mean(off[(valid > 0) & (near == 0)])


def test_the_parked_car_is_background():
    movers, parked = cast(0)
    assert all(np.linalg.norm(b.velocity_m_s) > 0 for b in movers)
    assert parked
    assert all(np.linalg.norm(b.velocity_m_s) == 0 for b in parked)
    assert max(int(p.mask.max()) for p in film(seed=0, frames=2, size=SIZE)) <= len(movers)


def test_gain_brightens_a_single_frame_and_leaves_the_truth(clip):
    jump = render(seed=3, frames=4, size=SIZE, gain=[1, 1.15, 1, 1])
    assert np.array_equal(jump.images[0], clip.images[0])
    assert np.mean(jump.images[1]) / np.mean(clip.images[1]) == pytest.approx(1.15, abs=0.01)
    assert np.array_equal(jump.masks[1], clip.masks[1])


def test_gain_of_another_length_is_refused():
    with pytest.raises(ValueError, match="2 numbers for 4 frames"):
        render(frames=4, size=SIZE, gain=[1, 1])


def test_boxes_of_an_empty_mask_is_an_empty_table():
    assert boxes_of(np.zeros((4, 5), np.uint16)).shape == (0, 4)
