"""Landmarks whose errors are larger than stated widen the ellipses."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import CAMERA, look, with_aerial, within_95
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.landmark_misfit import Misfit
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels

SOLVER = load_solver("onboard")


def share_inside(too_small, n, seeds=range(40)):
    inside, causes = [], []
    for seed in seeds:
        seen = look(seed, n, altitude_m=100.0)
        marks = replace(seen.marks, sigma_m=seen.marks.sigma_m / too_small)
        fix = Georeferencer(CAMERA, with_aerial(correlation_s=0.0), SOLVER).update(1, 0.0, seen.flight, marks)
        place, covariance = locate_pixels(fix, CAMERA, seen.targets_px, 1.0)
        inside.append(within_95(place - seen.targets, covariance).mean())
        causes.append(fix.cause)
    return np.mean(inside), causes


@pytest.mark.slow
@pytest.mark.parametrize("too_small", [3.0, 10.0])
@pytest.mark.parametrize("n", [4, 8])
def test_ellipses_hold_the_truth_where_landmarks_state_errors_too_small(too_small, n):
    inside, causes = share_inside(too_small, n)
    assert inside > 0.8
    assert np.mean(["errors of landmarks taken" in cause for cause in causes]) > 0.7


def test_ellipses_stay_where_stated_errors_are_right():
    inside, causes = share_inside(1.0, 6)
    assert 0.88 < inside < 0.99
    assert np.mean(["errors of landmarks taken" in cause for cause in causes]) < 0.35


def test_the_frames_before_tell_what_one_frame_cannot():
    seen = [look(seed, 4) for seed in range(30)]
    georeferencer = Georeferencer(CAMERA, with_aerial(correlation_s=0.0), SOLVER)
    for k, one in enumerate(seen):
        marks = replace(one.marks, sigma_m=one.marks.sigma_m / 3)
        fix = georeferencer.update(k + 1, float(k), one.flight, marks)
    found = float(fix.cause.split("taken ")[1].split()[0])
    assert found == pytest.approx(3, rel=0.35)


def test_a_misfit_by_chance_changes_nothing():
    assert Misfit(9.0, 8.0).factor(0.05) == Misfit(0.5, 8.0).factor(0.05) == Misfit(50.0, 0.5).factor(0.05) == 1
    assert Misfit(800.0, 80.0).factor(0.05) == pytest.approx(np.sqrt(10))
