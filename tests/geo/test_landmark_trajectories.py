"""Where landmarks are in every frame: between reports, in dropouts, along their plans; and which of them are used."""

import numpy as np
import pytest

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.geo.landmark_trajectories import (
    LandmarkTrajectories,
    LandmarkUse,
    best_spread,
    select_landmarks,
    spread_m2,
)
from torchvision_dddas.types import LandmarkObservations, Landmarks

RATE = 25.0
KNOBS = LandmarkParameters(sigma_m=1.0, gap_s=4.0, drift_m_s=0.5, pixel_sigma=2.0, height_m=1.5)


def landmarks(rows, names=("a",), geographic=False):
    """rows: frame, landmark, east, north, and 1 at the end where it is a plan."""
    table = np.array(sorted((*row, 0)[:5] for row in rows), float)
    n, frame, which, place = len(table), table[:, 0], table[:, 1].astype(np.int64), table[:, 2:4]
    unseen, planned = np.full((n, 2), np.nan), table[:, 4] == 1
    return Landmarks(names, frame, which, unseen, place, unseen[:, 0], planned, np.arange(n), geographic)


def reported(seconds, places, names=("a",)):
    """The trajectories of a landmark that reports at these times."""
    rows = [(1 + RATE * t, 0, *place) for t, place in zip(seconds, places, strict=True)]
    return LandmarkTrajectories(landmarks(rows, names), KNOBS, RATE)


def test_reports_once_a_second_give_a_straight_way_in_every_frame_and_no_jump_at_a_report():
    course = reported(range(4), [(0, 0), (5, 0), (10, 5), (10, 15)])
    places = np.array([course.at(frame).east_north_m[0] for frame in range(1, 77)])
    assert places[[0, 25, 50, 75]].tolist() == [[0, 0], [5, 0], [10, 5], [10, 15]]
    assert places[10] == pytest.approx([2, 0])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() <= 10 / RATE + 1e-9
    assert all(course.at(frame).sigma_m[0] == pytest.approx(1.0) for frame in range(1, 77))


def test_a_short_dropout_is_bridged_and_in_a_long_one_the_landmark_is_absent_gap_s_after_its_last_report():
    course = reported([0, 1, 2, 5, 12, 13], [(2.0 * t, 0) for t in (0, 1, 2, 5, 12, 13)])
    for seconds, drifted_s in ((2, 0), (3.5, 1.5), (5, 0), (8, 3), (9, 4), (12, 0)):
        seen = course.at(1 + 25 * seconds)
        assert seen.east_north_m[0] == pytest.approx([2 * seconds, 0])
        assert seen.sigma_m[0] == pytest.approx(np.hypot(1.0, 0.5 * drifted_s))
    assert len(course.at(2 + 25 * 9)) == len(course.at(25 * 11)) == 0


def test_a_plan_carries_a_dropout_however_long_shifted_by_how_far_the_reports_were_from_it():
    corner = [(1 + 25 * t, 0, *place, 1) for t, place in ((0, (0, 0)), (10, (10, 0)), (20, (10, 10)))]
    reports = [(1 + 25 * t, 0, t, 0.5) for t in range(4)]
    course = LandmarkTrajectories(landmarks(reports + corner), KNOBS, RATE)
    later = course.at(1 + 25 * 16)
    assert course.at(1 + 25 * 10).east_north_m[0] == pytest.approx([10, 0.5])
    assert later.east_north_m[0] == pytest.approx([10, 6.5])
    # It strays from its plan by no more than it keeps to it at all.
    assert later.sigma_m[0] == pytest.approx(np.hypot(1, 1))
    assert len(course.at(1 + 25 * 21)) == 0  # beyond the plan, long after the last report


def test_speeds_are_those_over_the_ground():
    speed = reported(range(5), [(3 * t, 4 * t) for t in range(5)], ("a", "b")).speed_m_s(51)
    assert speed[0] == pytest.approx(5.0) and np.isnan(speed[1])


def test_degrees_are_refused():
    with pytest.raises(ValueError, match="wanted local metres"):
        LandmarkTrajectories(landmarks([(1, 0, 0, 0)], geographic=True), KNOBS, RATE)


SIX = np.array([[0, 0], [10, 0], [10, 10], [0, 10], [5, 5.2], [5, 0.3]], float)
SOURCE = LandmarkParameters(rule="source", poor_speed_m_s=2.0)
MARKS = LandmarkObservations(np.arange(6), SIX * 20, SIX, np.ones(6), np.ones(6), np.zeros(6))


def test_the_source_rule_takes_four_of_six_slow_landmarks_and_all_six_fast_ones_and_says_why():
    rows, use, record = select_landmarks(1, LandmarkUse(), MARKS, np.full(6, 1.0), SOURCE)
    assert (rows.tolist(), record) == ([0, 1, 2, 3], ())
    rows, use, (more,) = select_landmarks(2, use, MARKS, np.full(6, 2.5), SOURCE)
    assert len(rows) == 6 and use.poor
    assert (more.frame, more.parameter, more.old, more.new) == (2, "landmarks.used", 4, 6)
    assert more.cause == "6 landmarks in view go at 2.5 m/s on average, above 2: they are detected poorly"
    _, use, (fewer,) = select_landmarks(3, use, MARKS, np.full(6, 1.0), SOURCE)
    assert (fewer.old, fewer.new, use.poor) == (6, 4, False)


def test_the_best_spread_is_that_of_an_exhaustive_search_also_with_many_landmarks_in_one_place():
    assert spread_m2(np.array([[0, 0], [4, 0], [0, 2], [4, 3.0]])) == pytest.approx(4.0)
    assert best_spread(SIX, 4).tolist() == [0, 1, 2, 3]
    crowd = np.concatenate([np.full((20, 2), 5.0), SIX[:4]])
    assert best_spread(crowd, 4).tolist() == [20, 21, 22, 23]
    assert best_spread(np.full((9, 2), 5.0), 4).tolist() == sorted(set(best_spread(np.full((9, 2), 5.0), 4).tolist()))
