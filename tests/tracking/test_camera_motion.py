"""How the camera moved between sampled frames."""

import cv2
import numpy as np
import pytest

from tests.synthetic_clip import render
from torchvision_dddas.config import Settings
from torchvision_dddas.detection import load_engine
from torchvision_dddas.geometry import chain, corner_error, transfer
from torchvision_dddas.tracking import CameraMotion


class Counted:
    """A back end that counts its registrations."""

    def __init__(self) -> None:
        self.engine, self.count = load_engine("onboard", Settings()), 0
        self.prepare = self.engine.prepare

    def register(self, pairs):
        self.count += len(pairs)
        return self.engine.register(pairs)


@pytest.fixture(scope="module")
def ground():
    """A large picture of the simulator's ground."""
    return cv2.resize(render(3, 1, (640, 480)).images[0], (1600, 1200), interpolation=cv2.INTER_CUBIC)


def seen(ground, ground_from_image, noise=0, size=(640, 480)):
    image = cv2.warpPerspective(ground, ground_from_image, size, flags=cv2.INTER_AREA | cv2.WARP_INVERSE_MAP)
    return np.clip(image + np.random.default_rng(noise).normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def shift(x, y=0.0):
    return np.array([[1, 0, 300 + x], [0, 1, 200 + y], [0, 0, 1.0]])


@pytest.mark.parametrize("speed_px", [0, 0.05, 0.7, 6.0])
def test_a_pan_however_slow_is_measured_and_a_still_camera_never_registered(ground, speed_px):
    engine, steps = Counted(), []
    camera, count = CameraMotion(engine), 30
    for k in range(count):
        now_from_before, cause = camera.update(seen(ground, shift(speed_px * k), k))
        assert cause == ""
        steps += [] if now_from_before is None else [now_from_before]
        measured = transfer(chain(steps), np.array([[320.0, 240.0]]))[0]
        assert np.abs(measured - (320 - speed_px * k, 240)).max() < 0.25 + 0.01 * k  # but for the allowed stillness
    assert engine.count <= count * min(1, 8 * speed_px)


@pytest.mark.parametrize("size", [(640, 480), (300, 200), (801, 607)])
def test_the_motion_is_in_pixels_of_the_picture(ground, size):
    camera = CameraMotion(Counted())
    camera.update(seen(ground, shift(0), 1, size))
    now_from_before, _ = camera.update(seen(ground, shift(7, -4), 2, size))
    assert now_from_before is not None
    assert corner_error(now_from_before, np.array([[1, 0, -7], [0, 1, 4], [0, 0, 1.0]]), size) < 0.4


def test_a_blank_picture_does_not_lose_the_motion_behind_it(ground):
    camera, moved = CameraMotion(Counted()), np.eye(3)
    for k in range(8):
        image = seen(ground, shift(12.0 * k), k)
        now_from_before, cause = camera.update(np.zeros_like(image) if k == 4 else image)
        assert bool(cause) == (k == 4)
        moved = moved if now_from_before is None else now_from_before @ moved
    assert corner_error(moved, np.array([[1, 0, -84.0], [0, 1, 0], [0, 0, 1]]), (640, 480)) < 1.5


@pytest.mark.parametrize("shape", [(480, 640), (48, 64, 3), (3, 90, 3), (1, 1)])
def test_grey_blank_and_tiny_pictures_have_no_motion(shape):
    camera = CameraMotion(Counted())
    for _ in range(3):
        now_from_before, _ = camera.update(np.full(shape, 90, np.uint8))
        assert now_from_before is None
