"""The affinities of one window without torch; tests/ops/test_affinity.py holds them against the batched ones."""

import numpy as np
import pytest

from torchvision_dddas.tracking import jaccard


def test_a_hundred_pixels_apart_count_less_the_farther_from_the_corner():
    """A defect of the source: absolute pixels make the affinity depend on where in the picture two targets stand."""
    step = np.array([[100.0, 0.0]])
    found = [
        float(jaccard.similarity(at, at + step)[0, 0]) for at in (np.array([[0.0, 50.0]]), np.array([[400.0, 300.0]]))
    ]
    assert found == pytest.approx([50 / 150, 0.875])


def test_the_centre_of_a_box_is_cut_at_the_corner():
    centres = jaccard.centres(np.array([[10, 20, 30, 40], [-50, 20, 30, 40]], float))
    assert centres.tolist() == [[25, 40], [0, 40]]


def test_normalised_channels_add_up_to_one_and_an_empty_box_stays_empty():
    counts = np.zeros((2, 768))
    counts[0, [3, 300, 600]] = 1, 5, 20
    counts[0, 4] = 3
    shares = jaccard.per_channel(counts)
    assert shares[0, [3, 4, 300, 600]].tolist() == [0.25, 0.75, 1, 1]
    assert not shares[1].any()
    assert jaccard.per_channel(np.zeros((0, 768))).shape == (0, 768)


def test_the_dummy_by_words_and_by_formula():
    a, b, c = (np.array([row], float) for row in ([4, 1], [2, 3], [1, 5]))
    words, formula = jaccard.triplets(a, b, c), jaccard.triplets(a, b, c, "formula")
    assert words[1, 1, 1] == formula[1, 1, 1] == pytest.approx(7 / 14)
    assert words.sum() == words[1, 1, 1]
    # A vector of zeros adds nothing above and the other vector below the line: (2 + 1 + 0) / (4 + 3 + 5) and so on.
    assert formula[1, 1, 0] == pytest.approx((2 + 1) / (4 + 3 + 5))
    assert formula[0, 1, 1] == pytest.approx((1 + 3) / (5 + 2 + 5))
    assert formula[1, 0, 1] == formula[0, 0, 0] == formula[0, 0, 1] == formula[0, 1, 0] == 0
    assert not jaccard.pairs(a, b)[0].any()


def test_turning_on_the_spot_scores_as_well_as_going_straight_on():
    """A defect of eq. 4: newest and oldest are never compared, so a triplet is worth what its two links are."""
    newest, middle = np.array([[390.0, 300.0]]), np.array([[400.0, 300.0]])
    oldest = np.array([[410.0, 300.0], [390.0, 300.0]])
    straight, back = jaccard.triplets(newest, middle, oldest)[1, 1, 1:]
    assert straight == pytest.approx((690 + 700) / (700 + 710))
    assert back == pytest.approx((690 + 690) / (700 + 700))
    assert abs(straight - back) < 3e-4
