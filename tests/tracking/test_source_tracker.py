"""The source's affinities, gate, dispersion and tracker, with its failures."""

from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from torchvision_dddas.config import PaperParameters, Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking import source_tracker
from torchvision_dddas.tracking.source_tracker import (
    Feature,
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


def at(*centres: tuple[float, float]) -> Detections:
    box = np.array([(u - 10, v - 20, 20, 40) for u, v in centres], float).reshape(-1, 4)
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


MISSED = [at((50, 50), (600, 500)), at((600, 500)), at((50, 52), (600, 500))]
LEAVING = [at((100, 100), (400, 300)), at((105, 100), (410, 300)), at((110, 100), (420, 300)), at((115, 105))]
SHUFFLED = [at((100, 100), (400, 300)), at((410, 300), (105, 100)), at((110, 100), (420, 300))]


@pytest.mark.parametrize(
    ("values", "linked"),
    [({"window": 2}, True), ({}, True), ({"dummy": "zero"}, False), ({"dummy": "real_pair"}, True)],
)
def test_a_target_that_enters_in_the_middle_frame_is_linked_unless_a_dummy_is_worth_nothing(values, linked):
    # Its true link with the dummy before is worth 0 then, and false ones, at least 0.6, keep the gate from raising it.
    entering = [at((300, 200)), at((310, 200), (500, 300)), at((320, 200), (510, 300))]
    _, before, last = tracked(entering, **values)
    assert (before[1] == last[1]) is linked


@pytest.mark.parametrize(
    ("frames", "values", "last"),
    [
        (SHUFFLED, {"window": 2}, [1, 2]),
        (SHUFFLED, {"window": 3}, [1, 2]),
        (MISSED, {"window": 2}, [3, 2]),
        (MISSED, {"window": 3}, [1, 2]),  # three frames bridge one that missed a target
        # The true triplet is worth 1, but each false one leaves two dummies worth 0.6 behind.
        (LEAVING, {"dummy": "zero"}, [3]),
        (LEAVING, {"dummy": "zero", "gate": "off"}, [1]),
        (LEAVING, {}, [1]),
        (LEAVING, {"dummy": "real_pair"}, [1]),
        (LEAVING, {"window": 2}, [1]),
    ],
)
def test_identities_after_frames_in_disorder_a_miss_and_a_target_that_leaves(frames, values, last):
    found = tracked(frames, **values)
    assert found[0] == [1, 2]
    assert found[-1] == last


@pytest.mark.parametrize(
    ("frame", "levels", "values", "weight", "cause"),
    [
        (at((20, 40), (100, 100), (400, 300)), None, {}, 1.0, "dispersion of locations 1.000, above 0.65"),
        (at((400, 300), (404, 300)), (1, 200), {}, 0.0, "locations 0.000, of appearances 1.000: only the latter above"),
        (at((400, 300), (404, 300)), (9, 9), {}, 0.5, "locations 0.000, of appearances 0.000: neither above 0.65"),
        (at((400, 300), (404, 300)), None, {}, 1.0, "locations 0.000, not above 0.65, but a frame has no picture"),
        (at((400, 300), (404, 300)), (9, 9), {"rule": "fixed", "weight": 0.7}, 0.7, "paper.rule is fixed"),
    ],
)
def test_each_association_says_its_weight_its_dispersions_and_why(frame, levels, values, weight, cause):
    tracker = SourceTracker(with_parameters(Settings(), {f"paper.{k}": v for k, v in values.items()}), 1)
    pictures = coloured(*levels) if levels else None
    (first,), (use,) = ([t.appearance for t in tracker.feed(n, frame, None, pictures)] for n in (1, 2))
    assert first is None and use is not None  # one frame alone has nothing to link
    assert cause in use.cause and (use.weight, use.looked) == (weight, weight < 1)
    assert use.location_dispersion == (1.0 if len(frame) == 3 else 0.0)
    assert np.isfinite(use.appearance_dispersion) == ("of appearances" in cause)


def test_histograms_are_computed_only_once_and_only_where_targets_are_close():
    scattered, close = at((20, 40), (100, 100), (400, 300)), at((400, 300), (404, 300), (100, 100))
    tracked([scattered] * 4, [never] * 4)
    histograms = [Mock(side_effect=coloured(1, 2, 3)) for _ in range(4)]
    tracked([scattered, scattered, close, close], histograms)
    assert [histogram.call_count for histogram in histograms] == [1] * 4
    features = Features(at((400, 300), (404, 300)).box_px, lambda: np.zeros((2, 240)))
    with pytest.raises(InputError, match=r"\(2, 768\).*got \(2, 240\)"):
        features.histogram("channel")


@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 1000), st.floats(0.1, 0.9))
@settings(max_examples=60, deadline=None)
def test_pairs_are_the_best_of_all_assignments_with_the_dummy(count, older, seed, threshold):
    score = np.pad(np.random.default_rng(seed).random((count, older)), ((1, 0), (1, 0)))
    gated = gate(score, threshold, "one_dummy")
    np.testing.assert_array_equal(gated[1:, 1:], score[1:, 1:])
    found = assign(score, None, 1.0, parameters(window=2, threshold=threshold))
    for axis, size in enumerate((count, older)):
        assert sorted(found[found[:, axis] > 0, axis]) == list(range(1, size + 1))
    # One dummy a target of the other frame makes the assignment a square one.
    square = np.zeros((count + older, count + older))
    square[:count, :older], square[:count, older:], square[count:, :older] = gated[1:, 1:], gated[1:, :1], gated[:1, 1:]
    rows, columns = linear_sum_assignment(square, maximize=True)
    assert gated[tuple(found.T)].sum() == pytest.approx(square[rows, columns].sum())


@pytest.mark.parametrize("window", [2, 3])
@pytest.mark.parametrize("counts", [[0, 0, 0, 0], [1, 1, 1, 1, 1], [0, 1, 0, 2]])
def test_empty_frames_one_target_and_two_identical_boxes(counts, window):
    frames = [at(*[(50, 50)] * count) for count in counts]
    found = tracked(frames, [coloured(*range(n)) if n else never for n in counts], window=window)
    assert [len(identities) for identities in found] == counts
    assert counts[0] == 0 or found == [[1]] * len(frames)


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


@pytest.mark.parametrize(
    ("gating", "most", "sizes"),
    [("off", 1, [3] * 5), ("off", 12, [3] * 5), ("every_dummy", 12, [1] * 15)],  # alone 3 · 0.6 beats a triplet's 0.99
)
def test_three_frames_of_obvious_targets(gating, most, sizes):
    score = np.pad(0.89 * np.eye(5)[:, :, None] * np.eye(5) + 0.1, ((1, 0),) * 3)
    found = assign(score, None, 1.0, parameters(exact_targets=most, gate=gating))
    assert (found > 0).sum(axis=1).tolist() == sizes
    assert gating != "off" or found.tolist() == [[k] * 3 for k in range(1, 6)]


def test_the_dummy_by_words_and_by_formula():
    a, b, c = (np.array([row], float) for row in ([4, 1], [2, 3], [1, 5]))
    words, formula = (source_tracker.affinity([a, b, c], parameters(dummy=d)) for d in ("zero", "formula"))
    assert words[1, 1, 1] == formula[1, 1, 1] == pytest.approx(7 / 14)
    assert words.sum() == words[1, 1, 1]
    # A vector of zeros adds nothing above and the other vector below the line: (2 + 1 + 0) / (4 + 3 + 5) and so on.
    assert formula[1, 1, 0] == pytest.approx((2 + 1) / (4 + 3 + 5))
    assert formula[0, 1, 1] == pytest.approx((1 + 3) / (5 + 2 + 5))
    assert formula[1, 0, 1] == formula[0, 0, 0] == formula[0, 0, 1] == formula[0, 1, 0] == 0
    assert not source_tracker.affinity([a, b], PaperParameters())[0].any()


@pytest.mark.parametrize("gated", ["features", "affinity"])
def test_false_pairs_do_not_win_where_the_gate_raises_only_real_ones(gated: str):
    # Two true triplets are worth 2 · 0.85; three false pairs with a dummy, 3 · 0.6.
    score = np.zeros((3, 3, 3))
    score[1:, 1:, 1:] = 0.1
    score[1, 1, 1] = score[2, 2, 2] = 0.85
    true, knobs = np.full((2, 2), 0.1) + 0.75 * np.eye(2), parameters(histogram_scale=1.0, gated=gated)
    assert (assign(None, score, 0.0, knobs) == 0).any()
    for location, weight in ((None, 0.0), (score, 0.5)):
        pairs: dict[Feature, list[np.ndarray]] = {"location": [true, true], "appearance": [true, true]}
        found = assign(location, score, weight, knobs, pairs)
        assert found.tolist() == [[1, 1, 1], [2, 2, 2]]
    # The second target is in the two newest frames only: its real pair is raised.
    score[2, 2, 2] = 0.1
    pairs = {"appearance": [true, np.array([[0.85, 0.1], [0.1, 0.1]])]}
    assert assign(None, score, 0.0, knobs, pairs).tolist() == [[0, 0, 2], [1, 1, 1], [2, 2, 0]]


def test_real_pairs_are_those_of_three_frames_and_scaled_as_histograms_are():
    a, b, c = (np.array([row], float) for row in ([4, 1], [2, 3], [1, 5]))
    knobs = parameters(dummy="real_pair", histogram_scale=0.5)
    newer, older = source_tracker.real_pairs([a, b, c], knobs, "location")
    assert (newer.item(), older.item()) == pytest.approx((3 / 7, 4 / 7))
    newer, older = source_tracker.real_pairs([a, b, c], knobs, "appearance")
    assert (newer.item(), older.item()) == pytest.approx((1 - 0.5 * 4 / 7, 1 - 0.5 * 3 / 7))
    assert source_tracker.real_pairs([a, b], knobs, "location") == []
    assert source_tracker.real_pairs([a, b, c], parameters(), "location") == []


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


@pytest.mark.parametrize(
    ("reading", "same", "differ"),
    [("smallest", 0.4, 0.4), ("newest", 0.9, 0.9), ("smallest_if_counts_differ", 0.9, 0.4)],
)
def test_the_dispersion_of_a_window_by_each_reading(reading, same, differ):
    for counts, wanted in (([3, 3], same), ([3, 4], differ)):
        assert min([0.9, 0.4][: frames_considered(counts, parameters(dispersion_of=reading))]) == wanted


def test_clusters_end_at_chi_squared_quantiles_relative_to_those_of_one_in_ten_thousand():
    # beta = 0.1, two dimensions of a location and three colours (appendix C, III-E).
    for cut, dimensions in ((PaperParameters().location_cut, 2), (PaperParameters().appearance_cut, 3)):
        assert cut == pytest.approx(chi2.ppf(0.9, dimensions) / chi2.ppf(0.9999, dimensions), abs=5e-4)


@pytest.mark.parametrize("shape", [(3, 4), (3, 2, 4)])
def test_scaling_brings_histograms_of_real_targets_closer_and_leaves_the_dummys_entries(shape):
    score = np.random.default_rng(0).uniform(0, 1, shape)
    scaled, real = source_tracker.scale_histograms(score, 0.5), np.index_exp[1:] * len(shape)
    np.testing.assert_allclose(1 - scaled[real], 0.5 * (1 - score[real]))
    scaled[real] = score[real]
    np.testing.assert_array_equal(scaled, score)


def test_a_link_of_half_alike_histograms_passes_the_threshold_only_where_dissimilarities_are_scaled():
    appearance = np.zeros((2, 2))
    appearance[1, 1] = 0.5
    rows = [assign(None, appearance, 0.0, parameters(window=2, histogram_scale=s)).tolist() for s in (0.5, 1.0)]
    assert rows == [[[1, 1]], [[0, 1], [1, 0]]]


@pytest.mark.parametrize("rule", ["dispersion", "fixed"])
def test_without_something_to_link_nothing_is_decided(rule):
    tracker = SourceTracker(with_parameters(Settings(), {"paper.rule": rule}), 1)
    one = Detections(np.array([[10.0, 10, 20, 40]]), np.ones(1))
    none = Detections(np.zeros((0, 4)), np.zeros(0))
    fed = [tracker.feed(n, given, None, None) for n, given in enumerate((none, none, one, none, none, none, one), 1)]
    assert [settled[0].appearance for settled in fed] == [None] * 7


@pytest.mark.parametrize(("window", "is_refused"), [(3, True), (2, False)])
def test_more_targets_than_the_memory_of_a_window_allows_are_refused_before_they_are_compared(window, is_refused):
    tracker = source_tracker.SourceTracker(with_parameters(Settings(), {"paper.window": window}), 1)
    box_px = np.stack([*np.divmod(np.arange(300), 20), np.full(300, 0.5), np.full(300, 0.5)], axis=1) * 20.0
    detections = Detections(box_px, *np.ones((4, 300)))
    for frame in (1, 2):
        tracker.feed(frame, detections)
    if is_refused:
        with pytest.raises(
            InputError, match=r"paper.window = 3 with 300 targets in a frame has 27,270,901 combinations"
        ):
            tracker.feed(3, detections)
    else:
        assert len(tracker.feed(3, detections)[0].identity) == 300
