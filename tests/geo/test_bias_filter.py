"""What the registrar believes of errors: that those last which foretell the pictures best."""

import numpy as np
import pytest

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.geo.projection import axes_of, project
from torchvision_dddas.types import Camera, CameraPose, Flight, LandmarkObservations

CAMERA = Camera("aerial", (1920, 1080), (1371.0, 1371.0), (959.5, 539.5))
RING_M = 25.0 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
TARGETS_M = np.array([[3.0, 4.0], [-6.0, 2.0], [1.0, -8.0]])
GPS_M, TILT, HEADING = 1.43, np.radians(1.0), np.radians(5.0)
FRAMES, STEP_S = 70, 0.2


def flown(alike_s: tuple[float, float], told_s: float, seed: int) -> tuple[float, float]:
    """Mean error and share in the ellipses of 95 % in the second half of a flight.

    Telemetry and receivers err as the settings say, alike over alike_s each; the registrar is told told_s.
    """
    rng = np.random.default_rng(seed)
    registrar = Georeferencer(
        CAMERA, with_parameters(Settings(), {"aerial.correlation_s": told_s}), load_solver("onboard")
    )
    keep = np.repeat(np.exp(-STEP_S / np.array(alike_s)), (6, 8))
    off, inside = [], []
    slow = rng.normal(0, 1, 14)
    pose = CameraPose(np.array([0.0, 0.0, 50.0]), axes_of(0.4, 1.4, 0.0))
    for frame in range(1, FRAMES + 1):
        seen = [project(np.c_[where, np.zeros(len(where))], pose, CAMERA) for where in (RING_M, TARGETS_M)]
        seen = [pixels + rng.normal(0, 1, pixels.shape) for pixels in seen]
        place = pose.place_m + slow[:3] * (GPS_M, GPS_M, 1.0)
        angles = np.array([0.4, 1.4, 0.0]) + slow[3:6] * (HEADING, TILT, TILT)
        flight = Flight(
            place[2], place=(place[0], place[1]), heading_rad=angles[0], pitch_rad=angles[1], roll_rad=angles[2]
        )
        reports = RING_M + GPS_M * slow[6:].reshape(4, 2)
        marks = LandmarkObservations(np.arange(4), seen[0], reports, np.full(4, GPS_M), np.ones(4), np.zeros(4))
        fix = registrar.update(frame, STEP_S * frame, flight, marks)
        found, covariance = locate_pixels(fix, CAMERA, seen[1], 1.0)
        if frame > FRAMES // 2:
            away = found - TARGETS_M
            off.append(np.linalg.norm(away, axis=1).mean())
            inside.append((np.einsum("ni,nij,nj->n", away, np.linalg.inv(covariance), away) < 5.991).mean())
        slow = keep * slow + np.sqrt(1 - keep**2) * rng.normal(0, 1, slow.shape)
    return float(np.mean(off)), float(np.mean(inside))


def flights(alike_s: tuple[float, float], told_s: float = 20.0) -> tuple[float, float]:
    off, inside = np.mean([flown(alike_s, told_s, seed) for seed in range(4)], axis=0)
    return off, inside


@pytest.mark.slow
@pytest.mark.parametrize("alike_s", [(4.0, 4.0), (1.0, 1.0), (1e-3, 1e-3)])
def test_errors_that_change_faster_than_told_do_no_harm_and_ellipses_still_hold(alike_s: tuple[float, float]) -> None:
    off, inside = flights(alike_s)
    assert off < 1.05 * flights(alike_s, told_s=0.0)[0]
    assert inside > 0.85


@pytest.mark.slow
@pytest.mark.parametrize("alike_s", [(1e-3, 20.0), (20.0, 1e-3)])
def test_where_one_errs_anew_in_every_frame_and_the_other_alike_a_flight_averages_it_out(
    alike_s: tuple[float, float],
) -> None:
    off, inside = flights(alike_s)
    assert off < 0.8 * flights(alike_s, told_s=0.0)[0]
    assert inside > 0.85
