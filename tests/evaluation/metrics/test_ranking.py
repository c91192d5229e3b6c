import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.evaluation.metrics import boxes
from torchvision_dddas.evaluation.metrics.boxes import RATES, judged


def ranked(score, right, true, images=1.0):
    unit = np.zeros(len(score), np.int64)
    args = np.array(score, float), np.array(right, float), unit, np.array([float(true)]), np.array([float(images)])
    return boxes.ranking(*args)


def test_average_precision_by_hand():
    # Precision 1, 1/2, 2/3, 2/4, 3/5 at recall 1/4, 1/4, 2/4, 2/4, 3/4; made to fall: 1, 2/3, 2/3, 3/5, 3/5.
    found = ranked([0.9, 0.8, 0.7, 0.6, 0.5], [1, 0, 1, 0, 1], 4).measures()
    assert found["ap"] == pytest.approx(1 / 4 + 2 / 3 / 4 + 3 / 5 / 4)


def test_miss_rates_by_hand():
    # Ten images: the false ones come at 0.1, 0.2 and 0.3 an image.
    found = ranked([0.9, 0.8, 0.7, 0.6, 0.5, 0.4], [1, 0, 1, 0, 0, 1], 4, images=10)
    measures = found.measures()
    assert measures["miss_rate_at_0.1"] == pytest.approx(1 - 2 / 4)
    assert measures["miss_rate_at_1"] == pytest.approx(1 - 3 / 4)
    # Of the nine rates 0.01, 0.018, 0.032, 0.056 are below 0.1; 0.1, 0.178 below 0.3; three are above.
    assert (RATES[3] < 0.1, RATES[5] < 0.2) == (True, True)
    logs = 4 * math.log(3 / 4) + 2 * math.log(1 / 2) + 3 * math.log(1 / 4)
    assert measures["log_average_miss_rate"] == pytest.approx(math.exp(logs / 9))


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
def test_ranking_is_what_every_threshold_by_itself_gives(seed):
    rng = np.random.default_rng(seed)
    count, images = int(rng.integers(1, 40)), int(rng.integers(1, 30))
    score, right = rng.integers(0, 12, count) / 12, rng.integers(0, 2, count)
    true = int(right.sum() + rng.integers(1, 5))
    found = ranked(score, right, true, images).measures()
    area, miss = brute_force(score.tolist(), right.tolist(), true, images)
    assert found["ap"] == pytest.approx(area)
    assert found["log_average_miss_rate"] == pytest.approx(miss)


@given(st.integers(0, 2**32 - 1))
def test_order_does_not_matter_even_among_equal_scores(seed):
    rng = np.random.default_rng(seed)
    score, right = rng.integers(0, 4, 20) / 4, rng.integers(0, 2, 20)
    order = rng.permutation(20)
    assert ranked(score, right, 25).measures() == ranked(score[order], right[order], 25).measures()


@given(st.integers(0, 2**32 - 1))
def test_a_weight_of_two_is_the_unit_twice(seed):
    rng = np.random.default_rng(seed)
    score, right, unit = rng.random(30), rng.integers(0, 2, 30).astype(float), rng.integers(0, 3, 30)
    true = np.array([9.0, 30.0, 4.0])
    once = boxes.ranking(score, right, unit, true).measures(np.array([2.0, 0.0, 1.0]))
    rows = np.concatenate([np.flatnonzero(unit == k) for k in (0, 0, 2)])
    twice = boxes.ranking(score[rows], right[rows], np.zeros(len(rows), np.int64), np.array([22.0]), np.array([3.0]))
    assert once == pytest.approx(twice.measures())


def test_what_does_not_count_is_neither_right_nor_false():
    assert ranked([0.9, 0.8], [np.nan, 1], 1).measures() == ranked([0.8], [1], 1).measures()


def test_without_detections_all_is_missed_and_without_truth_nothing_is_said():
    assert ranked([], [], 3).measures() == {
        "ap": 0.0,
        "log_average_miss_rate": pytest.approx(1.0),
        "miss_rate_at_0.1": 1.0,
        "miss_rate_at_1": 1.0,
    }
    assert all(math.isnan(value) for value in ranked([0.5], [0], 0).measures().values())


def test_the_best_score_takes_the_true_box_first():
    truth = np.array([[0, 0, 10, 10.0]])
    found = np.array([[0, 0, 10, 10], [0, 1, 10, 10.0]])
    assert judged(found, np.array([0.3, 0.9]), truth).tolist() == [0, 1]
    assert judged(found, np.array([0.5, 0.5]), truth).tolist() == [1, 0]  # equal scores: the better fit
    assert judged(found, np.array([0.9, 0.3]), np.concatenate([truth, truth])).tolist() == [1, 1]
    assert judged(found[:0], np.zeros(0), truth).tolist() == []
    assert judged(found, np.ones(2), truth[:0]).tolist() == [0, 0]
