"""What pictures from the ground say of located targets, and where people are searched for in them."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.config import GroundParameters, Settings
from torchvision_dddas.control import ground_confirmation
from torchvision_dddas.control.confirmation import GroundObservation
from torchvision_dddas.control.ground_confirmation import GroundConfirmation, drop_fast_targets, expected_regions
from torchvision_dddas.control.prediction import Prediction
from torchvision_dddas.types import (
    AerialLocations,
    Camera,
    Fix,
    GroundPicture,
    LandmarkObservations,
    People,
    Positions,
)

CAMERA = Camera("", (640, 480), (600.0, 600.0), (319.5, 239.5), height_m=1.3, position_sigma_m=0.1)
HEADING = math.radians(60)


def test_people_beside_the_way_of_a_car_do_not_make_it_human_and_its_empty_view_still_counts():
    apart = np.ones(4)
    seen = GroundObservation(np.ones(4, bool), np.array([3, 3, 0, 2]), apart, apart, np.full(4, 0.9))
    velocity = np.array([[5.0, 0.0], [1.2, 0.3], [0.0, 7.0], [np.nan, np.nan]])
    assert drop_fast_targets(seen, velocity).looked.tolist() == [False, True, True, True]


def test_a_target_that_the_air_missed_is_found_by_its_people_and_nothing_is_concluded_of_it(monkeypatch):
    """Five people 12 m ahead of a vehicle; the air locates another target, to the side of its view."""
    ahead, right = np.array([math.sin(HEADING), math.cos(HEADING)]), np.array([math.cos(HEADING), -math.sin(HEADING)])
    at = [(12.0, side) for side in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    boxes = np.array([box_of(CAMERA, *place, 1.75) for place in at])
    people = People(boxes, np.full(5, 0.97), np.ones(5), np.zeros(5, bool), boxes)
    scorer: Any = None
    monkeypatch.setattr(ground_confirmation, "detect_people", lambda *given: [people])
    picture = GroundPicture("ugv1", 4, np.zeros((480, 640, 3), np.uint8), replace(CAMERA, heading_rad=HEADING))
    positions = Positions(np.array([4]), np.array([2]), np.array([-30.0 * ahead]), np.eye(2)[None], np.ones(1))
    nowhere, row, marks = np.full((1, 2), np.nan), np.zeros(1, np.int64), LandmarkObservations()
    box_px, fix = np.zeros((1, 4)), Fix(4, "pose")
    located = AerialLocations(4, 0.3, positions, row, np.eye(2)[None], nowhere, box_px, fix, marks)
    yes, no, one = np.ones(1, bool), np.zeros(1, bool), np.ones(1)
    missing = Prediction(
        *(np.array([1]), np.array([12.5 * ahead + 0.5 * right]), np.zeros((1, 2)), 2 * one, 0.99 * one, no, yes),
        *(one, np.array([2]), yes, no),
    )
    for expected, found in ((None, []), (missing, [1])):
        confirmation = GroundConfirmation(Settings(), scorer)
        confirmation.take([picture])
        confirmed, crowds = confirmation.confirm(located, np.full(1, 2.0), expected)
        assert confirmed.kind == ("unseen",) and confirmed.people.tolist() == [0]
        assert crowds.target.tolist() == found
    assert (crowds.people.tolist(), crowds.seen_by.tolist()) == ([5], ["ugv1"])
    np.testing.assert_allclose(crowds.east_north_m[0], 12.0 * ahead, atol=0.5)


def regions(camera, *targets):
    """Of targets (ahead, right, radius) in metres, before a camera at (5, -3)."""
    ahead, stands = np.array([math.sin(HEADING), math.cos(HEADING)]), np.array([5.0, -3.0])
    place = np.array([stands + a * ahead + r * ahead[::-1] * (1, -1) for a, r, _ in targets])
    spread, radius = np.tile(0.04 * np.eye(2), (len(targets), 1, 1)), np.array([r for *_, r in targets])
    return expected_regions(place, spread, radius, camera, stands, HEADING, GroundParameters())


def box_of(camera, ahead, right, tall):
    """The box of a body on level ground."""
    u, scale = camera.centre_px[0] + camera.focal_px[0] * right / ahead, camera.focal_px[1] / ahead
    horizon = camera.centre_px[1] - camera.focal_px[1] * math.tan(camera.pitch_rad)
    feet = horizon + scale * camera.height_m
    return u - 0.17 * scale * tall, feet - scale * tall, 0.34 * scale * tall, scale * tall


@pytest.mark.parametrize("pitch", [0.0, 0.03])
@pytest.mark.parametrize(("ahead", "right", "radius"), [(12, 0, 2.0), (8, -3, 1.0), (15, 4, 3.0), (5, 1, 2.5)])
def test_everybody_of_a_target_is_within_its_region_and_of_an_expected_height(ahead, right, radius, pitch):
    camera = replace(CAMERA, pitch_rad=pitch)
    ((left, top, width, height),), ((least, largest),) = regions(camera, (ahead, right, radius))
    for turn, tall in itertools.product(np.linspace(0, 2 * np.pi, 12, endpoint=False), (1.6, 1.9)):
        x, y, w, h = box_of(camera, ahead + radius * math.cos(turn), right + radius * math.sin(turn), tall)
        assert left <= x and x + w <= left + width and top <= y and y + h <= top + height
        assert least <= h <= largest


def test_a_target_outside_the_view_has_no_region():
    assert not len(regions(CAMERA, (-10, 0, 2.0), (8, 12, 1.0))[0])
