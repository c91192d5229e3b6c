"""One box a person: suppression, boxes settled on means, OpenCV's grouping."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.people.suppression import group, nms, settled


def boxes(*rows):
    return np.array(rows, float).reshape(-1, 4)


def iou(a, b):
    side = np.minimum(a[:2] + a[2:], b[:2] + b[2:]) - np.maximum(a[:2], b[:2])
    shared = np.prod(np.maximum(side, 0))
    return shared / (a[2:].prod() + b[2:].prod() - shared)


def crowd(seed, number=120):
    rng = np.random.default_rng(seed)
    height = rng.uniform(60, 120, number)
    return np.column_stack([rng.uniform(0, 300, (number, 2)), height / 2, height]), rng.normal(size=number)


def test_the_best_of_boxes_that_overlap_stays_and_others_are_untouched():
    box = boxes([0, 0, 40, 100], [4, 0, 40, 100], [200, 0, 40, 100])
    assert nms(box, np.array([1.0, 2, 0.5]), 0.5).tolist() == [1, 2]


def test_only_boxes_that_stay_put_others_out():
    box = boxes([0, 0, 40, 100], [15, 0, 40, 100], [30, 0, 40, 100])  # neighbours share 0.45, the outer two 0.14
    assert nms(box, np.array([3.0, 2, 1]), 0.4).tolist() == [0, 2]


def test_a_part_of_a_better_box_goes_where_containment_counts():
    box = boxes([0, 0, 40, 100], [10, 60, 20, 40])
    assert nms(box, np.array([2.0, 1]), 0.4).tolist() == [0, 1]
    assert nms(box, np.array([2.0, 1]), 0.4, contained=0.7).tolist() == [0]


def test_a_large_box_around_a_better_small_one_goes_too():
    box = boxes([0, 0, 40, 100], [10, 60, 20, 40])
    assert nms(box, np.array([1.0, 2]), 0.4, contained=0.7).tolist() == [1]


def test_of_equal_scores_the_first_row_stays():
    box = boxes([0, 0, 40, 100], [2, 0, 40, 100], [4, 0, 40, 100])
    assert nms(box, np.ones(3), 0.5).tolist() == [0]


@pytest.mark.parametrize("seed", range(5))
def test_those_that_stay_are_apart_and_each_that_goes_has_a_better_one_on_it(seed):
    box, score = crowd(seed)
    kept = nms(box, score, 0.3)
    assert (np.diff(score[kept]) <= 0).all()
    for place, i in enumerate(kept):
        assert all(iou(box[i], box[j]) <= 0.3 for j in kept[:place])
    for i in set(range(len(box))) - set(kept.tolist()):
        assert any(iou(box[i], box[j]) > 0.3 and score[j] >= score[i] for j in kept)


def test_suppression_does_not_depend_on_the_order_of_rows():
    box, score = crowd(7)
    order = np.random.default_rng(0).permutation(len(box))
    assert order[nms(box[order], score[order], 0.3, 0.7)].tolist() == nms(box, score, 0.3, 0.7).tolist()


def test_nothing_stays_of_nothing():
    assert nms(np.zeros((0, 4)), np.zeros(0), 0.5).tolist() == []
    assert settled(np.zeros((0, 4)), np.zeros(0), np.zeros(0, int), 0.7).shape == (0, 4)


def test_a_box_settles_on_the_weighted_mean_of_its_neighbours():
    box = boxes([0, 0, 40, 100], [4, 8, 40, 100], [300, 0, 40, 100])
    np.testing.assert_allclose(settled(box, np.array([3.0, 1, 5]), np.array([0]), 0.7), [[1, 2, 40, 100]])


def test_sizes_settle_on_their_geometric_mean():
    box = boxes([0, 0, 40, 100], [-2, -5, 44, 110])  # one centre
    (found,) = settled(box, np.ones(2), np.array([0]), 0.7)
    np.testing.assert_allclose(found[2:], [np.sqrt(40 * 44), np.sqrt(100 * 110)])
    np.testing.assert_allclose(found[:2] + found[2:] / 2, [20, 50])


def test_a_box_alone_or_without_weight_stays_where_it_is():
    box = boxes([0, 0, 40, 100], [4, 8, 40, 100])
    np.testing.assert_allclose(settled(box, np.ones(2), np.array([1, 0]), 1.0), box[[1, 0]], atol=1e-9)
    np.testing.assert_allclose(settled(box, np.zeros(2), np.array([0]), 0.7), box[[0]], atol=1e-9)


@pytest.fixture(scope="module")
def scored():
    """HOG windows of noise and a few bright columns, many of them alike."""
    rng = np.random.default_rng(5)
    image = np.clip(128 + 300 * cv2.GaussianBlur(rng.normal(size=(240, 320, 3)), (0, 0), 3), 0, 255).astype(np.uint8)
    for x in (60, 150, 230):
        cv2.ellipse(image, (x, 130), (16, 50), 0, 0, 360, (240, 240, 240), -1)
        cv2.circle(image, (x, 70), 10, (240, 240, 240), -1)
    detector = cv2.HOGDescriptor()
    detector.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector()))
    # Several threads report windows in an order of chance, on which the weights of OpenCV's groups depend.
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield image, detector
    cv2.setNumThreads(threads)


@pytest.mark.parametrize("least", [0, 1, 2, 3])
@pytest.mark.parametrize("threshold", [-1.2, -1.0, -0.7])
def test_groups_are_those_of_opencv_to_the_rectangle_and_the_weight(scored, threshold, least):
    image, detector = scored
    every, weight = detector.detectMultiScale(image, threshold, (8, 8), (0, 0), 1.05, 0)
    assert len(every) > 30
    box, best = group(every, np.ravel(weight), least)
    theirs, weight = detector.detectMultiScale(image, threshold, (8, 8), (0, 0), 1.05, least)
    corner = np.maximum(box[:, :2], 0)
    box = np.concatenate([corner, np.minimum(box[:, :2] + box[:, 2:], (320, 240)) - corner], axis=1)
    ours = sorted((*row, m) for row, m in zip(box.astype(int).tolist(), best.tolist(), strict=True))
    wanted = sorted((*row, w) for row, w in zip(np.reshape(theirs, (-1, 4)).tolist(), np.ravel(weight), strict=True))
    assert [row[:4] for row in ours] == [row[:4] for row in wanted]
    np.testing.assert_allclose([row[4] for row in ours], [row[4] for row in wanted])


def test_boxes_that_a_chain_links_are_one_group_whatever_their_order():
    chain = boxes(*[[x, 0, 64, 128] for x in range(0, 96, 16)])
    order = [3, 0, 5, 1, 4, 2]
    for rows in (chain, chain[order]):
        box, best = group(rows, np.arange(6.0), least=2)
        assert box.tolist() == [[40, 0, 64, 128]] and best.tolist() == [5]


def test_a_group_inside_a_larger_one_goes():
    small, large = boxes(*[[40, 40, 32, 64]] * 2), boxes(*[[20, 10, 80, 160]] * 4)
    box, _ = group(np.concatenate([small, large]), np.arange(6.0), least=1)
    assert box.tolist() == [[20, 10, 80, 160]]


def test_no_boxes_make_no_groups():
    box, best = group(np.zeros((0, 4)), np.zeros(0), 2)
    assert box.shape == (0, 4) and best.shape == (0,)
