"""Whose detections are: by the matching of the measures."""

from pathlib import Path

import numpy as np

from torchvision_dddas.evaluation.metrics.truth import TrackTable, Truth
from torchvision_dddas.tuning.examples import match_owners
from torchvision_dddas.types import DetectionTable

ONE, OTHER, FAR = [100.0, 50.0, 20.0, 50.0], [112.0, 50.0, 20.0, 50.0], [300.0, 50.0, 20.0, 50.0]


def table(rows: list[tuple[int, int, list[float]]]) -> TrackTable:
    frame, identity, box_px = zip(*rows, strict=True)
    return TrackTable(np.array(frame), np.array(identity), np.array(box_px))


def truth_of(rows: list[tuple[int, int, list[float]]], **more) -> Truth:
    return Truth("boxes", Path("here"), {}, {}, table(rows), **more)


def found_of(rows: list[tuple[int, list[float], float]]) -> DetectionTable:
    frame, box_px, score = zip(*rows, strict=True)
    return DetectionTable("det", np.array(frame), np.array(box_px), np.array(score), np.arange(len(rows)))


def test_each_target_owns_the_box_that_fits_it_best_and_what_nobody_owns_is_another_each_time():
    truth = truth_of([(1, 7, ONE), (1, 9, OTHER), (2, 7, ONE)])
    near = [OTHER[0] - 2, *OTHER[1:]]
    mine = match_owners(found_of([(1, near, 0.9), (1, ONE, 1.0), (1, FAR, 0.8), (2, FAR, 0.8)]), truth, 1, 0.7)
    second, first, *nobody = mine.table.identity.tolist()
    assert first != second
    assert min(first, second) >= 0
    assert max(nobody) < 0
    assert nobody[0] != nobody[1]
    assert mine.score.tolist() == [0.9, 1.0, 0.8, 0.8]


def test_a_target_keeps_its_number_from_frame_to_frame():
    truth = truth_of([(1, 7, ONE), (1, 9, FAR), (2, 9, FAR), (3, 7, ONE)])
    mine = match_owners(found_of([(1, FAR, 1.0), (1, ONE, 1.0), (2, FAR, 1.0), (3, ONE, 1.0)]), truth, 1, 0.7)
    a, b, c, d = mine.table.identity.tolist()
    assert (a, b) == (c, d)


def test_what_does_not_count_or_is_not_looked_at_is_left_out():
    truth = truth_of([(1, 7, ONE), (6, 7, ONE)])
    mine = match_owners(found_of([(1, ONE, 0.69), (1, FAR, 0.7), (2, ONE, 1.0), (6, ONE, 1.0)]), truth, 5, 0.7)
    assert mine.table.frame.tolist() == [1, 6]


def test_scores_on_another_scale_are_all_certain():
    truth = truth_of([(1, 7, ONE)])
    mine = match_owners(found_of([(1, ONE, 40.0), (1, FAR, -3.0)]), truth, 1, 0.7)
    assert mine.score.tolist() == [1.0, 1.0]


def test_who_is_no_mistake_to_find_owns_a_box_and_is_nobody_else():
    truth = truth_of([(1, 7, ONE)], ignored=table([(1, 7, FAR), (2, 7, FAR)]), ignoring="removed")
    mine = match_owners(found_of([(1, ONE, 1.0), (1, FAR, 1.0), (2, FAR, 1.0)]), truth, 1, 0.7)
    one, other, again = mine.table.identity.tolist()
    assert other == again >= 0
    assert one != other
