import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import bgr_to_hsv, within_ranges
from torchvision_dddas.geo.colours import mask_colours
from torchvision_dddas.lab.tuning.colours import SoftColours, fit_colours, start_ranges

NAMES, PAINT = ("red", "green"), {1: (178, 190, 190), 2: (62, 150, 150)}


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A ground of olive and rust, which is near both paints, with a patch of each paint in light and shade."""
    rng = np.random.default_rng(seed)
    hsv = np.empty((60, 80, 3))
    left = np.arange(80)[None] < 40
    hsv[...] = np.where(left[..., None], (42, 90, 110), (10, 130, 120))
    labels = np.zeros((60, 80), np.int64)
    for k, paint in PAINT.items():
        u, v = rng.integers(5, 60), rng.integers(5, 20) + 30 * (k - 1)
        hsv[v : v + 8, u : u + 14], labels[v : v + 8, u : u + 14] = paint, k
    hsv += rng.normal(0, (4, 18, 25), hsv.shape)
    hsv[..., 0] %= 180
    hsv[..., 1:] = hsv[..., 1:].clip(0, 255)
    return cv2.cvtColor(np.round(hsv).clip(0, 255).astype(np.uint8), cv2.COLOR_HSV2BGR), labels


def f(colours, seeds) -> float:
    """Mean F of the colours' pixels, by the onboard finder."""
    counts = np.zeros((2, 2))
    for picture, labels in map(scene, seeds):
        for k, mask in enumerate(mask_colours(picture, colours.low, colours.high) > 0):
            true = labels == k + 1
            counts[k] += 2 * (mask & true).sum(), mask.sum() + true.sum()
    return float((counts[:, 0] / counts[:, 1]).mean())


def test_tuned_ranges_find_colours_in_pictures_not_tuned_on():
    pictures, labels = zip(*(scene(seed) for seed in range(4)), strict=True)
    before, after = (fit_colours(pictures, labels, NAMES, steps=steps) for steps in (0, 80))
    held_out = range(100, 104)
    assert f(after, held_out) > max(f(before, held_out) + 0.05, 0.9)
    assert after.low[0, 0] > after.high[0, 0]  # red goes over 0
    assert after.names == NAMES


def test_ranges_may_begin_where_others_ended():
    pictures, labels = zip(*(scene(seed) for seed in range(2)), strict=True)
    once = fit_colours(pictures, labels, NAMES, steps=5)
    assert fit_colours(pictures, labels, NAMES, steps=0, start=once).low.tolist() == once.low.tolist()
    with pytest.raises(InputError, match="wanted green, red"):
        fit_colours(pictures, labels, ("green", "red"), start=once)


def test_colours_that_pictures_do_not_tell_apart_are_refused():
    picture, labels = scene(0)
    v, u = np.nonzero(labels == 1)
    labels[v[: len(v) // 2], u[: len(v) // 2]] = 2
    labels[labels == 2] = np.where(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)[labels == 2][:, 0] > 100, 2, 0)
    with pytest.raises(InputError, match="come out overlapping"):
        fit_colours([picture], [labels], NAMES, steps=5)


@pytest.mark.parametrize(
    ("picture", "labels", "words"),
    [
        (np.zeros((4, 5), np.uint8), np.zeros((4, 5), int), "wanted height x width x 3"),
        (np.zeros((4, 5, 3), np.uint8), np.zeros((5, 4), int), "labels of that size"),
        (np.zeros((4, 5, 3), np.uint8), np.full((4, 5), 3), "labels go from 3 to 3; wanted 0 to 2"),
        (np.zeros((4, 5, 3), np.uint8), np.full((4, 5), 1), "no pixel is labelled with colour 2"),
    ],
)
def test_bad_labels_are_refused_in_one_line(picture, labels, words):
    with pytest.raises(InputError, match=words):
        fit_colours([picture], [labels], NAMES)


LOW, HIGH = torch.tensor([[172, 90, 60], [50, 100, 40]]), torch.tensor([[8, 255, 255], [70, 200, 250]])


def test_hard_colours_are_those_of_the_operation_and_ranges_come_out_as_they_went_in():
    assert [bound.tolist() for bound in SoftColours(LOW, HIGH).ranges()] == [LOW.tolist(), HIGH.tolist()]
    bgr = torch.as_tensor(np.random.default_rng(0).uniform(0, 1, (1, 3, 40, 50)))
    wanted = within_ranges(bgr_to_hsv(bgr), LOW.double(), HIGH.double())
    assert 0 < float(wanted.mean()) < 1
    torch.testing.assert_close(SoftColours(LOW, HIGH)(bgr, 0.0).detach(), wanted)


def test_a_range_begins_about_the_patch_s_own_colour_even_across_red():
    hues = torch.tensor([[0.0, 0.02, 0.9], [0.02, 0.0, 0.9]])  # a little to either side of red
    low, high = start_ranges(hues.T.reshape(1, 3, 1, 2), torch.ones(1, 1, 1, 2)).ranges()
    assert low[0, 0] > 160 and high[0, 0] < 20
