"""Found boxes on what does not count are taken out, others stay."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from torchvision_dddas.evaluation.metrics.matching import counted, pair
from torchvision_dddas.evaluation.metrics.truth import TrackTable, Truth


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


def test_it_takes_out_what_matching_for_tracks_takes_out() -> None:
    """`matching.pair` with "removed", which is checked against TrackEval."""
    rng = np.random.default_rng(3)
    frame = np.repeat(np.arange(1, 41), 8)
    labelled = TrackTable(
        frame, np.tile(np.arange(8), 40), np.c_[rng.uniform(0, 60, (320, 2)), np.full((320, 2), 30.0)]
    )
    real = rng.random(320) < 0.6
    found = TrackTable(frame, labelled.identity, labelled.box_px + rng.normal(0, 5, (320, 4)) * (1, 1, 0, 0))
    true, ignored = labelled.at(real), labelled.at(~real)
    boxes = {n: true.box_px[true.frame == n] for n in range(1, 41)}
    truth = Truth("boxes", Path("gt.txt"), {}, boxes, true, ignored, ignoring="removed")
    kept = counted(truth, found.frame, found.box_px)
    assert 0.3 < kept.mean() < 0.9
    theirs, ours = pair(true, found, ignored, "removed"), pair(true, found.at(kept))
    assert [p.overlap.tolist() for p in theirs.frames] == [p.overlap.tolist() for p in ours.frames]
