import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.evaluation.metrics import boxes, pixels
from torchvision_dddas.evaluation.metrics.boxes import Boxes, OneTarget
from torchvision_dddas.evaluation.metrics.pixels import Pixels


def test_counts_of_two_small_masks():
    found = np.array([[0, 3, 3], [0, 0, 1]])
    truth = np.array([[0, 7, 0], [7, 0, 7]])
    assert pixels.count(found, truth) == Pixels(tp=2, fp=1, fn=1, tn=2)


def test_pixels_of_which_nothing_is_known_do_not_count():
    found, truth = np.array([[1, 1, 0, 0]]), np.array([[5, -1, -1, 0]])
    assert pixels.count(found, truth) == Pixels(tp=1, fp=0, fn=0, tn=1)


def test_six_measures_by_hand():
    m = pixels.measures(Pixels(tp=6, fp=2, fn=4, tn=8))
    assert m["accuracy"] == pytest.approx(14 / 20)
    assert m["specificity"] == pytest.approx(8 / 10)
    assert m["precision"] == pytest.approx(6 / 8)
    assert m["recall"] == pytest.approx(6 / 10)
    assert m["f"] == pytest.approx(2 * 0.75 * 0.6 / 1.35)
    assert m["gmean"] == pytest.approx(math.sqrt(0.48))


def test_measures_without_foreground_are_undefined_not_perfect():
    m = pixels.measures(Pixels(tn=10))
    assert (m["accuracy"], m["specificity"]) == (1, 1)
    assert all(math.isnan(m[k]) for k in ("precision", "recall", "f", "gmean"))


def test_finding_nothing_of_something_scores_zero():
    m = pixels.measures(Pixels(fn=3, tn=10))
    assert (m["f"], m["recall"], m["gmean"]) == (0, 0, 0)


def test_iou_by_hand():
    a = np.array([[0, 0, 4, 4.0]])
    b = np.array([[0, 0, 4, 4], [2, 2, 4, 4], [4, 0, 4, 4], [1, 1, 2, 2], [0, 0, 0, 0.0]])
    assert boxes.iou(a, b)[0] == pytest.approx([1, 4 / 28, 0, 4 / 16, 0])


def test_each_true_box_takes_its_best_remaining_detection():
    found = np.array([[0, 0, 10, 10], [0, 1, 10, 10], [50, 50, 5, 5.0]])
    truth = np.array([[0, 1, 10, 10], [0, 0, 10, 10], [90, 90, 5, 5.0]])
    assert boxes.match(found, truth) == Boxes(hit=2, false=1, missed=1)
    m = boxes.measures(Boxes(2, 1, 1))
    assert m == {"precision": pytest.approx(2 / 3), "recall": pytest.approx(2 / 3), "f1": pytest.approx(2 / 3)}


def test_one_detection_does_not_serve_two_true_boxes():
    box = np.array([[0, 0, 10, 10.0]])
    assert boxes.match(box, np.concatenate([box, box])) == Boxes(hit=1, false=0, missed=1)


@pytest.mark.parametrize(
    ("found", "truth", "expected"), [(0, 2, Boxes(0, 0, 2)), (2, 0, Boxes(0, 2, 0)), (0, 0, Boxes())]
)
def test_matching_without_boxes(found, truth, expected):
    assert boxes.match(np.ones((found, 4)), np.ones((truth, 4))) == expected


@given(st.integers(0, 2**32 - 1))
def test_counts_add_up_to_the_boxes_there_are(seed):
    rng = np.random.default_rng(seed)
    found, truth = (
        np.c_[rng.integers(0, 9, (n, 2)), rng.integers(1, 9, (n, 2))].astype(float) for n in rng.integers(0, 7, 2)
    )
    hit, false, missed = boxes.match(found, truth, 0.3)
    assert (hit + false, hit + missed) == (len(found), len(truth))


def test_boxes_of_labels_leave_slivers_out():
    labels = np.zeros((20, 30), np.int32)
    labels[2:10, 3:9] = 5
    labels[15, :30] = 9
    assert boxes.boxes_of(labels).tolist() == [[3, 2, 6, 8]]
    assert len(boxes.boxes_of(labels, least_px=30)) == 2


def test_one_target_hit_near_and_other_by_hand():
    mask = np.zeros((40, 40), np.uint8)
    mask[10:13, 10:20] = 1  # 30 % of the target
    found = np.array([[10, 10, 10, 3], [30, 30, 5, 5.0]])
    assert boxes.one_target(mask, found, np.array([10, 10, 10, 10.0])) == OneTarget(1, 1, 1, 1)
    assert boxes.one_target(mask, found[1:], np.array([10, 12, 10, 10.0])) == OneTarget(1, 0, 0, 1)
    assert boxes.one_target(mask, found, np.array([-90, 0, 10, 10.0])) == OneTarget(1, 0, 0, 2)


def test_a_frame_without_the_target_does_not_count():
    assert boxes.one_target(np.ones((9, 9)), np.ones((1, 4)), np.full(4, np.nan)) == OneTarget()
