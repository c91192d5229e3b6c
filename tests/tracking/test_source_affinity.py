"""The source's affinities, gate and dispersion."""

import numpy as np
import pytest

from torchvision_dddas.config import PaperParameters
from torchvision_dddas.tracking import source_tracker as source_affinity
from torchvision_dddas.tracking.dual_ascent import assign_triplets
from torchvision_dddas.tracking.source_tracker import (
    frames_considered,
    gate,
    location_weight,
    normalized_entropy,
)


def exact(score):
    return assign_triplets(score, gap=0.0, most_exact=None).triplets


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
    words, formula = (
        source_affinity.affinity([a, b, c], PaperParameters.model_validate({"dummy": d})) for d in ("zero", "formula")
    )
    assert words[1, 1, 1] == formula[1, 1, 1] == pytest.approx(7 / 14)
    assert words.sum() == words[1, 1, 1]
    # A vector of zeros adds nothing above and the other vector below the line: (2 + 1 + 0) / (4 + 3 + 5) and so on.
    assert formula[1, 1, 0] == pytest.approx((2 + 1) / (4 + 3 + 5))
    assert formula[0, 1, 1] == pytest.approx((1 + 3) / (5 + 2 + 5))
    assert formula[1, 0, 1] == formula[0, 0, 0] == formula[0, 0, 1] == formula[0, 1, 0] == 0
    assert not source_affinity.affinity([a, b], PaperParameters())[0].any()


def padded(real: np.ndarray) -> np.ndarray:
    return np.pad(real, [(1, 0)] * real.ndim)


@pytest.mark.parametrize("shape", [(3, 4), (3, 4, 2)])
def test_off_raises_nothing_and_no_reading_touches_real_entries_or_the_dummies_own(shape):
    score = padded(np.random.default_rng(0).random(shape) * 0.5)
    np.testing.assert_array_equal(gate(score, 0.4, "off"), score)
    for reading in ("one_dummy", "every_dummy"):
        gated = gate(score, 0.4, reading)
        inside = (slice(1, None),) * len(shape)
        np.testing.assert_array_equal(gated[inside], score[inside])
        assert gated[(0,) * len(shape)] == 0


def test_to_the_letter_the_best_assignment_leaves_everybody_alone():
    """Five targets that no one could mistake: each alone earns 0.6, three of them 1.8, their triplet at most 1."""
    real = np.full((5, 5, 5), 0.1)
    real[np.arange(5), np.arange(5), np.arange(5)] = 0.99
    found = exact(gate(padded(real), 0.4, "every_dummy"))
    assert (found > 0).sum(axis=1).tolist() == [1] * 15
    right = exact(gate(padded(real), 0.4, "off"))
    np.testing.assert_array_equal(right, np.repeat(np.arange(1, 6), 3).reshape(5, 3))


def never() -> float:
    raise AssertionError("appearance was computed")


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
