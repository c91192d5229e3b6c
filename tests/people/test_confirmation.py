"""Blobs confirmed by people recognized from the ground."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.config import ConfirmParameters, GroundParameters, PeopleParameters
from torchvision_dddas.people.confirmation import (
    Beliefs,
    GroundObservation,
    View,
    evidence,
    field_of_view,
    observe_ground,
    observe_picture,
)
from torchvision_dddas.types import Camera

KNOBS = ConfirmParameters(spread_m=0.0)
NORTH = View(np.zeros(2), 0.0, math.radians(30), 2.0, 20.0)


def square(sigma_m, n):
    return np.tile(sigma_m**2 * np.eye(2), (n, 1, 1))


def seen(blobs, people=(), views=(NORTH,), parameters=KNOBS, blob_sigma=0.3, person_sigma=0.1, score=None):
    blobs, people = np.reshape(blobs, (-1, 2)).astype(float), np.reshape(people, (-1, 2)).astype(float)
    score = np.ones(len(people)) if score is None else np.array(score)
    return observe_ground(
        blobs, square(blob_sigma, len(blobs)), people, square(person_sigma, len(people)), score, views, parameters
    )


def test_a_person_inside_the_gate_is_at_the_blob_and_the_distance_is_kept():
    found = seen([0, 10], [0.3, 10.4])
    assert (found.looked.tolist(), found.people.tolist(), found.best.tolist()) == ([True], [1], [1.0])
    assert found.nearest_m[0] == pytest.approx(0.5)
    assert found.nearest_sigmas[0] == pytest.approx(0.5 / math.hypot(0.3, 0.1))


@pytest.mark.parametrize(
    "blob",
    [(0, 1.5), (0, 30), (0, -10), (8, 10), (0, 2.3), (0, 19.7)],
    ids=["near", "far", "behind", "side", "2", "20"],
)
def test_a_blob_outside_the_view_or_at_its_edge_is_unseen(blob):
    assert not seen(blob).looked[0]


def test_a_blob_behind_another_is_hidden_and_one_beside_it_is_not():
    assert seen([[0, 5], [0, 10]]).looked.tolist() == [True, False]
    assert seen([[-1, 5], [1, 10]]).looked.tolist() == [True, True]
    assert seen([[0, 10]], [[0, 5]]).looked.tolist() == [False]


def test_a_person_between_two_blobs_is_at_one_and_leaves_the_other_in_doubt_and_crowds_are_counted():
    people = [[0.2, 10], [-0.3, 10.1], [0.1, 9.8], [5, 12]]
    found = seen([[0, 10], [5, 12]], people, score=[0.6, 0.9, 0.7, 0.8])
    assert (found.people.tolist(), found.best.tolist()) == ([3, 1], [0.9, 0.8])
    found = seen([[0, 10], [0.8, 10]], [0.2, 10])
    assert (found.people.tolist(), found.looked.tolist()) == ([1, 0], [True, False])


@given(st.floats(-math.pi, math.pi), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
@settings(max_examples=50, deadline=None)
def test_nothing_changes_when_the_whole_scene_is_turned_and_moved(angle, east, north):
    rng = np.random.default_rng(3)
    blobs, people = rng.uniform((-6, 1), (6, 22), (12, 2)), rng.uniform((-6, 1), (6, 22), (6, 2))
    first = seen(blobs, people)
    # Clockwise, as headings go.
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    view = View(np.array([east, north]), angle, NORTH.half_rad, NORTH.near_m, NORTH.far_m)
    second = seen(blobs @ turn.T + (east, north), people @ turn.T + (east, north), views=[view])
    np.testing.assert_array_equal(first.looked, second.looked)
    np.testing.assert_array_equal(first.people, second.people)
    np.testing.assert_allclose(first.nearest_sigmas, second.nearest_sigmas, atol=1e-6)


def test_a_cameras_view_reaches_as_far_as_bodies_are_large_enough():
    camera = Camera("ugv", (800, 600), (1000.0, 1000.0), (399.5, 299.5))
    view = field_of_view(
        camera, np.zeros(2), 0.0, PeopleParameters(enlarge=1.0, height_share=0.75), GroundParameters(body_height_m=1.8)
    )
    assert view.far_m == pytest.approx(1000 * 1.8 / 96)
    assert view.near_m == pytest.approx(3.0)
    assert view.half_rad == pytest.approx(math.atan(0.4))
    twice = PeopleParameters(enlarge=2.0, scale_step=2**0.25, height_share=0.75)  # whole steps to twice the size
    closer = field_of_view(camera, np.zeros(2), 0.0, twice, GroundParameters(body_height_m=1.8))
    assert closer.far_m == pytest.approx(2 * view.far_m)


def one(looked, people=0, best=0.0):
    nothing = np.full(1, np.nan)
    return GroundObservation(np.array([looked]), np.array([people]), nothing, nothing, np.array([best]))


def test_a_look_weighs_as_bayes_says():
    parameters = ConfirmParameters(detection_rate=0.8, false_rate=0.1, prior=0.25)
    beliefs = Beliefs(parameters)
    beliefs.add(["blob"], [("ugv", one(True, 1, 1.0))])
    assert beliefs.probability("blob") == pytest.approx(0.25 * 0.8 / (0.25 * 0.8 + 0.75 * 0.1))
    assert evidence(one(True), parameters)[0] == pytest.approx(math.log(0.2 / 0.9))
    assert evidence(one(False), parameters)[0] == 0
    beliefs.add(["other"], [("ugv", one(False))])
    assert beliefs.kind("other") == "unseen" and beliefs.probability("other") == pytest.approx(0.25)


def test_one_chance_hit_makes_no_crowd_of_a_car():
    person, car, crowd = [[0, 0, 50, 130]], [[0, 0, 400, 130]], [[0, 0, 400, 130]]
    one_hit, many = [[5, 5, 45, 120.0]], [[x, 5, 45, 120.0] for x in range(5, 350, 80)]

    def weight(blob, people):
        found = observe_picture(np.array(blob, float), np.array(people), np.full(len(people), 0.8), KNOBS)
        return evidence(found, KNOBS)[0]

    assert weight(person, one_hit) > 0.5
    assert weight(car, one_hit) < 0
    assert weight(crowd, many) > 0
    assert weight(car, np.zeros((0, 4))) < weight(person, np.zeros((0, 4)))


def test_boxes_are_confirmed_by_the_people_they_share():
    blobs = np.array([[100, 100, 60, 130], [300, 100, 60, 130], [500, 150, 30, 40], [0, 0, 200, 20.0]])
    people = np.array([[110, 95, 40, 120], [500, 120, 40, 110.0], [330, 400, 40, 100]])
    found = observe_picture(blobs, people, np.array([0.9, 0.6, 0.8]), KNOBS, least_px=96)
    assert found.people.tolist() == [1, 0, 1, 0]
    # The second is tall enough for a person to have been found in it, the last is not.
    assert found.looked.tolist() == [True, True, True, False]
    assert found.best.tolist() == [0.9, 0, 0.6, 0]


@pytest.mark.parametrize("which", ["blobs", "people", "both"])
def test_nothing_to_compare_is_fine(which):
    blobs = np.zeros((0, 2)) if which != "people" else np.array([[0, 10.0]])
    people = np.zeros((0, 2)) if which != "blobs" else np.array([[0, 10.0]])
    assert len(seen(blobs, people).looked) == len(blobs)
    boxes = observe_picture(np.zeros((len(blobs), 4)), np.zeros((len(people), 4)), np.ones(len(people)), KNOBS)
    assert len(boxes.people) == len(blobs)
