"""Histograms of boxes, their similarity, its scores, and when they may decide."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import Settings
from torchvision_dddas.tracking.appearance import (
    SIGNATURE,
    ambiguity,
    appearance_scores,
    blend_histograms,
    similarity,
    strip_histograms,
)

RED, GREEN, BLUE = (0, 0, 200), (0, 200, 0), (200, 0, 0)
GROUND = (110, 120, 115)


def picture(*people: tuple[tuple[int, int, int, int], tuple[int, int, int], tuple[int, int, int]]) -> np.ndarray:
    """A (200, 300, 3) picture with people of a box, a colour above and a colour below."""
    image = np.full((200, 300, 3), GROUND, np.uint8)
    for (x, y, width, height), above, below in people:
        image[y : y + height // 2, x : x + width] = above
        image[y + height // 2 : y + height, x : x + width] = below
    return image


BOX = (100, 40, 40, 120)
NOISE = np.random.default_rng(0).integers(0, 256, (200, 300, 3), np.uint8)
KNOBS = Settings().track
UNKNOWN = np.zeros(12)


def histograms(count: int) -> np.ndarray:
    """(N, 12) histograms of sum 1."""
    some = np.random.default_rng(0).random((count, 12)) ** 4
    return some / some.sum(axis=1, keepdims=True)


def test_histograms_of_boxes_outside_are_zero_and_of_boxes_cut_off_have_sum_one():
    outside = [(-50, 10, 40, 80), (300, 10, 40, 80), (10, -90, 40, 80), (10, 200, 40, 80)]
    cut = [(-20, 40, 40, 120), (0, 150, 40, 120), (-100, -100, 600, 600)]
    found = strip_histograms(NOISE, np.array(outside + cut, float))
    assert found.dtype == np.float32 and not found[:4].any() and (found >= 0).all()
    np.testing.assert_allclose(found[4:].sum(axis=1), 1, rtol=1e-5)


def test_a_target_cut_off_by_the_border_is_similar_to_itself():
    """The visible part is compared in its place in the whole box, not stretched to one."""
    image = picture((BOX, RED, BLUE), ((200, 40, 40, 120), GREEN, BLUE))
    whole, other = strip_histograms(image, np.array([BOX, (200, 40, 40, 120)], float))
    cut = strip_histograms(image[:, 115:], np.array([(-15, *BOX[1:])], float))[0]
    low = strip_histograms(image[:130], np.array([BOX], float))[0]
    alike = np.sqrt([whole, cut, low, other]) @ np.sqrt(whole)
    assert alike[0] == pytest.approx(1, abs=1e-5)
    assert alike[1:3].min() > 0.98 and alike[3] < 0.8


def test_a_grey_picture_equals_one_without_colour():
    grey, boxes = cv2.cvtColor(NOISE, cv2.COLOR_BGR2GRAY), np.array([(10, 10, 20, 50), (150, 150, 3, 2)], float)
    found = strip_histograms(grey, boxes)
    assert found.shape == (2, SIGNATURE)
    np.testing.assert_array_equal(found, strip_histograms(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), boxes))


def test_the_score_grows_with_the_similarity_and_the_visible_share_and_is_zero_if_unknown():
    one, two = histograms(2)
    alike = similarity(np.stack([one, UNKNOWN]), np.stack([one, (one + two) / 2, two, two, two, UNKNOWN]))
    score = appearance_scores(alike, np.array([1, 1, 1, 0.4, 0, 1]), KNOBS)
    assert score[0, 0] == pytest.approx(KNOBS.appearance_weight * (1 - KNOBS.appearance_offset))
    assert score[0, 0] > score[0, 1] > score[0, 2]
    assert abs(score[0, 2]) > abs(score[0, 3]) > abs(score[0, 4]) == 0
    assert score[0, 5] == 0 and not score[1].any()


BOTH = histograms(2)


@pytest.mark.parametrize(
    ("links", "known", "ambiguous"),
    [
        ([[9.0, -90], [-90, 9.0]], BOTH, False),
        ([[9.0, 8.5], [-90, -90]], BOTH, True),  # a track with two likely links
        ([[9.0, -90], [8.5, -90]], BOTH, True),  # a detection with two
        ([[9.0, -90], [-90, 9.0]], BOTH[:, :0], True),  # a track with a link has no histogram yet
        ([[9.0, -90], [-90, 9.0]], BOTH * [[1], [0]], True),
        ([[9.0, -90], [-90, -90]], BOTH * [[1], [0]], False),
    ],
)
def test_links_are_ambiguous_with_two_likely_ones_or_without_a_histogram(links, known, ambiguous):
    assert bool(ambiguity(np.array(links), known)) == ambiguous


def test_the_first_histogram_is_taken_whole_and_an_unknown_one_changes_nothing():
    one, none, hits = histograms(1), UNKNOWN[None], np.array([4])
    for visible in (np.array([0.1]), np.ones(1)):
        np.testing.assert_array_equal(blend_histograms(none, one, visible, hits), one)
        np.testing.assert_array_equal(blend_histograms(one, none, visible, hits), one)
        np.testing.assert_array_equal(blend_histograms(none, none, visible, hits), none)
