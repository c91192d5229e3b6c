"""Measures of pixels, boxes, ranked boxes and places on the ground, and which found boxes count."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.lab.evaluation.metrics import boxes, metres, pixels
from torchvision_dddas.lab.evaluation.metrics.boxes import RATES, BoxCounts, OneTarget, judged
from torchvision_dddas.lab.evaluation.metrics.matching import counted, pair
from torchvision_dddas.lab.evaluation.metrics.pixels import Pixels
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, TrackTable


def test_pixels_by_hand():
    assert pixels.count(np.array([[0, 3, 3], [0, 0, 1]]), np.array([[0, 7, 0], [7, 0, 7]])) == Pixels(2, 1, 1, 2)
    assert pixels.count(np.array([[1, 1, 0, 0]]), np.array([[5, -1, -1, 0]])) == Pixels(1, 0, 0, 1)  # -1 is unknown
    m = pixels.measures(Pixels(tp=6, fp=2, fn=4, tn=8))
    expected = {"accuracy": 14 / 20, "specificity": 8 / 10, "precision": 6 / 8, "recall": 6 / 10}
    assert m == pytest.approx(expected | {"f": 2 * 0.75 * 0.6 / 1.35, "gmean": math.sqrt(0.48)})


def test_measures_without_foreground_are_undefined_and_finding_nothing_scores_zero():
    m = pixels.measures(Pixels(tn=10))
    assert (m["accuracy"], m["specificity"]) == (1, 1)
    assert all(math.isnan(m[k]) for k in ("precision", "recall", "f", "gmean"))
    m = pixels.measures(Pixels(fn=3, tn=10))
    assert (m["f"], m["recall"], m["gmean"]) == (0, 0, 0)


def test_boxes_by_hand():
    a = np.array([[0, 0, 4, 4.0]])
    b = np.array([[0, 0, 4, 4], [2, 2, 4, 4], [4, 0, 4, 4], [1, 1, 2, 2], [0, 0, 0, 0.0]])
    assert boxes.iou(a, b)[0] == pytest.approx([1, 4 / 28, 0, 4 / 16, 0])
    found = np.array([[0, 0, 10, 10], [0, 1, 10, 10], [50, 50, 5, 5.0]])
    truth = np.array([[0, 1, 10, 10], [0, 0, 10, 10], [90, 90, 5, 5.0]])
    assert boxes.match(found, truth) == BoxCounts(hit=2, false=1, missed=1)
    assert boxes.measures(BoxCounts(2, 1, 1)) == pytest.approx(dict.fromkeys(("precision", "recall", "f1"), 2 / 3))


@pytest.mark.parametrize(
    ("found", "truth", "expected"),
    [(1, 2, BoxCounts(1, 0, 1)), (0, 2, BoxCounts(0, 0, 2)), (2, 0, BoxCounts(0, 2, 0)), (0, 0, BoxCounts())],
)
def test_one_detection_serves_one_true_box(found, truth, expected):
    assert boxes.match(np.ones((found, 4)), np.ones((truth, 4))) == expected


@given(st.integers(0, 2**32 - 1))
def test_counts_add_up_to_the_boxes_there_are(seed):
    rng = np.random.default_rng(seed)
    found, truth = (
        np.c_[rng.integers(0, 9, (n, 2)), rng.integers(1, 9, (n, 2))].astype(float) for n in rng.integers(0, 7, 2)
    )
    hit, false, missed = boxes.match(found, truth, 0.3)
    assert (hit + false, hit + missed) == (len(found), len(truth))


def test_one_target_hit_near_and_other_by_hand():
    mask = np.zeros((40, 40), np.uint8)
    mask[10:13, 10:20] = 1  # 30 % of the target
    found = np.array([[10, 10, 10, 3], [30, 30, 5, 5.0]])
    assert boxes.one_target(mask, found, np.array([10, 10, 10, 10.0])) == OneTarget(1, 1, 1, 1)
    assert boxes.one_target(mask, found[1:], np.array([10, 12, 10, 10.0])) == OneTarget(1, 0, 0, 1)
    assert boxes.one_target(mask, found, np.array([-90, 0, 10, 10.0])) == OneTarget(1, 0, 0, 2)
    assert boxes.one_target(mask, found, np.full(4, np.nan)) == OneTarget()  # the target is not there


def test_boxes_of_labels_leave_slivers_out():
    labels = np.zeros((20, 30), np.int32)
    labels[2:10, 3:9] = 5
    labels[15, :30] = 9
    assert boxes.boxes_of(labels).tolist() == [[3, 2, 6, 8]]
    assert len(boxes.boxes_of(labels, least_px=30)) == 2


# -- ranked boxes ------------------------------------------------------------------------------------------------------


def ranked(score, right, true, images=1.0):
    unit = np.zeros(len(score), np.int64)
    args = np.array(score, float), np.array(right, float), unit, np.array([float(true)]), np.array([float(images)])
    return boxes.ranking(*args)


def test_ranked_boxes_by_hand():
    # Precision 1, 1/2, 2/3, 2/4, 3/5 at recall 1/4, 1/4, 2/4, 2/4, 3/4; made to fall: 1, 2/3, 2/3, 3/5, 3/5.
    found = ranked([0.9, 0.8, 0.7, 0.6, 0.5], [1, 0, 1, 0, 1], 4).measures()
    assert found["ap"] == pytest.approx(1 / 4 + 2 / 3 / 4 + 3 / 5 / 4)
    # Ten images: the false ones come at 0.1, 0.2 and 0.3 an image.
    found = ranked([0.9, 0.8, 0.7, 0.6, 0.5, 0.4], [1, 0, 1, 0, 0, 1], 4, images=10).measures()
    assert (found["miss_rate_at_0.1"], found["miss_rate_at_1"]) == pytest.approx((1 - 2 / 4, 1 - 3 / 4))
    # Of the nine rates, 0.01, 0.018, 0.032, 0.056 are below 0.1; 0.1, 0.178 below 0.3; three are above.
    logs = 4 * math.log(3 / 4) + 2 * math.log(1 / 2) + 3 * math.log(1 / 4)
    assert found["log_average_miss_rate"] == pytest.approx(math.exp(logs / 9))


def brute_force(score, right, true, images):
    """Every threshold anew: the best precision at each recall or above, and the least miss within each rate."""
    points = []
    for threshold in sorted(set(score), reverse=True):
        taken = [bool(r) for s, r in zip(score, right, strict=True) if s >= threshold]
        points.append((sum(taken) / true, sum(taken) / len(taken), (len(taken) - sum(taken)) / images))
    area, before = 0.0, 0.0
    for recall in sorted({p[0] for p in points}):
        area += (recall - before) * max(p[1] for p in points if p[0] >= recall)
        before = recall
    misses = [1 - max([p[0] for p in points if p[2] <= rate] or [0.0]) for rate in RATES]
    return area, math.exp(sum(math.log(max(m, 1e-10)) for m in misses) / len(misses))


@given(st.integers(0, 2**32 - 1))
def test_ranking_is_that_of_every_threshold_by_itself_in_any_order(seed):
    rng = np.random.default_rng(seed)
    count, images = int(rng.integers(1, 40)), int(rng.integers(1, 30))
    score, right = rng.integers(0, 12, count) / 12, rng.integers(0, 2, count)
    true, order = int(right.sum() + rng.integers(1, 5)), rng.permutation(count)
    found = ranked(score, right, true, images).measures()
    area, miss = brute_force(score.tolist(), right.tolist(), true, images)
    assert (found["ap"], found["log_average_miss_rate"]) == pytest.approx((area, miss))
    assert found == ranked(score[order], right[order], true, images).measures()


@given(st.integers(0, 2**32 - 1))
def test_a_weight_of_two_is_the_unit_twice(seed):
    rng = np.random.default_rng(seed)
    score, right, unit = rng.random(30), rng.integers(0, 2, 30).astype(float), rng.integers(0, 3, 30)
    true = np.array([9.0, 30.0, 4.0])
    once = boxes.ranking(score, right, unit, true).measures(np.array([2.0, 0.0, 1.0]))
    rows = np.concatenate([np.flatnonzero(unit == k) for k in (0, 0, 2)])
    twice = boxes.ranking(score[rows], right[rows], np.zeros(len(rows), np.int64), np.array([22.0]), np.array([3.0]))
    assert once == pytest.approx(twice.measures())


def test_detections_that_do_not_count_none_at_all_and_no_truth():
    assert ranked([0.9, 0.8], [np.nan, 1], 1).measures() == ranked([0.8], [1], 1).measures()
    expected = {"ap": 0.0, "log_average_miss_rate": 1.0, "miss_rate_at_0.1": 1.0, "miss_rate_at_1": 1.0}
    assert ranked([], [], 3).measures() == pytest.approx(expected)
    assert all(math.isnan(value) for value in ranked([0.5], [0], 0).measures().values())


def test_the_best_score_takes_the_true_box_first():
    truth = np.array([[0, 0, 10, 10.0]])
    found = np.array([[0, 0, 10, 10], [0, 1, 10, 10.0]])
    assert judged(found, np.array([0.3, 0.9]), truth).tolist() == [0, 1]
    assert judged(found, np.array([0.5, 0.5]), truth).tolist() == [1, 0]  # equal scores: the better fit
    assert judged(found, np.array([0.9, 0.3]), np.concatenate([truth, truth])).tolist() == [1, 1]
    assert judged(found[:0], np.zeros(0), truth).tolist() == []
    assert judged(found, np.ones(2), truth[:0]).tolist() == [0, 0]


# -- which boxes count -------------------------------------------------------------------------------------------------


def table(*boxes: tuple[float, float, float, float]) -> TrackTable:
    return TrackTable(np.ones(len(boxes), np.int64), np.arange(len(boxes)), np.array(boxes, float).reshape(-1, 4))


PERSON, RIDER, CAR = (0, 0, 10, 20), (100, 0, 10, 20), (102, 0, 10, 20)
TRUTH = ClipTruth(
    "boxes", Path("gt.txt"), {}, {1: table(PERSON).box_px}, table(PERSON), table(RIDER), ignoring="removed"
)


def counts(truth: ClipTruth, *boxes: tuple[float, float, float, float]) -> list[bool]:
    found = table(*boxes)
    return counted(truth, found.frame, found.box_px).tolist()


def test_a_box_on_an_ignored_one_does_not_count_and_a_second_one_there_does() -> None:
    assert counts(TRUTH, PERSON, RIDER) == [True, False]
    assert counts(TRUTH, (101, 0, 10, 20), RIDER) == [True, False]
    assert counts(replace(TRUTH, ignoring="dropped"), PERSON, RIDER) == [True, True]


def test_a_box_that_fits_something_else_better_counts() -> None:
    assert counts(TRUTH, CAR) == [False]
    assert counts(replace(TRUTH, others=table(CAR)), CAR) == [True]


def test_a_box_in_a_region_counts_only_where_it_is_right() -> None:
    within = replace(TRUTH, regions=table((-5, -5, 60, 60)))
    assert counts(within, PERSON, (30, 0, 10, 20)) == [True, False]
    assert counts(within, (50, 0, 10, 20)) == [True]  # half of it is not more than half
    assert counts(TRUTH) == []
    assert counted(TRUTH, np.array([2]), np.array([RIDER], float)).tolist() == [True]


def test_the_same_boxes_are_left_out_as_in_matching_tracks() -> None:
    rng = np.random.default_rng(3)
    frame, identity = np.repeat(np.arange(1, 41), 8), np.tile(np.arange(8), 40)
    labelled = TrackTable(frame, identity, np.c_[rng.uniform(0, 60, (320, 2)), np.full((320, 2), 30.0)])
    real = rng.random(320) < 0.6
    found = TrackTable(frame, identity, labelled.box_px + rng.normal(0, 5, (320, 4)) * (1, 1, 0, 0))
    true, ignored = labelled.at(real), labelled.at(~real)
    truth = ClipTruth("boxes", Path("gt.txt"), {}, true.boxes_by_frame(), true, ignored, ignoring="removed")
    kept = counted(truth, found.frame, found.box_px)
    assert 0.3 < kept.mean() < 0.9
    theirs, ours = pair(true, found, ignored, "removed"), pair(true, found.at(kept))
    assert [p.overlap.tolist() for p in theirs.frames] == [p.overlap.tolist() for p in ours.frames]


# -- places on the ground ----------------------------------------------------------------------------------------------


def samples(error, inside):
    nothing = np.full(len(error), np.nan)
    known = {"error_m": np.array(error, float), "inside": np.array(inside, float)}
    return {**known, "relative_error_m": nothing, "relative_inside": nothing}


def test_errors_by_hand():
    found = metres.measures(samples([1, 2, 3, 4], [1, 1, 0, np.nan]))
    assert (found["mean_m"], found["median_m"], found["p95_m"]) == (2.5, 2, 4)
    assert found["rms_m"] == pytest.approx(np.sqrt(7.5))
    assert found["in_ellipse"] == pytest.approx(2 / 3)
    assert np.isnan(found["relative_mean_m"])


def test_weights_count_as_copies_and_quantiles_are_numpys():
    rng = np.random.default_rng(0)
    error, weight = rng.random(37), rng.integers(0, 5, 37).astype(float)
    rows = np.repeat(np.arange(37), weight.astype(int))
    once = metres.measures(samples(error, error < 0.5), weight)
    assert once == pytest.approx(metres.measures(samples(error[rows], error[rows] < 0.5)), nan_ok=True)
    for share in (0.1, 0.5, 0.95):
        wanted = np.quantile(error, share, weights=weight, method="inverted_cdf")
        assert metres.quantile(error, share, weight) == wanted


def test_95_percent_of_gaussian_errors_lie_in_their_ellipses_and_unknown_ones_are_undefined():
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    off = np.random.default_rng(2).multivariate_normal((0, 0), covariance, 4000)
    held = metres.inside(off, np.broadcast_to(covariance, (4000, 2, 2)))
    assert held.mean() == pytest.approx(0.95, abs=0.012)
    covariance = np.array([np.full((2, 2), np.nan), [[1, 1], [1, 1]], np.eye(2)])
    assert np.isnan(metres.inside(np.zeros((3, 2)), covariance)).tolist() == [True, True, False]


def test_each_true_box_and_place_belongs_to_one_target():
    box_px = np.array([[0, 0, 10, 10], [20, 0, 10, 10], [0, 0, 10, 10.0]])
    truth = TrackTable(np.array([1, 1, 2]), np.array([1, 2, 1]), box_px)
    found = np.array([[1, 0, 10, 10], [0, 1, 10, 10], [21, 0, 10, 10], [0, 0, 10, 10]], float)
    which = metres.by_boxes(np.array([1, 1, 1, 3]), found, truth)
    assert sorted(which.tolist()) == [-1, -1, 0, 1] and which[2] == 1
    places = np.array([[0, 0], [0.5, 0], [30, 0]], float)
    nearest = metres.by_places(np.array([1, 1, 1]), places, np.array([1, 1]), np.array([[0.4, 0], [19, 0.0]]))
    assert nearest.tolist() == [-1, 0, -1]


def test_landmarks_are_matched_by_their_paths_and_their_common_error_is_found():
    frame, who = np.repeat(np.arange(1, 21), 3), np.tile([5, 6, 9], 20)
    true = np.stack([15.0 * who + frame, 3.0 * frame], axis=1)
    common = np.stack([2 + 0.1 * frame, np.full(60, -1.0)], axis=1)
    driven = who != 9
    reports = (true + common + np.random.default_rng(3).normal(0, 0.05, (60, 2)))[driven]
    at, shift = metres.shared_error(frame[driven], np.where(who[driven] == 5, 1, 0), reports, frame, who, true)
    assert at.tolist() == list(range(1, 21))
    assert shift == pytest.approx(common[::3], abs=0.15)
    place = np.zeros((1, 2))
    at, shift = metres.shared_error(np.array([9]), np.array([0]), place, np.array([1]), np.array([1]), place)
    assert (len(at), shift.shape) == (0, (0, 2))
