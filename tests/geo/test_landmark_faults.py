"""The test of landmarks against telemetry: swaps and outliers found and repaired, right data left alone."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import CAMERA, GPS_M, look
from torchvision_dddas.config import AerialParameters
from torchvision_dddas.geo.landmark_faults import check_landmarks
from torchvision_dddas.geo.pose_estimation import focal_prior, independent_expectation, pose_prior
from torchvision_dddas.types import Camera, LandmarkObservations

KNOBS = AerialParameters()
NAMES = ("red", "green", "blue", "white", "black", "pink")
SEEDS = range(25)


def judged(seen, marks, telemetry=True):
    bare = independent_expectation(focal_prior(CAMERA, KNOBS), marks.sigma_m)
    prior = pose_prior(seen.flight, CAMERA, KNOBS)
    assert prior is not None
    expected = independent_expectation(prior, marks.sigma_m) if telemetry else bare
    names = NAMES[: len(marks)]
    return check_landmarks(marks, CAMERA, expected, KNOBS.gate_probability, names, bare if telemetry else None)


def with_pixels_of(marks, order):
    return replace(marks, image_px=marks.image_px[order])


def moved_away(marks, row, by_m):
    return replace(marks, east_north_m=marks.east_north_m + np.eye(len(marks))[:, row : row + 1] * by_m)


def same_pose(a, b):
    return np.allclose(a.solution.pose.place_m, b.solution.pose.place_m, atol=1e-2)


@pytest.mark.parametrize("altitude_m", [50.0, 200.0])
@pytest.mark.parametrize("pair", [(0, 1), (0, 2)])
def test_two_swapped_identities_are_found_and_swapped_back(pair, altitude_m):
    order = np.arange(4)
    order[list(pair)] = pair[::-1]
    for seed in SEEDS:
        seen = look(seed, altitude_m=altitude_m)
        right, repaired = judged(seen, seen.marks), judged(seen, with_pixels_of(seen.marks, order))
        assert repaired.order.tolist() == order.tolist() and same_pose(right, repaired)
    assert repaired.changes[0].startswith(f"identities of {NAMES[pair[0]]} and {NAMES[pair[1]]} swapped back (chi-sq")
    assert [repaired.state[row] for row in pair] == ["reassigned", "reassigned"]


@pytest.mark.parametrize("n", [4, 6])
def test_a_place_far_off_is_left_out_and_said_so(n):
    for seed in SEEDS:
        seen = look(seed, n=n)
        verdict = judged(seen, moved_away(seen.marks, 2, [15.0, -12.0]))
        assert verdict.state == tuple("excluded" if row == 2 else "used" for row in range(n))
    assert verdict.changes[0].startswith("blue left out: not where it is expected (chi-square")


def test_landmarks_that_agree_overrule_a_telemetry_that_does_not():
    seen = look(3, n=6, sigma_m=0.05)
    astray = replace(seen, flight=replace(seen.flight, place=(500.0, -400.0), altitude_m=20.0))
    verdict = judged(astray, seen.marks)
    assert verdict.alone and verdict.passed and verdict.used.all()
    assert np.allclose(verdict.solution.pose.place_m, seen.pose.place_m, atol=0.5)
    assert "telemetry left out: the 6 landmarks agree with one another, not with it" in verdict.changes[0]


@pytest.mark.parametrize("turn", [1, 3, 5])
def test_without_telemetry_four_of_six_landmarks_whose_names_are_all_wrong_are_not_believed(turn):
    places = np.array([[10.3, -5.1], [9.5, 11.7], [1.9, 13.4], [-12.9, 5.4], [-9.5, -6.8], [4.7, -12.2]])
    pixels = np.array([[1179, 500], [966, 221], [850, 284], [636, 619], [843, 790], [1173, 703.0]])
    camera = Camera("above", (1920, 1080), (1371.0, 1371.0), (959.5, 539.5))
    marks = LandmarkObservations(
        np.arange(6), np.roll(pixels, turn, axis=0), places, np.full(6, GPS_M), np.ones(6), np.zeros(6)
    )
    expected = independent_expectation(focal_prior(camera, KNOBS), marks.sigma_m)
    verdict = check_landmarks(marks, camera, expected, KNOBS.gate_probability, NAMES)
    assert not verdict.passed
    assert "no change explains it" in verdict.cause


def test_identities_that_went_round_are_put_back():
    for seed in SEEDS:
        seen = look(seed, n=6)
        repaired = judged(seen, with_pixels_of(seen.marks, np.roll(np.arange(6), 1)))
        assert repaired.order.tolist() == np.roll(np.arange(6), -1).tolist()
        assert same_pose(judged(seen, seen.marks), repaired)
    assert repaired.changes[0].startswith("identities reassigned")


def test_without_telemetry_six_landmarks_tell_which_is_off():
    seen = look(2, n=6)
    verdict = judged(seen, moved_away(seen.marks, 4, [60.0, 40.0]), telemetry=False)
    assert verdict.used.tolist() == [True, True, True, True, False, True]
