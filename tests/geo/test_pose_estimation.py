"""The likeliest pose and the test of landmarks against telemetry: swaps and outliers are found and repaired."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import CAMERA, look, ring
from torchvision_dddas.config import AerialParameters
from torchvision_dddas.geo.landmark_faults import check_landmarks
from torchvision_dddas.geo.pose_estimation import find_pose, focal_prior, independent_expectation, pose_prior
from torchvision_dddas.geometry import turn_of

PARAMETERS = AerialParameters()
NAN = float("nan")
NAMES = ("red", "green", "blue", "white", "black", "pink")
TELEMETRY = {
    "all": {},
    "no heading": {"heading_rad": NAN},
    "no place": {"place": (NAN, NAN)},
    "no altitude": {"altitude_m": NAN},
    "no heading or place": {"heading_rad": NAN, "place": (NAN, NAN)},
    "no place or altitude": {"place": (NAN, NAN), "altitude_m": NAN},
    "field of view": {"hfov_rad": 2 * np.arctan(960 / CAMERA.focal_px[0])},
}


def solved(seen, flight, camera=CAMERA):
    prior = pose_prior(flight, camera, PARAMETERS) or focal_prior(camera, PARAMETERS)
    return find_pose(seen.marks, camera, independent_expectation(prior, seen.marks.sigma_m))


def same(found, pose):
    assert np.allclose(found.pose.place_m, pose.place_m, atol=0.02)
    assert np.allclose(found.pose.axes, pose.axes, atol=1e-3)
    assert np.isclose(found.pose.focal, pose.focal, atol=1e-3)


@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
@pytest.mark.parametrize("known", TELEMETRY.values(), ids=TELEMETRY)
def test_exact_data_give_the_exact_pose_whatever_the_telemetry_leaves_out(known, tilt_deg):
    seen = look(1, n=5, tilt_deg=tilt_deg, errors=0)
    found = solved(seen, replace(seen.flight, **known))
    same(found, seen.pose)
    assert found.covariance[6, 6] <= PARAMETERS.focal_sigma**2 * (1 + 1e-9)


def test_a_log_that_states_the_error_of_its_places_counts_before_the_parameters():
    flight = replace(look(0).flight, position_sigma_m=0.02)
    prior = pose_prior(flight, CAMERA, PARAMETERS)
    assert prior is not None
    np.testing.assert_allclose(prior.information.diagonal()[3:5], 1 / 0.02**2)


def test_a_bent_lens_is_allowed_for():
    bent = replace(CAMERA, k1=-0.15, k2=0.03)
    seen = look(3, errors=0, camera=bent)
    same(solved(seen, seen.flight, camera=bent), seen.pose)
    assert np.abs(solved(seen, seen.flight).pose.place_m - seen.pose.place_m).max() > 0.1


@pytest.mark.parametrize("case", [{"tilt_deg": 45.0}, {"sigma_m": 0.0}, {"n": 6}, {"places": ring(4) * [1, 0.01]}])
def test_the_true_pose_lies_where_the_covariance_says(case):
    """Mahalanobis distances of 7 are chi-square of 7: mean 7, and a mean over 60 has a deviation of 0.5."""
    distance = []
    for seed in range(60):
        seen = look(seed, **case)
        found = solved(seen, seen.flight)
        turn, moved = turn_of(seen.pose.axes @ found.pose.axes.T), seen.pose.place_m - found.pose.place_m
        off = np.r_[turn, moved, np.log(seen.pose.focal / found.pose.focal)]
        distance.append(off @ np.linalg.solve(found.covariance[:7, :7], off))
    assert 5.2 < np.mean(distance) < 8.8


def test_with_no_landmark_the_pose_is_the_telemetrys_and_with_such_as_no_camera_there_can_see_there_is_none():
    seen = look(7, places=np.zeros((0, 2)))
    found = solved(seen, seen.flight)
    assert np.allclose(found.pose.place_m[:2], seen.flight.place)
    sigma = [*np.radians([1, 1, 5]), 1.43, 1.43, 0.02 * seen.flight.altitude_m, 0.01]
    assert np.allclose(np.sqrt(np.diag(found.covariance)), sigma)
    seen = look(8, n=3)
    assert solved(seen, replace(seen.flight, pitch_rad=-1.5)) is None


# The test of landmarks.


def checked(seen, marks, telemetry=True):
    bare = independent_expectation(focal_prior(CAMERA, PARAMETERS), marks.sigma_m)
    prior = pose_prior(seen.flight, CAMERA, PARAMETERS) if telemetry else None
    expected = bare if prior is None else independent_expectation(prior, marks.sigma_m)
    alone = bare if telemetry else None
    return check_landmarks(marks, CAMERA, expected, PARAMETERS.gate_probability, NAMES[: len(marks)], alone)


def with_pixels_of(marks, order):
    return replace(marks, image_px=marks.image_px[order])


def moved_away(marks, row, by_m):
    return replace(marks, east_north_m=marks.east_north_m + np.eye(len(marks))[:, [row]] * by_m)


@pytest.mark.parametrize("altitude_m", [50.0, 200.0])
@pytest.mark.parametrize("pair", [(0, 1), (0, 2)])
def test_two_swapped_identities_are_found_and_swapped_back(pair, altitude_m):
    order = np.arange(4)
    order[list(pair)] = pair[::-1]
    for seed in range(10):
        seen = look(seed, altitude_m=altitude_m)
        right, repaired = checked(seen, seen.marks), checked(seen, with_pixels_of(seen.marks, order))
        assert repaired.order.tolist() == order.tolist()
        assert np.allclose(right.solution.pose.place_m, repaired.solution.pose.place_m, atol=1e-2)
    assert repaired.changes[0].startswith(f"identities of {NAMES[pair[0]]} and {NAMES[pair[1]]} swapped back (chi-sq")
    assert [repaired.state[row] for row in pair] == ["reassigned", "reassigned"]


def test_identities_that_went_round_are_put_back():
    for seed in range(15):
        seen = look(seed, n=6)
        repaired = checked(seen, with_pixels_of(seen.marks, np.roll(np.arange(6), 1)))
        assert repaired.order.tolist() == np.roll(np.arange(6), -1).tolist()
    assert repaired.changes[0].startswith("identities reassigned")


@pytest.mark.parametrize("n", [4, 6])
def test_a_place_far_off_is_left_out_also_without_telemetry_where_six_landmarks_tell_which(n):
    for seed in range(10):
        seen = look(seed, n=n)
        check = checked(seen, moved_away(seen.marks, 2, [15.0, -12.0]))
        assert check.state == tuple("excluded" if row == 2 else "used" for row in range(n))
    assert check.changes[0].startswith("blue left out: not where it is expected (chi-square")
    seen = look(2, n=6)
    check = checked(seen, moved_away(seen.marks, 4, [60.0, 40.0]), telemetry=False)
    assert check.used.tolist() == [True, True, True, True, False, True]


def test_landmarks_that_agree_overrule_a_telemetry_that_does_not():
    seen = look(3, n=6, sigma_m=0.05)
    astray = replace(seen, flight=replace(seen.flight, place=(500.0, -400.0), altitude_m=20.0))
    check = checked(astray, seen.marks)
    assert check.alone and check.passed and check.used.all()
    assert np.allclose(check.solution.pose.place_m, seen.pose.place_m, atol=0.5)
    assert "telemetry left out: the 6 landmarks agree with one another, not with it" in check.changes[0]


@pytest.mark.parametrize("turn", [1, 3, 5])
def test_without_telemetry_four_of_six_landmarks_whose_names_are_all_wrong_are_not_believed(turn):
    places = np.array([[10.3, -5.1], [9.5, 11.7], [1.9, 13.4], [-12.9, 5.4], [-9.5, -6.8], [4.7, -12.2]])
    pixels = np.array([[1179, 500], [966, 221], [850, 284], [636, 619], [843, 790], [1173, 703.0]])
    marks = replace(look(0, n=6).marks, image_px=np.roll(pixels, turn, axis=0), east_north_m=places)
    check = checked(None, marks, telemetry=False)
    assert not check.passed and "no change explains it" in check.cause
