"""The batched back end: a batch is a loop, whatever is in it."""

from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("torch")

from tests.synthetic_clip import render
from torchvision_dddas import config as parameters
from torchvision_dddas.detection.engine import View, Window
from torchvision_dddas.detection.torch_engine import TorchEngine
from torchvision_dddas.geometry import corner_error

SETTINGS = parameters.load_config()


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return render(2, 6, (256, 192)).images


@pytest.fixture
def engine() -> TorchEngine:
    return TorchEngine(SETTINGS, device="cpu")


def around(views: list[View], at: int) -> Window:
    """A window with one frame on either side, held still."""
    return Window(views[at], (views[at - 1], views[at + 1]), np.stack([np.eye(3)] * 2), (-1, 1), ((0, 1),))


def test_five_pairs_at_once_give_what_one_at_a_time_gives(engine, images) -> None:
    together = engine.register(list(pairwise([engine.prepare(image) for image in images])))
    for pair, whole in zip(pairwise(images), together, strict=True):
        (alone,) = engine.register([(engine.prepare(pair[0]), engine.prepare(pair[1]))])
        np.testing.assert_allclose(whole.later_from_earlier, alone.later_from_earlier, rtol=0, atol=1e-6)
        assert (whole.tracked, whole.inliers) == (alone.tracked, alone.inliers)


def test_pairs_of_several_sizes_keep_their_order(engine, images) -> None:
    views = [engine.prepare(image) for image in images]
    small = [engine.prepare(image[:150, :200]) for image in images]
    mixed = engine.register([(views[0], views[1]), (small[0], small[1]), (views[1], views[2])])
    apart = [engine.register([pair])[0] for pair in ((views[0], views[1]), (small[0], small[1]), (views[1], views[2]))]
    for one, other in zip(mixed, apart, strict=True):
        np.testing.assert_allclose(one.later_from_earlier, other.later_from_earlier, rtol=0, atol=1e-6)
        assert one.tracked == other.tracked


def test_windows_at_once_give_what_one_at_a_time_gives(engine, images) -> None:
    views = [engine.prepare(image) for image in images]
    odd = Window(views[0], tuple(views[1:4]), np.stack([np.eye(3)] * 3), (1, 2, 3), ((0, 1),), (1, 2), (0, 2))
    asked = [around(views, 1), odd, around(views, 2), around(views, 4)]
    for whole, one in zip(engine.foreground(asked), asked, strict=True):
        (alone,) = engine.foreground([one])
        for name in ("core", "evidence", "wide", "texture"):
            np.testing.assert_array_equal(getattr(whole, name), getattr(alone, name))
        assert (whole.small is None) == (alone.small is None) == (one.small is None)
        assert whole.offsets == alone.offsets


def test_a_frame_is_worked_on_once_however_many_pairs_it_is_in(engine, images) -> None:
    views = [engine.prepare(image) for image in images[:3]]
    engine.register([(views[0], views[1])])
    before = views[1].kept["pyramid"]
    engine.register([(views[1], views[2])])
    assert views[1].kept["pyramid"] is before


def test_an_image_shifted_by_whole_pixels_is_registered_as_that_shift(engine, images) -> None:
    grey = engine.prepare(images[0]).grey
    pair = engine.prepare(grey[:180, :240].copy()), engine.prepare(grey[5:185, 9:249].copy())
    (step,) = engine.register([pair])
    assert step.reliable
    # Points at the border follow what is mirrored there: a little is lost to them.
    assert corner_error(step.later_from_earlier, np.array([[1, 0, -9], [0, 1, -5], [0, 0, 1]]), (240, 180)) < 0.3
    assert step.flow_px == pytest.approx(np.hypot(9, 5), abs=0.1)


def test_a_change_of_light_alone_shows_nothing(engine, images) -> None:
    grey = (images[0][..., 0] * 0.7).astype(np.uint8)
    darker, lighter = ((grey * gain).round().astype(np.uint8) for gain in (0.8, 1.2))
    views = [engine.prepare(picture) for picture in (darker, grey, lighter)]
    assert not engine.foreground([around(views, 1)])[0].core.any()


def test_nothing_asked_nothing_given(engine) -> None:
    assert engine.register([]) == [] and engine.foreground([]) == []


@pytest.mark.parametrize("shape", [(9, 200), (30, 30), (1, 1)])
def test_frames_smaller_than_a_cell_are_unreliable_and_break_nothing(engine, shape) -> None:
    random = np.random.default_rng(0)
    views = [engine.prepare(random.integers(0, 255, shape).astype(np.uint8)) for _ in range(3)]
    (step,) = engine.register([(views[0], views[1])])
    assert not step.reliable and "keypoints" in step.cause
    assert engine.foreground([around(views, 1)])[0].core.shape == shape
