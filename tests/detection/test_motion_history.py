"""The motion history of one clip: its stamps, its gradient, and its agreement with the batched operations."""

import math

import numpy as np
import pytest

from torchvision_dddas.detection.motion_history import NEWEST, MotionHistory, motion_gradient, region_orientation

SIZE = (67, 43)
ALL = (0, 0, *SIZE)


def shift(u: float, v: float) -> np.ndarray:
    return np.array([[1, 0, u], [0, 1, v], [0, 0, 1]], float)


def test_stamps_tell_how_many_frames_ago_a_place_moved_and_forget_after_the_duration(painted):
    history = MotionHistory(2.0)
    for number in range(1, 6):
        history.move(number, np.eye(3))
        history.add(painted(SIZE, (10 * number, 5, 4, 4)))
    stamps = history.stamps(ALL)
    assert [int(stamps[6, 10 * number + 1]) for number in range(1, 6)] == [0, 0, NEWEST - 2, NEWEST - 1, NEWEST]


def test_the_newest_silhouette_wins_where_two_overlap(painted):
    history = MotionHistory(6.0)
    for number, x in ((1, 10), (2, 12)):
        history.move(number, np.eye(3))
        history.add(painted(SIZE, (x, 5, 6, 6)))
    assert history.stamps((10, 7, 8, 1)).tolist() == [[NEWEST - 1] * 2 + [NEWEST] * 6]


def test_a_frame_number_that_is_missing_ages_the_past_by_two(painted):
    history = MotionHistory(6.0)
    history.move(1, None)
    history.add(painted(SIZE, (10, 5, 6, 6)))
    history.move(3, np.eye(3))
    assert history.stamps(ALL).max() == NEWEST - 2


def test_a_cut_forgets_everything(painted):
    history = MotionHistory(6.0)
    history.move(1, None)
    history.add(painted(SIZE, (10, 5, 6, 6)))
    history.move(2, None)
    assert not history.stamps(ALL).any()


def test_what_stands_on_the_ground_stays_there_under_a_camera_that_moves_by_fractions_of_a_pixel(painted):
    """Warping the stamps on at every step would leave them where they were: 0.4 px rounds to 0."""
    history = MotionHistory(20.0)
    history.move(1, None)
    history.add(painted(SIZE, (10, 5, 6, 6)))
    for number in range(2, 12):
        history.move(number, shift(0.4, 0.0))
    assert np.flatnonzero(history.stamps(ALL)[7]).tolist() == list(range(14, 20))


def test_a_history_does_not_change_with_the_array_it_was_given(painted):
    history = MotionHistory(6.0)
    history.move(1, None)
    silhouette = painted(SIZE, (10, 5, 6, 6))
    history.add(silhouette)
    silhouette[:] = 0
    assert history.stamps(ALL).max() == NEWEST


@pytest.mark.parametrize("box", [(0, 0, 20, 20), (33, 11, 34, 32), (5, 40, 3, 3)])
def test_stamps_in_a_box_are_those_of_the_whole_picture_cut_out(box, painted):
    history = MotionHistory(6.0)
    for number in range(1, 5):
        history.move(number, shift(1.3, -0.7))
        history.add(painted(SIZE, (8 * number, 2 * number, 9, 30)))
    x, y, width, height = box
    np.testing.assert_array_equal(history.stamps(box), history.stamps(ALL)[y : y + height, x : x + width])


@pytest.mark.parametrize("velocity", [(3, 0), (-3, 0), (0, 2), (0, -2)])
def test_the_orientation_of_a_trail_is_where_its_maker_went(velocity, painted):
    history = MotionHistory(6.0)
    for number in range(1, 6):
        history.move(number, np.eye(3))
        history.add(painted(SIZE, (28 + velocity[0] * (number - 3), 16 + velocity[1] * (number - 3), 12, 12)))
    stamps = history.stamps(ALL)
    angle, valid = motion_gradient(stamps, 0.5, 4.0)
    direction, agreement = region_orientation(angle, valid, stamps, stamps > 0, 6.0)
    turn = direction - math.atan2(velocity[1], velocity[0])
    assert abs(math.atan2(math.sin(turn), math.cos(turn))) < 0.02
    assert agreement > 0.9


def test_a_still_silhouette_has_no_direction(painted):
    history = MotionHistory(6.0)
    for number in range(1, 6):
        history.move(number, np.eye(3))
        history.add(painted(SIZE, (28, 16, 12, 12)))
    stamps = history.stamps(ALL)
    angle, valid = motion_gradient(stamps, 0.5, 4.0)
    assert not valid.any()
    direction, agreement = region_orientation(angle, valid, stamps, stamps > 0, 6.0)
    assert math.isnan(direction) and agreement == 0


def test_trails_that_point_opposite_ways_cancel():
    angle = np.array([[0.0, math.pi]], np.float32)
    stamps = np.full((1, 2), 254, np.uint8)
    every = np.ones((1, 2), bool)
    assert math.isnan(region_orientation(angle, every, stamps, every, 6.0)[0])
