"""Fragments of one mover."""

import numpy as np
import pytest

from torchvision_dddas.detection.blobs import group_fragments

TORSO, LEGS = (50, 20, 20, 40), (52, 64, 16, 30)


def grouped(boxes, velocities):
    return sorted(
        sorted(g) for g in group_fragments(np.array(boxes, float).reshape(-1, 4), np.array(velocities, float))
    )


def test_fragments_near_each_other_that_move_alike_are_one():
    assert grouped([TORSO, LEGS], [(3, 0), (3.3, 0.2)]) == [[0, 1]]


@pytest.mark.parametrize("other", [(-3, 0), (0, 3), (4.5, 0), (np.nan, np.nan)])
def test_neighbours_that_move_differently_or_unknown_stay_apart(other):
    assert grouped([TORSO, LEGS], [(3, 0), other]) == [[0], [1]]


def test_neighbours_that_stand_stay_apart():
    """Without motion nothing says that they belong together."""
    assert grouped([TORSO, LEGS], [(0.1, 0), (0.1, 0)]) == [[0], [1]]


@pytest.mark.parametrize("box", [(52, 75, 16, 30), (75, 20, 20, 40), (66, 64, 30, 30)])
def test_movers_side_by_side_or_too_far_stay_apart(box):
    assert grouped([TORSO, box], [(3, 0), (3, 0)]) == [[0], [1]]


def test_a_chain_of_fragments_is_one_group_whatever_their_order():
    boxes = [(10, 10, 20, 20), (11, 33, 20, 20), (12, 56, 20, 20), (200, 10, 20, 20)]
    velocities = [(3, 0), (3, 0), (3, 0), (3, 0)]
    assert grouped(boxes, velocities) == [[0, 1, 2], [3]]
    assert grouped([boxes[i] for i in (2, 0, 3, 1)], velocities) == [[0, 1, 3], [2]]


def test_no_boxes_make_no_groups():
    assert group_fragments(np.zeros((0, 4)), np.zeros((0, 2))) == []
