"""From windows to people: suppression, body boxes, probabilities; OpenCV's grouping."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import load_config
from torchvision_dddas.people.suppression import (
    group_rectangles,
    non_maximum_suppression,
    people_from_windows,
    refine_boxes,
)


def iou(a, b):
    side = np.minimum(a[:2] + a[2:], b[:2] + b[2:]) - np.maximum(a[:2], b[:2])
    shared = np.prod(np.maximum(side, 0))
    return shared / (a[2:].prod() + b[2:].prod() - shared)


def test_a_box_inside_a_better_one_is_suppressed_where_containment_counts():
    box, score = np.array([[0, 0, 40, 100], [10, 60, 20, 40.0]]), np.array([2.0, 1])
    assert non_maximum_suppression(box, score, 0.4).tolist() == [0, 1]
    assert non_maximum_suppression(box, score, 0.4, contained=0.7).tolist() == [0]


def test_a_refined_box_is_the_weighted_mean_of_its_neighbours():
    box = np.array([[0, 0, 40, 100], [4, 8, 40, 100], [300, 0, 40, 100.0]])
    np.testing.assert_allclose(refine_boxes(box, np.array([3.0, 1, 5]), np.array([0]), 0.7), [[1, 2, 40, 100]])


@pytest.mark.parametrize("seed", range(5))
def test_kept_boxes_are_apart_and_each_suppressed_one_overlaps_a_better_one(seed):
    random = np.random.default_rng(seed)
    height, score = random.uniform(60, 120, 120), random.normal(size=120)
    box = np.column_stack([random.uniform(0, 300, (120, 2)), height / 2, height])
    kept = non_maximum_suppression(box, score, 0.3)
    assert (np.diff(score[kept]) <= 0).all()
    for place, i in enumerate(kept):
        assert all(iou(box[i], box[j]) <= 0.3 for j in kept[:place])
    for i in set(range(len(box))) - set(kept.tolist()):
        assert any(iou(box[i], box[j]) > 0.3 and score[j] >= score[i] for j in kept)


@pytest.fixture
def one_opencv_thread():
    """Several threads report windows in an order of chance, on which the weights of OpenCV's groups depend."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


@pytest.mark.parametrize("least", [0, 1, 2, 3])
@pytest.mark.parametrize("threshold", [-1.2, -1.0, -0.7])
def test_groups_are_those_of_opencv_to_the_rectangle_and_the_weight(one_opencv_thread, threshold, least):
    noise = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(240, 320, 3)), (0, 0), 3)
    image = np.clip(128 + 300 * noise, 0, 255).astype(np.uint8)
    for x in (60, 150, 230):
        cv2.ellipse(image, (x, 130), (16, 50), 0, 0, 360, (240, 240, 240), -1)
        cv2.circle(image, (x, 70), 10, (240, 240, 240), -1)
    detector = cv2.HOGDescriptor()
    detector.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector()))
    every, weight = detector.detectMultiScale(image, threshold, (8, 8), (0, 0), 1.05, 0)
    assert len(every) > 30
    box, best = group_rectangles(np.asarray(every), np.ravel(weight), least)
    theirs, weight = detector.detectMultiScale(image, threshold, (8, 8), (0, 0), 1.05, least)
    corner = np.maximum(box[:, :2], 0)
    box = np.concatenate([corner, np.minimum(box[:, :2] + box[:, 2:], (320, 240)) - corner], axis=1)
    ours = sorted((*row, m) for row, m in zip(box.astype(int).tolist(), best.tolist(), strict=True))
    wanted = sorted((*row, w) for row, w in zip(np.reshape(theirs, (-1, 4)).tolist(), np.ravel(weight), strict=True))
    assert [row[:4] for row in ours] == [row[:4] for row in wanted]
    np.testing.assert_allclose([row[4] for row in ours], [row[4] for row in wanted])


SIZE = (640, 480)


def parameters(**changed):
    return load_config(overrides=[f"people.{name}={value}" for name, value in changed.items()]).people


def test_windows_around_one_person_become_one_between_them():
    window = np.array([[100.0, 50, 64, 128], [108, 50, 64, 128], [104, 46, 67.2, 134.4], [400, 100, 64, 128]])
    people = people_from_windows(window, np.array([1.0, 1.0, 0.5, 0.3]), SIZE, parameters())
    assert people.margin.tolist() == [1.0, 0.3]
    assert 100 + 32 < people.box_px[0, 0] + people.box_px[0, 2] / 2 < 108 + 32
    np.testing.assert_allclose(people.window_px[1], window[3])


@pytest.mark.parametrize("suppression", ["nms", "opencv", "none"])
def test_people_are_sorted_by_score_and_may_be_none(suppression):
    window, k = np.array([[x, 50, 64, 128.0] for x in (0, 200, 400)]), parameters(suppression=suppression, group=0)
    people = people_from_windows(window, np.array([0.5, 2.0, 1.0]), SIZE, k)
    assert people.margin.tolist() == [2.0, 1.0, 0.5]
    assert (np.diff(people.score) < 0).all()
    nobody = people_from_windows(window[:0], np.zeros(0), SIZE, parameters(suppression=suppression))
    assert len(nobody) == 0 and nobody.box_px.shape == nobody.window_px.shape == (0, 4)


@pytest.mark.parametrize(
    ("x", "y", "cut"),
    [
        (300, 200, False),
        (300, -1, True),
        (300, 381, True),
        (300, 379, True),  # the feet end 1 px above the border: they may go on below it
        (-10, 200, True),
        (610, 200, True),
        (300, 370, False),
    ],
)
def test_a_body_that_meets_the_border_is_flagged(x, y, cut):
    k, wide, tall = parameters(), 40, 100
    width, height = wide / k.width_share, tall / k.height_share
    window = np.array([[x - (width - wide) / 2, y + tall - k.feet_share * height, width, height]])
    assert people_from_windows(window, np.array([1.0]), SIZE, k).cut.tolist() == [cut]
