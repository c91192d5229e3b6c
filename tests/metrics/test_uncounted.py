"""Found boxes on what does not count are taken out, others stay."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from torchvision_dddas.metrics.matching import TrackTable
from torchvision_dddas.metrics.truth import Truth
from torchvision_dddas.metrics.uncounted import counted


def table(*boxes: tuple[float, float, float, float]) -> TrackTable:
    return TrackTable(np.ones(len(boxes), np.int64), np.arange(len(boxes)), np.array(boxes, float).reshape(-1, 4))


PERSON, RIDER, CAR = (0, 0, 10, 20), (100, 0, 10, 20), (102, 0, 10, 20)
TRUTH = Truth("boxes", Path("gt.txt"), {}, {1: table(PERSON).box_px}, table(PERSON), table(RIDER), ignoring="removed")


def counts(truth: Truth, *boxes: tuple[float, float, float, float]) -> list[bool]:
    found = table(*boxes)
    return counted(truth, found.frame, found.box_px).tolist()


def test_a_box_on_an_ignored_one_does_not_count_and_a_second_one_there_does() -> None:
    assert counts(TRUTH, PERSON, RIDER) == [True, False]
    assert counts(TRUTH, (101, 0, 10, 20), RIDER) == [True, False]


def test_where_ignored_boxes_are_dropped_all_count() -> None:
    assert counts(replace(TRUTH, ignoring="dropped"), PERSON, RIDER) == [True, True]


def test_a_box_that_fits_something_else_better_counts() -> None:
    assert counts(TRUTH, CAR) == [False]
    assert counts(replace(TRUTH, others=table(CAR)), CAR) == [True]


def test_a_box_in_a_region_counts_only_where_it_is_right() -> None:
    within = replace(TRUTH, regions=table((-5, -5, 60, 60)))
    assert counts(within, PERSON, (30, 0, 10, 20)) == [True, False]
    assert counts(within, (50, 0, 10, 20)) == [True]  # half of it is not more than half


def test_frames_are_apart_and_without_boxes_nothing_is_said() -> None:
    assert counts(TRUTH) == []
    assert counted(TRUTH, np.array([2]), np.array([RIDER], float)).tolist() == [True]
