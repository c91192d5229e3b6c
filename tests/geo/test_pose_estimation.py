"""The likeliest pose: exact on exact data, honest about its errors, at home with telemetry that says little."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.airborne import CAMERA, look, ring
from torchvision_dddas.config import AerialParameters
from torchvision_dddas.geo.pose_estimation import find_pose, focal_prior, independent_expectation, pose_prior

KNOBS = AerialParameters()
NAN = float("nan")
SAYS_NOT: dict[str, dict[str, Any]] = {
    "nothing": {},
    "heading": {"heading_rad": NAN},
    "place": {"place": (NAN, NAN)},
    "altitude": {"altitude_m": NAN},
    "heading or place": {"heading_rad": NAN, "place": (NAN, NAN)},
    "place or altitude": {"place": (NAN, NAN), "altitude_m": NAN},
}


def solved(seen, flight, used=None, camera=CAMERA):
    prior = pose_prior(flight, camera, KNOBS) or focal_prior(camera, KNOBS)
    return find_pose(seen.marks, camera, independent_expectation(prior, seen.marks.sigma_m), used)


def same(found, pose):
    assert np.allclose(found.pose.place_m, pose.place_m, atol=0.02)
    assert np.allclose(found.pose.axes, pose.axes, atol=1e-3)
    assert np.isclose(found.pose.focal, pose.focal, atol=1e-3)


@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
@pytest.mark.parametrize("says_not", SAYS_NOT)
def test_exact_data_give_the_exact_pose_whatever_the_telemetry_leaves_out(says_not, tilt_deg):
    seen = look(1, n=5, tilt_deg=tilt_deg, errors=0)
    same(solved(seen, replace(seen.flight, **SAYS_NOT[says_not])), seen.pose)


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
        turn = seen.pose.axes @ found.pose.axes.T
        off = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        off = np.concatenate(
            [off, seen.pose.place_m - found.pose.place_m, [np.log(seen.pose.focal / found.pose.focal)]]
        )
        distance.append(off @ np.linalg.solve(found.covariance[:7, :7], off))
    assert 5.2 < np.mean(distance) < 8.8


def test_with_no_landmark_the_pose_is_that_of_the_telemetry():
    seen = look(7, places=np.zeros((0, 2)))
    found = solved(seen, seen.flight)
    assert np.allclose(found.pose.place_m[:2], seen.flight.place)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.allclose(sigma[:5], [np.radians(1), np.radians(1), np.radians(5), 1.43, 1.43])
    assert np.allclose(sigma[5:], [0.02 * seen.flight.altitude_m, 0.01])


def test_landmarks_that_no_camera_up_there_can_see_have_no_pose():
    seen = look(8, n=3)
    up = replace(seen.flight, pitch_rad=-1.5)
    assert solved(seen, up) is None
