"""The errors of a log are found by points of known place in its pictures."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import CAMERA
from torchvision_dddas.config import AerialParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import Look, estimate_flight_errors, pose_prior
from torchvision_dddas.geometry import axes_of, ground_with_slopes, turned
from torchvision_dddas.types import CameraPose, Flight, LandmarkObservations

SIGMA = np.array([0.5, 0.5, 1.5, 0.8, 0.8, 0.6]) * np.r_[np.radians([1] * 3), 1, 1, 1]
"""True errors of each picture, in the order of a pose."""


def looks(pictures=40, offset_deg=4.0, interval_s=60.0, sigma=SIGMA, seed=0, pitches=(40.0, 60.0, 90.0)):
    rng, found = np.random.default_rng(seed), []
    for k in range(pictures):
        heading, pitch = rng.uniform(0, 6), np.radians(rng.choice(pitches))
        height = float(rng.choice([30.0, 60.0, 120.0]))
        error = rng.normal(0, sigma) - [0, 0, np.radians(offset_deg), 0, 0, 0]
        told = CameraPose(np.array([*rng.uniform(-20, 20, 2), height]), axes_of(heading, pitch, 0.0))
        true = CameraPose(told.place_m + error[3:], turned(error[:3]) @ told.axes)
        pixels = rng.uniform(0.1, 0.9, (3, 2)) * CAMERA.size_px
        places = ground_with_slopes(true, CAMERA, pixels)[0]
        marks = LandmarkObservations(np.arange(3), pixels, places, np.full(3, 0.05), np.ones(3), np.zeros(3))
        flight = Flight(height, place=tuple(told.place_m[:2]), heading_rad=heading, pitch_rad=pitch, roll_rad=0.0)
        prior = pose_prior(flight, CAMERA, AerialParameters())
        assert prior is not None
        found.append(Look(k + 1, interval_s * k, prior, marks))
    return found


def estimate(seen):
    return estimate_flight_errors(seen, CAMERA, AerialParameters())


@pytest.mark.parametrize("offset_deg", [4.0, -150.0])
def test_offset_and_standard_deviations_are_found(offset_deg):
    found = estimate(looks(offset_deg=offset_deg))
    assert abs(np.degrees(found.offset[0]) - offset_deg) < 3 * np.degrees(found.offset_sigma[0]) < 3
    assert found.shown.all() and not found.wrong
    np.testing.assert_allclose(found.sigma, SIGMA[[0, 2, 3, 5]], rtol=0.35)
    values = found.settings(AerialParameters(heading_offset_deg=1.0))
    assert values["aerial.heading_offset_deg"] == pytest.approx(1 + np.degrees(found.offset[0]), abs=0.01)
    assert values["aerial.heading_sigma_deg"] == pytest.approx(1.5, rel=0.3)
    assert not any("heading" in name for name in found.settings(AerialParameters(), ["heading"]))


@pytest.mark.slow
def test_a_wrong_point_is_left_out_and_changes_little():
    seen, right = looks(), estimate(looks())
    seen[7].marks.east_north_m[1] += [15.0, -10.0]
    found = estimate(seen)
    assert found.wrong == ((8, 1),)
    np.testing.assert_allclose(found.sigma, right.sigma, rtol=0.1)


def turned_looks(angles_deg, pitches):
    """Looks of small errors whose log is turned about the level axes to the left and ahead of each heading."""
    seen = looks(sigma=0.2 * SIGMA, pitches=pitches)
    for look in seen:
        sine, cosine = np.sin(a := look.prior.pose.angles_rad[0]), np.cos(a)
        turn = np.radians(angles_deg) @ [[-cosine, sine, 0], [sine, cosine, 0]]
        look.prior.pose.axes[:] = turned(turn) @ look.prior.pose.axes
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("offset_deg", [1.0, -1.0])
def test_a_camera_that_looks_lower_than_its_log_gets_an_offset_of_the_pitch(offset_deg):
    found = estimate(turned_looks([-offset_deg, 0.0], (40.0, 60.0, 90.0)))
    assert np.degrees(found.offset[1]) == pytest.approx(offset_deg, abs=0.15)
    values = found.settings(AerialParameters(pitch_offset_deg=2.0))
    assert values["aerial.pitch_offset_deg"] == pytest.approx(2.0 + offset_deg, abs=0.15)
    assert values["aerial.tilt_sigma_deg"] < 0.4
    assert not any("pitch" in name for name in found.settings(AerialParameters(), ["tilt"]))


@pytest.mark.slow
def test_an_offset_without_a_parameter_counts_in_the_standard_deviation():
    found = estimate(turned_looks([0.0, -1.0], (40.0, 60.0)))
    assert np.degrees(found.offset[2]) == pytest.approx(1.0, abs=0.15)
    assert found.settings(AerialParameters())["aerial.tilt_sigma_deg"] == pytest.approx(np.sqrt(0.5), abs=0.15)


def test_pictures_in_quick_succession_tell_little():
    few = estimate(looks(10, interval_s=0.1))
    assert not few.shown.all()
    assert few.offset_sigma[0] > 1.5 * estimate(looks(10)).offset_sigma[0]


@pytest.mark.slow
def test_too_few_pictures_and_a_log_of_another_flight_are_refused():
    with pytest.raises(InputError, match=r"at least 6 pictures with points are needed.*got 5"):
        estimate(looks(5))
    with pytest.raises(InputError, match="the points contradict the log"):
        estimate([replace(look, marks=other.marks) for look, other in zip(looks(), looks(seed=1), strict=True)])
