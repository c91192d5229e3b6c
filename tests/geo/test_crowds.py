"""Crowds: who is close together on the ground and goes the same way is one target."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.geo.crowds import group_targets, merge_detections
from torchvision_dddas.geometry import middles_of
from torchvision_dddas.types import Detections

STILL = np.zeros((3, 2))


def test_a_chain_of_near_targets_is_one_crowd_and_a_far_one_is_another():
    place = np.array([[0.0, 0], [4, 0], [8, 0], [30, 0]])
    assert group_targets(place, np.full(4, 1.0), np.zeros((4, 2)), 2.0, 1.5).tolist() == [0, 0, 0, 1]


def test_a_car_that_passes_a_crowd_is_none_of_it():
    place, velocity = np.array([[0.0, 0], [1, 0]]), np.array([[1.0, 0], [6, 0]])
    assert group_targets(place, np.ones(2), velocity, 3.0, 1.5).tolist() == [0, 1]
    velocity[1] = np.nan  # whose way nobody knows goes with all
    assert group_targets(place, np.ones(2), velocity, 3.0, 1.5).tolist() == [0, 0]


def test_targets_of_unknown_place_stay_alone():
    place = np.array([[0.0, 0], [np.nan, np.nan], [np.nan, np.nan]])
    assert group_targets(place, np.ones(3), STILL, 100.0, 1.5).tolist() == [0, 1, 2]
    assert group_targets(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)), 1.0, 1.0).tolist() == []


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), min_size=1, max_size=12), st.randoms())
def test_crowds_do_not_depend_on_the_order_of_targets(places, chance):
    place = np.array(places, float)
    order = list(range(len(place)))
    chance.shuffle(order)
    ones, still = np.ones(len(place)), np.zeros((len(place), 2))
    crowd, shuffled = (group_targets(p, ones, still, 2.0, 1.0) for p in (place, place[order]))
    same = crowd[:, None] == crowd[None]
    assert (same[np.ix_(order, order)] == (shuffled[:, None] == shuffled[None])).all()


def scene():
    mask = np.zeros((20, 30), np.uint16)
    mask[2:6, 3:7], mask[10:12, 20:28], mask[3:5, 9:11] = 1, 2, 3
    found = Detections(
        np.array([[3.0, 2, 4, 4], [20, 10, 8, 2], [9, 3, 2, 2]]),
        np.array([0.5, 0.7, 0.9]),
        np.array([16.0, 16, 4]),
        np.array([0.0, np.nan, np.pi / 2]),
        np.array([2.0, np.nan, 2.0]),
    )
    return found, mask


def test_the_middle_is_the_mean_of_the_foreground():
    found, mask = scene()
    assert middles_of(found.box_px, mask).tolist() == [[4.5, 3.5], [23.5, 10.5], [9.5, 3.5]]
    mask[mask == 2] = 0
    assert np.isnan(middles_of(found.box_px, mask)[1]).all()


def test_a_crowd_has_the_box_area_score_and_mean_motion_of_its_parts():
    found, mask = scene()
    found = replace(found, middle_px=middles_of(found.box_px, mask))
    crowds, numbered = merge_detections(found, mask, np.array([0, 1, 0]))
    assert crowds.box_px.tolist() == [[3, 2, 8, 4], [20, 10, 8, 2]]
    assert crowds.score.tolist() == [0.9, 0.7]
    assert crowds.area_px.tolist() == [20, 16]
    assert crowds.middle_px[0] == pytest.approx([(16 * 4.5 + 4 * 9.5) / 20, 3.5])
    # Four fifths of it go right at 2 px a frame, one fifth down.
    assert crowds.speed_px[0] == pytest.approx(np.hypot(1.6, 0.4))
    assert crowds.heading_rad[0] == pytest.approx(np.arctan2(0.4, 1.6))
    assert np.isnan(crowds.speed_px[1])
    assert sorted(np.unique(numbered)) == [0, 1, 2]
    assert (numbered == 1).sum() == 20
    assert (numbered > 0).sum() == (mask > 0).sum()
