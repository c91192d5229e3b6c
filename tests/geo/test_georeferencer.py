"""Frames laid on the ground one after another: slow errors are remembered, gaps are said, nothing invented."""

from dataclasses import replace

import numpy as np

from tests.airborne import CAMERA, look, with_aerial
from torchvision_dddas.config import Settings
from torchvision_dddas.geo.georeferencer import BiasFilter, Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.geo.pose_estimation import independent_expectation, pose_prior

SOLVER = load_solver("onboard")
NAMES = ("red", "green", "blue", "white", "black", "pink")
NAN = float("nan")


def registrar(settings=None, **parameters):
    return Georeferencer(CAMERA, settings or with_aerial(**parameters), SOLVER, names=NAMES)


def rows(marks, which):
    return replace(marks, **{name: getattr(marks, name)[which] for name in vars(marks)})


def off(fix, seen):
    return locate_pixels(fix, CAMERA, seen.targets_px, 1.0)[0] - seen.targets


def test_the_first_frame_is_that_of_a_single_picture():
    seen = look(1)
    alone, first = (registrar(correlation_s=s).update(1, 0.0, seen.flight, seen.marks) for s in (0.0, 20.0))
    assert np.allclose(alone.pose.place_m, first.pose.place_m, atol=1e-6)
    assert np.allclose(alone.covariance, first.covariance, rtol=1e-6)
    prior = pose_prior(seen.flight, CAMERA, Settings().aerial)
    assert prior is not None
    remembered = BiasFilter().at(0.0, prior, seen.marks, 20.0).expected(prior, seen.marks)
    assert np.allclose(remembered.information, independent_expectation(prior, seen.marks.sigma_m).information)


def test_few_landmarks_leave_the_rest_to_the_telemetry_and_none_leave_all():
    seen = look(7)
    few = registrar().update(9, 0.0, seen.flight, rows(seen.marks, [0, 1]))
    none = registrar().update(9, 0.0, seen.flight, rows(seen.marks, []))
    assert few.by == "pose" and "2 missing of the 4" in few.cause
    assert none.by == "telemetry" and none.cause == "frame 9 has no landmark: by telemetry alone"
    assert np.trace(few.covariance[3:6, 3:6]) < np.trace(none.covariance[3:6, 3:6])


def test_a_gap_is_said_and_no_place_invented():
    seen, one = look(8), registrar()
    assert one.update(16, 0.0, seen.flight, seen.marks).by == "pose"
    gap = one.update(17, 0.1, None, rows(seen.marks, [0, 1, 3]))
    assert gap.by == "" and gap.pose is None
    assert gap.cause == "frame 17 has 3 landmarks and no telemetry, 1 missing of the 4 that are needed"
    assert one.update(18, 0.2, seen.flight, seen.marks).by == "pose"


def test_a_row_of_landmarks_needs_telemetry():
    row = np.stack([np.linspace(-25, 25, 4), 0.1 * np.array([1.0, -1.0, -1.0, 1.0])], axis=1)
    seen = look(10, places=row, sigma_m=0.02)
    assert np.abs(off(registrar().update(1, 0.0, seen.flight, seen.marks), seen)).max() < 1.0
    assert "stand on one line" in registrar().update(1, 0.0, None, seen.marks).cause


def test_telemetry_that_lacks_what_the_landmarks_cannot_tell_is_named():
    seen = look(11)
    fix = registrar().update(4, 0.0, replace(seen.flight, heading_rad=NAN, place=(NAN, NAN)), rows(seen.marks, [0]))
    assert fix.by == ""
    assert fix.cause == "frame 4 has 1 landmark, too few where the telemetry does not say heading and place"


def test_landmarks_without_a_place_or_seen_twice_do_no_harm():
    seen = look(12, n=6)
    right = registrar().update(1, 0.0, seen.flight, rows(seen.marks, [0, 1, 2, 3]))
    places, pixels = seen.marks.east_north_m.copy(), seen.marks.image_px.copy()
    places[4], pixels[5] = NAN, [5.0, 5.0]
    marks = replace(seen.marks, east_north_m=places, image_px=pixels, landmark=np.array([0, 1, 2, 3, 4, 3]))
    fix = registrar().update(1, 0.0, seen.flight, marks)
    assert fix.state == ("used",) * 4 + ("excluded",) * 2
    assert fix.changes == ("black left out: its place is not known", "white left out where it is seen a second time")
    assert np.allclose(fix.pose.place_m, right.pose.place_m)


def test_the_bare_homography_is_by_landmarks_alone_and_telemetry_only_tests_them():
    seen = look(15, errors=0, sigma_m=0.5)
    swapped = replace(seen.marks, image_px=seen.marks.image_px[[1, 0, 2, 3]])
    one = registrar(mode="homography")
    fixes = [one.update(1, 0.0, flight, marks) for flight, marks in ((None, seen.marks), (seen.flight, swapped))]
    for fix in fixes:
        assert fix.by == "homography" and fix.pose is None and np.abs(off(fix, seen)).max() < 1e-6
    assert fixes[1].state == ("reassigned", "reassigned", "used", "used")


def test_landmarks_that_fit_hopelessly_leave_a_gap_and_no_place():
    """All six names went round: no change of one or two explains it."""
    seen = look(8, n=6)
    turned = replace(seen.marks, image_px=seen.marks.image_px[[4, 2, 1, 0, 5, 3]])
    fix = registrar().update(7, 0.0, None, turned)
    assert fix.by == "" and fix.pose is None and fix.state == ("excluded",) * 6
    assert "the landmarks disagree" in fix.cause and "10 times as large" in fix.cause
