"""The source's affinities, gate, dispersion and tracker, what fails in it included."""

from collections.abc import Callable, Sequence
from itertools import combinations, permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.config import PaperParameters, Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking import source_tracker
from torchvision_dddas.tracking.dual_ascent import assign_triplets
from torchvision_dddas.tracking.source_tracker import (
    Features,
    SourceTracker,
    assign,
    associate,
    frames_considered,
    gate,
    location_weight,
    normalized_entropy,
)
from torchvision_dddas.types import Detections

SIZE = (20.0, 40.0)


def at(*centres: tuple[float, float]) -> Detections:
    box = np.array([(u - SIZE[0] / 2, v - SIZE[1] / 2, *SIZE) for u, v in centres]).reshape(-1, 4)
    return Detections(box, np.ones(len(box)))


def coloured(*levels: int) -> Callable[[], np.ndarray]:
    """One level in each channel a target."""
    counts = np.zeros((len(levels), 3, 256))
    counts[np.arange(len(levels)), :, levels] = 800
    return lambda: counts.reshape(-1, 768)


def never() -> Any:
    raise AssertionError("appearance was computed")


def parameters(**values: object) -> PaperParameters:
    return PaperParameters.model_validate(values)


def tracked(frames: Sequence[Detections], appearance: Sequence | None = None, **values: object) -> list[list[int]]:
    """The identities of each frame's targets."""
    tracker = SourceTracker(with_parameters(Settings(), {f"paper.{k}": v for k, v in values.items()}), 5)
    found = []
    for number, detections in enumerate(frames):
        (tracks,) = tracker.feed(1 + 5 * number, detections, None, appearance[number] if appearance else None)
        assert tracks.frame == 1 + 5 * number
        assert tracks.row.tolist() == list(range(len(detections)))
        found.append(tracks.identity.tolist())
    assert tracker.end() == []
    return found


@pytest.mark.parametrize("window", [2, 3])
def test_targets_keep_their_identities_whatever_order_they_come_in(window):
    frames = [at((100, 100), (400, 300)), at((410, 300), (105, 100)), at((110, 100), (420, 300))]
    assert tracked(frames, window=window) == [[1, 2], [2, 1], [1, 2]]


@pytest.mark.parametrize(("window", "back"), [(2, 3), (3, 1)])
def test_three_frames_bridge_one_that_missed_a_target_two_do_not(window, back):
    frames = [at((50, 50), (600, 500)), at((600, 500)), at((50, 52), (600, 500))]
    assert tracked(frames, window=window)[2] == [back, 2]


def test_histograms_are_not_made_while_targets_are_scattered_and_once_when_they_are_close():
    scattered, close = at((20, 40), (100, 100), (400, 300)), at((400, 300), (404, 300), (100, 100))
    tracked([scattered] * 4, [never] * 4)
    made: list[int] = []

    def counted(number: int) -> Callable[[], np.ndarray]:
        def make() -> np.ndarray:
            made.append(number)
            return coloured(1, 2, 3)()

        return make

    tracked([scattered, scattered, close, close], [counted(n) for n in range(4)])
    assert sorted(made) == [0, 1, 2, 3]


def test_histograms_of_another_shape_are_refused_in_one_line():
    look = Features(at((400, 300), (404, 300)).box_px, lambda: np.zeros((2, 240)))
    with pytest.raises(InputError, match=r"\(2, 768\).*got \(2, 240\)"):
        look.histogram("channel")


@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 1000), st.floats(0.1, 0.9))
@settings(max_examples=60, deadline=None)
def test_pairs_are_the_best_of_all_assignments_with_the_dummy(count, older, seed, threshold):
    score = np.pad(np.random.default_rng(seed).random((count, older)), ((1, 0), (1, 0)))
    gated = gate(score, threshold, "one_dummy")
    found = assign(score, None, 1.0, parameters(window=2, threshold=threshold))
    for axis, size in enumerate((count, older)):
        assert sorted(found[found[:, axis] > 0, axis]) == list(range(1, size + 1))
    best = max(
        sum(gated[i + 1, j + 1] for i, j in zip(some, others, strict=True))
        + sum(gated[i + 1, 0] for i in range(count) if i not in some)
        + sum(gated[0, j + 1] for j in range(older) if j not in others)
        for size in range(min(count, older) + 1)
        for some in combinations(range(count), size)
        for others in permutations(range(older), size)
    )
    assert gated[tuple(found.T)].sum() == pytest.approx(best)


@pytest.mark.parametrize("window", [2, 3])
@pytest.mark.parametrize("frames", [[at()] * 4, [at((50, 50))] * 5, [at(), at((5, 5)), at(), at((5, 5), (5, 5))]])
def test_empty_frames_one_target_for_ever_and_two_identical_boxes(frames, window):
    found = tracked(frames, [never if not len(f) else coloured(*range(len(f))) for f in frames], window=window)
    assert [len(identities) for identities in found] == [len(f) for f in frames]
    if all(len(f) == 1 for f in frames):
        assert found == [[1]] * len(frames)


def test_a_target_that_leaves_takes_the_identity_of_another_with_it():
    """Two stood and one stays: the true triplet is worth 1, but each false one leaves two dummies worth 0.6 behind."""
    frames = [at((100, 100), (400, 300)), at((105, 100), (410, 300)), at((110, 100), (420, 300)), at((115, 105))]
    assert tracked(frames)[-1] == [3]
    assert tracked(frames, gate="off")[-1] == tracked(frames, window=2)[-1] == [1]


def test_without_pictures_location_alone_decides():
    boxes = [at((400, 300), (404, 300)).box_px, at((404, 300), (400, 300)).box_px]
    frames = [Features(box, None) for box in boxes]
    for rule in ("dispersion", "fixed"):
        found = associate(frames, parameters(window=2, rule=rule, weight=0.0))
        assert (found.weight, found.appearance_dispersion) == (1.0, None)
        assert found.rows.tolist() == [[1, 2], [2, 1]]
    seen = [Features(box, coloured(10, 200)) for box in boxes]
    assert associate(seen, parameters(window=2, rule="fixed", weight=0.3)).weight == 0.3


def test_gating_features_or_their_sum_by_hand():
    location, appearance = (np.pad(np.array([[s]]), ((1, 0), (1, 0))) for s in (0.5, 0.9))
    # Features: the pair 0.7 · 0.5 + 0.3 · 0.9 = 0.62 against two dummies at 0.7 · 0.6. The sum: 0.62 is not below 0.6.
    assert assign(location, appearance, 0.7, parameters(window=2)).tolist() == [[0, 1], [1, 0]]
    assert assign(location, appearance, 0.7, parameters(window=2, gated="affinity")).tolist() == [[1, 1]]
    three = np.pad(0.9 * np.eye(3)[:, :, None] * np.eye(3), ((1, 0),) * 3)
    for most in (1, 12):  # by relaxation and exactly
        assert assign(three, None, 1.0, parameters(exact_targets=most, gate="off")).tolist() == [
            [k] * 3 for k in (1, 2, 3)
        ]


def test_the_dummy_by_words_and_by_formula():
    a, b, c = (np.array([row], float) for row in ([4, 1], [2, 3], [1, 5]))
    words, formula = (
        source_tracker.affinity([a, b, c], PaperParameters.model_validate({"dummy": d})) for d in ("zero", "formula")
    )
    assert words[1, 1, 1] == formula[1, 1, 1] == pytest.approx(7 / 14)
    assert words.sum() == words[1, 1, 1]
    # A vector of zeros adds nothing above and the other vector below the line: (2 + 1 + 0) / (4 + 3 + 5) and so on.
    assert formula[1, 1, 0] == pytest.approx((2 + 1) / (4 + 3 + 5))
    assert formula[0, 1, 1] == pytest.approx((1 + 3) / (5 + 2 + 5))
    assert formula[1, 0, 1] == formula[0, 0, 0] == formula[0, 0, 1] == formula[0, 1, 0] == 0
    assert not source_tracker.affinity([a, b], PaperParameters())[0].any()


@pytest.mark.parametrize("shape", [(3, 4), (3, 4, 2)])
def test_off_raises_nothing_and_no_reading_touches_real_entries_or_the_dummies_own(shape):
    score = np.pad(np.random.default_rng(0).random(shape) * 0.5, [(1, 0)] * len(shape))
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
    score = np.pad(real, 1)[:-1, :-1, :-1]
    found = assign_triplets(gate(score, 0.4, "every_dummy"), gap=0.0, most_exact=None).triplets
    assert (found > 0).sum(axis=1).tolist() == [1] * 15
    right = assign_triplets(score, gap=0.0, most_exact=None).triplets
    np.testing.assert_array_equal(right, np.repeat(np.arange(1, 6), 3).reshape(5, 3))


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
