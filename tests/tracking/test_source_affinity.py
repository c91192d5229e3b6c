"""The source's affinities, gate and dispersion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.config import PaperParameters
from torchvision_dddas.tracking import source_affinity
from torchvision_dddas.tracking.dual_ascent import assign_triplets
from torchvision_dddas.tracking.source_affinity import (
    clusters,
    dispersion,
    frames_considered,
    gate,
    location_weight,
    normalized_entropy,
)


def exact(score):
    return assign_triplets(score, gap=0.0, most_exact=None).triplets


def test_a_hundred_pixels_apart_count_less_the_farther_from_the_corner():
    """A defect of the source: absolute pixels make the affinity depend on where in the picture two targets stand."""
    step = np.array([[100.0, 0.0]])
    found = [
        float(source_affinity.similarity(at, at + step)[0, 0])
        for at in (np.array([[0.0, 50.0]]), np.array([[400.0, 300.0]]))
    ]
    assert found == pytest.approx([50 / 150, 0.875])


def test_normalised_channels_add_up_to_one_and_an_empty_box_stays_empty():
    counts = np.zeros((2, 768))
    counts[0, [3, 300, 600]] = 1, 5, 20
    counts[0, 4] = 3
    shares = source_affinity.normalize_channels(counts)
    assert shares[0, [3, 4, 300, 600]].tolist() == [0.25, 0.75, 1, 1]
    assert not shares[1].any()
    assert source_affinity.normalize_channels(np.zeros((0, 768))).shape == (0, 768)


def test_the_dummy_by_words_and_by_formula():
    a, b, c = (np.array([row], float) for row in ([4, 1], [2, 3], [1, 5]))
    words, formula = source_affinity.triplet_affinity(a, b, c), source_affinity.triplet_affinity(a, b, c, "formula")
    assert words[1, 1, 1] == formula[1, 1, 1] == pytest.approx(7 / 14)
    assert words.sum() == words[1, 1, 1]
    # A vector of zeros adds nothing above and the other vector below the line: (2 + 1 + 0) / (4 + 3 + 5) and so on.
    assert formula[1, 1, 0] == pytest.approx((2 + 1) / (4 + 3 + 5))
    assert formula[0, 1, 1] == pytest.approx((1 + 3) / (5 + 2 + 5))
    assert formula[1, 0, 1] == formula[0, 0, 0] == formula[0, 0, 1] == formula[0, 1, 0] == 0
    assert not source_affinity.pair_affinity(a, b)[0].any()


def test_turning_on_the_spot_scores_as_well_as_going_straight_on():
    """A defect of eq. 4: newest and oldest are never compared, so a triplet is worth what its two links are."""
    newest, middle = np.array([[390.0, 300.0]]), np.array([[400.0, 300.0]])
    oldest = np.array([[410.0, 300.0], [390.0, 300.0]])
    straight, back = source_affinity.triplet_affinity(newest, middle, oldest)[1, 1, 1:]
    assert straight == pytest.approx((690 + 700) / (700 + 710))
    assert back == pytest.approx((690 + 690) / (700 + 700))
    assert abs(straight - back) < 3e-4


def padded(real: np.ndarray) -> np.ndarray:
    return np.pad(real, [(1, 0)] * real.ndim)


def test_a_pair_by_hand():
    # Row 2 and column 1 have nothing of 0.6 or more.
    score = padded(np.array([[0.3, 0.7], [0.5, 0.2]]))
    wanted = score.copy()
    wanted[2, 0] = wanted[0, 1] = 0.6
    np.testing.assert_allclose(gate(score, 0.4, "one_dummy"), wanted)


def test_a_triplet_by_hand():
    score = padded(np.array([[[0.3, 0.7]], [[0.5, 0.2]]]))
    gated = gate(score, 0.4, "one_dummy")
    assert gated[0, 1].tolist() == pytest.approx([0, 0.6, 0])  # over i: 0.5 is below, 0.7 is not
    assert gated[1:, 1, 0].tolist() == pytest.approx([0, 0.6])  # over k: 0.7 is not, 0.5 is
    assert gated[1:, 0, 1:].ravel().tolist() == pytest.approx([0.6, 0, 0.6, 0.6])  # over j, which is one target


@pytest.mark.parametrize("shape", [(3, 4), (3, 4, 2)])
def test_off_raises_nothing_and_no_reading_touches_real_entries_or_the_dummies_own(shape):
    score = padded(np.random.default_rng(0).random(shape) * 0.5)
    np.testing.assert_array_equal(gate(score, 0.4, "off"), score)
    for reading in ("one_dummy", "every_dummy"):
        gated = gate(score, 0.4, reading)
        inside = (slice(1, None),) * len(shape)
        np.testing.assert_array_equal(gated[inside], score[inside])
        assert gated[(0,) * len(shape)] == 0


def test_to_the_letter_entries_with_two_dummies_are_raised_too():
    score = padded(np.full((2, 2, 2), 0.9))
    dummies = (np.indices(score.shape) == 0).sum(axis=0)
    assert (gate(score, 0.4, "every_dummy")[dummies == 2] == 0.6).all()
    assert (gate(score, 0.4, "one_dummy")[dummies == 2] == 0).all()


def test_to_the_letter_the_best_assignment_leaves_everybody_alone():
    """Five targets that no one could mistake: each alone earns 0.6, three of them 1.8, their triplet at most 1."""
    real = np.full((5, 5, 5), 0.1)
    real[np.arange(5), np.arange(5), np.arange(5)] = 0.99
    found = exact(gate(padded(real), 0.4, "every_dummy"))
    assert (found > 0).sum(axis=1).tolist() == [1] * 15
    right = exact(gate(padded(real), 0.4, "off"))
    np.testing.assert_array_equal(right, np.repeat(np.arange(1, 6), 3).reshape(5, 3))


def test_three_dummy_triplets_beat_two_true_ones_below_0_9():
    """Two targets, all seen thrice, alike by s in truth and not at all otherwise: three links at 0.6 are worth 1.8."""

    def best(s: float) -> list[list[int]]:
        real = np.zeros((2, 2, 2))
        real[0, 0, 0] = real[1, 1, 1] = s
        # The false triplets' best alternative lies below 0.6, so their entries with one dummy are raised.
        return exact(gate(padded(real), 0.4, "one_dummy")).tolist()

    assert best(0.95) == [[1, 1, 1], [2, 2, 2]]
    assert len(best(0.85)) == 3
    assert all(0 in row for row in best(0.85))


def never() -> float:
    raise AssertionError("appearance was computed")


def test_average_linkage_by_hand():
    # 0 and 1 join at 0.1; their mean distance to 2 is (0.3 + 0.5) / 2 = 0.4
    apart = np.array([[0, 0.1, 0.3], [0.1, 0, 0.5], [0.3, 0.5, 0]])
    assert len(set(clusters(apart, 0.05))) == 3
    assert len(set(clusters(apart, 0.39))) == 2
    assert len(set(clusters(apart, 0.41))) == 1


@pytest.mark.parametrize(
    ("cluster", "wanted"),
    [
        ([1, 2, 3, 4], 1.0),
        ([1, 1, 1, 1], 0.0),
        ([1, 1, 2, 2], 0.5),
        ([1, 1, 1, 2], (0.75 * np.log2(4 / 3) + 0.25 * 2) / 2),
        ([1], 1.0),
        ([], 1.0),
    ],
)
def test_normalized_entropy_by_hand(cluster, wanted):
    assert normalized_entropy(np.array(cluster, int)) == pytest.approx(wanted)


def test_targets_side_by_side_are_less_dispersed_than_scattered_ones():
    close = np.array([[100, 100], [104, 100], [400, 300], [404, 300]], float)
    scattered = np.array([[20, 30], [100, 100], [400, 300], [700, 500]], float)
    assert dispersion(close, 0.25) == 0.5
    assert dispersion(scattered, 0.25) == pytest.approx(1.0)


@given(st.integers(0, 1000), st.integers(2, 12), st.floats(0.05, 0.5))
@settings(max_examples=40, deadline=None)
def test_dispersion_does_not_depend_on_the_order_of_targets(seed, count, cut):
    random = np.random.default_rng(seed)
    feature = random.random((count, 2)) * 500
    assert dispersion(feature[random.permutation(count)], cut) == pytest.approx(dispersion(feature, cut))


@pytest.mark.parametrize(
    ("location", "appearance", "weight"), [(0.9, None, 1.0), (0.65, 0.9, 0.0), (0.3, 0.65, 0.5), (0.0, 0.0, 0.5)]
)
def test_the_weight_rule(location, appearance, weight):
    assert location_weight(location, never if appearance is None else lambda: appearance, 0.65) == (weight, appearance)


def test_each_reading_of_the_window_is_its_own():
    values, same, differ = [0.9, 0.4], [3, 3], [3, 4]
    for reading, wanted in (
        ("smallest", (0.4, 0.4)),
        ("newest", (0.9, 0.9)),
        ("smallest_if_counts_differ", (0.9, 0.4)),
    ):
        parameters = PaperParameters.model_validate({"dispersion_of": reading})
        assert tuple(min(values[: frames_considered(counts, parameters)]) for counts in (same, differ)) == wanted
