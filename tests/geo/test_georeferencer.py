"""Frames mapped to the ground one after another: slow errors are estimated, gaps are named, nothing is invented."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import CAMERA, GPS_M, look, with_aerial, within_95
from torchvision_dddas.config import Settings
from torchvision_dddas.geo.georeferencer import BiasFilter, Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.geo.pose_estimation import independent_expectation, pose_prior
from torchvision_dddas.geometry.projection import axes_of, project
from torchvision_dddas.types import Camera, CameraPose, Flight, LandmarkObservations

SOLVER = load_solver("onboard")
NAMES = ("red", "green", "blue", "white", "black", "pink")
NAN = float("nan")


def georeferencer(camera=CAMERA, **parameters):
    return Georeferencer(camera, with_aerial(**parameters), SOLVER, names=NAMES)


def off(fix, seen):
    return locate_pixels(fix, CAMERA, seen.targets_px, 1.0)[0] - seen.targets


def test_the_first_frame_is_that_of_a_single_picture():
    seen = look(1)
    alone, first = (georeferencer(correlation_s=s).update(1, 0.0, seen.flight, seen.marks) for s in (0.0, 20.0))
    assert np.allclose(alone.pose.place_m, first.pose.place_m, atol=1e-6)
    assert np.allclose(alone.covariance, first.covariance, rtol=1e-6)
    prior = pose_prior(seen.flight, CAMERA, Settings().aerial)
    assert prior is not None
    remembered = BiasFilter().at(0.0, prior, seen.marks, 20.0).expected(prior, seen.marks)
    assert np.allclose(remembered.information, independent_expectation(prior, seen.marks.sigma_m).information)


def test_few_landmarks_leave_the_rest_to_the_telemetry_and_none_leave_all():
    seen = look(7)
    few, none = (georeferencer().update(9, 0.0, seen.flight, seen.marks[:n]) for n in (2, 0))
    assert few.by == "pose" and "2 missing of the 4" in few.cause
    assert none.by == "telemetry" and none.cause == "frame 9 has no landmark: by telemetry alone"
    assert np.trace(few.covariance[3:6, 3:6]) < np.trace(none.covariance[3:6, 3:6])


def test_gaps_and_telemetry_that_lacks_what_the_landmarks_cannot_tell_are_named_and_no_place_invented():
    seen, one = look(8), georeferencer()
    assert one.update(16, 0.0, seen.flight, seen.marks).by == "pose"
    gap = one.update(17, 0.1, None, seen.marks[np.array([0, 1, 3])])
    assert gap.by == "" and gap.pose is None
    assert gap.cause == "frame 17 has 3 landmarks and no telemetry, 1 missing of the 4 that are needed"
    assert one.update(18, 0.2, seen.flight, seen.marks).by == "pose"
    fix = georeferencer().update(4, 0.0, replace(seen.flight, heading_rad=NAN, place=(NAN, NAN)), seen.marks[:1])
    assert fix.by == ""
    assert fix.cause == "frame 4 has 1 landmark, too few where the telemetry does not say heading and place"


def test_a_row_of_landmarks_needs_telemetry():
    row = np.stack([np.linspace(-25, 25, 4), 0.1 * np.array([1.0, -1.0, -1.0, 1.0])], axis=1)
    seen = look(10, places=row, sigma_m=0.02)
    assert np.abs(off(georeferencer().update(1, 0.0, seen.flight, seen.marks), seen)).max() < 1.0
    assert "stand on one line" in georeferencer().update(1, 0.0, None, seen.marks).cause


def test_landmarks_without_a_place_or_seen_twice_do_no_harm():
    seen = look(12, n=6)
    right = georeferencer().update(1, 0.0, seen.flight, seen.marks[:4])
    places, pixels = seen.marks.east_north_m.copy(), seen.marks.image_px.copy()
    places[4], pixels[5] = NAN, [5.0, 5.0]
    marks = replace(seen.marks, east_north_m=places, image_px=pixels, landmark=np.array([0, 1, 2, 3, 4, 3]))
    fix = georeferencer().update(1, 0.0, seen.flight, marks)
    assert fix.state == ("used",) * 4 + ("excluded",) * 2
    assert fix.changes == ("black left out: its place is not known", "white left out where it is seen a second time")
    assert np.allclose(fix.pose.place_m, right.pose.place_m)


def test_a_repair_is_kept_from_frame_to_frame_and_dropped_when_the_landmarks_are_right_again():
    seen, one = look(2, n=5), georeferencer()
    swapped = replace(seen.marks, image_px=seen.marks.image_px[[1, 0, 2, 3, 4]])
    states = [one.update(k + 1, 0.2 * k, seen.flight, swapped if k < 3 else seen.marks).state for k in range(4)]
    assert states == [("reassigned", "reassigned", "used", "used", "used")] * 3 + [("used",) * 5]


def test_the_bare_homography_is_by_landmarks_alone_and_telemetry_only_tests_them():
    seen = look(15, errors=0, sigma_m=0.5)
    swapped = replace(seen.marks, image_px=seen.marks.image_px[[1, 0, 2, 3]])
    one = georeferencer(mode="homography")
    fixes = [one.update(1, 0.0, flight, marks) for flight, marks in ((None, seen.marks), (seen.flight, swapped))]
    for fix in fixes:
        assert fix.by == "homography" and fix.pose is None and np.abs(off(fix, seen)).max() < 1e-6
    assert fixes[1].state == ("reassigned", "reassigned", "used", "used")


def test_landmarks_that_fit_hopelessly_leave_a_gap_and_no_place():
    """All six names went round: no change of one or two explains it."""
    seen = look(8, n=6)
    fix = georeferencer().update(7, 0.0, None, replace(seen.marks, image_px=seen.marks.image_px[[4, 2, 1, 0, 5, 3]]))
    assert fix.by == "" and fix.pose is None and fix.state == ("excluded",) * 6
    assert "the landmarks disagree" in fix.cause


# Flights with slow errors.

HIGH = Camera("aerial", (1920, 1080), (1371.0, 1371.0), (959.5, 539.5))
RING_M = 25.0 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
TARGETS_M = np.array([[3.0, 4.0], [-6.0, 2.0], [1.0, -8.0]])


def flown(decay_s: tuple[float, float], correlation_s: float, seed: int) -> tuple[float, float]:
    """Mean error and share in the ellipses of 95 % in the second half of a flight.

    Telemetry and receivers err as the settings say; their errors decay over decay_s.
    """
    rng, frames, step_s = np.random.default_rng(seed), 70, 0.2
    one = georeferencer(HIGH, correlation_s=correlation_s)
    keep = np.repeat(np.exp(-step_s / np.array(decay_s)), (6, 8))
    sigma = np.array([GPS_M, GPS_M, 1.0, *np.radians([5.0, 1.0, 1.0]), *[GPS_M] * 8])
    away, inside, slow, angles = [], [], rng.normal(0, 1, 14), np.array([0.4, 1.4, 0.0])
    pose = CameraPose(np.array([0.0, 0.0, 50.0]), axes_of(*angles))
    for frame in range(1, frames + 1):
        marks_px, targets_px = (
            project(np.c_[place, np.zeros(len(place))], pose, HIGH) + rng.normal(0, 1, place.shape)
            for place in (RING_M, TARGETS_M)
        )
        off = slow * sigma
        east, north, up = pose.place_m + off[:3]
        flight = Flight(up, float("nan"), (east, north), float("nan"), *(angles + off[3:6]))
        reports = RING_M + off[6:].reshape(4, 2)
        marks = LandmarkObservations(np.arange(4), marks_px, reports, np.full(4, GPS_M), np.ones(4), np.zeros(4))
        found, covariance = locate_pixels(one.update(frame, step_s * frame, flight, marks), HIGH, targets_px, 1.0)
        if frame > frames // 2:
            away.append(np.linalg.norm(found - TARGETS_M, axis=1).mean())
            inside.append(within_95(found - TARGETS_M, covariance).mean())
        slow = keep * slow + np.sqrt(1 - keep**2) * rng.normal(0, 1, slow.shape)
    return float(np.mean(away)), float(np.mean(inside))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("decay_s", "share"), [((4.0, 4.0), 1.05), ((1e-3, 1e-3), 1.05), ((1e-3, 20.0), 0.8), ((20.0, 1e-3), 0.8)]
)
def test_a_flight_averages_out_what_errs_anew_and_errors_that_decay_faster_than_expected_do_no_harm(decay_s, share):
    """share: of the error without a memory of slow errors."""
    (error, inside), (single, _) = (
        np.mean([flown(decay_s, correlation_s, seed) for seed in range(4)], axis=0) for correlation_s in (20.0, 0.0)
    )
    assert error < share * single and inside > 0.85
